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
# # My reference changed
#
# What iterative learning has learned belongs to one reference: change the motion, and it starts
# anew. Basis functions learn the parameters of a feedforward in place of its samples, and take them
# along. The axis here has a motor and a load on an elastic coupling; its model is 10 % off.

# %%
import matplotlib.pyplot as plt
import numpy as np

import jaxilc
from jaxilc import Machine, Sensor, Task, learn
from jaxilc.plants import StateSpace
from jaxilc.schemes import (
    BasisFunctions,
    NormOptimal,
    OnBasis,
    PIDType,
    PolynomialBasis,
    WarmStart,
    fitted,
    select_basis,
)

jaxilc.setup()

DT = 1e-3
RISE = np.polynomial.Polynomial([0, 0, 0, 0, 0, 126, -420, 540, -315, 70])


def axis(force: float) -> StateSpace:
    """Motor and load on a position loop: input V, output mm. force: N per V"""
    m, load, k, c = 2.0, 0.3, 4.0e4, 12.0
    A = np.zeros((4, 4))
    A[0, 1] = A[2, 3] = 1.0
    A[1] = np.array([-3e4 - k, -30 - c, k, c]) / m
    A[3] = np.array([k, c, -k, -c]) / load
    return StateSpace(A, [[0.0], [1e3 * force / m], [0.0], [0.0]], [[1.0, 0.0, 0.0, 0.0]])


def motion(height: float, move: float, samples: int) -> Task:
    """There and back, at rest at both ends: height in mm, time of a move in s."""
    t = np.arange(samples + 1) * DT
    there = RISE(np.clip((t - 0.05) / move, 0, 1))
    back = RISE(np.clip((t - t[-1] + 0.05 + move) / move, 0, 1))
    return Task(height * (there - back), DT, unit="mm", input_unit="V")


machine = Machine(axis(60.0), sensor=Sensor(noise=1e-4))
model = axis(66.0).sampled(DT)
first, second = motion(5.0, 0.12, 400), motion(-12.0, 0.1, 320)

# %% [markdown]
# ## Learn on one motion, go on with another
#
# The second motion is longer, quicker, goes the other way, and its trial has another length. The
# memory of `BasisFunctions` is five numbers, so `learn(..., memory=...)` simply goes on.

# %%
basis = PolynomialBasis((0, 1, 2, 3, 4))
scheme = BasisFunctions(basis, model)
sample_wise = NormOptimal(model, w_r=1e-3)

on_first = learn(machine, scheme, first, 6)
on_second = learn(machine, scheme, second, 6, memory=on_first.memory)
anew = learn(machine, sample_wise, second, 12)

um = 1e3
names = basis.names(1, 1)
print("theta:", {n: float(f"{x:.4g}") for n, x in zip(names, on_first.memory.theta, strict=True)})
print(f"first trial on the new motion: {um * on_second.rms[0, 0]:.2f} um")
print(f"sample-wise learning: {um * anew.rms[0, 0]:.0f} um, then {um * anew.rms[5, 0]:.2f} um")
assert on_second.rms[0, 0] < 1e-3
assert anew.rms[0, 0] > 1e3 * on_second.rms[0, 0]

fig, ax = plt.subplots(figsize=(7, 3.4))
both = np.concatenate([on_first.rms, on_second.rms])[:, 0]
ax.semilogy(1 + np.arange(12), um * both, "o-", label="basis functions")
ax.semilogy(7 + np.arange(6), um * anew.rms[:6, 0], "s--", label="sample-wise, anew")
ax.axvline(6.5, color="grey", lw=1)
ax.set(xlabel="trial", ylabel="rms error [um]", title="The reference changes after trial 6")
ax.legend()
plt.show()

# %% [markdown]
# ## Any law on a basis, and any law from a basis
#
# `OnBasis` needs no model: what a P-type law learns sample by sample is fitted by the functions.
# `WarmStart` is the other way round: a sample-wise law that starts where the basis has come to, and
# then learns what the functions cannot make. `fitted` takes the parameters from a learned input.

# %%
without_model = OnBasis(PIDType(gamma_p=0.3, lead=2), basis)
learned = learn(machine, without_model, first, 40)
taken = WarmStart(without_model, basis, learned.memory.theta)  # to a trial of another length
moved = learn(machine, taken, second, 1)
theta = fitted(basis, anew.memory.u, second.reference, DT)
warm = learn(machine, WarmStart(sample_wise, basis, theta), first, 1)
print(f"P-type on the basis, first trial of the new motion: {um * moved.rms[0, 0]:.2f} um")
print(f"warm start of norm-optimal learning: {um * warm.rms[0, 0]:.2f} um")
assert moved.rms[0, 0] < 0.01 * anew.rms[0, 0]
assert warm.rms[0, 0] < 1e-3

# %% [markdown]
# ## Which functions matter?
#
# From trials that were learned on several motions, L1 and cross-validation choose: each trial is
# predicted from the others. Here the machine needs position to acceleration, and little else.

# %%
trials = [(t.reference, learn(machine, sample_wise, t, 12).memory.u) for t in (
    first, motion(8.0, 0.12, 400), motion(-3.0, 0.09, 400), motion(15.0, 0.15, 400))]  # fmt: skip
chosen = select_basis(PolynomialBasis((0, 1, 2, 3, 4), coulomb=1.0), trials, dt=DT)
for name, value in zip(chosen.names, chosen.theta, strict=True):
    print(f"{name:14} {value: .4g}")
assert {"position", "acceleration"} <= set(chosen.names)
assert "friction" not in chosen.names
assert len(chosen.names) < 6
