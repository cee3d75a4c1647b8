"""The double mass of IterativeLearningControl2.jl: its test suite, row by row.

Two masses on a spring are driven at the first one, in a loop with a PID controller; position in m.
The continuous closed loops are sampled with a zero-order hold. Learning acts on the input of the
drive or on the reference of the loop, and it knows a model with a third less load than there is.
The numbers to compare with are those that the tests of that package expect.
"""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from ..learning.machine import Disturbance, Machine
from ..learning.metrics import root_mean_square
from ..plants import StateSpace, motion
from ..pytree.aliases import Leaf
from ..pytree.fields import child, leaf, pytree
from ..pytree.ranges import need_one_of
from ..runtime.lanes import over_samples
from ..schemes import ConstrainedNormOptimal, GradientILC, ModelFreeGradient, NormOptimal, Scheme
from ..schemes.scheme import Feedforward
from ..signals.task import Task, Trial, product
from ..uncertainty import Uniform
from .published import printed
from .scenario import Quantity, Scenario


def error_norm(trial: Trial) -> jax.Array:
    """||e||_2 of a trial: the root of the sum of the squared errors, over all samples and outputs.

    It grows with the number of samples; the metric `rms` does not.
    """
    e = trial.e.reshape(-1, 1)
    return root_mean_square(e)[0] * e.size**0.5


# The law by model inverse and zero-phase filter as that package runs it
# --------------------------------------------------------------------------------------------------


class WholeRecord(NamedTuple):
    """a: (N+1, 1) what was learned, of which the last sample acts on nothing within the trial."""

    a: jax.Array


@pytree
class InverseLaw(Scheme):
    """a_{j+1} = Q (a_j + gain G^-1 e_j), over records of N+1 samples (`HeuristicILC` there).

    G^-1 runs forward from rest, so the zeros of the model must lie within the unit circle. It looks
    one sample ahead; at the last sample it repeats its value. Q is the lag 1/(T s + 1), sampled
    with a zero-order hold, first backward and then forward in time, from rest each time.

    These ends are why this law is not a `LearningFilter`: they are part of the numbers that the
    scenario compares with.

    model: sampled model G of one input and one output
    gain: () share of the inverse
    time_constant: () T [s]
    """

    model: StateSpace = child()
    gain: Leaf = leaf(interval="(0, inf)")
    time_constant: Leaf = leaf(interval="(0, inf)")

    def check(self, task: Task) -> None:
        if (self.model.n_u, self.model.n_y, task.inputs, task.outputs) != (1, 1, 1, 1):
            raise ValueError(
                f"InverseLaw: the model has {self.model.n_u} inputs and {self.model.n_y} outputs, "
                f"the task {task.inputs} and {task.outputs}; allowed is one of each"
            )
        self.model.sampled(task.dt)

    def initial_memory(self, task: Task) -> WholeRecord:
        return WholeRecord(jnp.zeros((task.N + 1, task.inputs)))

    def schedule(self, memory: WholeRecord, task: Task) -> Feedforward:
        return Feedforward(memory.a[:-1])

    def learn(self, memory: WholeRecord, trial: Trial) -> WholeRecord:
        played = jnp.concatenate([trial.u, memory.a[-1:]])
        wanted = self.gain * self._inverse(trial.e[1:], trial.dt)
        both = played + jnp.concatenate([wanted, wanted[-1:]])
        pole = jnp.exp(-trial.dt / self.time_constant)
        return WholeRecord(_lagged(_lagged(both[::-1], pole)[::-1], pole))

    def _inverse(self, e, dt):
        """(N, 1) the input that moves the output of the model by e (N, 1), one sample later."""
        A, B, C = (getattr(self.model.sampled(dt), name) for name in "ABC")
        first = (C @ B)[0, 0]

        def tick(x, e_next):
            u = (e_next - product(C, product(A, x))) / first
            return product(A, x) + product(B, u), u

        return over_samples(tick, jnp.zeros(A.shape[-1]), e)[1]


def _lagged(signal, pole):
    """The signal behind the sampled lag (1 - pole) / (z - pole), from rest."""

    def tick(state, x):
        return pole * state + (1 - pole) * x, state

    return over_samples(tick, jnp.zeros_like(signal[0]), signal)[1]


# The scenario
# --------------------------------------------------------------------------------------------------


SAMPLE_TIME = 0.02
DURATION = 3 * np.pi
MODELLED = 1.0  # inertia of the load that the model knows [kg]
LIMIT, HIGHEST, OF_CONTROLLER = 25.0, 1.1, 1000.0


class Loop(NamedTuple):
    """The continuous closed loop.

    A (n, n); of_reference and of_input (n, 1); states (2, n): position and velocity of the first
    mass; controller (1, n) and direct (): the output of the controller is controller x + direct r
    """

    A: np.ndarray
    of_reference: np.ndarray
    of_input: np.ndarray
    states: np.ndarray
    controller: np.ndarray
    direct: float


def closed_loop(load: float) -> Loop:
    """The double mass under C(s) = 10 (1 + 1/s) (s + 1) / (0.02 s + 1). load: inertia [kg]."""
    k, c, m = 100.0, 1.0, 1.0  # stiffness [N/m], each of three dampings [N s/m], motor [kg]
    A = np.array(
        [
            [0, 1, 0, 0],
            [-k / m, -2 * c / m, k / m, c / m],
            [0, 0, 0, 1],
            [k / load, c / load, -k / load, -2 * c / load],
        ]
    )
    B, C = np.array([[0], [1 / m], [0], [0]]), np.array([[1.0, 0, 0, 0]])
    # C(s) = 10 (s + 1)^2 / (0.02 s^2 + s) in controller form, with d its value at high frequency
    lag = 0.02
    a, b = np.array([[-1 / lag, 0], [1, 0]]), np.array([[1.0], [0]])
    d = 10 / lag
    c_ = np.array([[20 / lag - d / lag, 10 / lag]])
    closed = np.block([[A - d * B @ C, B @ c_], [-b @ C, a]])
    still = np.zeros((2, 1))
    return Loop(
        closed, np.vstack([d * B, b]), np.vstack([B, still]), np.eye(2, 6), np.hstack([-d * C, c_]),
        d,
    )  # fmt: skip


