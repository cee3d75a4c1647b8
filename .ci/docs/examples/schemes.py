"""Learning laws, feedbacks and what is made of them; `errors` learns on a simple machine."""

import jax.numpy as jnp
import numpy as np

import jaxilc
from jaxilc import Machine, Task, Trial
from jaxilc.filters import ZeroPhaseButterworth, ZeroPhaseFIR, stable_inverse
from jaxilc.plants import Harmonics, StateSpace, TwoAxes, multivariable_model
from jaxilc.pytree import Leaf, leaf, pytree
from jaxilc.schemes import *

jaxilc.setup()
P = StateSpace([[0.8]], [[0.2]], [[1.0]], dt=1e-3)  # y[k+1] = 0.8 y[k] + 0.2 u[k]
task = Task(np.sin(np.linspace(0, 2 * np.pi, 101)), dt=1e-3)


def errors(scheme, machine=P, task=task):
    """The rms errors of the first, the third and the last of 6 trials."""
    rms = jaxilc.learn(Machine(machine), scheme, task, trials=6).rms[:, 0]
    return " ".join(f"{x:.2g}" for x in rms[jnp.array([0, 2, 5])])


# %% PIDType
print(errors(PIDType(gamma_p=1.0)))  # u'[k] = u[k] + e[k+1]
# 0.71 0.045 0.0051

# %% HigherOrder
print(errors(HigherOrder(alpha=(0.8, 0.2), gamma=(1.0, 0.1))))  # of the last two trials
# 0.71 0.044 0.0053

# %% ExponentialPD
print(errors(ExponentialPD(K_P=1.0, lam0=2.0)))  # a gain that grows along the trial
# 0.71 0.05 0.0055

# %% CFDLMFAILC, PFDLMFAILC, FFDLMFAILC
print(errors(CFDLMFAILC(phi0=0.2, lam=0.01)))
print(errors(PFDLMFAILC(phi0=(0.2, 0.0), lam=0.01)))
print(errors(FFDLMFAILC(phi0=(0.8, 0.0, 0.2, 0.0), lam=0.01)))
# 0.71 0.58 0.21
# 0.71 0.42 0.15
# 0.71 0.0021 4.5e-06

# %% LearningFilter
print(errors(LearningFilter(L=(0.1, 0.8, 0.1), keep=(0.05, 0.9, 0.05))))  # taps of L and of Q
# 0.71 0.045 0.0051

# %% learning_filter
print(errors(learning_filter(stable_inverse(P), ZeroPhaseFIR((0.8, 0.1)), gain=0.9)))
# 0.71 0.0074 0.00042

# %% Filtered, ErrorFiltered
smooth = ZeroPhaseButterworth(cutoff=100.0)
print(errors(Filtered(PIDType(gamma_p=1.0), smooth)))  # Q (u + L e)
print(errors(ErrorFiltered(PIDType(gamma_p=1.0), smooth)))  # u + L Q e
# 0.71 0.045 0.0042
# 0.71 0.046 0.0068

# %% NormOptimal, GradientILC
print(errors(NormOptimal(P, w_q=1.0, w_r=0.1)))
print(errors(GradientILC(P)))
# 0.71 0.0072 0.00078
# 0.71 0.013 0.006

# %% ConstrainedNormOptimal
print(errors(ConstrainedNormOptimal(P, w_r=0.01, limit=1.0)))  # |u| stays within 1
# 0.71 0.0073 0.0073

# %% TwoStep
print(
    errors(TwoStep(P, w_y=1e3, w_change=0.1, w_r=0.1))
)  # estimates what the model lacks, then plans
# 0.069 0.0017 0.00059

# %% EstimatedDisturbance
print(errors(EstimatedDisturbance(NormOptimal(P, w_r=0.1), 0.1, 0.1)))  # a Kalman filter by trial
# 0.71 0.0072 0.00078

# %% ModelFreeGradient
print(errors(ModelFreeGradient(step=0.5)))  # an experiment on the machine in place of a model
# 0.71 0.38 0.39

# %% BasisFunctions, PolynomialBasis
print(errors(BasisFunctions(PolynomialBasis((0,)), P)))  # learns a weight for each derivative
# 0.71 0.18 0.18

