"""These tests hold for every plant and every scheme that cases.py lists."""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from cases import ALGEBRA, CASES, DIFFERENCES, FEW, assert_close, case, task_for
from turns import drawn

from jaxilc import tiled
from jaxilc.learning import Machine, learn, over_trials
from jaxilc.plants import StateSpace
from jaxilc.pytree import named_leaves, replaced
from jaxilc.runtime.lanes import usual_stored
from jaxilc.schemes import PID, PIDType

THRESHOLDS = ("epsilon", "theta_limit", "delta", "max_error", "growth", "slow", "scheme.rms")
# The estimators of MFAILC get their first data after two trials and use it in the fourth. Five
# trials are one block of the scan and four are two, in which each trial is compiled twice.
TRIALS = 5
LANES = 3  # of a batch
# A cutoff changes 8.3 and 18.7 ms after the start, and the error leaves the boundary layer late.
LONG = {"p_type_switchable", "asmc_carried_limited"}
# Without jit each operation is compiled by itself, which takes seconds. So this is for the plants,
# filters and laws that ask whether values are known.
WITHOUT_JIT = ("p_type_butterworth", "norm_optimal", "fast_tool_servo_nonlinear")
PARTED = (  # one of each kind; others have their turn
    "p_type_ladder",
    "ffdl_book",
    "norm_optimal",
    "higher_order_leaky_limited",
    "keep_unmeasured",
    "ilc_asmc",
)
of_each_kind = pytest.mark.parametrize("run", PARTED, indirect=True, scope="module")


class Run(NamedTuple):
    """A case is run as a batch, whose first lane has the parts as they are.

    parts: {"machine", "scheme"}
    history: of the parts, that of the first lane
    lanes: the parts perturbed, leaves (LANES, ...)
    batch, gradient: history and gradient of the loss of the lanes, by vmap
    """

    parts: dict
    task: Any
    history: Any
    lanes: dict
    batch: Any
    gradient: dict


def of(parts, task):
    return learn(parts["machine"], parts["scheme"], task, TRIALS)


def loss(parts, task):
    """Return the RMS error of the last trial over all outputs, and the history."""
    history = of(parts, task)
    return jnp.sqrt(jnp.mean(history.rms[-1] ** 2)), history


batched = jax.jit(jax.vmap(jax.value_and_grad(loss, has_aux=True), in_axes=(0, None)))
sampled = jax.jit(lambda machine, dt: machine.sampled(dt), static_argnums=1)


@pytest.fixture(
    scope="module", params=[x for x in CASES if x in PARTED or drawn(f"tests/schemes/{x}")]
)
def run(request) -> Run:
    machine, scheme, task = case(request.param)
    if request.param not in LONG:
        task = task_for(machine.plant, FEW)
    parts = {"machine": machine, "scheme": scheme}
    shrink = np.random.default_rng(1).uniform(0.97, 1.0, (LANES, len(jax.tree.leaves(parts))))
    shrink[0] = 1.0
    leaves, shape = jax.tree.flatten(parts)
    lanes = shape.unflatten(
        [
            np.stack([leaf * f for f in factors])
            for leaf, factors in zip(leaves, shrink.T, strict=True)
        ]
    )
    (_, batch), gradient = batched(lanes, task)
    batch, gradient = jax.device_get((batch, gradient))  # its parts are then taken by NumPy
    return Run(parts, task, lane(batch, 0), lanes, batch, gradient)


def lane(tree, i):
    return jax.tree.map(lambda leaf: leaf[i], tree)


def assert_same(one, other):
    for (name, a), b in zip(named_leaves(one).items(), named_leaves(other).values(), strict=True):
        assert_close(a, b, name)


def test_leaves_are_strongly_typed_floats(run):
    for tree in (run.parts, run.task, run.history.memory, run.history.final):
        for name, leaf in named_leaves(tree).items():
            assert jnp.issubdtype(jnp.result_type(leaf), jnp.floating), name
            assert not jax.typeof(leaf).weak_type or name == "dt", name


@pytest.mark.thorough
@pytest.mark.parametrize("run", WITHOUT_JIT, indirect=True, scope="module")
def test_jit_equals_no_jit(run):
    # Sampling is a matrix exponential of hundreds of operations, which test_plants.py tests.
    parts = run.parts | {"machine": sampled(run.parts["machine"], run.task.dt)}
    with jax.disable_jit():
        assert_same(run.history, of(parts, run.task))


def test_parts_are_made_and_checked_inside_jit_though_nothing_of_them_is_traced(run):
    @jax.jit
    def checked(x):
        parts = {name: replaced(part, named_leaves(part)) for name, part in run.parts.items()}
        over_trials.check(**parts, task=run.task)
        over_trials.check(**run.parts, task=run.task)
        return x

    checked.eval_shape(1.0)


@of_each_kind  # these programs of single machines are compiled in addition to those of batches
def test_vmap_equals_loop(run):
    for i in range(LANES):
        assert_same(lane(run.batch, i), of(lane(run.lanes, i), run.task))
    final = np.asarray(run.batch.rms)[:, -1]
    assert np.all(final[1:] != final[0]), "the lanes should differ"


