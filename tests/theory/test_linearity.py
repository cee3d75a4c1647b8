"""What theory derives from the programs of machines and schemes is compared with what they do.

It is tested for any wrapper and any composition.
"""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from cases import ARX, CASES, DT, PLANTS, SCHEMES, case, task_for
from jax.flatten_util import ravel_pytree
from jax.lax import scan, while_loop

from jaxilc.filters import ZeroPhaseButterworth, ZeroPhaseFIR
from jaxilc.learning import Actuator, Machine, Sensor
from jaxilc.plants import DifferenceEquation, Plant, StateSpace
from jaxilc.plants.structure import AFFINE, OTHERWISE, blind, dependence, obstacle
from jaxilc.pytree import child, leaf, pytree
from jaxilc.schemes import (
    CFDLMFAC,
    CFDLMFAILC,
    PID,
    ErrorFiltered,
    ExponentialPD,
    Feedforward,
    Filtered,
    HigherOrder,
    Ladder,
    NormOptimal,
    OnReference,
    PIDType,
    Scheme,
    StopWhen,
    WithFeedback,
)
from jaxilc.theory import linearity
from jaxilc.theory.certificates import long_run
from jaxilc.theory.trials import step, trial_of
from jaxilc.uncertainty import drawn_machines

MACHINE = Machine(DifferenceEquation(*ARX, dt=DT))
TASK = task_for(PLANTS["arx"], 40)

# The programs of jaxilc, one by one
# -----------------------------------------------------------------------------------------

LEFT_OUT = {"asmc_carried_limited"}  # which learns no feedforward
LEFT_OUT |= {"voice_coil_printed", "voice_coil_dai", "arx"}  # p_type with other numbers
NOT_LINEAR = {  # the reason, for those plants and schemes of cases.py that learn a feedforward
    "p_type_stop": "learns by",
    "p_type_ladder": "learns by",
    "estimated_disturbance": "learns by",
    "model_free": "makes experiments",
    "ilc_mfapc": "acts within the trial by",
    "p_type_on_reference": "acts within the trial by",
    "ilc_asmc": "acts within the trial by",
    "fast_tool_servo_nonlinear": "answers its input by",
    "ball_screw_real": "answers its input by",
    "motor_real": "answers its input by",
    "three_axes": "answers its input by",
    "by_position": "answers its input by",
    "two_step": "answers its input by",
    "basis_rational": "learns by",
    "pendulum": "answers its input by",
} | {
    name: "learns by"
    for name in SCHEMES
    if name.startswith(("cfdl", "pfdl", "ffdl")) and "mfa" not in name
}


@pytest.mark.parametrize(
    "name", [name for name, (_, scheme) in CASES.items() if scheme.learns and name not in LEFT_OUT]
)
def test_what_is_linear_is_found_linear_and_what_is_not_is_not(name):
    broken = [p.detail for p in linearity.learning_premises(*case(name)) if not p.held]
    if name in NOT_LINEAR:
        assert NOT_LINEAR[name] in broken[0]
    else:
        assert not broken
    if name == "two_step":
        assert broken[0].endswith("by sin of a signal")
        assert broken[1] == "TwoStep learns by a search for a minimum"


def learning(rng) -> Scheme:
    kinds = (
        lambda: PIDType(
            gamma_p=rng.uniform(0.1, 0.6),
            gamma_d=rng.uniform(0, 0.3),
            leak=rng.choice([0.0, 0.1]),
            lead=int(rng.integers(3)),
        ),
        lambda: HigherOrder((0.7, 0.3), tuple(rng.uniform(0.0, 0.3, 2))),
        lambda: ExponentialPD(K_P=rng.uniform(0.1, 0.5), lam0=rng.uniform(0, 20)),
        lambda: NormOptimal(
            StateSpace([[0.9]], [[rng.uniform(0.05, 0.15)]], [[1.0]], dt=DT), w_r=0.1, w_s=0.01
        ),
        lambda: CFDLMFAILC(phi0=0.1, lam=0.1, reset="sign"),
    )
    return kinds[rng.integers(len(kinds))]()


def composed(rng, depth: int) -> Scheme:
    if depth == 0:
        return learning(rng)
    inner = composed(rng, depth - 1)
    wrappers = (
        lambda: Filtered(inner, ZeroPhaseButterworth(rng.uniform(60, 200))),
        lambda: Filtered(inner, ZeroPhaseFIR((0.5, 0.25))),
        lambda: ErrorFiltered(inner, ZeroPhaseButterworth(rng.uniform(60, 200), padding=5)),
        lambda: StopWhen(inner, rms=0.05, growth=0.5),
        lambda: Ladder(inner, repeats=int(rng.integers(1, 3)), slow=rng.choice([None, 0.9])),
        lambda: WithFeedback(inner, PID(kp=rng.uniform(0.1, 1.0), ki=rng.uniform(0, 5.0))),
        lambda: WithFeedback(inner, CFDLMFAC(lam=1.0, phi0=0.1)),
        lambda: OnReference(inner, PID(kp=rng.uniform(0.3, 1.0), ki=5.0)),
    )
    while True:
        try:
            found = wrappers[rng.integers(len(wrappers))]()
            found.check(TASK)
            return found
        except (ValueError, TypeError):  # not every pair of them fits together
            continue