# %% SelectedBasis
print(errors(BasisFunctions(SelectedBasis(PolynomialBasis((0, 1, 2)), (0,)), P)))
# 0.71 0.18 0.18

# %% GivenBasis
hats = np.maximum(0, 1 - np.abs(np.linspace(0, 10, 100)[:, None] - np.arange(11)))
print(errors(OnBasis(PIDType(gamma_p=1.0), GivenBasis(hats[:, None, :]))))
# 0.71 0.046 0.0062

# %% OnBasis, RationalBasis
print(errors(OnBasis(PIDType(gamma_p=1.0), PolynomialBasis((0, 1)))))
print(errors(OnBasis(PIDType(gamma_p=1.0), RationalBasis(PolynomialBasis((0, 1))))))
# 0.71 0.042 0.00052
# 0.71 0.042 0.0016

# %% PositionBasis, JoinedBasis
by_place = PositionBasis(Harmonics(pitch=2.0, orders=(1, 2)))
print(errors(BasisFunctions(JoinedBasis((PolynomialBasis((0,)), by_place)), P)))
# 0.71 0.18 0.18

# %% Basis
print(isinstance(PolynomialBasis((0, 1)), Basis), PolynomialBasis((0, 1)).names(1, 1))
# True ('position', 'velocity')

# %% fitted
u, r = 2 * task.reference[1:], task.reference
print(fitted(PolynomialBasis((0,)), u, r, task.dt).round(3))  # the weights by which u is best met
# [2.]

# %% select_basis, Selection
rng = np.random.default_rng(0)
trials = [(r, u + 0.01 * rng.standard_normal(u.shape)) for _ in range(3)]
found = select_basis(PolynomialBasis((0, 1, 2)), trials, dt=task.dt)
print(type(found).__name__, found.names, found.chosen)
# Selection ('position', 'velocity') 34

# %% WarmStart
print(errors(WarmStart(PIDType(gamma_p=1.0), PolynomialBasis((0,)), (0.9,))))
# 0.19 0.018 0.0043

# %% started
memory = started(PIDType(gamma_p=1.0), PIDType(gamma_p=1.0).initial_memory(task), u, task)
print(memory.u.shape)
# (100, 1)

# %% Feedforward
memory = Feedforward(jnp.zeros((100, 1)))  # what most laws carry: the input of the next trial
print(PIDType(gamma_p=1.0).schedule(memory, task).u.shape)
# (100, 1)

# %% PID, WithFeedback, OnReference
pid = PID(kp=1.0, ki=20.0)
print(errors(pid))
print(errors(WithFeedback(PIDType(gamma_p=1.0), pid)))  # learning on the input
print(errors(OnReference(PIDType(gamma_p=1.0), pid)))  # learning on the reference
# 0.36 0.36 0.36
# 0.36 0.098 0.016
# 0.36 0.094 0.016

# %% RepetitiveControl
law = LearningFilter(L=(0.0, 0.5, 0.0), keep=(0.05, 0.9, 0.05))
turning = Task(np.sin(np.arange(401) * 2 * np.pi / 50), dt=1e-3)
scheme = WithFeedback(RepetitiveControl(law, period=0.05), pid)
e = np.abs(jaxilc.learn(Machine(P), scheme, turning, trials=1).final.e[:, 0])
print([f"{e[50 * i : 50 * i + 50].max():.2f}" for i in (0, 3, 7)])  # by period of one trial
# ['0.59', '0.25', '0.08']

# %% RepetitiveBasis
waves = Harmonics(pitch=0.05, orders=(1,))  # a resonator, with a lead for the phase of the loop
scheme = WithFeedback(RepetitiveBasis(waves, gain=0.05, lead=0.003), pid)
e = np.abs(jaxilc.learn(Machine(P), scheme, turning, trials=1).final.e[:, 0])
print([f"{e[50 * i : 50 * i + 50].max():.2f}" for i in (0, 3, 7)])
# ['0.50', '0.06', '0.00']

# %% harmonic_taps
taps = harmonic_taps((1.0, 1.0, 0.0, 0.5), period=0.05, dt=1e-3)  # the second is not learned
print(taps.shape, f"{np.sum(taps):.2f}")
# (51,) 1.00

