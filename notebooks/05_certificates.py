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
# # Certificates: when the bounds hold, and when they do not
#
# For the compact-form law (CFDL-MFAILC; Cao 2019, eq. 12 and 13)
#
# $$u_j = u_{j-1} + \frac{\rho\,\hat\varphi_j}{\lambda + \hat\varphi_j^2}\, e_{j-1}[k+1], \qquad
# \hat\varphi_{j} = \hat\varphi_{j-1} + \frac{\eta\,\Delta u}{\mu + \Delta u^2}\,(\Delta y -
# \hat\varphi_{j-1} \Delta u)$$
#
# the theory promises two contractions: of the estimate's error by $d_1$, and of the tracking error
# by $d_2 \ge |1 - \rho\varphi\hat\varphi/(\lambda + \hat\varphi^2)|$,
# $|e_j[k+1]| \le d_2\,|e_{j-1}[k+1]|$. Here $\varphi$ is the *pseudo partial derivative* in
# $\Delta y[k+1] = \varphi\,\Delta u[k]$, and the premises are that it is bounded, keeps its sign
# and stays away from zero, and $\lambda > b^2/4$ with $b = \max|\varphi|$.
#
# $\varphi$ taken from a run would make $d_2$ the ratio that was observed. `jaxilc` takes it from
# the plant, $\partial y[k+1] / \partial u[k]$ along the trial, and computes $d_2$ before any trial.
# Beside it stands what a run shows, and how much of the plant the theory leaves out: the reaction
# of $y[k+1]$ to inputs before $u[k]$.

# %%
import numpy as np

import jaxilc
from jaxilc import Machine, Task, figures, learn, plants, schemes, theory
from jaxilc.filters import ZeroPhaseButterworth
from jaxilc.signals import references
from jaxilc.uncertainty import draw

# %matplotlib inline
# ruff: noqa: B018
jaxilc.setup()


def report(machine, scheme, task, trials):
    found = learn(machine, scheme, task, trials, watch=theory.BoundsWatch()).watched
    print(f"phi of the plant between {found['ppd_low']:.4g} and {found['ppd_high']:.4g}")
    print(f"left out by the theory: {found['left_out']:.4%} of the variance")
    print(f"d2 = {found['d2']:.5g}, {'claimed' if found['claimed'] == 1 else 'not claimed'}")
    for name in ("linear", "alone", "signs", "damped", "printed"):
        print(f"    {'held  ' if found[name] == 1 else 'broken'} {theory.bounds.OF_MACHINES[name]}")
    for name in ("share_lipschitz", "share_sign", "share_excited", "share_kept"):
        print(f"    {np.nanmean(found[name]):7.2%} {theory.bounds.OF_TRIALS[name]}")
    return found


# %% [markdown]
# ## Where they hold: a static plant
#
# $y[k+1] = 0.8\,u[k]$. Every premise holds, $\varphi = 0.8$ everywhere, and the error of each
# sample falls by $d_2$ or more in every trial.

# %%
task = Task(
    references.sinusoid(1.0, 2.0, duration=0.5, dt=1e-3), dt=1e-3, unit="mm", input_unit="V"
)
static = Machine(plants.DifferenceEquation(a=(0.0,), b=(0.8,), dt=1e-3))
scheme = schemes.CFDLMFAILC(lam=1.0, eta=0.9, mu=1.0, rho=1.0, phi0=0.5, reset="sign")
holding = report(static, scheme, task, 15)
assert holding["claimed"] == 1
assert np.nanmin(holding["share_kept"]) == 1
assert np.nanmax(holding["contraction_worst"]) > 0.99 * holding["d2"]  # it is not careful either

# %% [markdown]
# ## Where they do not: a motor
#
# On the voice-coil motor of eq. 7 (reading: amplitude) $y[k+1]$ hardly depends on $u[k]$: nearly
# all of it comes from earlier inputs of the trial. Nothing is claimed, although the error falls in
# each of these trials. (The first sample of the motor's answer is positive, and its start value
# `phi0` is negative, as the answer in the long run is.)

# %%
of = {"reading": "amplitude", "plant": "exact", "frequency": 2.0}  # 500 samples
motor = jaxilc.scenarios.load("cao-2019", **of)
cfdl = motor.schemes["cfdl-mfailc"]
broken = report(motor.machine, cfdl, motor.task, 20)
assert broken["claimed"] == 0
assert broken["left_out"] > 0.99

# %% [markdown]
# The full form with windows of 2 outputs and 2 inputs sees nearly all of the motor, and with 3 and
# 3 all of it. The paper bounds its pseudo gradient, and proves nothing of its error.

# %%
for L_y, L_u in ((0, 1), (0, 2), (1, 1), (2, 2), (3, 3)):
    seen = theory.pseudo_gradient_of(motor.machine, motor.task, L_y=L_y, L_u=L_u)
    print(f"L_y = {L_y}, L_u = {L_u}: {np.sum(seen.rest) / np.sum(seen.total):9.2e} left out")
