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
# The whole learning process, trial after trial, is one differentiable function of the weights. So
# the weights can be tuned by descent:
#
# $$\min_w \; \mathrm{risk}\big(J_1(w), \dots, J_S(w)\big), \qquad J_s = \text{objective of learning
# on machine } s$$
#
# over many uncertain machines at once, and judged on machines that the tuning has never seen.
#
# The example is a feed axis with a lag at 10 Hz and a lightly damped resonance at 64 Hz under PI
# control, P-type learning with a lead of 12 samples and a zero-phase low-pass filter $Q$ on what is
# learned, $u_{j+1} = Q(u_j + \gamma\,e_j[k+13])$. Two numbers must be chosen: the gain $\gamma$ and
# the cutoff of $Q$. If they are too low, little is learned. If they are too high, the error grows
# on some of the machines.

# %%
import dataclasses
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import scipy.integrate
from matplotlib.figure import Figure

import jaxilc
from jaxilc import Actuator, Machine, Sensor, Task, Tuning, Uniform, figures, plants, schemes
from jaxilc.filters import ZeroPhaseButterworth
from jaxilc.pytree import replaced
from jaxilc.signals import references
from jaxilc.theory import contraction
from jaxilc.tuning.objectives import Final, Growth
from jaxilc.tuning.risks import CVaR

# %matplotlib inline
# ruff: noqa: B018
jaxilc.setup()

# %%
reference = references.s_curve(
    (0.0, 1.0, 0.0), velocity=20.0, acceleration=600.0, jerk=3e4, dt=1e-3, duration=0.25
)
task = Task(reference, dt=1e-3, unit="mm", input_unit="V")
axis = plants.ProcessModel(gain=1.0, frequencies=(60.0, 400.0), dampings=(0.6, 0.05))  # [rad/s]
machine = Machine(axis, sensor=Sensor(noise=5e-4))
law = schemes.Filtered(schemes.PIDType(gamma_p=0.3, lead=12), ZeroPhaseButterworth(15.0))
scheme = schemes.WithFeedback(law, schemes.PID(kp=0.8, ki=15.0))
print("what can be tuned:", ", ".join(jaxilc.pytree.named_leaves(scheme)))

# %% [markdown]
# Gain and resonance are known to ±20 %. The objective is the logarithm of the last trial's RMS
# error, with a penalty on growth from trial to trial. The risk is the mean of the worst quarter of
# the machines (CVaR). Adam takes 25 steps. At every fifth step, machines that it has not seen are
# used to choose the best iterate.

# %%
problem = Tuning(
    machine,
    scheme,
    task,
    trials=12,
    weights={"learning.scheme.gamma_p": (0.05, 2.0), "learning.filter.cutoff": (5.0, 200.0)},
    uncertainty={
        "plant.gain": Uniform(0.8, 1.2, relative=True),
        "plant.frequencies[1]": Uniform(0.8, 1.2, relative=True),
    },
    objective=Final("rms") + 0.5 * Growth("rms"),
    risk=CVaR(0.75),
    machines=16,
    held_out=16,
    steps=25,
    rate=0.2,
)
tuned = problem.run()
print("given:", tuned.start)
print("tuned:", {name: round(value, 3) for name, value in tuned.values.items()})
factor = np.exp(tuned.before - tuned.after)
print(
    f"held-out loss {tuned.before:.3f} -> {tuned.after:.3f}: the error of the worst quarter "
    f"divided by {factor:.1f}"
)
assert tuned.after < tuned.before

# %% [markdown]
# ## How it went
#
# The loss of each step, on the machines of the tuning and on the held-out ones, and the weights.

# %%
top, bottom = Figure(figsize=(7.2, 5.0), layout="constrained", dpi=150).subplots(2, 1, sharex=True)
top.plot(tuned.loss[:, 0], color=figures.COLOURS[0], label="tuning")
held_out = tuned.held_out[:, 0]
looked = np.flatnonzero(np.isfinite(held_out))
top.plot(looked, held_out[looked], "o--", color=figures.COLOURS[1], label="held out")
top.set(ylabel="loss, logarithm of the error")
top.legend()
for (name, values), colour, dash in zip(
    tuned.weights.items(), figures.COLOURS, figures.DASHES, strict=False
):
    bottom.semilogy(values[:, 0], color=colour, linestyle=dash, label=name)
