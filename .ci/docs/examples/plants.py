"""Plants and their parts; `step` is the response to a constant input."""

import control
import numpy as np

import jaxilc
from jaxilc.plants import *

jaxilc.setup()
s = 2 * np.pi


def response(plant, samples=40, u=1.0, dt=1e-3):
    """The output after a quarter, a half and all of the samples of a constant input."""
    y = motion(plant, np.full((samples, 1), u), dt)[:, 0]
    return " ".join(f"{value:.3g}" for value in y[np.array([1, 2, 4]) * samples // 4])


# %% StateSpace, motion
plant = StateSpace([[0.9]], [[0.1]], [[1.0]], dt=1e-3)  # y[k+1] = 0.9 y[k] + 0.1 u[k]
print(motion(plant, np.ones((3, 1)), 1e-3)[:, 0])
# [0.    0.1   0.19  0.271]

# %% DifferenceEquation
print(response(DifferenceEquation((1.6, -0.65), (0.06, 0.03), dt=1e-3)))
# 1.4 1.79 1.8

# %% ProcessModel
print(response(ProcessModel(gain=2.0, frequencies=(s * 30,), dampings=(0.7,), delay=2e-3)))
# 1.07 2.02 2.01

# %% ModalModel
print(response(ModalModel(poles=(60.0,), pole_gains=(1.0,), integrator=2.0)))
# 0.471 0.739 0.989

# %% modal_model
system = control.tf([4000.0], [1.0, 80.0, 4000.0])
print(modal_model(system).frequencies)
# [63.2455532]

# %% from_control, to_control
plant = from_control(system)
print(response(plant), "like", f"{control.step_response(to_control(plant), 0.04).y.max():.3g}")
# 0.151 0.445 0.924 like 0.924

# %% TimeVaryingStateSpace, linearised
pendulum = Pendulum()
about = linearised(pendulum, np.zeros((50, 1)), 1e-3)  # along the motion without an input
print(type(about).__name__, about.A.shape)
# TimeVaryingStateSpace (50, 2, 2)

# %% Pendulum
print(response(Pendulum(), u=0.1))
# 8.78e-05 0.000368 0.00149

# %% VoiceCoil, voice_coil
print(response(VoiceCoil()), "and as printed", response(voice_coil("printed")))
# -0.147 -0.431 -0.956 and as printed -0.145 -0.423 -0.934

# %% VoiceCoilMotor, voice_coil_motor
print(response(voice_coil_motor(), u=-1.0), isinstance(voice_coil_motor(), VoiceCoilMotor))
# 0.147 0.43 0.955 True

# %% FastToolServo, fast_tool_servo
print(response(fast_tool_servo(), dt=1e-5), isinstance(fast_tool_servo(), FastToolServo))
# 0.111 0.44 1.71 True

# %% BallScrewDrive
weights = {"motor_mass": 2.0, "table_mass": 1.0, "stiffness": 4e4, "damping": 20.0}
drive = BallScrewDrive(**weights, force_gain=4.0, command_scale=10.0)
print(response(drive))
# 0.083 0.185 0.404

# %% cnc_axis
print(response(cnc_axis(), dt=2e-3))
# 7.19 37.2 180

# %% TwoAxes, ThreeAxes
axis = StateSpace([[0.9]], [[0.1]], [[1.0]], dt=1e-3)
print(motion(TwoAxes(axis, axis), np.ones((3, 2)), 1e-3).shape)
print(motion(ThreeAxes(axis, axis, axis), np.ones((3, 3)), 1e-3).shape)
# (4, 2)
# (4, 3)

# %% InputHysteresis, Dahl, BoucWen
smooth = InputHysteresis(axis, Dahl(initial_slope=0.4, limit=0.3))
print(response(smooth), "or", response(InputHysteresis(axis, BoucWen(0.3, beta=1.2))))
# 0.507 0.684 0.768 or 0.538 0.725 0.813

# %% StribeckFriction, FrictionTable
grease = StribeckFriction(coulomb_force=2.0, static_force=3.0, transition_velocity=0.02)
table = FrictionTable.of(grease, np.linspace(-0.1, 0.1, 7))  # as controls compensate it
stiff = BallScrewDrive(**weights, force_gain=4.0, motor_friction=grease, compensation=table)
print(table.velocity.shape, response(stiff))
# (7,) 0.0078 0.0174 0.0381

# %% LeadError
print(response(BallScrewDrive(**weights, force_gain=4.0, lead_error=LeadError(1e-5, 5e-3))))
# 0.00827 0.0185 0.0404

# %% Cogging, EndEffect
parts = {"cogging": Cogging(amplitude=2.0, pitch=1e-3), "end_effect": EndEffect(0.05, drop=0.3)}
print(response(VoiceCoilMotor(**parts), u=-1.0))
# 0.146 0.428 0.958

# %% FlexibleMode, Creep, PeriodicForce, CuttingForce
parts = {"mode": FlexibleMode(500.0, 0.05, -0.1), "creep": Creep((0.1,), (5e-3,))}
parts |= {"periodic": PeriodicForce((0.1,), (400.0,), (0.3,)), "cutting": CuttingForce(0.1, 0.01)}
print(response(FastToolServo(**parts), dt=1e-5))
# 0.0837 0.3 1.15

# %% InBlocks
print(response(InBlocks(axis, length=8)), "in", response(axis))  # the same, faster where N is long
# 0.651 0.878 0.985 in 0.651 0.878 0.985

# %% cascade, direct_model, multivariable_model
both = cascade(control.tf([50], [1, 50]), control.tf([900], [1, 40, 900]), 1e-3)  # motor, table
for model in (both, direct_model(0.5, both), multivariable_model(0.5, both)):
    print(model.B.shape[1], "inputs to", model.C.shape[0], "outputs")
# 1 inputs to 2 outputs
# 1 inputs to 1 outputs
# 2 inputs to 2 outputs


# %% Plant
@jaxilc.pytree.pytree
class Lag(Plant):
    """y[k+1] = a y[k] + (1 - a) u[k]: a plant of your own is a class with three methods."""

    a: jaxilc.pytree.Leaf = jaxilc.pytree.leaf(default=0.9)

    def initial_state(self):
        return np.zeros(1)

    def step(self, x, u, dt):
        return self.a * x + (1 - self.a) * u

    def output(self, x):
        return x


print(response(Lag()))
# 0.651 0.878 0.985

# %% Harmonics, Splines, PositionMap, ByPosition
print(Harmonics(pitch=12.0, orders=(1,)).at(3.0).round(3))  # cosine and sine a quarter further
print(Splines(0.0, 50.0, count=6, degree=1).at(15.0).round(3))  # between two of six nodes
cogging = PositionMap(Harmonics(pitch=0.5, orders=(1,)), weights=(0.3, 0.1))
print(response(ByPosition(ProcessModel(gain=2.0, poles=(60.0,)), force=cogging)))
# [0. 1.]
# [0.  0.5 0.5 0.  0.  0. ]
# 0.804 1.25 1.62
