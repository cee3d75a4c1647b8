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
# # Coming from IterativeLearningControl2.jl, Simulink or gILC
#
# Their examples, line by line, with their numbers. `jaxilc reproduce double-mass pendulum` judges
# all of these numbers; here the same is written out, so that you see which object takes the place
# of which.
#
# | there | here |
# |---|---|
# | `ILCProblem(r, Gr, Gu)` | `Task(r, dt)` and a `Machine` |
# | `actual` of `ilc`, the plant in Simulink, `plant.py` of gILC | the machine |
# | `Gu` of the problem, the model of the block, `f` and `h` of gILC | `model` of the scheme |
# | `HeuristicILC(Q, L, :input)` | `Filtered(learning_filter(L), ZeroPhaseIIR(b, a))`, Q = b / a |
# | `HeuristicILC(Q, L, :ref)` | the same in `OnReference`, or on a model of the closed loop |
# | `OptimizationILC(ρ, λ)`, norm-optimal in Simulink | `NormOptimal(model, w_s=ρ, w_r=λ)` |
# | `ConstrainedILC(Q, R, A, Y, α)` | `ConstrainedNormOptimal`, `step` = α / 2 |
# | `GradientILC(β)`, gradient in Simulink | `GradientILC(model, step=β)` |
# | `ModelFreeILC(α, β)` | `ModelFreeGradient(step=β, amplitude=α, about="mean")` |
# | model-free (Arimoto) in Simulink | `PIDType(gamma_p, gamma_d)` in `Filtered` |
# | inverse model in Simulink | `learning_filter(stable_inverse(P), gain=γ)` |
# | `estimation` and `control` of gILC | `TwoStep(model, ...)` |
# | `ilc(prob, alg; iters, actual)` | `learn(machine, scheme, task, trials)` |

# %%
import control
import jax
import jax.numpy as jnp
import numpy as np

import jaxilc
from jaxilc import Disturbance, Machine, Sweep, Task, Uniform, figures, learn, scenarios
from jaxilc.filters import ZeroPhaseButterworth, stable_inverse
from jaxilc.plants import Pendulum, StateSpace, from_control, motion
from jaxilc.schemes import (
    ConstrainedNormOptimal,
    Filtered,
    GradientILC,
    ModelFreeGradient,
    NormOptimal,
    PIDType,
    TwoStep,
    learning_filter,
)

# %matplotlib inline
# ruff: noqa: B018
jaxilc.setup()


def norm(trial):
    """What these packages print of a trial; `learn` keeps it of each in `saved`."""
    return jnp.linalg.norm(trial.e)


# %% [markdown]
# ## IterativeLearningControl2.jl: two masses on a spring
#
# Its test suite has the plant with a load of 1.5, the model with a load of 1, a PID controller, and
# closed loops that are sampled at 20 ms. python-control builds them as ControlSystems.jl does.

# %%
Ts = 0.02


def double_mass(load, k=100.0, c=1.0):
    A = [
        [0, 1, 0, 0],
        [-k, -2 * c, k, c],
        [0, 0, 0, 1],
        [k / load, c / load, -k / load, -2 * c / load],
    ]
    return control.ss(A, [[0], [1], [0], [0]], [[1, 0, 0, 0]], 0)


def closed_loops(load):
    """The loop from the reference and that from the input of the plant, sampled."""
    G = double_mass(load)
    C = control.ss(control.tf([10, 20, 10], [0.02, 1, 0]))  # 10 (1 + 1/s) (s + 1) / (0.02 s + 1)
    continuous = control.feedback(G * C), control.feedback(G, C)
    return [from_control(control.c2d(loop, Ts)) for loop in continuous]


Gr, Gu = closed_loops(1.0)  # what the laws know
Gr_actual, Gu_actual = closed_loops(1.5)  # what there is

x = np.sin(np.arange(0, 3 * np.pi, Ts))
r = np.sign(x) * ((np.abs(x) + 0.01) ** 0.2 - 0.01**0.2)
task = Task(r, dt=Ts, unit="m", input_unit="N")

# %% [markdown]
# `ilc` there adds the response to the reference and that to the learned input. Here the first is an
# output disturbance that repeats: for a linear loop it is the same.


# %%
def machine_of(Gr, Gu):
    return Machine(Gu, disturbance=Disturbance(output=motion(Gr, task.reference[:-1], Ts)))


actual = machine_of(Gr_actual, Gu_actual)

norm_optimal = NormOptimal(Gu, w_s=1e-5, w_r=1e-4)  # OptimizationILC(; rho = 1e-5, lambda = 1e-4)
gradient = GradientILC(Gu, step=500.0)  # GradientILC(500)
model_free = ModelFreeGradient(step=500.0, amplitude=1.0, about="mean")  # ModelFreeILC(1, 500)

