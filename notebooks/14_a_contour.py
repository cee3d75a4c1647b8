# ---
# jupyter:
#   jupytext:
#     text_representation:
#       extension: .py
#       format_name: percent
#   kernelspec:
#     display_name: Python 3
#     language: python
#     name: python3
# ---

# %% [markdown]
# # A contour
#
# The workpiece shows the error across the path, not the lag along it. `OnContour` lets any law
# learn from the contour error, beside the errors of the axes or in their place. Two axes here have
# different loops, 20 and 35 Hz, as an old machine has them; they follow a butterfly (a NURBS path,
# planned within limits of feed, acceleration and jerk).

# %%
import tempfile
from pathlib import Path

import matplotlib.pyplot as plt

import jaxilc
from jaxilc import Sweep, Uniform, contour_error, learn, load_scenario, summarise
from jaxilc.filters import ZeroPhaseButterworth
from jaxilc.schemes import Filtered, OnContour, PIDType

jaxilc.setup()

# %% [markdown]
# ## The machine and the path, as a plant file

# %%
AXES = """
[plant]
kind = "TwoAxes"
x = { kind = "transfer_function", num = [15790.0], den = [1.0, 176.0, 15790.0] }
y = { kind = "transfer_function", num = [48361.0], den = [1.0, 352.0, 48361.0] }

[task]
dt = 0.002
unit = "mm"

[task.reference]
path = "butterfly"
width = 40.0
feed = 60.0
acceleration = 2000.0
jerk = 1e5
rest = 0.1
"""
with tempfile.TemporaryDirectory() as place:
    file = Path(place, "axes.toml")
    file.write_text(AXES)
    scenario = load_scenario(file)
machine, task = scenario.machine, scenario.task
metrics = {name: quantity.of for name, quantity in scenario.quantities.items()}
print(f"{task.N} samples, metrics {', '.join(metrics)}")

# %% [markdown]
# ## Three laws that differ in the error that they learn from
#
# The same P-type law with a lead and a filter: on each axis by itself, with the contour error
# beside, and with the contour error alone. The last one leaves the lag along the path as it is.

# %%
law = Filtered(PIDType(gamma_p=0.25, lead=3), ZeroPhaseButterworth(30.0))
schemes = {
    "axes": law,
    "contour beside": OnContour(law, own=1.0, contour=1.0),
    "contour in place": OnContour(law, own=0.0, contour=2.0),
}
spread = {f"plant.{axis}.B": Uniform(0.9, 1.1, relative=True) for axis in ("x", "y")}
sweep = Sweep(machine, schemes, task, 6, spread, machines=8, seed=5, quantities=metrics)
dataset = sweep.run()

um = 1e3
TOLERANCE = 0.01
worst = {}
for row in summarise(dataset, tolerance=TOLERANCE, metric="contour_max"):
    of_axes = um * float(dataset["rms"].sel(scheme=row.scheme)[:, -1].max())
    worst[row.scheme] = um * row.worst[-1], of_axes
    print(
        f"{row.scheme:16} contour: {um * row.median[0]:6.1f}, at last {um * row.median[-1]:5.2f}, "
        f"worst {um * row.worst[-1]:5.2f} um; rms of the axes {of_axes:.1f} um; "
        f"within {um * TOLERANCE:g} um: {row.yield_share:.0%}"
    )
assert worst["contour beside"][0] < 0.7 * worst["axes"][0]
assert worst["contour in place"][0] < worst["axes"][0]
assert worst["contour in place"][1] > 10 * worst["contour beside"][1]  # it lags, and may

# %% [markdown]
# ## What the workpiece shows
#
# The contour error along the path, after six trials of the nominal machine.

# %%
fig, ax = plt.subplots(figsize=(7, 3.4))
for name in ("axes", "contour beside"):
    y = learn(machine, schemes[name], task, 6).final.y
    ax.plot(task.time, um * contour_error(y, task.reference, window=64), label=name)
ax.set(xlabel="t [s]", ylabel="contour error [um]")
ax.legend()