ADAPTS = (CFDLMFAILC, CFDLMFAC, StopWhen, Ladder)


def parts_of(scheme) -> list:
    below = [value for value in vars(scheme).values() if isinstance(value, Scheme)]
    return [scheme, *(one for value in below for one in parts_of(value))]


@pytest.mark.thorough
@pytest.mark.parametrize("seed", [1, 2, 3, 4, 5, 7, 8, 10, 11, 12])  # of other parts each
def test_any_composition_superposes_if_it_is_said_to(seed):
    """The map from one memory to the next is tested with large and small changes.

    No composition whose parts obey superposition is refused.
    """
    scheme = composed(np.random.default_rng(seed), depth=1 + seed % 3).prepared(TASK)
    said = all(p.held for p in linearity.learning_premises(MACHINE, scheme, TASK))
    assert said == (not any(isinstance(one, ADAPTS) for one in parts_of(scheme)))
    if not said:
        return
    first, unravel = ravel_pytree(scheme.initial_memory(TASK))
    free = jax.jit(lambda w: ravel_pytree(step(MACHINE, scheme.unlimited(), TASK, unravel(w)))[0])
    d = np.random.default_rng(seed).standard_normal(first.size)
    origin, unit = free(first), None
    for size in (1.0, 1e-3, 1e4):
        answer = (np.asarray(free(first + size * d)) - origin) / size
        unit = answer if unit is None else unit
        np.testing.assert_allclose(answer, unit, rtol=1e-6, atol=1e-7 * np.max(np.abs(unit)))


# A user's own
# --------------------------------------------------------------------------------------------------


@pytree
class OnlyTen(Scheme):
    """The wrapper of a user learns in the first ten trials only.

    This is far after all trials that are looked at.
    """

    scheme: Scheme = child()

    def initial_memory(self, task):
        return self.scheme.initial_memory(task), jnp.asarray(0.0)

    def schedule(self, memory, task):
        return self.scheme.schedule(memory[0], task)

    def learn(self, memory, trial) -> Any:
        inner, count = memory
        kept = jax.tree.map(
            lambda new, old: jnp.where(count < 10, new, old), self.scheme.learn(inner, trial), inner
        )
        return kept, count + 1


@pytree
class Bent(Scheme):
    """The wrapper of a user has a gain that decreases for errors near a thousand.

    No trial that is looked at has such errors.
    """

    scheme: Scheme = child()
    knee: jax.Array = leaf(default=1e3)

    def initial_memory(self, task):
        return self.scheme.initial_memory(task)

    def schedule(self, memory, task):
        return self.scheme.schedule(memory, task)

    def learn(self, memory, trial):
        e = jnp.clip(trial.e, -self.knee, self.knee)
        return self.scheme.learn(memory, trial._replace(y=trial.r - e))


@pytest.mark.thorough(but=["Bent"])
@pytest.mark.parametrize("wrapper", [OnlyTen, Bent])
def test_a_wrapper_that_nobody_knows_cannot_slip_through(wrapper):
    machines = drawn_machines(Machine(DifferenceEquation((0.7,), (0.3,), dt=DT)), {}, {})
    law = PIDType(gamma_p=0.5)
    for scheme in (wrapper(law), WithFeedback(wrapper(law), PID(kp=0.3))):
        assert set(long_run(machines, scheme, TASK).claim) == {"not claimed"}
    assert set(long_run(machines, law, TASK).claim) != {"not claimed"}


@pytree
class Beside(Scheme):
    """Two laws of a user, whose inputs are added; the second learns beside what is played back."""

    first: Scheme = child()
    second: Scheme = child()

    def initial_memory(self, task):
        return self.first.initial_memory(task), self.second.initial_memory(task)

    def schedule(self, memory, task):
        return memory

    def feedforward(self, memory, task):
        return memory[0].u

    def play(self, learned, memory, task):
        return memory[0]._replace(u=learned), memory[1]

    def act(self, state, sample):
        first, second = sample.row
        return state, first.u + second.u

    def learn(self, memory, trial):
        first = self.first.learn(memory[0], trial._replace(u=trial.u - memory[1].u))
        return first, self.second.learn(memory[1], trial._replace(u=memory[1].u))