bottom.set(xlabel="step", ylabel="weight")
bottom.legend()
bottom.figure

# %% [markdown]
# ## On machines that the tuning has not seen
#
# `compare` is a sweep of the given and the tuned scheme over the nominal machine and fresh ones.
# Here it runs twice as many trials as the tuning, since a tuning over 12 trials does not see the
# thirteenth.

# %%
dataset = problem.compare(tuned, trials=24, machines=65)
axes = figures.error_band(dataset, metric="rms", scale=1e3, unit="µm")
axes[0].figure

# %%
given, best = jaxilc.summarise(dataset, tolerance=0.02, metric="rms")
for row in (given, best):
    median, worst = 1e3 * row.median, 1e3 * row.worst
    print(
        f"{row.scheme:6s} median of trials 12 and 24: {median[11]:.2f}, {median[23]:.2f} µm, "
        f"worst {worst[11]:.2f}, {worst[23]:.2f} µm, "
        f"within 20 µm at trial 24: {row.yield_share:.0%}"
    )
assert np.all(best.worst[[11, 23]] < given.worst[[11, 23]])

# %% [markdown]
# The gradient of any metric by any weight, of any machine, can also be taken alone (notebook 01).
# On the command line: `jaxilc tune`, and for a budget of effort or of trials `jaxilc pareto`.
#
# ## Where a gradient misleads: resets
#
# The estimators of model-free adaptive schemes reset an estimate to its start value where it is
# useless. The gradient of such a switch is that of the branch taken: it does not see the samples
# that change from one branch to the other when a weight changes. The following test needs no step
# size. Integrated over a range of a weight, the slope must give the change of the loss,
# $\int_a^b J'\,\mathrm{d}\eta = J(b) - J(a)$. Here the weight is the step $\eta$ of the estimator
# of CFDL-MFAILC.

# %%
quiet = Machine(axis)
adaptive = schemes.CFDLMFAILC(phi0=0.3, lam=0.05, mu=0.01, epsilon=0.01, lead=12)


def eighth_trial(eta, reset):
    """Logarithm of the RMS error of the eighth trial."""
    law = schemes.Filtered(
        dataclasses.replace(adaptive, eta=eta, reset=reset), ZeroPhaseButterworth(15.0)
    )
    return jnp.log(jaxilc.learn(quiet, law, task, 8).rms[-1, 0])


etas, missed = np.linspace(0.2, 1.0, 201), {}
for reset in ("sign", "book", "smooth"):
    values, slopes = jax.jit(jax.vmap(jax.value_and_grad(partial(eighth_trial, reset=reset))))(etas)
    change, integral = values[-1] - values[0], scipy.integrate.trapezoid(slopes, etas)
    missed[reset] = abs(change - integral)
    print(
        f"{reset:6s} change {change:+.3f}, integral of the slope {integral:+.3f}, largest slope "
        f"{np.abs(slopes).max():.1f}"
    )
assert missed["sign"] < 1e-3 < missed["smooth"] < 0.01 < 0.05 < missed["book"]

# %% [markdown]
# With `book` the slope gives two fifths of the change; `sign` resets nothing here and is exact.
# `reset="smooth"` blends the two branches over widths of `epsilon`, and its slope gives the whole
# change. It is another scheme, though, and its slope is steeper for a narrower `epsilon`. So tune
# with it, and then judge the weights with the reset that the machine will have.
#
# ## Saturation
#
# A limit has an exact slope, but a sample at the limit contributes nothing to it. The more of the
# trial is saturated, the smaller the gradient is, and it is zero where the whole trial is
# saturated.

# %%
gain, cutoff, lead = "learning.scheme.gamma_p", "learning.filter.cutoff", "learning.scheme.lead"


def limited(gamma, limit):
    """Logarithm of the RMS error of the eighth trial, and its input."""
    history = jaxilc.learn(
        Machine(axis, Actuator(limit=limit)), replaced(scheme, {gain: gamma}), task, 8
    )
    return jnp.log(history.rms[-1, 0]), history.final.u


