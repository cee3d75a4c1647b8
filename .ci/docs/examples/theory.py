"""What theory claims of a machine and a law, and on which premises."""

import jax
import jax.numpy as jnp
import numpy as np

import jaxilc
from jaxilc import Machine, Sweep, Task, Uniform
from jaxilc.learning import Variation
from jaxilc.plants import Harmonics, Splines, StateSpace
from jaxilc.schemes import (
    CFDLMFAILC,
    PID,
    BasisFunctions,
    LearningFilter,
    PIDType,
    PositionBasis,
    RepetitiveBasis,
    RepetitiveControl,
    WithFeedback,
)
from jaxilc.theory import *
from jaxilc.theory import condition, frequency
from jaxilc.uncertainty import draw

jaxilc.setup()
P = StateSpace([[0.8]], [[0.2]], [[1.0]], dt=1e-3)
machine = Machine(P)
task = Task(np.sin(np.linspace(0, 2 * np.pi, 101)), dt=1e-3, unit="mm")
law = PIDType(gamma_p=1.0)
gain = {"plant.B": Uniform(0.8, 1.2, relative=True)}
drawn = draw(machine, gain, 4)

# %% certify, Certificate
found = certify(machine, law, task, trials=30)
print(isinstance(found, Certificate), found.claim[0])
print(certify(machine, law, task, 30, gain, drawn).claim)
# True monotone
# ['monotone' 'monotone' 'monotone' 'monotone']

# %% certify_each
two = jax.tree.map(lambda leaf: jnp.stack([leaf, leaf]), machine)  # as `vmap` takes them
print(certify_each(two, law, task, 30).claim)
# ['monotone' 'monotone']

# %% Condition, Premise
asked = frequency.learning_condition(machine, law, task).condition
print(isinstance(asked, condition.Condition), f"|1 - L P| is at most {asked.value:.3f}")
print([(one.name, bool(one.held)) for one in asked.premises if isinstance(one, Premise)][:2])
# True |1 - L P| is at most 0.889
# [('loop linear and time invariant', True), ('loop stable', True)]

# %% carried_radius, CarriedRadius
never_reset = Machine(P, variation=Variation(carried=1.0))
of_all = carried_radius(never_reset, law, task)
print(isinstance(of_all, CarriedRadius), of_all.claim, f"{of_all.radius:.3f}")
# True converges 0.889

# %% bounds_of, Bounds
mfailc = CFDLMFAILC(phi0=0.2, lam=0.1, epsilon=0.5)
bounds = bounds_of(machine, mfailc, task)
print(isinstance(bounds, Bounds), f"b = {bounds.b:.2f}")
# True b = 0.20

# %% ppd_bound
print(ppd_bound(bounds, 3).round(3))
# [2.222 2.222 2.222]

# %% frozen_growth
print(f"{frozen_growth(machine, mfailc, task).value:.2f}")  # what d2 of the paper should have been
# 0.84

# %% pseudo_gradient_of, PseudoGradient
seen = pseudo_gradient_of(machine, task)
print(isinstance(seen, PseudoGradient), seen.Phi.shape)
# True (100, 1)

# %% checked_machines, Checked, PremiseShare
both = checked_machines(machine, mfailc, task, 4, gain, drawn)
print(isinstance(both, Checked), all(isinstance(one, PremiseShare) for one in both.premises))
# True True

# %% BoundsWatch, checked
watched = Sweep(machine, {"cfdl": mfailc}, task, 4, gain, machines=4, watch=BoundsWatch()).run()
names = [name for name in watched if "cfdl" not in str(name)]
print(checked({n: watched[n].values[0] for n in names}).verdicts)
# {'holds': 0, 'fails': 0, 'not claimed': 4}

# %% repetitive_condition, RepetitiveTest (slow)
turning = Task(np.sin(np.arange(401) * 2 * np.pi / 50), dt=1e-3)
taps = LearningFilter(L=(0.0, 0.5, 0.0), keep=(0.05, 0.9, 0.05))
scheme = WithFeedback(RepetitiveControl(taps, period=0.05), PID(kp=1.0))
tested = repetitive_condition(machine, scheme, turning)
print(isinstance(tested, RepetitiveTest), f"between harmonics up to {tested.worst:.2f} times")
# True between harmonics up to 1.28 times

# %% basis_condition, PeriodTest
waves = RepetitiveBasis(Harmonics(0.05, (1, 2)), gain=0.05, lead=0.005)
tested = basis_condition(machine, WithFeedback(waves, PID(kp=1.0)), task)
print(isinstance(tested, PeriodTest), f"nearer by {tested.condition.value:.2f} in a period")
# True nearer by 0.65 in a period

# %% to_control
print(type(to_control(machine, law, task)).__name__)
# StateSpace

# %% visits, Visits
bins = BasisFunctions(PositionBasis(Splines(-1.0, 3.0, count=5, degree=1)), machine.plant)
seen = visits(machine, bins, Task(np.sin(np.arange(101) / 16), dt=1e-3))
print(isinstance(seen, Visits), [bool(told) for told in seen.told])
# True [True, True, True, False, False]