def test_gradient_of_every_parameter_equals_finite_differences(run):
    """A leaf is moved along a random direction, to both sides in two lanes of the batch."""
    leaves, shape = jax.tree.flatten(run.parts)
    rng = np.random.default_rng(3)
    for at, (name, gradient) in enumerate(named_leaves(run.gradient).items()):
        gradient = np.asarray(gradient)[0]
        assert np.all(np.isfinite(gradient)), name
        # Thresholds act by switching. The forecast of MFAPC (delta, theta) acts only with several
        # moves.
        assert np.any(gradient != 0) or name.endswith(THRESHOLDS), (
            f"{name} has no effect in this case"
        )
        away = rng.choice([-1.0, 1.0], gradient.shape) * np.maximum(np.abs(leaves[at]), 0.1)
        sides = [np.stack([leaf] * LANES) for leaf in leaves]
        sides[at] = leaves[at] + np.multiply.outer([1e-6, -1e-6, 0.0], away)
        (values, _), _ = batched(shape.unflatten(sides), run.task)
        expected = (values[0] - values[1]) / 2e-6
        np.testing.assert_allclose(np.sum(gradient * away), expected, **DIFFERENCES, err_msg=name)


@of_each_kind
def test_other_weights_do_not_retrace(run):
    program = over_trials._program(over_trials._nothing, 1, None, usual_stored())
    of(run.parts, run.task)
    before = program._cache_size()
    for turn in range(10):
        moved = {
            name: np.asarray(value) * (1 - 0.001 * turn)
            for name, value in named_leaves(run.parts).items()
        }
        of(replaced(run.parts, moved), run.task)
    assert program._cache_size() == before


def test_dtype_is_preserved(run):
    with jax.enable_x64(False):
        single = jax.eval_shape(of, run.parts, run.task)
    for precision, tree in (("float32", single), ("float64", (run.history, run.batch))):
        floats = {
            leaf.dtype for leaf in jax.tree.leaves(tree) if jnp.issubdtype(leaf.dtype, jnp.floating)
        }
        assert floats == {jnp.dtype(precision)}


@pytest.mark.thorough
@of_each_kind
def test_in_parts_and_step_by_step_it_learns_what_it_learns_at_once(run):
    """The same is learned in two parts, two trials a pass, and from the record of a trial.

    `truncated` runs four trials and one; the memory after four and the record of the fifth give the
    memory after five, by the step that a real machine takes.
    """
    machine, scheme, task = run.parts["machine"], run.parts["scheme"], run.task
    parts = over_trials.truncated(machine, scheme, task, TRIALS, 1, trials_a_pass=2)
    for name in ("metrics", "final", "memory"):
        assert_same(getattr(run.history, name), getattr(parts, name))
    before = learn(machine, scheme, task, TRIALS - 1, trials_a_pass=2).memory
    last = jax.tree.map(np.asarray, run.history.final)
    step = Compiled(scheme)
    after = over_trials.next_memory(step, task, before, last.y, last.u, **last.signals)
    assert_same(run.history.memory, after)
    if scheme.plays_back:
        np.testing.assert_allclose(scheme.feedforward(before, task), last.u, **ALGEBRA)


class Compiled:
    """A scheme of which only the learning step is known, as one program."""

    def __init__(self, scheme):
        self.scheme = scheme

    def learn(self, memory, trial):
        def program(memory, signals):
            return self.scheme.learn(memory, signals._replace(dt=trial.dt))

        return jax.jit(program)(memory, trial._replace(dt=None))


@pytest.mark.thorough
@of_each_kind
def test_one_device_gives_what_several_give(run):
    spread = tiled(lambda task, parts: of(parts, task).rms, lanes=2)
    np.testing.assert_allclose(spread(run.task, run.lanes), run.batch.rms, **ALGEBRA)


@of_each_kind
def test_single_precision_is_double_precision_but_for_its_digits(run):
    # JAX keeps what it made of an array as long as a program holds it, in that program's precision.
    parts = jax.tree.map(np.array, run.parts)
    with jax.enable_x64(False):
        single = of(parts, run.task)
    scale = np.max(run.history.rms)
    np.testing.assert_allclose(single.rms, run.history.rms, rtol=1e-3, atol=1e-4 * scale)


STATIC = StateSpace([[0.0]], [[1.0]], [[1.0]], dt=1e-3)  # y[k+1] = u[k]
DIVERGING = {
    "plant": (
        lambda pole: (
            Machine(StateSpace(pole[None, None], [[1.0]], [[1.0]], dt=1e-3)),
            PID(kp=0.1),
        ),
        1,
        1,
    ),
    "feedback": (lambda gain: (Machine(STATIC), PID(kp=gain)), 1, 1),
    # e_j = (1 - gamma)^(j-1) r. With gamma = 1e45 and max r = 1 the error of the second trial
    # exceeds a thousand times the reference, and the square of the fifth trial's error exceeds the
    # largest float, 1.8e308.
    "learning": (lambda gain: (Machine(STATIC), PIDType(gamma_p=gain)), 2, 5),
}


@pytest.mark.thorough(but=["feedback"])
@pytest.mark.parametrize("kind", DIVERGING)
def test_a_diverged_lane_is_flagged_and_spoils_no_other(kind):
    build, diverged, when = DIVERGING[kind]
    task, trials = task_for(STATIC), np.arange(1, 11)
    batch = jax.jit(jax.vmap(lambda strength: learn(*build(strength), task, len(trials))))
    alone, together = batch(np.array([0.5, 0.6, 0.7])), batch(np.array([0.5, 1e45, 0.7]))
    for i in (0, 2):
        assert_same(lane(alone, i), lane(together, i))
    np.testing.assert_array_equal(alone.diverged_at, [0, 0, 0])
    np.testing.assert_array_equal(together.diverged_at, [0, diverged, 0])
    np.testing.assert_array_equal(together.diverged, [trials < 0, trials >= diverged, trials < 0])
    np.testing.assert_array_equal(together.finite, [trials > 0, trials < when, trials > 0])
    assert not np.any(np.isfinite(together.rms[1, when - 1 :]))