@pytree
class OfFeedback(Scheme):
    """A user's law that learns from what the feedback beside it did, too."""

    share: jax.Array = leaf(default=8.0)

    def learn(self, memory, trial):
        beside = trial.signals.get("beside", jnp.zeros_like(trial.u))
        return memory._replace(u=trial.u + 0.2 * trial.e[1:] + self.share * beside)


@pytest.mark.parametrize(
    ("scheme", "more"),
    [
        (WithFeedback(PIDType(gamma_p=0.2), PID(kp=1.0)), ""),
        (WithFeedback(OfFeedback(), PID(kp=1.0)), "what the feedback does"),
        (Beside(PIDType(gamma_p=0.2), PIDType(gamma_p=9.0)), "earlier trials"),
    ],
)
def test_what_a_law_learns_from_besides_is_found_in_the_program_of_any_law(scheme, more):
    """A monotone error was claimed of the two laws of a user, under which it grew to 1e86."""
    found = linearity.of_last_trial(scheme, TASK)
    assert found.held == (not more)
    assert more in found.detail


# Limits
# --------------------------------------------------------------------------------------------------


LIMITED = Machine(MACHINE.plant, actuator=Actuator(limit=4.0, rate=200.0))
EXTRA = {
    "filtered": (MACHINE, Filtered(PIDType(gamma_p=0.5, limit=0.3), ZeroPhaseFIR((0.5, 0.25)))),
    "actuator": (LIMITED, PIDType(gamma_p=0.5)),
    "cut": (MACHINE, WithFeedback(PIDType(gamma_p=0.5, limit=0.5), PID(kp=0.3))),
}
OF_CASES = ["pid_type_leaky_limited", "higher_order_leaky_limited", "norm_optimal_lifted"]


@pytest.mark.thorough
@pytest.mark.parametrize("name", [*OF_CASES, *EXTRA])
def test_limits_that_are_declared_decide_whether_anything_changes(name):
    """The free run equals the limited one up to the first trial beyond a bound, and no further."""
    machine, scheme, task = (*EXTRA[name], TASK) if name in EXTRA else case(name)
    free, bounded = scheme.unlimited().prepared(task), scheme.prepared(task)

    @jax.jit
    def turn(one, other):
        """Return the largest share of a bound in a free trial, both outputs and next memories."""
        trial = trial_of(machine.unlimited(), free, task, one)
        seen = trial_of(machine, bounded, task, other)
        found = machine.limits(trial) | scheme.limits(task, one, trial)
        shares = [jnp.max(jnp.abs(signal) / bound) for signal, bound in found.values()]
        share = jnp.max(jnp.stack(shares))
        return share, trial.y, seen.y, free.learn(one, trial), bounded.learn(other, seen)

    one = other = scheme.initial_memory(task)
    for _ in range(40):
        share, y, seen, one, other = turn(one, other)
        if share > 1:
            break
        np.testing.assert_allclose(seen, y, rtol=1e-9, atol=1e-12)
    else:
        pytest.fail("no limit was ever met, and the test says nothing")
    _, y, seen, _, _ = turn(one, other)
    assert np.max(np.abs(seen - y)) > 1e-9


# Single operations
# --------------------------------------------------------------------------------------------------

LINEAR = {
    "unstack": lambda _, x: sum(jnp.unstack(x)),
    "a filter": lambda a, x: jnp.convolve(x, a),
    "a transform": lambda a, x: jnp.fft.irfft(jnp.fft.rfft(x) * a[0]),
    "a choice of the fixed": lambda a, x: jnp.where(a > 0, x, -x),
    "a scan": lambda a, x: scan(lambda c, v: (0.5 * c + v, c), 0.0, x)[1],
}
OTHERS = {
    "its own square": lambda a, x: x * x,
    "a limit": lambda a, x: jnp.clip(x, -1e30, 1e30),
    "a choice by itself": lambda a, x: jnp.where(x > 1e30, x, 2 * x),
    "a limit in a scan": lambda a, x: scan(lambda c, v: (jnp.minimum(c + v, 1e30), c), 0.0, x)[1],
    "a late product": lambda a, x: scan(lambda c, v: ((v, c[0]), c[0] * c[1]), (0.0, 1.0), x)[1],
    "a loop that it ends": lambda a, x: while_loop(lambda c: c[0] < 3.0, lambda c: c + 1.0, x),
    "a branch": lambda a, x: jax.lax.cond(x[0] > 0, lambda v: v, lambda v: 2 * v, x),
    "rounding": lambda a, x: jnp.round(x),
}


@pytest.mark.parametrize("name", LINEAR | OTHERS)
def test_what_an_operation_leaves_of_linearity(name):
    f, linear = (LINEAR | OTHERS)[name], name in LINEAR
    assert dependence(f, jnp.ones(4), jnp.ones(4)).order == (AFFINE if linear else OTHERWISE)
    assert bool(obstacle(f, jnp.ones(4), jnp.ones(4))) != linear


