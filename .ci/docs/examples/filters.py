"""Filters without phase, inverses of systems, and how their cutoffs are chosen."""

import numpy as np

import jaxilc
from jaxilc.filters import *
from jaxilc.plants import StateSpace

jaxilc.setup()
dt = 1e-3
P = StateSpace([[0.8]], [[0.2]], [[1.0]], dt=dt)
t = dt * np.arange(501)
mixed = (np.sin(2 * np.pi * 4 * t) + np.sin(2 * np.pi * 200 * t))[:, None]


def left(filter):
    """The largest value of a mixture of 4 Hz and 200 Hz that the filter leaves."""
    return f"{abs(filter(mixed, dt)).max():.2f}"


# %% ZeroPhaseButterworth, ZeroPhaseFIR, ZeroPhaseIIR, ZeroPhaseBandStop
print("of", f"{abs(mixed).max():.2f}", left(ZeroPhaseButterworth(cutoff=50.0)))
print(left(ZeroPhaseFIR((0.5, 0.25))), left(ZeroPhaseIIR((0.2, 0.0), (1.0, -0.8))))
print(left(ZeroPhaseBandStop(low=150.0, high=260.0)))
# of 1.95 1.00
# 1.62 1.02
# 1.00

# %% SwitchableFilter
print(left(SwitchableFilter(cutoff=(50.0, 300.0), times=(0.25,), width=0.02)))
# 1.88

# %% segments
print(type(segments(mixed, dt, cutoffs=(50.0, 300.0), threshold=100.0, shortest=0.02)).__name__)
# SwitchableFilter

# %% Filter
print([isinstance(one, Filter) for one in (ZeroPhaseFIR(), ZeroPhaseButterworth(50.0))])
# [True, True]

# %% stable_inverse, StableInverse
inverse_of_P = stable_inverse(P)
print(type(inverse_of_P).__name__, f"{np.ravel(inverse_of_P(mixed, dt))[1]:.3f}")
# StableInverse -0.715

# %% zpetc, ZPETC
slow = StateSpace([[0.9, 0.1], [-0.2, 0.8]], [[0.01], [0.1]], [[1.0, -0.05]], dt=dt)
print(type(zpetc(slow)).__name__)  # its zero at -1.3 is outside the unit circle
# ZPETC

# %% inverse, Inverse
print(isinstance(inverse(P, method="zpetc"), Inverse))
# True

# %% factors, output_ratio
print(factors(slow)._fields)
two = StateSpace([[0.9, 0.1], [0.3, 0.6]], [[0.2], [0.0]], np.eye(2), dt=dt)
print(type(output_ratio(two, above=1, below=0)).__name__)  # of one output to another
# ('zeros', 'poles', 'gain', 'dt')
# Factors

# %% instantaneous_frequency
print(f"{np.median(instantaneous_frequency(mixed[:, 0], dt)):.0f} Hz")
# 200 Hz

# %% cutoffs_below
print(cutoffs_below(300.0))  # of a filter that switches, below a critical frequency [Hz]
# (60.0, 240.0)
