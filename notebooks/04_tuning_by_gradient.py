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
# # Tuning by gradient
#
# The whole learning process, trial after trial, is one differentiable function of the weights. So the weights can be tuned by descent:
#
# $$\min_w \; \mathrm{risk}\big(J_1(w), \dots, J_S(w)\big), \qquad J_s = \text{objective of learning on machine } s$$
#
# over many uncertain machines at once, and judged on machines that the tuning has never seen.
#
# The example: a feed axis with a lag at 10 Hz and a lightly damped resonance at 64 Hz under PI control, P-type learning with a lead of 12
# samples and a zero-phase low-pass filter $Q$ on what is learned, $u_{j+1} = Q(u_j + \gamma\,e_j[k+13])$. Two numbers to choose: the gain
# $\gamma$ and the cutoff of $Q$. Too low, and little is learned; too high, and the error grows on some of the machines.

# %%
import numpy as np
from matplotlib.figure import Figure

import jaxilc
from jaxilc import Machine, Sensor, Task, Tuning, Uniform, figures, plants, references, schemes
from jaxilc.filters import ZeroPhaseButterworth
from jaxilc.objectives import Final, Growth
from jaxilc.risks import CVaR

# %matplotlib inline
# ruff: noqa: B018
jaxilc.setup()

# %%
reference = references.s_curve((0.0, 1.0, 0.0), velocity=20.0, acceleration=600.0, jerk=3e4, dt=1e-3, duration=0.25)
task = Task(reference, dt=1e-3, unit="mm", input_unit="V")
axis = plants.ProcessModel(gain=1.0, frequencies=(60.0, 400.0), dampings=(0.6, 0.05))  # [rad/s]
machine = Machine(axis, sensor=Sensor(noise=5e-4))
law = schemes.Filtered(schemes.PIDType(gamma_p=0.3, lead=12), ZeroPhaseButterworth(15.0))
scheme = schemes.WithFeedback(law, schemes.PID(kp=0.8, ki=15.0))
print("what can be tuned:", ", ".join(jaxilc.pytree.named_leaves(scheme)))

# %% [markdown]
# Gain and resonance are known to ±20 %. The objective is the logarithm of the last trial's RMS error, with a penalty on growth from
# trial to trial; the risk is the mean of the worst quarter of the machines (CVaR). Adam takes 25 steps; every fifth, machines that it
# has not seen choose the best iterate.

# %%
problem = Tuning(
    machine,
    scheme,
    task,
    trials=12,
    weights={"learning.scheme.gamma_p": (0.05, 2.0), "learning.filter.cutoff": (5.0, 200.0)},
    uncertainty={"plant.gain": Uniform(0.8, 1.2, relative=True), "plant.frequencies[1]": Uniform(0.8, 1.2, relative=True)},
    objective=Final("rms") + 0.5 * Growth("rms"),
    risk=CVaR(0.75),
    samples=16,
    held_out=16,
    steps=25,
    rate=0.2,
)
tuned = problem.run()
print("given:", tuned.start)
print("tuned:", {name: round(value, 3) for name, value in tuned.values.items()})
factor = np.exp(tuned.before - tuned.after)
print(f"held-out loss {tuned.before:.3f} -> {tuned.after:.3f}: the error of the worst quarter divided by {factor:.1f}")
assert tuned.after < tuned.before

# %% [markdown]
# ## How it went
#
# The loss of each step, on the machines of the tuning and on the held-out ones, and the way of the weights.

# %%
top, bottom = Figure(figsize=(7.2, 5.0), layout="constrained", dpi=150).subplots(2, 1, sharex=True)
top.plot(tuned.loss[:, 0], color=figures.COLOURS[0], label="tuning")
held_out = tuned.held_out[:, 0]
looked = np.flatnonzero(np.isfinite(held_out))
top.plot(looked, held_out[looked], "o--", color=figures.COLOURS[1], label="held out")
top.set(ylabel="loss, logarithm of the error")
top.legend()
for (name, values), colour, dash in zip(tuned.weights.items(), figures.COLOURS, figures.DASHES, strict=False):
    bottom.semilogy(values[:, 0], color=colour, linestyle=dash, label=name)
bottom.set(xlabel="step", ylabel="weight")
bottom.legend()
bottom.figure

# %% [markdown]
# ## On machines that nobody has seen
#
# `compare` is a sweep of the given and the tuned scheme over fresh machines, here for twice as many trials as were tuned for: a tuning
# that looks at 12 trials knows nothing of the thirteenth, so look.

# %%
dataset = problem.compare(tuned, trials=24, samples=65)
ax = figures.error_band(dataset, figure="rms", scale=1e3, unit="µm")
ax.figure

# %%
for row in jaxilc.summarise(dataset, tolerance=0.02, figure="rms"):
    median, worst = 1e3 * row.median, 1e3 * row.worst
    print(
        f"{row.scheme:6s} median of trials 12 and 24: {median[11]:.2f}, {median[23]:.2f} µm, worst {worst[11]:.2f}, {worst[23]:.2f} µm, "
        f"within 20 µm at trial 24: {row.yield_share:.0%}"
    )

# %% [markdown]
# A gradient of any figure by any weight, of any machine, is also at hand by itself (notebook 01). On the command line: `jaxilc tune`.