def test_a_derivative_that_misses_rounding_is_known_to():
    """A quantiser passes derivatives unchanged, so they are not derivatives of the quantiser."""
    sensor = Sensor(resolution=0.1)
    straight = lambda _, x: x + jax.lax.stop_gradient(jnp.round(x) - x)  # noqa: E731
    assert blind(straight, sensor, jnp.ones(4))
    assert not blind(lambda _, x: 2.0 * x, sensor, jnp.ones(4))
    machine = Machine(MACHINE.plant, sensor=sensor)
    memory = PIDType().initial_memory(TASK)
    output = lambda machine, w: trial_of(machine, PIDType(), TASK, memory._replace(u=w)).y  # noqa: E731
    assert blind(output, machine, jnp.zeros((40, 1)))


def ruled(function, slope):
    """Return the function with a slope of its own."""
    made = jax.custom_jvp(function)
    made.defjvp(lambda at, by: (made(*at), slope(*by)))
    return made


BY_RULE = ruled(lambda x: 8.0 * x, lambda d: d)
WITHIN = ruled(lambda a, x: a * x, lambda _, d: 0.5 * d)  # the slope by x alone, and for a = 0.5
NEAR_ZERO = jax.custom_jvp(lambda x: 8.0 * x)
NEAR_ZERO.defjvp(lambda at, by: (NEAR_ZERO(*at), jnp.where(jnp.abs(at[0]) < 1, 1.0, 8.0) * by[0]))
MADE_UP = {
    "of numbers below 1 alone": lambda _, x: jnp.stack([NEAR_ZERO(one) for one in x]),
    "left out": lambda _, x: x + 7.0 * jax.lax.stop_gradient(x),
    "left out in a scan": lambda _, x: scan(
        lambda c, v: (0.1 * jax.lax.stop_gradient(c) + v, c), 0.0, x
    )[1],
    "by a rule": lambda _, x: BY_RULE(x),
    "by a rule in a program in a scan": lambda _, x: scan(
        lambda c, v: (c, jax.jit(BY_RULE)(v)), 0.0, x
    )[1],
    "by a rule for another number": lambda _, x: WITHIN(4.0, x),
}
TRUE = {
    "of the fixed": lambda a, x: jax.lax.stop_gradient(a) * x + BY_RULE(a),
    "by a true rule": lambda _, x: ruled(lambda x: 8.0 * x, lambda d: 8.0 * d)(x),
    "by a rule that leaves out the fixed": lambda _, x: WITHIN(0.5, x),
}


@pytest.mark.thorough
@pytest.mark.parametrize("name", MADE_UP | TRUE)
def test_a_map_whose_derivative_is_made_up_is_not_taken_for_its_matrix(name):
    f, a, x = (MADE_UP | TRUE)[name], jnp.ones(4), np.random.default_rng(3).normal(size=4)
    there, slope = jax.jvp(lambda x: f(a, x), (x,), (x,))
    # f(x) - f(0) of an affine map is what its matrix makes of x
    right = np.allclose(there - f(a, 0 * x), slope)
    assert right == (name in TRUE)
    assert (obstacle(f, a, x) == "") == right
    assert blind(f, a, x) != right


def test_a_rule_is_compared_again_where_another_operand_moves():
    """The program of the comparison is the same, and so its result was once taken for both."""
    second = ruled(lambda x, y: x + 3.0 * y, lambda _, d: 3.0 * d)
    assert obstacle(second, jnp.ones(4), jnp.ones(4)) == ""
    assert obstacle(lambda a, x: second(x, a), jnp.ones(4), jnp.ones(4)) != ""


@pytest.mark.parametrize("name", ["law", "plant"])
def test_nothing_is_claimed_by_a_derivative_that_is_made_up(name):
    """A monotone error was claimed of a law under which it grew to 1e17 times in 30 trials."""

    @pytree
    class Law(Scheme):
        def learn(self, memory, trial):
            e = trial.e[1:]
            return Feedforward(trial.u + e + 7.0 * jax.lax.stop_gradient(e))

    @pytree
    class Slow(Plant):
        def initial_state(self):
            return jnp.zeros(1)

        def step(self, x, u, dt):
            return jax.lax.stop_gradient(0.9 * x) + 0.3 * u

        def output(self, x):
            return x

    machine, law = (MACHINE, Law()) if name == "law" else (Machine(Slow()), PIDType(gamma_p=1.0))
    premises = linearity.learning_premises(machine, law, TASK)
    assert [p.held for p in premises] == [name == "law", name == "plant"]
    assert "a part whose derivative is made up" in next(p.detail for p in premises if not p.held)
