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
# # Which scheme for my machine?
#
# A page of decisions, each with a small simulation on one axis: a lag at 10 Hz, a lightly damped
# resonance at 64 Hz, PI feedback at 1 kHz, a move of 1 mm and back in a quarter of a second. Other
# machines have other numbers; the *order* of the decisions remains.
#
# | question | if so | then |
# |---|---|---|
# | Does the error repeat from trial to trial? | no | improve the feedback; learning cannot help |
# | Does the loop lag? | yes, always | first of all, a learning lead of about the loop's delay |
# | Do you have a model good to the resonance? | yes | norm-optimal learning: a few trials |
# | Is the model rough? | yes | P-type with lead and a filter $Q$, or norm-optimal, large $w_s$ |
# | No model at all? | | P-type, or MFAILC, whose sign of `phi0` must be that of the plant |
# | Does some of the error not repeat? | yes | learn fast first, then slowly, and stop in time |
# | Must convergence be certain? | yes | a filter $Q$ that certifies it (notebook 05) |
# | Is the drive flexible? | yes | learn input and reference together (MILC, notebook 02) |
#
# Whatever you choose: certify it before use (notebook 05), sweep over what you do not know (03),
# and observe the error on the machine (07).

# %%
import dataclasses

import numpy as np
from matplotlib.figure import Figure

import jaxilc
from jaxilc import Disturbance, Machine, Sensor, Task, figures, plants, theory
from jaxilc.filters import ZeroPhaseButterworth
from jaxilc.learning import Keep
from jaxilc.schemes import CFDLMFAILC, PID, Filtered, NormOptimal, PIDType, WithFeedback
from jaxilc.signals import references
from jaxilc.theory import frequency

# %matplotlib inline
# ruff: noqa: B018
jaxilc.setup()

# %%
reference = references.s_curve(
    (0.0, 1.0, 0.0), velocity=20.0, acceleration=600.0, jerk=3e4, dt=1e-3, duration=0.25
)
task = Task(reference, dt=1e-3, unit="mm", input_unit="V")
axis, pid = (
    plants.ProcessModel(gain=1.0, frequencies=(60.0, 400.0), dampings=(0.6, 0.05)),
    PID(kp=0.8, ki=15.0),
)
TRIALS = 60


def machine(noise=0.0, disturbance=0.0, **changed):
    return Machine(
        dataclasses.replace(axis, **changed),
        sensor=Sensor(noise=noise),
        disturbance=Disturbance(input_noise=disturbance),
    )


def errors_of(scheme, on):
    """(TRIALS, N+1) error of every trial [µm]."""
    return (
        1e3
        * np.asarray(jaxilc.learn(on, scheme, task, TRIALS, save=Keep.of({}, "e")).saved["e"])[
            ..., 0
        ]
    )


def rms(scheme, on):
    """(TRIALS,) RMS error [µm]."""
    return np.sqrt(np.mean(errors_of(scheme, on) ** 2, axis=1))


def row(name, errors):
    best = int(np.argmin(errors))
    cells = " ".join(f"{errors[j - 1]:10.3g}" for j in (1, 5, 20, TRIALS))
    print(f"{name:44s} {cells}   best {errors[best]:.3g} at trial {best + 1}")


nominal, other = (
    machine(),
    machine(gain=1.15, frequencies=np.array((60.0, 280.0))),
)  # the resonance at 45 Hz instead of 64
noisy, shaken = machine(noise=2e-3), machine(disturbance=0.3)
p_type = WithFeedback(PIDType(gamma_p=0.5), pid)
lead = WithFeedback(PIDType(gamma_p=0.5, lead=12), pid)
filtered = WithFeedback(Filtered(PIDType(gamma_p=0.5, lead=12), ZeroPhaseButterworth(25.0)), pid)
print(f"{'RMS error [µm] at trial':44s} {1:10d} {5:10d} {20:10d} {TRIALS:10d}")
feedback_only = rms(pid, nominal)
row("feedback only", feedback_only)
assert np.ptp(feedback_only) < 1e-9 * feedback_only[0]  # it repeats exactly, so it can be learned

