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
# # Your own plant and your own scheme
#
# Both are classes of a few lines; nothing in the package changes. A plant says where it rests, how
# it steps and what it measures; a scheme says what it remembers and how it learns. `@pytree` makes
# the fields the parameters: checked, batched by `vmap`, differentiated by `grad`.

# %%
import dataclasses
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

import jaxilc
from jaxilc import Machine, Task, Uniform, figures
from jaxilc.plants import Plant
from jaxilc.pytree import leaf, pytree
from jaxilc.schemes import PID, PIDType, Scheme, WithFeedback
from jaxilc.signals import references

# %matplotlib inline
# ruff: noqa: B018
jaxilc.setup()

# %% [markdown]
# ## A plant: a belt-driven axis with friction
#
# $$m\ddot x = K u - d\dot x - F_c \tanh(\dot x / v_s)$$
#
# position $x$ in mm, input in volts. Semi-implicit Euler at the task's sample time is enough here;
# the speed is stepped first.


# %%
@pytree
class BeltAxis(Plant):
    """m dv/dt = K u - d v - F_c tanh(v / v_s), dx/dt = v. Position [mm], input [V]."""

    mass: jax.Array = leaf(default=2.0, interval="(0, inf)")  # [kg]
    force: jax.Array = leaf(default=40.0)  # K [N/V]
    damping: jax.Array = leaf(default=30.0, interval="[0, inf)")  # d [N s/m]
    friction: jax.Array = leaf(default=8.0, interval="[0, inf)")  # F_c [N]
    speed: jax.Array = leaf(default=5.0, interval="(0, inf)")  # v_s [mm/s]

    def initial_state(self):
        return jnp.zeros(2)  # position, speed

    def step(self, x, u, dt):
        force = (
            self.force * u[0]
            - self.damping * 1e-3 * x[1]
            - self.friction * jnp.tanh(x[1] / self.speed)
        )
        v = x[1] + dt * 1e3 * force / self.mass
        return jnp.stack([x[0] + dt * v, v])

    def output(self, x):
        return x[:1]


# %% [markdown]
# ## A scheme: learning with momentum
#
# $$\Delta_{j+1} = \beta\,\Delta_j + \gamma\,e_j[k+1+m], \qquad u_{j+1} = u_j + \Delta_{j+1}$$
#
# The method of the heavy ball, along the trials: an error that persists is corrected faster. The
# memory holds two signals.


# %%
class Ball(NamedTuple):
    u: jax.Array  # (N, n_u), the input to be played: `act` of Scheme plays back the field u
    step: jax.Array  # (N, n_u), the last correction


@pytree
class HeavyBall(Scheme):
    """step' = beta step + gamma e[k+1+m],  u' = u + step'."""

    gamma: jax.Array = leaf(default=0.0)  # [V/mm]
    beta: jax.Array = leaf(default=0.0, interval="[0, 1)")
    lead: int = jaxilc.pytree.static(0, "[0, inf)", whole=True)  # m

    def initial_memory(self, task):
        zero = jnp.zeros((task.N, task.inputs))
        return Ball(zero, zero)

    def learn(self, memory, trial):
        e = jnp.pad(trial.e[1 + self.lead :], ((0, self.lead), (0, 0)))
        step = self.beta * memory.step + self.gamma * e
        return Ball(trial.u + step, step)


# %% [markdown]
# ## They learn
#
# With $\beta = 0$ it must be the package's own P-type law, number for number.

# %%
reference = references.s_curve(
    (0.0, 5.0, 0.0), velocity=80.0, acceleration=2000.0, jerk=1e5, dwell=0.05, dt=1e-3
)
task = Task(reference, dt=1e-3, unit="mm", input_unit="V")
machine, feedback = Machine(BeltAxis()), PID(kp=0.5, kd=0.01)
learning = {
    "P-type": PIDType(gamma_p=0.15, lead=12),
    "heavy ball, beta 0": HeavyBall(gamma=0.15, lead=12),
    "heavy ball, beta 0.4": HeavyBall(gamma=0.15, beta=0.4, lead=12),
}
over_feedback = {name: WithFeedback(scheme, feedback) for name, scheme in learning.items()}
dataset, histories = jaxilc.run_schemes(machine, over_feedback, task, 15)
rms = {name: 1e3 * np.asarray(history.rms)[:, 0] for name, history in histories.items()}
for name, errors in rms.items():
    print(
        f"{name:22s} RMS error, trials 1, 5, 15: {errors[0]:7.1f} {errors[4]:7.2f} "
        f"{errors[14]:7.3f} µm"
    )
np.testing.assert_allclose(rms["heavy ball, beta 0"], rms["P-type"], rtol=1e-9)
assert all(errors[14] < errors[0] / 5 for errors in rms.values())
ax = figures.error_by_trial(dataset, metric="rms", scale=1e3, unit="µm")
ax.figure

# %% [markdown]
# ## They batch
#
# `vmap` over the friction, against the same machines one by one.


# %%
def last_error(friction, beta):
    axis = Machine(BeltAxis(friction=friction))
    return jaxilc.learn(
        axis, WithFeedback(HeavyBall(gamma=0.15, beta=beta, lead=12), feedback), task, 8
    ).rms[-1, 0]


frictions = jnp.linspace(0.0, 20.0, 5)
batched = jax.jit(jax.vmap(last_error, (0, None)))(frictions, 0.4)
one_by_one = [float(last_error(f, 0.4)) for f in frictions]
np.testing.assert_allclose(batched, one_by_one, rtol=1e-9)
print("RMS error of trial 8 by friction [µm]:", np.round(1e3 * np.asarray(batched), 2))

# %% [markdown]
# ## They differentiate
#
# The slope of the last error by $\beta$, through eight trials of your plant under your scheme,
# against finite differences.

# %%
slope = float(jax.grad(last_error, argnums=1)(8.0, 0.2))
h = 1e-5
difference = float((last_error(8.0, 0.2 + h) - last_error(8.0, 0.2 - h)) / (2 * h))
print(
    f"d RMS / d beta = {1e3 * slope:.4f} µm by gradient, {1e3 * difference:.4f} µm by differences"
)
np.testing.assert_allclose(slope, difference, rtol=1e-4)

# %% [markdown]
# ## Everything else works on them
#
# A sweep, for instance, over named numbers of the new plant; `Tuning`, `theory.lifted`,
# `worst_case_search` likewise.

# %%
uncertainty = {"plant.friction": Uniform(4.0, 16.0), "plant.mass": Uniform(0.8, 1.2, relative=True)}
swept = jaxilc.Sweep(
    machine, over_feedback, task, trials=15, uncertainty=uncertainty, machines=64
).run()
for row in jaxilc.summarise(swept, tolerance=0.02, metric="rms"):
    print(
        f"{row.scheme:22s} median {1e3 * row.median[-1]:.2f} µm, worst {1e3 * row.worst[-1]:.2f} "
        f"µm of {swept.sizes['sample']} machines"
    )
    assert row.worst[-1] < row.worst[0] / 4

# %% [markdown]
# A parameter outside its declared range is refused by name:

# %%
try:
    dataclasses.replace(machine.plant, mass=-1.0)
except ValueError as error:
    print(error)