def references(kind: str, second: str) -> np.ndarray:
    """(N+1, n_y) the reference: that of the position, and that of the second output.

    The second is the derivative by central differences for `velocity`, and 0 for `controller`.
    """
    x = np.sin(np.arange(0, DURATION, SAMPLE_TIME))
    r = np.sign(x) * ((np.abs(x) + 0.01) ** 0.2 - 0.01**0.2)
    r = np.sign(r) if kind == "square" else r
    steps = np.diff(r) / 2 / SAMPLE_TIME
    speed = np.r_[steps[0], steps] + np.r_[steps, steps[-1]]
    return np.stack({"none": [r], "velocity": [r, speed], "controller": [r, 0 * r]}[second], axis=1)


def loop_from(loop: Loop, at: str, second: str) -> StateSpace:
    """The loop from what is learned to the outputs, in continuous time.

    As the tests of that package have it, the controller's output counts with the sign of CP/(1+CP).
    """
    rows = {"none": 0 * loop.controller[:0], "velocity": loop.states[1:]}
    C = np.vstack([loop.states[:1], rows.get(second, -loop.controller)])
    B = loop.of_input if at == "input" else loop.of_reference
    if at == "reference" and second == "velocity":
        B = np.hstack([B, 0 * B])  # the reference of the velocity has no effect
    return StateSpace(loop.A, B, C)


def without_learning(loop: Loop, r: np.ndarray, second: str) -> np.ndarray:
    """(N+1, n_y) what the outputs do by the reference alone."""
    C = np.vstack([loop.states, loop.controller])
    y = np.array(motion(StateSpace(loop.A, loop.of_reference, C), jnp.asarray(r[:-1]), SAMPLE_TIME))
    y[:, 2] += loop.direct * r[:, 0]
    return y[:, {"none": [0], "velocity": [0, 1], "controller": [0, 2]}[second]]


def bounds_for(second: str) -> dict[str, Leaf]:
    """The weight of the errors and the bounds of the constrained law."""
    if second == "velocity":
        return {"w_q": 1000.0}
    highest: Leaf = HIGHEST
    weight: Leaf = 1000.0
    if second == "controller":
        highest, weight = np.array([HIGHEST, OF_CONTROLLER]), (1000.0, 0.0)
    return {"w_q": weight, "limit": LIMIT, "y_low": -highest, "y_high": highest}


def schemes_for(model: StateSpace, at: str, second: str) -> dict[str, Scheme]:
    """The laws of the tests by name, for a model that is sampled."""
    bounded, step, amplified = bounds_for(second), 500.0, 500.0
    if second == "velocity":
        step, amplified = 1e-2, 1.0
    found = {
        "inverse-filter": InverseLaw(model, 0.5, 0.1 if at == "input" else 0.05),
        "norm-optimal": NormOptimal(model, w_r=1e-4, w_s=1e-5),
        "gradient": GradientILC(model, step=step),
        "model-free": ModelFreeGradient(
            step=amplified,
            about="mean",
            method="joint" if model.n_u == model.n_y else "exact",
            inputs=model.n_u,
            outputs=model.n_y,
        ),
        "constrained": ConstrainedNormOptimal(model, w_s=1e-3, step=0.5, **bounded),
    }
    if second != "none":
        del found["inverse-filter"]
    return found


def double_mass(
    load: float = 1.5, at: str = "input", reference: str = "smooth", second: str = "none"
) -> Scenario:
    """The tests of IterativeLearningControl2.jl.

    load: inertia of the load that there is, where the model has 1 [kg]
    at: what is learned is added to the `input` of the drive, or to the `reference` of the loop
    reference: `smooth`, or `square` for the sign of it
    second: a second output: `none`, the `velocity` of the first mass, which has a reference too, or
        the output of the `controller`, which is bounded
    Raises ValueError for a load that is not positive, and for other choices.
    """
    need_one_of("double-mass", "at", at, ("input", "reference"))
    need_one_of("double-mass", "reference", reference, ("smooth", "square"))
    need_one_of("double-mass", "second", second, ("none", "velocity", "controller"))
    if not 0 < load < np.inf:
        raise ValueError(f"double-mass: load = {load} is outside its allowed range (0, inf) kg")
    r, loop = references(reference, second), closed_loop(load)
    plant = loop_from(loop, at, second)
    norm = of_position if second == "controller" else error_norm
    return Scenario(
        **printed("double-mass"),
        machine=Machine(plant, disturbance=Disturbance(output=without_learning(loop, r, second))),
        task=Task(r, dt=SAMPLE_TIME, unit="m", input_unit="N", inputs=plant.n_u),
        schemes=schemes_for(
            loop_from(closed_loop(MODELLED), at, second).sampled(SAMPLE_TIME), at, second
        ),
        uncertainty={"plant.B": Uniform(0.9, 1.1, relative=True)},
        shown_unit="mm",
        shown_scale=1e3,
        show_trials=(1, 2, 3, 5, 10, 28),
        quantities={"error_norm": Quantity(norm, "m", 1.0)},
        judged_by="rms",
    )


def of_position(trial: Trial):
    """The norm of the error of the first output alone."""
    return error_norm(trial._replace(r=trial.r[:, :1], y=trial.y[:, :1]))