# %% [markdown]
# ## 1. Lead first
#
# The error of the P-type law without lead falls to a third and then grows far beyond that of trial
# 1: beyond 12 Hz $|1 - \gamma z P| > 1$. Twelve samples of lead move that to 97 Hz, where there is
# little left to amplify: in 60 trials nothing of it is seen. In thousands of trials the error grows
# again, and theory claims that this law diverges. Part 4 adds a filter $Q$, with which it does not.

# %%
without, with_lead = rms(p_type, nominal), rms(lead, nominal)
row("P-type", without)
row("P-type, lead of 12 samples", with_lead)
loop = frequency.linear_loop(
    Machine(axis), pid, task
)  # from what is learned to the output, under feedback
f = np.linspace(0.5, 500.0, 1000)
P, z = np.asarray(frequency.response(loop, f, task.dt))[:, 0, 0], np.exp(2j * np.pi * f * task.dt)
for m in (0, 12):
    gain = np.abs(1 - 0.5 * z ** (1 + m) * P)
    first = f[np.argmax(gain > 1)]
    print(
        f"lead of {m:2d} samples: sup |1 - gamma z^(1+m) P| = {np.max(gain):.4f}, first above 1 "
        f"at {first:.1f} Hz"
    )
assert 0.25 * without[0] < np.min(without) < 0.4 * without[0]
assert without[-1] > 10 * np.min(without)
assert with_lead[-1] < 1e-2 * feedback_only[0]
assert theory.certify(nominal, lead, task, TRIALS).claim[0] == "diverges"

# %% [markdown]
# ## 2. A model saves trials, as long as it is right
#
# Norm-optimal learning minimises $|e_{j+1}|^2_{w_q} + |u_{j+1} - u_j|^2_{w_r} + |u_{j+1}|^2_{w_s}$
# with a model of the closed loop. With the true model five trials are enough. With the resonance at
# 45 Hz instead of 64 and 15 % more gain it diverges, while P-type with lead is hardly affected. A
# larger weight $w_s$ makes it converge, and leaves an error. A larger $w_r$ only slows it: in 60
# trials the error falls, and later it grows all the same.

# %%
model = plants.StateSpace(loop.A, loop.B, loop.C, dt=task.dt)
norm_optimal = WithFeedback(NormOptimal(model, w_q=1.0, w_r=1e-3, w_s=1e-6), pid)
slowed = WithFeedback(NormOptimal(model, w_q=1.0, w_r=1.0, w_s=1e-6), pid)
cautious = WithFeedback(NormOptimal(model, w_q=1.0, w_r=1e-3, w_s=1e-2), pid)
with_model, wrong_model = rms(norm_optimal, nominal), rms(norm_optimal, other)
row("norm-optimal, true model", with_model)
row("norm-optimal, wrong model", wrong_model)
careful = rms(cautious, other)
row("norm-optimal, wrong model, large w_s", careful)
row("norm-optimal, wrong model, large w_r", rms(slowed, other))
lead_other = rms(lead, other)
row("P-type with lead, the same machine", lead_other)
assert with_model[4] < with_lead[4] / 100
assert wrong_model[-1] > 1e3 * wrong_model[0]
assert lead_other[-1] < 1e-2 * lead_other[0]
assert theory.certify(other, cautious, task, TRIALS).claim[0] in ("monotone", "converges")
assert theory.certify(other, slowed, task, TRIALS).claim[0] == "diverges"
assert careful[-1] < 0.06 * careful[0]

# %% [markdown]
# ## 3. No model: check the sign
#
# MFAILC estimates its gain from the trials. With `phi0` of the plant's sign it does what P-type
# with a tuned gain does. With the other sign it diverges, and the reset keeps the wrong sign.