found = {
    "norm-optimal, trial 5": learn(actual, norm_optimal, task, 5, save=norm).saved[-1],
    "gradient, trial 10": learn(actual, gradient, task, 10, save=norm).saved[-1],
    # three experiments a step: the learned input is played in trials 1, 4, 7, ..., 28
    "model-free, step 10": learn(actual, model_free, task, 28, save=norm).saved[-1],
}
printed = (0.5615131021547797, 0.8851911872861579, 0.9347317369952786)
for (name, ours), theirs in zip(found.items(), printed, strict=True):
    print(f"{name:22} ours {ours:.10f}   theirs {theirs:.10f}")
    assert abs(ours / theirs - 1) < 1e-9

# %% [markdown]
# With bounds: `A` and `Y`, functions that add constraints to a JuMP model, are fields here. What is
# solved is the same problem, by an interior point whose steps are Riccati recursions.

# %%
square = Task(np.sign(r), dt=Ts, unit="m", input_unit="N")
exact = Machine(Gu, disturbance=Disturbance(output=motion(Gr, square.reference[:-1], Ts)))
constrained = ConstrainedNormOptimal(
    Gu, w_q=1000.0, w_s=0.001, step=0.5, limit=25.0, y_low=-1.1, y_high=1.1
)
history = learn(exact, constrained, square, 5, save=norm)
print(f"ours {history.saved[-1]:.10f}   theirs 4.4544077312 (OSQP)")
print(f"largest |u|: {jnp.max(jnp.abs(history.final.u)):.6f}")
print(f"trials without a solution: {int(history.memory.unsolved)}")
assert abs(history.saved[-1] / 4.4544077312015835 - 1) < 1e-6

# %% [markdown]
# What comes on top: each of these laws may be batched and differentiated. The gain of the drive is
# known to 40 % only: a sweep over 64 machines shows what that does. A step of 500 is 0.72 of the
# bound of the model; with 1.4 times the gain it is beyond the bound, and the error grows.

# %%
uncertain = {"plant.B": Uniform(0.6, 1.4, relative=True)}
schemes = {"norm-optimal": norm_optimal, "gradient": gradient}
swept = Sweep(actual, schemes, task, 20, uncertain, machines=64).run()
largest = swept["rms"][
    :, int(np.argmax(swept["plant.B"].values))
]  # of the machine of the largest gain
gradient, optimal = (np.asarray(largest.sel(scheme=name)) for name in ("gradient", "norm-optimal"))
assert gradient[19] > 1.5 * gradient[9] > 1.5 * optimal[9]
assert optimal[19] < optimal[0]
figures.error_band(swept, metric="rms", scale=1e3, unit="mm")[0].figure

# %% [markdown]
# And the weights follow from a gradient through all trials, where there they are chosen by hand.


# %%
@jax.jit
@jax.value_and_grad
def final_error(step):
    return learn(actual, GradientILC(Gu, step=step), task, 10, save=norm).saved[-1]


value, slope = final_error(jnp.asarray(500.0))
print(f"norm in trial 10: {value:.6f}, by the step: {slope:.2e}")
assert slope < 0  # a larger step learns faster here; the bound is 2 / |G|^2 = 699

# %% [markdown]
# ## Simulink: the block Iterative Learning Control
#
# The plant of its first example, at 10 ms. The block offers a P-type law with a filter Q, the
# gradient, the inverse of the model, and a norm-optimal law. A step that is too long for the model,
# `GradientILC(P, step=0.2)`, would be refused: its bound is 0.197.

# %%
P = StateSpace([[-0.7, -0.012], [1.0, 0.0]], [[1.0], [0.0]], [[1.0, 0.0]], dt=0.01)
k = np.arange(401)
move = Task(np.sin(2 * np.pi * k / 400), dt=0.01)
laws = {
    "P-type": Filtered(PIDType(gamma_p=0.5), ZeroPhaseButterworth(20.0)),
    "gradient": GradientILC(P),
    "inverse": learning_filter(stable_inverse(P), dt=0.01, gain=0.8),
    "norm-optimal": NormOptimal(P, w_r=0.1),
}
for name, law in laws.items():
    rms = learn(Machine(P), law, move, 6).rms[:, 0]
    print(f"{name:13}", " ".join(f"{value:.2e}" for value in rms))
    assert np.all(np.diff(rms) < 0)

# %% [markdown]
# ## gILC: a pendulum, swung upright
#
# `f` and `h` of gILC are a plant here; the model has other parameters than the machine. `TwoStep`
# estimates a correction of the model's input from each trial (`estimation`), and then finds the
# input that is best for the corrected model within $|u| \le 2$ (`control`). gILC hands both steps
# to IPOPT; here they are Gauss-Newton steps along the motion, linear in the number of samples.

# %%
swing = scenarios.load("pendulum")
model = Pendulum(mass=0.495, damping=0.105)
two_step = TwoStep(model, w_y=1e8, w_alpha=1e-10, w_q=1e8, w_s=1e-10, limit=2.0)
history = learn(Machine(Pendulum(mass=0.5, damping=0.1)), two_step, swing.task, 5, save=norm)
printed = (159.727147, 24.524486, 3.007175, 0.145207, 0.0377695)
for ours, theirs in zip(history.saved, printed, strict=True):
    print(f"ours {ours:14.7f}   theirs {theirs}")
    assert abs(ours / theirs - 1) < 1e-5
print(f"trials that were not solved: {int(history.memory.unsolved)}")
