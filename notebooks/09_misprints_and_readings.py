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
# # The papers' misprints and readings
#
# This page lists what does not fit together in the printed text of five papers. Each entry says how
# it is read here; where it takes little time, the number is computed again. What was *chosen*
# because a paper does not print it is listed by `jaxilc.scenarios.load(name).chosen`, at the end of
# this page.

# %%
import control
import numpy as np
import scipy.signal

import jaxilc
from jaxilc.plants import voice_coil

jaxilc.setup()


def coefficients(form):
    """Of a printed difference equation of the motor."""
    plant = voice_coil(form).sampled(1e-3)
    return {"a": np.ravel(plant.a), "b": np.ravel(plant.b)}


EQ_29, EQ_24 = coefficients("printed"), coefficients("dai_2014_printed")


def dc_gain(a, b):
    """Of y(k) = a1 y(k-1) + ... + b1 u(k-1) + ..."""
    return np.sum(b) / (1 - np.sum(a))


# %% [markdown]
# ## Cao 2019: voice-coil motor
#
# **Equations 7 and 29 are not the same motor.** The identified model is $G(s) = 7437.7769\,(s -
# 928.2)/((s+474)^2(s+6.404))$; the difference equation is its zero-order hold at 1 ms, rounded. The
# rounding moves the DC gain by a tenth, since $1 - \sum a$ is a difference of near numbers, and
# splits the double pole in two. Both forms are kept: `exact` and `printed`.

# %%
G = control.zpk([928.2], [-474.0, -474.0, -6.404], 7437.7769)
sampled = control.sample_system(control.ss(G), 1e-3, method="zoh")
num, den = (np.squeeze(x) for x in control.tfdata(control.tf(sampled)))
exact = {"a": -den[1:], "b": num[-3:]}
for name, form in {"exact": exact, "eq. 29": EQ_29}.items():
    a, b = np.asarray(form["a"]), np.asarray(form["b"])
    print(
        f"{name:7s} a = {np.round(a, 6)}, b = {np.round(b, 6)}, DC gain {dc_gain(a, b):.4f}, "
        f"poles {np.round(np.roots(np.r_[1, -a]), 5)}"
    )
print(
    f"DC gain of eq. 7: {float(np.real(G(0))):.4f} mm/V; first sample of the step response: "
    f"{num[-3]:+.6f} mm/V"
)
assert abs(dc_gain(**exact) - float(np.real(G(0)))) < 1e-3
assert abs(dc_gain(**EQ_29) + 4.3) < 1e-6

# %% [markdown]
# The first sample of the step response is positive and the DC gain negative. So the sign of the
# pseudo partial derivative depends on the sample. $\hat\varphi(\cdot, 1)$ is not printed, and with
# a positive value learning diverges.
#
# **Equation 15** prints the contraction as $|\rho\varphi\hat\varphi/(\lambda + \hat\varphi^2)|$; a
# "1 −" is missing. On the static plant $y[k+1] = \varphi u[k]$ one trial decides which is right:

# %%
phi, estimate, lam, rho, e = 0.8, 0.5, 1.0, 1.0, 1.0
gain = rho * estimate / (lam + estimate**2)
after = e - phi * gain * e
print(
    f"|e_j / e_j-1| = {abs(after / e):.4f};  with '1 -': {abs(1 - gain * phi):.4f};  as printed: "
    f"{abs(gain * phi):.4f}"
)
assert np.isclose(abs(after / e), abs(1 - gain * phi))

# %% [markdown]
# **No reset is printed.** The theory's book has one, of three clauses, and Dai 2014 (eq. 12) prints
# it. The clause on a small $|\Delta u|$ can cause bursts; of the two readings of the paper
# `amplitude` uses the clause on the sign only (`reset="sign"`), and `stroke`, which is judged,
# none.
#
# **Table 2** prints 0.3 Hz three times; 0.3, 0.4 and 0.5 Hz are meant, the errors rise with the
# frequency. The denominator of $G(z)$ prints $z$ where $z^2$ is meant.
#
# **PID** is printed without its form. In position form with $K_i$ multiplied by the sample time it
# gives 22 µm for the printed 23 to 30 µm, for a sine of amplitude 1 mm (reading: amplitude).

# %%
cao = jaxilc.scenarios.load("cao-2019", reading="amplitude")
pid = 1e3 * jaxilc.learn(cao.machine, cao.schemes["pid"], cao.task, 1).settled_error[0, 0]
print(f"PID: {pid:.1f} µm")
assert round(float(pid)) == 22

# %% [markdown]
# ## Dai 2014: predictive control of the same motor
#
# **Equation 24** prints 2.236 for 2.2386. With this digit missing it is another motor:

# %%
for name, form in {"Cao 2019, eq. 29": EQ_29, "Dai 2014, eq. 24": EQ_24}.items():
    print(f"{name}: DC gain {dc_gain(**form):.3f} mm/V")
assert abs(dc_gain(**EQ_24) + 1.19) < 0.01

# %% [markdown]
# **Equation 17** prints $(A_1^T A_1\,\lambda I)^{-1}$; a "+" is missing. With it, one control move
# ($P_u = 1$) gives equation 10 exactly:

# %%
P, lam, phi = 10, 45.0, -0.12
error = np.random.default_rng(0).standard_normal(P)
A1 = np.full((P, 1), phi)
matrix_law = np.linalg.solve(A1.T @ A1 + lam * np.eye(1), A1.T @ error)[0]
scalar_law = phi * np.mean(error) / (phi**2 + lam / P)
print(f"first move by eq. 17 with '+': {matrix_law:.6e}, by eq. 10: {scalar_law:.6e}")
assert np.isclose(matrix_law, scalar_law, rtol=1e-12)

# %% [markdown]
# **PID** prints $K_i = 0.1$ and $0.2$, of the other sign than $K_p = -10$ and $-9$. Both are taken
# as printed: the loops drift, but so slowly that the few seconds of a trial do not show it.
#
# ## Li 2020: CNC axis
#
# **Equation 3** prints a state matrix whose poles are rounding errors away from a double integrator
# with a lag, $(z-1)^2(z-0.85)$, and unstable as they stand:

# %%
A = np.array([[2.85, -1.35, 0.8502], [2.0, 0.0, 0.0], [0.0, 0.5, 0.0]])
print("poles as printed:", np.round(np.sort(np.abs(np.linalg.eigvals(A)))[::-1], 4))
print(
    "characteristic polynomial:",
    np.round(np.poly(A), 4),
    "  (z-1)^2 (z-0.85):",
    np.round(np.poly([1, 1, 0.85]), 4),
)
assert np.max(np.abs(np.poly(A) - np.poly([1, 1, 0.85]))) < 1e-3
assert np.max(np.abs(np.linalg.eigvals(A))) > 1.03

# %% [markdown]
# **The "fourth-order" filter** has three poles: to the digits printed, a *third*-order Butterworth
# by impulse invariance, of 10 Hz at a sample rate of 855 Hz. Its DC gain is not 1.

# %%
a, b = np.array([1, -2.8531, 2.7167, -0.8633]), np.array([0, 0.00018896, 0.00017992])
_, analogue, _ = scipy.signal.butter(3, 2 * np.pi * 0.0117, analog=True, output="zpk")
invariant = np.real(np.poly(np.exp(analogue)))
print("denominator as printed:       ", a)
print("third-order, fc / fs = 0.0117:", np.round(invariant, 4))
print(f"DC gain of the print: {np.sum(b) / np.sum(a):.2f}")
assert np.max(np.abs(a - invariant)) < 3e-4

# %% [markdown]
# **Equation 12**, the switchable filter, prints its first interval three times; cutoffs $w_a, w_b,
# w_a$ on $[0, S_1), [S_1, S_2), [S_2, N]$ are meant.
#
# ## Xu 2024: fast tool servo
#
# **The error changes its sign** between the sections: $e = y - y_d$ in the sliding mode, $y_d - y$
# in the learning law. **The saturation function** is $\sigma/\Delta$ inside the layer and the sign
# outside; the prose has them the wrong way round. **$u_k$ in (25) to (27)** is read as the learned
# part of the input, not the whole. The printed percentages confirm the stroke of 20 µm:

# %%
for name, error, percent in (("ASMC", 987.91, 4.94), ("ILC-ASMC", 268.87, 1.34)):
    print(f"{name}: {error} nm of 20 µm = {error / 20000:.2%}, printed {percent} %")
    assert round(100 * error / 20000, 2) == percent

# %% [markdown]
# ## MILC 2024: flexible ball-screw drive
#
# **Equation 10** prints the motor's acceleration in the table's equation, and **$P_Z$** with
# $c_T + c_M$ where $c_s + c_T$ follows. Two masses with arbitrary numbers, and the transfer
# function from motor to table, decide which is right:

# %%
m_M, m_T, k, c_s, c_T, c_M = 2.0, 3.0, 5e3, 7.0, 11.0, 13.0
A = np.array(
    [
        [0, 0, 1, 0],
        [0, 0, 0, 1],
        [-k / m_M, k / m_M, -(c_M + c_s) / m_M, c_s / m_M],
        [k / m_T, -k / m_T, c_s / m_T, -(c_T + c_s) / m_T],
    ]
)
drive = control.ss(A, [[0], [0], [1 / m_M], [0]], [[1, 0, 0, 0], [0, 1, 0, 0]], 0)
s = 2j * np.pi * 5.0
motor, table = np.squeeze(drive(s))
for name, c in (("c_s + c_T", c_s + c_T), ("c_T + c_M, as printed", c_T + c_M)):
    print(
        f"|P_Z| at 5 Hz with {name}: {abs((c_s * s + k) / (m_T * s**2 + c * s + k)):.5f};  of the "
        f"two masses: {abs(table / motor):.5f}"
    )
assert np.isclose(table / motor, (c_s * s + k) / (m_T * s**2 + (c_s + c_T) * s + k))

# %% [markdown]
# **Appendix A**, the recursion for norm-optimal learning, has errors; it is derived anew in
# `jaxilc.schemes.NormOptimal`, which agrees with the dense form to rounding. **The unit of the
# input** is not printed, and decides how the printed weights act: 12.3 mm/s per volt is fitted.
#
# ## What was chosen, and what was fitted
#
# Each scenario carries the list.

# %%
for name in jaxilc.scenarios.SCENARIOS:
    print(f"\n{name}: {jaxilc.scenarios.load(name).title}")
    for note in jaxilc.scenarios.load(name).chosen:
        print("  -", note)
