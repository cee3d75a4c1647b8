"""A user's own wrapper and own composition work everywhere without a change in the package.

Each does what a law of the package does with other gains, so every result can be compared.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from cases import ALGEBRA, DT

from jaxilc.hardware import Campaign, Measured
from jaxilc.learning import Machine, learn
from jaxilc.learning.playback import schedules
from jaxilc.plants import DifferenceEquation
from jaxilc.pytree import child, leaf, named_leaves, pytree
from jaxilc.scenarios.scenario import Scenario
from jaxilc.schemes import FFDLMFAILC, PID, Feedforward, Ladder, PIDType, Scheme, WithFeedback
from jaxilc.schemes.scheme import Wrapper, limited, with_all_parts
from jaxilc.signals import Task
from jaxilc.sweeps import Sweep
from jaxilc.theory import certify
from jaxilc.theory.certificates import long_run
from jaxilc.theory.frequency import learning_condition
from jaxilc.tuning import Tuning
from jaxilc.tuning.objectives import Final
from jaxilc.uncertainty import Uniform, draw, drawn_machines

N, TRIALS = 40, 6
TASK = Task(0.5 - 0.5 * np.cos(2 * np.pi * np.arange(N + 1) / N), dt=DT)
MACHINE = Machine(DifferenceEquation((0.7,), (0.3,), dt=DT))
FEEDBACK = PID(kp=0.5, ki=2.0)
GAIN = {"plant.b": Uniform(0.8, 1.2, relative=True)}


class Kept(NamedTuple):
    """What the wrapper keeps: the memory of its scheme under a name of its own, and a count."""

    inner: object
    trials: jax.Array


@pytree
class Cautious(Wrapper):
    """The wrapper learns from a share of the error, and counts its trials."""

    scheme: Scheme = child()
    caution: jax.Array = leaf(default=0.5, interval="(0, 1]")

    def parts(self, task, memory):
        return {"scheme": (self.scheme, task, memory.inner)}

    def shown(self, trial):
        return {"scheme": trial._replace(y=trial.r - self.caution * trial.e)}

    def initial_memory(self, task):
        return Kept(self.scheme.initial_memory(task), jnp.zeros(()))

    def learn(self, memory, trial):
        learned = self.scheme.learn(memory.inner, self.shown(trial)["scheme"])
        return Kept(learned, memory.trials + 1)


class Both(NamedTuple):
    first: object
    second: object


@pytree
class Blend(Scheme):
    """The scheme is u = share u_1 + (1 - share) u_2 of two laws that learn from the whole trial."""

    first: Scheme = child()
    second: Scheme = child()
    share: jax.Array = leaf(default=0.5, interval="[0, 1]")

    def initial_memory(self, task):
        return Both(self.first.initial_memory(task), self.second.initial_memory(task))

    def schedule(self, memory, task):
        one = self.first.schedule(memory.first, task)
        other = self.second.schedule(memory.second, task)
        return one._replace(u=self.share * one.u + (1 - self.share) * other.u)

    def learn(self, memory, trial):
        shown = self.shown(trial)
        return Both(
            self.first.learn(memory.first, shown["first"]),
            self.second.learn(memory.second, shown["second"]),
        )


@pytree
class Beside(Scheme):
    """The scheme is u = u_1 + u_2 of two laws that both act within the trial."""

    first: Scheme = child()
    second: Scheme = child()

    def initial_memory(self, task):
        return Both(self.first.initial_memory(task), self.second.initial_memory(task))

    def schedule(self, memory, task):
        parts = self.parts(task, memory).items()
        return Both(**{name: one.schedule(known, seen) for name, (one, seen, known) in parts})

    def initial_state(self, task):
        return Both(self.first.initial_state(task), self.second.initial_state(task))

    def act(self, state, sample):
        one, u_1 = self.first.act(state.first, sample._replace(row=sample.row.first))
        other, u_2 = self.second.act(state.second, sample._replace(row=sample.row.second))
        return Both(one, other), u_1 + u_2

    def learn(self, memory, trial):
        own = trial.u - memory.second.u
        return Both(self.first.learn(memory.first, trial._replace(u=own)), memory.second)


class Counted(NamedTuple):
    u: jax.Array
    trials: int


@pytree
class Slowing(Scheme):
    """The law learns less in each trial; what it keeps begins as a number of Python."""

    gain: jax.Array = leaf(default=0.5)

    def initial_memory(self, task):
        return Counted(jnp.zeros((task.N, task.inputs)), 0)

    def learn(self, memory, trial):
        step = self.gain * trial.e[1:] / (1 + memory.trials)
        return Counted(trial.u + step, memory.trials + 1)


class Case(NamedTuple):
    own: Scheme  # the user's scheme
    theirs: Scheme  # the scheme of the package that must be equal
    share: str  # path of one weight


# The last case holds both, so it alone is enough where a program takes seconds to compile.
both = pytest.mark.parametrize("case", ["both, under feedback"], indirect=True, scope="module")


def law(gains, **limits):
    return PIDType(gamma_p=gains[0], gamma_d=gains[1], **limits)


@pytest.fixture(scope="module", params=["wrapper", "composition", "both, under feedback"])
def case(request) -> Case:
    rng = np.random.default_rng(7)
    one, other = rng.uniform((0.6, 0.0), (0.9, 0.2), (2, 2))
    caution, share = rng.uniform(0.4, 0.9, 2)
    blend = Blend(law(one), law(other), share)
    mixed = share * one + (1 - share) * other
    if request.param == "wrapper":
        return Case(Cautious(law(one), caution), law(caution * one), "caution")
    if request.param == "composition":
        return Case(blend, law(mixed), "share")
    own = Cautious(WithFeedback(blend, FEEDBACK), caution)
    return Case(own, WithFeedback(law(caution * mixed), FEEDBACK), "scheme.learning.share")


@pytest.mark.thorough(but=["composition"])
def test_they_learn(case):
    ours, theirs = (learn(MACHINE, scheme, TASK, TRIALS) for scheme in (case.own, case.theirs))
    assert theirs.rms[-1, 0] < 0.8 * theirs.rms[0, 0]
    np.testing.assert_allclose(ours.final.u, theirs.final.u, **ALGEBRA)
    np.testing.assert_allclose(ours.rms, theirs.rms, **ALGEBRA)


@pytest.mark.thorough
def test_a_memory_may_begin_with_numbers_of_python():
    at_once = learn(MACHINE, Slowing(), TASK, 4)
    u = np.zeros((N, 1))
    for j in range(4):
        y = np.zeros((N + 1, 1))
        for k in range(N):
            y[k + 1] = 0.7 * y[k] + 0.3 * u[k]
        e = TASK.reference - y
        np.testing.assert_allclose(at_once.rms[j], np.sqrt(np.mean(e[1:] ** 2)), **ALGEBRA)
        u = u + 0.5 * e[1:] / (1 + j)
    known = learn(MACHINE, Slowing(), TASK, 2).memory
    on = learn(MACHINE, Slowing(), TASK, 2, memory=known._replace(trials=2), first=3)
    np.testing.assert_array_equal(on.rms, at_once.rms[2:])


@pytest.mark.thorough
@both
def test_a_machine_plays_them(case, tmp_path):
    memories = [learn(MACHINE, s, TASK, TRIALS).memory for s in (case.own, case.theirs)]
    ours, theirs = (
        schedules(s, memory, TASK)
        for s, memory in zip((case.own, case.theirs), memories, strict=True)
    )
    assert list(ours) == list(theirs)
    for name, rows in ours.items():
        np.testing.assert_allclose(rows, theirs[name], **ALGEBRA)
    rng = np.random.default_rng(8)
    y, u = rng.standard_normal((N + 1, 1)), rng.standard_normal((N, 1))
    turns = [
        Campaign.start(tmp_path / name, scheme, TASK).turn(Measured(y, u, {}, (), "a file"))
        for name, scheme in (("ours", case.own), ("theirs", case.theirs))
    ]
    for name, rows in turns[0].schedules.items():
        np.testing.assert_allclose(rows, turns[1].schedules[name], **ALGEBRA)


@pytest.mark.thorough
@both
def test_theory_claims_the_same_of_them(case):
    drawn = draw(MACHINE, GAIN, 3)
    ours, theirs = (
        certify(MACHINE, scheme, TASK, TRIALS, GAIN, drawn) for scheme in (case.own, case.theirs)
    )
    assert "not claimed" not in theirs.claim
    assert list(ours.claim) == list(theirs.claim)
    np.testing.assert_allclose(ours.sigma, theirs.sigma, rtol=1e-8)
    np.testing.assert_allclose(ours.predicted, theirs.predicted, **ALGEBRA)
    ours, theirs = (
        learning_condition(MACHINE, scheme, TASK).condition for scheme in (case.own, case.theirs)
    )
    assert (ours.verdict, ours.theorem) == (theirs.verdict, theirs.theorem)
    np.testing.assert_allclose(ours.value, theirs.value, rtol=1e-8)


@pytest.mark.thorough
@both
def test_a_sweep_runs_them(case):
    schemes = {"ours": case.own, "theirs": case.theirs}
    found = Sweep(MACHINE, schemes, TASK, 3, GAIN, samples=4, lanes=2).run()["rms"]
    np.testing.assert_allclose(found.sel(scheme="ours"), found.sel(scheme="theirs"), **ALGEBRA)


@pytest.mark.thorough
@both
def test_their_weights_are_tuned_by_name(case):
    assert case.share in named_leaves(case.own)
    problem = Tuning(
        MACHINE,
        case.own,
        TASK,
        3,
        [case.share],
        GAIN,
        Final("rms", floor=0.01),
        samples=4,
        held_out=3,
        steps=4,
        lanes=2,
    )
    tuned = problem.run()
    assert tuned.after < tuned.before
    assert tuned.values[case.share] != tuned.start[case.share]


@pytree
class Silent(Scheme):
    """It plays and learns as its field does, but no part is seen: its memory has no such field."""

    field: Scheme = child()

    def initial_memory(self, task):
        return Kept(self.field.initial_memory(task), jnp.zeros(()))

    def schedule(self, memory, task):
        return self.field.schedule(memory.inner, task)

    def learn(self, memory, trial):
        return Kept(self.field.learn(memory.inner, trial), memory.trials + 1)


def test_a_limit_of_a_scheme_that_is_no_part_is_not_claimed_away():
    """The error of a P-type law with a limit stalls, so that `monotone` would be wrong."""
    free, limited = (
        WithFeedback(Silent(PIDType(gamma_p=0.5, limit=x)), FEEDBACK) for x in (None, 0.3)
    )
    machines = drawn_machines(MACHINE, {}, {})
    assert list(long_run(machines, free, TASK).claim) != ["not claimed"]
    found = long_run(machines, limited, TASK)
    assert list(found.claim) == ["not claimed"]
    assert "Silent.parts leaves out, is met in trial 1" in found.reason[0]
    errors = np.asarray(learn(MACHINE, limited, TASK, 200).rms)[:, 0]
    assert errors[199] > 0.5 * errors[20] > 0.01


def test_limits_and_schedules_of_parts_have_their_names():
    own = Cautious(WithFeedback(Blend(law((0.3, 0.1), limit=0.2), law((0.3, 0.1))), FEEDBACK))
    history = learn(MACHINE, own.unlimited(), TASK, 2)
    found = own.limits(TASK, own.initial_memory(TASK), history.final)
    assert list(found) == ["scheme.learning.first.limit"]
    ffdl = FFDLMFAILC(phi0=(0.5, -0.1, 0.06, 0.03))
    beside = Beside(ffdl, law((0.3, 0.1)))
    names = list(schedules(beside, beside.initial_memory(TASK), TASK))
    assert names[:2] == ["first.table.u", "first.table.u_last"]
    assert names[-1] == "second.u"
    kinds = [type(part.scheme).__name__ for part in with_all_parts(beside, TASK)]
    assert kinds == ["Beside", "FFDLMFAILC", "PIDType"]
    with pytest.raises(ValueError, match=r"with L_y = 2 of FFDLMFAILC, which compares outputs"):
        Ladder(beside, repeats=2, slow=0.5).check(TASK)
    assert beside.frozen().first.eta < 1e-20


@pytree
class OneMethod(Scheme):
    """P-type learning, which only says how it learns."""

    gain: jax.Array = leaf(default=0.5)
    limit: jax.Array = leaf(default=None, interval="(0, inf)", optional=True)
    clips = ("limit",)

    def learn(self, memory, trial):
        return Feedforward(limited(trial.u + self.gain * trial.e[1:], self.limit))


@pytest.mark.thorough
def test_a_law_of_one_method_starts_from_zero_and_is_limited_in_what_it_learns():
    own, theirs = OneMethod(0.5, limit=0.3), PIDType(gamma_p=0.5, limit=0.3)
    ours, known = (learn(MACHINE, one, TASK, TRIALS) for one in (own, theirs))
    np.testing.assert_allclose(ours.rms, known.rms, **ALGEBRA)
    trial = learn(MACHINE, own.unlimited(), TASK, 1).final
    of_own, of_theirs = (
        one.limits(TASK, one.initial_memory(TASK), trial)["limit"] for one in (own, theirs)
    )
    assert np.max(np.abs(of_own.signal)) > 0.3 > np.max(np.abs(trial.u)) == 0
    np.testing.assert_allclose(of_own.signal, of_theirs.signal, **ALGEBRA)


@pytree
class Undecidable(PIDType):
    """A scheme with a mistake: it asks JAX for a decision on a signal."""

    def learn(self, memory, trial):
        return memory if trial.y[1, 0] > 0 else super().learn(memory, trial)


def test_a_mistake_in_the_program_of_a_scheme_is_shown_as_it_is():
    """It is none in a value, which the check of a scenario tells in a sentence."""
    made = Scenario("a", "a", MACHINE, TASK, {"mine": Undecidable(gamma_p=0.5)}, 2, {})
    with pytest.raises(jax.errors.TracerBoolConversionError):
        made.check()
    bad = made.with_values({"mine.lead": 2 * N})
    with pytest.raises(ValueError, match="mine: Undecidable: lead = 80 is"):
        bad.check()