value_and_slope = jax.jit(jax.value_and_grad(limited, has_aux=True))
slopes = []
for limit in (10.0, 0.8, 0.5, 0.2, 0.05):
    (_, u), slope = value_and_slope(0.3, limit)
    above, below = (value_and_slope(0.3 + h, limit)[0][0] for h in (1e-5, -1e-5))
    share = np.mean(np.abs(u) > 0.999999 * limit)
    slopes.append(abs(slope))
    quotient = (above - below) / 2e-5
    print(
        f"limit {limit:5.2f} V: {share:4.0%} of the samples saturated, slope {slope:+.5f}, "
        f"difference quotient {quotient:+.5f}"
    )
assert np.all(np.diff(slopes) < 0)
assert slopes[-1] < 1e-3 * slopes[0]

# %% [markdown]
# So start inside the limits: from smaller gains, or with wider limits that are then narrowed. An
# `Effort` term keeps the input inside.
#
# ## Long learning
#
# For a linear law $e_{j+1} = M e_j$ with $M = I - GL$, and $\mathrm{d}e_J/\mathrm{d}\gamma = \sum_i
# M^{J-2-i}\,M'\,M^i e_1$: the slope of the last error grows as powers of the learning map do. With
# a lead of 12 samples they fade on this reference; with 4 samples learning is semi-convergent, and
# the slope grows long after the error has stopped falling.

# %%
trials, growth = 60, Figure(figsize=(7.2, 4.2), layout="constrained", dpi=150).subplots()
growing = replaced(scheme, {gain: 0.8, cutoff: 60.0, lead: 4})


@jax.jit
def slope_and_map(gamma, law):
    """The errors of all trials, their slopes by the gain, and the matrix M of one trial."""

    def errors(gamma):
        return jaxilc.learn(
            quiet, replaced(law, {gain: gamma}), task, trials, save=lambda trial: trial.e[1:, 0]
        ).saved

    map_ = contraction.error_map(quiet, law, task)
    return *jax.jvp(errors, (gamma,), (1.0,)), jax.jacfwd(lambda e: map_.f(e)[-1])(map_.at)


for name, law, colour in (
    ("lead 4", growing, figures.COLOURS[1]),
    ("lead 12", replaced(growing, {lead: 12}), figures.COLOURS[0]),
):
    e, slope, M = slope_and_map(0.8, law)
    M = np.asarray(M)
    powers = [np.linalg.norm(np.linalg.matrix_power(M, j), 2) for j in range(trials - 1)]
    lengths = np.linalg.norm(slope, axis=1)
    growth.semilogy(
        np.arange(2, trials + 1), lengths[1:], color=colour, label=f"{name}: |de_j / dγ|"
    )
    growth.semilogy(
        np.arange(2, trials + 1),
        powers,
        color=colour,
        linestyle="--",
        label=f"{name}: largest singular value of $M^{{j-2}}$",
    )
    growth.semilogy(
        np.arange(1, trials + 1),
        np.linalg.norm(e, axis=1),
        color=colour,
        linestyle=":",
        label=f"{name}: |e_j|",
    )
    print(
        f"{name:7s} |de/dγ| of trials 20, 40, 60: {lengths[19]:.3g}, {lengths[39]:.3g}, "
        f"{lengths[59]:.3g}; |M^58| = {powers[-1]:.3g}"
    )
    assert (lengths[59] > lengths[19]) == (name == "lead 4")
growth.set(xlabel="trial j")
growth.legend(fontsize="small")
growth.figure

# %% [markdown]
# There are two remedies, and neither is free. `clip` bounds the slope of each machine, so that one
# that diverges does not determine the step; it keeps the direction. `truncate=K` takes the slope
# through the last $K$ trials alone. These are fewer factors of $M$ and less to compute and store,
# but it is another gradient: the effect of the weight in the trials before counts in the loss only.

# %%
law = replaced(growing, {gain: 0.3})
options = {"weights": [gain], "objective": Final("rms"), "machines": 1, "held_out": 0}
cut = {}
for K in (2, 20):
    problem = Tuning(quiet, law, task, 20, **options, truncate=K)
    cut[K] = float(
        jax.jit(jax.grad(lambda gamma, problem=problem: problem.loss_of(quiet, {gain: gamma})))(0.3)
    )
    print(f"slope through the last {K:2d} of 20 trials: {cut[K]:+.3f}")
assert abs(cut[2]) < 0.5 * abs(cut[20])

# %% [markdown]
# The loss is a logarithm, and so the whole slope here is a moderate number: long learning alone is
# no reason to truncate. Truncate where RAM is short, and only if the truncated slope has the sign
# of the whole one.
