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
# # First steps
#
# A machine that repeats one motion makes nearly the same error every time. *Iterative learning
# control* (ILC) keeps the input of the last trial and corrects it by what went wrong:
#
# $$u_{j+1}[k] = u_j[k] + \text{(learning law of } e_j), \qquad e_j[k] = r[k] - y_j[k]$$
#
# with $k$ the sample, $j$ the trial, $r$ the reference, $y$ the measured output, $u$ the input.
# `u[k]` acts on `y[k+1]`.
#
# One plant, one scheme, ten lines: a voice-coil motor that moves a turning tool by 1 mm at 0.5 Hz
# (Cao 2019), under model-free adaptive ILC. Lengths are in mm, the input in volts.

# %%
import dataclasses

import jax
import jax.numpy as jnp
import numpy as np

import jaxilc
from jaxilc import Machine, Task, figures, learn, plants, schemes
from jaxilc.signals import references

# %matplotlib inline
# ruff: noqa: B018
jaxilc.setup()  # float64, all cores; before anything else uses JAX

# %%
reference = references.sinusoid(1.0, 0.5, duration=2.0, dt=1e-3)
task = Task(reference, dt=1e-3, unit="mm", input_unit="V")
machine = Machine(plants.voice_coil())
scheme = schemes.CFDLMFAILC(lam=1.0, eta=0.9, mu=1.0, rho=1.0, phi0=-0.0682, reset="sign")
history = learn(machine, scheme, task, trials=30)
for trial in (1, 2, 5, 10, 20, 30):
    print(
        f"trial {trial:2d}: largest error in the second half of the trial "
        f"{1e3 * history.settled_error[trial - 1, 0]:7.1f} µm"
    )
assert history.settled_error[29, 0] < 0.01 * history.settled_error[0, 0]

# %% [markdown]
# The first trial plays no input, so its error is the whole millimetre. Each later trial plays what
# was learned from the trial before.
#
# `history` holds the metrics of every trial (`settled_error`, `max_error`, `rms`, `effort`), the
# last trial's signals (`history.final`) and what the scheme has learned (`history.memory`, from
# which learning can continue).

# %%
dataset, _ = jaxilc.run_schemes(machine, {"cfdl-mfailc": scheme}, task, 30)
axes = figures.tracking(dataset, "cfdl-mfailc", (2, 10, 30), scale=1e3, unit="µm")
axes[0, 0].figure

# %% [markdown]
# ## Another weight
#
# Every weight is a field. A variant is a copy with another value, checked like a construction:
# `lam=-1` is refused, with the range allowed.

# %%
variants = {f"lam = {lam:g}": dataclasses.replace(scheme, lam=lam) for lam in (0.3, 1.0, 3.0)}
compared, _ = jaxilc.run_schemes(machine, variants, task, 30)
by_lam = np.asarray(compared["settled_error"])[..., 0]
assert np.all(np.diff(by_lam[:, 1]) > 0)  # the smaller lam, the less error in trial 2
assert by_lam[0, 29] > 10 * by_lam[0, 0]  # but lam = 0.3 has grown long since
ax = figures.error_by_trial(compared, scale=1e3, unit="µm")
ax.figure

# %%
try:
    dataclasses.replace(scheme, lam=-1.0)
except ValueError as error:
    print(error)

# %% [markdown]
# A small `lam` learns fast. On this motor and motion, however, the error of every such law grows
# again after enough trials, and a smaller `lam` makes this happen earlier. Notebook 05 explains
# why, and how to know it beforehand.
#
# ## Many machines, and gradients
#
# Machine and scheme are JAX pytrees: `jax.vmap` runs many, `jax.grad` goes through all trials.


# %%
def last_error(gain, lam):
    motor = Machine(dataclasses.replace(plants.voice_coil(), gain=gain))
    return learn(motor, dataclasses.replace(scheme, lam=lam), task, 10).rms[-1, 0]


gains = machine.plant.gain * jnp.linspace(0.8, 1.2, 5)
print(
    "RMS error of trial 10, gain of the motor -20 % to +20 % [µm]:",
    1e3 * jax.vmap(last_error, (0, None))(gains, 1.0),
)
value, slope = jax.value_and_grad(last_error, argnums=1)(machine.plant.gain, 1.0)
print(f"RMS error of trial 10: {1e3 * value:.2f} µm, its slope by lam: {1e3 * slope:.2f} µm")
assert slope > 0  # a smaller lam learns faster, here

# %% [markdown]
# On the command line, the same machine: `jaxilc run cao-2019 --scheme cfdl-mfailc --trials 30`.