assert np.sum(seen.rest) < 1e-9 * np.sum(seen.total)

# %% [markdown]
# ## What does decide
#
# Frozen at its start value, the law is P-type with $\gamma = \rho\hat\varphi/(\lambda +
# \hat\varphi^2)$ and linear, $e_{j+1} = (I - G L)\,e_j$, and its largest singular value tells
# whether the error falls in *every* trial; in the frequency domain, whether $|1 - \gamma z P(z)| <
# 1$ at every frequency. On a plant with a lag this does not hold at all frequencies: beyond the
# first crossing, errors grow by up to 0.8 % a trial.

# %%
phi0, lam, rho = (float(np.squeeze(v)) for v in (cfdl.phi0, cfdl.lam, cfdl.rho))
p_type = schemes.PIDType(gamma_p=rho * phi0 / (lam + phi0**2))
test = theory.frequency.learning_condition(motor.machine, p_type, motor.task)
print(
    f"sup |1 - gamma z P| = {test.condition.value:.4f}; crosses 1 at {test.critical:.1f} Hz; "
    f"verdict: {test.condition.verdict}"
)

# %% [markdown]
# So the error falls, turns, and grows: it *semi-converges*. `certify` answers two questions for
# each of many machines. The claim about the long run holds for any number of trials; nothing is
# claimed where no theorem applies, as for a law that adapts. The error within $J$ trials is
# predicted from theory alone, and compared with simulation. The example is small, with 4 machines
# and 120 trials: first the adaptive law, then the P-type law as which it starts.

# %%
names = {name: motor.uncertainty[name] for name in ("plant.gain", "plant.poles[2]")}
drawn = draw(motor.machine, names, 4)
certificates = {}
for name, scheme in {"CFDL-MFAILC": cfdl, "P-type": p_type}.items():
    found = certificates[name] = theory.certify(
        motor.machine, scheme, motor.task, 120, names, drawn
    )
    print(f"{name}: {found.claim[0]}, since {found.reason[0]}")
    print("    turning trial predicted", found.turning, "observed", found.observed_turning)
    assert len(found.broken_promises()) == 0  # no claim was contradicted
adaptive, frozen = (certificates[name].observed_turning for name in ("CFDL-MFAILC", "P-type"))
np.testing.assert_array_equal(certificates["P-type"].turning, frozen)
assert 20 <= np.median(frozen - adaptive) <= 40
axes = figures.certificate(
    certificates["CFDL-MFAILC"],
    scale=1e3,
    unit="µm",
    title="CFDL-MFAILC on the voice-coil motor at 2 Hz",
)
axes[0].figure

# %% [markdown]
# For the linear law the prediction is exact. The adaptive law moves its estimates, so nothing is
# claimed of it. Here its error starts to grow 33 to 42 trials earlier than that of the frozen
# law. (At the paper's own 0.5 Hz the two differ by three trials of eighty.)

# %% [markdown]
# ## The cure, certified
#
# A low-pass filter $Q$ on what is learned, with its cutoff below the crossing, makes
# $|Q(1 - \gamma z P)| < 1$ again. What is learned then comes nearer to its limit in every trial.
# The disadvantage is that nothing is learned above the cutoff, so that an error remains. Other
# solutions are a leak or a stop rule (notebook 08).

# %%
tests = {"without a filter": test}
for cutoff in (10.0, 30.0):
    filtered = schemes.Filtered(p_type, ZeroPhaseButterworth(cutoff))
    tests[f"Q of {cutoff:g} Hz"] = found = theory.frequency.learning_condition(
        motor.machine, filtered, motor.task
    )
    print(
        f"cutoff {cutoff:5.0f} Hz: sup |Q (1 - gamma z P)| = {found.condition.value:.4f}; "
        f"verdict: {found.condition.verdict}"
    )
assert tests["Q of 10 Hz"].condition.holds
assert tests["Q of 30 Hz"].condition.value > 1
certified = theory.certify(
    motor.machine,
    schemes.Filtered(p_type, ZeroPhaseButterworth(10.0)),
    motor.task,
    120,
    names,
    drawn,
)
print(f"cutoff 10 Hz: {', '.join(np.unique(certified.claim))}; {certified.reason[0]}")
print(
    "    error left [µm]",
    np.round(1e3 * certified.floor, 2),
    "after 120 trials",
    np.round(1e3 * certified.simulated[:, -1], 2),
)
assert len(certified.broken_promises()) == 0
assert "not claimed" not in certified.claim
axes = figures.frequency_tests(tests)
axes[0].figure

# %% [markdown]
# With a cutoff of 30 Hz the value is still a little above 1, at 6 to 8 Hz. With 10 Hz it is below 1
# at every frequency.

# %% [markdown]
# "$\lambda > b^2/4$ guarantees convergence" is not a design rule for a feed drive;
# $|Q(1 - \gamma z P)| < 1$ is.
# On the command line: `jaxilc certify cao-2019 --scheme cfdl-mfailc --trials 200`.