# %%
adaptive = WithFeedback(CFDLMFAILC(phi0=0.5, lam=1.0, lead=12), pid)
right_sign, wrong_sign = (
    rms(adaptive, nominal),
    rms(WithFeedback(CFDLMFAILC(phi0=-0.5, lam=1.0, lead=12), pid), nominal),
)
row("CFDL-MFAILC with lead", right_sign)
row("CFDL-MFAILC with lead, phi0 of the wrong sign", wrong_sign)
assert right_sign[-1] < 1e-2 * right_sign[0]
assert wrong_sign[-1] > wrong_sign[0]

# %% [markdown]
# ## 4. What does not repeat
#
# White noise of 2 µm at the encoder, and a random force on the input. What is new in each trial is
# the spread of the error under feedback alone. Learning copies a share of it into the next trial,
# so the error settles above that spread, and the further above it, the faster the law. Learning at
# half the speed comes nearer to the spread on the machine with the random force, and is not yet
# settled on the noisy one: learn fast first, then slowly. A filter $Q$ of 25 Hz leaves an error of
# its own: what lies above its cutoff is not learned. In return the distance from that error falls
# in each trial, however many are run.

# %%
slow = WithFeedback(PIDType(gamma_p=0.25, lead=12), pid)
floor = {}
for where, on in {"noisy": noisy, "shaken": shaken}.items():
    e = errors_of(pid, on)
    floor["new in each trial", where] = np.sqrt(
        np.mean((e - np.mean(e, axis=0)) ** 2) * TRIALS / (TRIALS - 1)
    )
    for name, scheme in {"slow P-type": slow, "P-type": lead, "norm-optimal": norm_optimal}.items():
        errors = rms(scheme, on)
        floor[name, where] = np.sqrt(np.mean(errors[-15:] ** 2))
        row(f"{name}, {where}", errors)
row("P-type with lead and Q, no noise at all", rms(filtered, nominal))
for key, value in floor.items():
    print(f"RMS over the last 15 trials [µm]: {', '.join(key):28s} {value:.3g}")
for where in ("noisy", "shaken"):
    new, *left = (value for (_, on), value in floor.items() if on == where)
    assert new < min(left) < 1.2 * new
assert [new, *left] == sorted([new, *left])  # of the shaken machine
assert theory.certify(nominal, filtered, task, TRIALS).claim[0] == "monotone"

# %%
ax = Figure(figsize=(7.2, 4.2), layout="constrained", dpi=150).subplots()
curves = {
    "feedback only": feedback_only,
    "P-type": without,
    "P-type, lead": with_lead,
    "norm-optimal, true model": with_model,
    "norm-optimal, wrong model": wrong_model,
    "CFDL-MFAILC, lead": right_sign,
}
for (name, errors), colour, dash in zip(
    curves.items(), figures.COLOURS, figures.DASHES, strict=False
):
    ax.semilogy(np.arange(1, TRIALS + 1), errors, color=colour, linestyle=dash, label=name)
ax.set(xlabel="trial", ylabel="RMS error [µm]", ylim=(5e-3, 1e5))
ax.grid(True, which="both", alpha=0.25)
ax.legend(fontsize="small", ncols=2)
ax.figure

# %% [markdown]
# ## Before the machine
#
# 1. Run the same trial a few times without learning. The part of the error that is new in each run
#    is about the lowest error that learning can reach (`jaxilc potential` tells it from records).
# 2. Choose lead and filter in simulation. Check $|Q(1 - \gamma z P)| < 1$ for every plant within a
#    bound of the nominal one (`theory.frequency.robust_condition`), or for the corners of the
#    uncertainty, drawn machines and the worst one that a search finds (`family_condition`, which
#    proves nothing of the plants between them). `jaxilc certify` says of each drawn machine how
#    learning ends.
# 3. Tune gain and cutoff on many machines (notebook 04).
# 4. Start the campaign with limits on the input (notebook 07), and stop when the error stops
#    falling (`StopWhen`).