# %% PeriodTracking
drifting = Task(np.sin(np.arange(801) * 2 * np.pi / 51), dt=1e-3)  # 2 % longer than thought
for tracking in (None, PeriodTracking(fastest=0.01)):
    scheme = WithFeedback(RepetitiveControl(law, period=0.05, tracking=tracking), pid)
    e = np.abs(jaxilc.learn(Machine(P), scheme, drifting, trials=1).final.e[:, 0])
    print(f"{e[750:].max():.2f}")
# 0.24
# 0.08

# %% CFDLMFAC, PFDLMFAC, FFDLMFAC, CFDLMFAPC
print(errors(CFDLMFAC(phi0=0.2, lam=0.1)))  # feedbacks that adapt within a trial
print(errors(PFDLMFAC(phi0=(0.2, 0.0), lam=0.1)))
print(errors(FFDLMFAC(phi0=(0.8, 0.0, 0.2, 0.0), lam=0.1)))
print(errors(CFDLMFAPC(phi0=0.2, lam=1.0)))
# 0.022 0.022 0.022
# 0.02 0.02 0.02
# 0.025 0.025 0.025
# 0.21 0.21 0.21

# %% SMC, ASMC
drive = StateSpace([[0, 1], [-4e3, -80]], [[0], [4e3]], [[1, 0]])  # y'' = -4e3 y - 80 y' + 4e3 u
model = {"a1": 4e3, "a2": 80.0, "b": 4e3, "k_n": 100.0, "lam1": 100.0, "lam2": 300.0}
print(errors(SMC(**model, eta=1e3), drive))
print(errors(ASMC(**model, phi=2e4, epsilon=0.03, Delta=6.0), drive))
# 0.0067 0.0067 0.0067
# 0.0074 0.0074 0.0074

# %% StopWhen
print(errors(StopWhen(PIDType(gamma_p=1.0), rms=0.3)))  # keeps what made the error small enough
# 0.71 0.16 0.16

# %% Ladder
print(errors(Ladder(PIDType(gamma_p=0.5), repeats=1)))  # a gain that grows while learning goes well
# 0.71 0.21 0.037

# %% KeepUnmeasured
print(errors(KeepUnmeasured(PIDType(gamma_p=1.0))))  # learns nothing where no error was measured
# 0.71 0.045 0.0051

# %% AtSamples
print(
    errors(AtSamples(NormOptimal(P, w_r=0.1), windows=((0.05, 0.06),)))
)  # the error counts at samples only
# 0.71 0.68 0.68

# %% with_jerk
print(with_jerk(P).A.shape)  # the model, with the jerk of the input as an output
# (4, 4)

# %% CrossCoupled
xy = TwoAxes(P, P)
circle = Task(np.stack([np.cos(t := np.linspace(0, 6, 101)), np.sin(t)], axis=1) - [1, 0], dt=1e-3)
print(errors(CrossCoupled(PIDType(gamma_p=1.0), contour=1.2, own=0.8), xy, circle))
# 1.3 0.76 0.26

# %% OnOutputs
print(errors(OnOutputs(PIDType(gamma_p=1.0), (0,)), P))  # learns from some outputs only
# 0.71 0.045 0.0051

# %% MultivariableILC
both = StateSpace([[0.9, 0.1], [0.3, 0.6]], [[0.2], [0.0]], np.eye(2), dt=1e-3)
law = MultivariableILC(NormOptimal(multivariable_model(0.5, both), w_r=0.1), PID(kp=0.5))
two = Task(np.repeat(task.reference, 2, axis=1), dt=1e-3, inputs=1)
print(errors(law, both, two))
# 0.35 0.26 0.27


# %% Scheme
@pytree
class Damped(Scheme):
    """u'[k] = 0.99 u[k] + gain e[k+1]: a law of your own is a class with one method."""

    gain: Leaf = leaf(default=1.0)

    def learn(self, memory: Feedforward, trial: Trial) -> Feedforward:
        return Feedforward(0.99 * trial.u + self.gain * trial.e[1:])


print(errors(Damped()))
# 0.71 0.04 0.0091
