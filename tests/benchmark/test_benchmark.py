"""`make bench`: every program that is timed computes what the package computes."""

import importlib.util
import json
import platform
from collections import Counter
from functools import partial
from types import SimpleNamespace

import compare
import contests
import gradients
import jax
import jax.numpy as jnp
import numpy as np
import operations
import ours
import peers
import pytest
import timing
from cases import ALGEBRA, first_order, follows, known_to, p_type
from gradients import WEIGHTS, Slope
from jax import lax
from ours import GRADIENT
from timing import OURS

from jaxilc.learning import learn
from jaxilc.pytree.named_paths import replaced
from jaxilc.scenarios import load
from jaxilc.schemes import CFDLMFAILC, PID, PIDType, WithFeedback
from jaxilc.tuning.objectives import Final
from jaxilc.tuning.weights import Weights

OPPONENTS, NOTES = contests.opponents()
WITHOUT_C = pytest.mark.skipif("C limit" not in OPPONENTS, reason="; ".join(NOTES) or "-")


@pytest.fixture(scope="module", params=["cfdl", "ffdl"])
def small(request):
    """Return a setting and the package's metrics of 3 plants, each over 6 trials of 40 samples."""
    of = contests.setting(request.param, 3, 6, 40)
    return of, of.ours(lanes=2)()


def test_the_opponents_leave_the_arithmetic_of_the_process_as_it_is():
    """Linked another way, the program in C let NumPy take denormal numbers as zero."""
    assert np.float64(5e-324) * 1.0 > 0


@pytest.mark.thorough
@pytest.mark.parametrize("name", ["NumPy loop", "NumPy batch", "Numba parallel", "C limit"])
def test_every_opponent_has_our_numbers(small, name):
    if name not in OPPONENTS:
        pytest.skip("; ".join(NOTES))
    of, ours = small
    if name == "Numba parallel" and len(of.problem.phi0) > 1:  # it is compiled for 7 s
        theirs = np.zeros(ours.shape)
        a, plants, *rest = of.problem
        for b, metrics in zip(plants, theirs, strict=True):
            peers._ffdl_plant(a, b, *rest, metrics)
    else:
        theirs = OPPONENTS[name][0](of.problem)
    assert ours.shape == (3, 6, 4)
    np.testing.assert_allclose(theirs, ours, **ALGEBRA)
    assert np.all(np.diff(ours[..., 1], axis=1) != 0)  # the error changes from trial to trial
    assert len(np.unique(ours[:, -1, 1])) == 3  # the plants differ


@pytest.mark.thorough
def test_the_reset_is_the_same_for_all():
    """The estimator's reset gives the same numbers in every opponent.

    The start value has the wrong size, and the estimate changes its sign.
    """
    of = contests.setting("cfdl", 2, 12, 40)
    of = of._replace(scheme=type(of.scheme)(lam=0.01, mu=1e-4, phi0=-1e-3, reset="sign"))
    ours, problem = of.ours(lanes=1)(), of.problem
    for name, (peer, _) in OPPONENTS.items():
        np.testing.assert_allclose(peer(problem), ours, rtol=1e-8, err_msg=name)
    never = of._replace(scheme=type(of.scheme)(lam=0.01, mu=1e-4, phi0=-1e-3, reset="none")).ours(
        lanes=1
    )()
    assert np.max(np.abs(never - ours)) > 1e-6 * np.max(np.abs(ours))  # a reset took place


TARGETS = {"x86-64": ("SSE2", 2), "haswell": ("AVX2", 4), "skylake-avx512": ("AVX-512", 8)}


@pytest.mark.thorough
@WITHOUT_C
@pytest.mark.skipif(platform.machine() not in ("x86_64", "AMD64"), reason="targets of x86-64")
@pytest.mark.parametrize("target", TARGETS)
def test_the_lanes_of_c_follow_from_the_processor(target):
    """Vectors wider than a register were taken apart: the limit took ten times as long."""
    found, here = (peers.target_of_c(of) for of in (target, "native"))
    assert (found.instructions, found.lanes) == TARGETS[target]
    widest_first = [*timing.INSTRUCTIONS.values()]
    if widest_first.index(found.instructions) < widest_first.index(here.instructions):
        pytest.skip(f"this processor has {here.instructions}, not {found.instructions}")
    for name in contests.SCHEMES:
        problem = contests.setting(name, 11, 6, 29).problem  # the last register is not full
        for program in (peers.c_program, peers.c_adjoint):
            np.testing.assert_allclose(program(1, target)(problem), program(1)(problem), **ALGEBRA)


def entry(value, **changes):
    return timing.Entry(lambda: np.full((2, 3, 4), value), 2, 3, 10)._replace(**changes)


def test_wrong_numbers_are_refused():
    with pytest.raises(ArithmeticError, match="other differs from jaxilc by 0\\.01"):
        timing.in_turns({"other": entry(1.01), OURS: entry(1.0)}, repeats=1)
    with pytest.raises(ArithmeticError, match="other differs from jaxilc by nan"):
        timing.in_turns({"other": entry(np.nan), OURS: entry(1.0)}, repeats=1)


def test_other_numbers_in_blocks_are_refused(monkeypatch):
    right = contests.InBlocks.response
    monkeypatch.setattr(
        contests.InBlocks, "response", lambda plant, u, dt: (1 + 2e-9) * right(plant, u, dt)
    )
    with pytest.raises(
        ArithmeticError,
        match="jaxilc in blocks differs from jaxilc by 2e-09 of the largest output; "
        "allowed is 1e-09",
    ):
        contests.compare_long(100, repeats=1)


# Gradients
# --------------------------------------------------------------------------------------------------


TRIALS = {"cfdl": 7, "ffdl": 3}  # in blocks of three trials and of two, with a rest


# phi0 of a wrong size with small lam and mu, with which the estimate changes its sign
RESET = {"cfdl": -1e-3, "ffdl": np.array([0.5, 0.0, -1e-3, 0.1])}


@partial(jax.jit, static_argnames="trials")
def by_jax(machine, scheme, task, b, trials):
    """Return (S, 1+P) mean square errors of the last trials, and their slopes by the weights."""

    def square(weights, b):
        history = learn(replaced(machine, {"plant.b": b}), replaced(scheme, weights), task, trials)
        return history.rms[-1, 0] ** 2

    weights = {name: getattr(scheme, name) for name in WEIGHTS}
    of_each = jax.vmap(jax.value_and_grad(square), in_axes=(None, 0))
    squares, slopes = of_each(weights, b)
    rows = [squares[:, None], *(slopes[name].reshape(len(b), -1) for name in WEIGHTS)]
    return jax.numpy.concatenate(rows, axis=1)


def right(of):
    return np.asarray(by_jax(of.machine, of.scheme, of.task, of.b, of.trials))


@pytest.mark.thorough
@WITHOUT_C
@pytest.mark.parametrize("name", TRIALS)
def test_the_adjoint_in_c_is_the_gradient(name):
    of = contests.setting(name, 17, TRIALS[name], 29)
    expected = right(of)
    assert np.all(np.any(expected != 0, axis=0))
    for adjoint in (peers.c_adjoint(1), peers.c_adjoint(2)):
        for plants in (17, 1):
            np.testing.assert_allclose(
                adjoint(of.part(plants).problem), expected[:plants], **ALGEBRA
            )


@pytest.mark.thorough
@WITHOUT_C
@pytest.mark.parametrize("name", TRIALS)
def test_the_adjoint_in_c_goes_through_the_branch_that_the_reset_took(name):
    of = contests.setting(name, 17, TRIALS[name], 29)
    changed = {"lam": 0.01, "mu": 1e-4, "phi0": RESET[name]}
    of = of._replace(scheme=replaced(of.scheme, changed))
    expected = right(of)
    off = np.abs(peers.c_adjoint(1)(of.problem) - expected)
    assert np.all(off <= 1e-10 * np.max(np.abs(expected), axis=0))
    one = of.part(1)
    never = one._replace(scheme=replaced(one.scheme, {"reset": "none"})).ours(lanes=1)()
    here = peers.c_program(1)(one.problem)
    assert np.max(np.abs(never - here)) > 1e-6 * np.max(here)  # a reset took place


def slope_of(name, plants, trials, samples):
    of = contests.setting(name, plants, trials, samples)
    of = of._replace(scheme=replaced(of.scheme, Weights.of(of.scheme, WEIGHTS).inside))
    return Slope.of(of, Weights.of(of.scheme, WEIGHTS))


@pytest.mark.thorough
@WITHOUT_C
@pytest.mark.parametrize(
    ("name", "shape"), [("cfdl", (5, 2, 8)), ("cfdl", (3, 30, 200)), ("ffdl", (3, 41, 97))]
)
def test_differences_approach_the_adjoint_and_a_larger_step_is_seen(name, shape, monkeypatch):
    of = slope_of(name, *shape)
    right = gradients.by_adjoint(peers.c_adjoint(2))(of)
    largest = np.max(np.abs(right[..., 1:]))

    def off():
        return np.max(np.abs(gradients.by_differences(peers.c_program(1))(of) - right)) / largest

    assert off() < 0.1 * gradients.DIFFERENCES
    monkeypatch.setattr(gradients, "STEP", 1e-2)
    assert off() > gradients.DIFFERENCES


@WITHOUT_C
def test_wrong_gradients_are_refused():
    of = slope_of("cfdl", 3, 4, 20)
    right = gradients.by_adjoint(peers.c_adjoint(1))(of)
    results = {OURS: peers.c_program(1)(of.problem), "reverse": right}
    agreement = partial(gradients._agreement, of, "reverse")
    off = agreement(results | {"1 weight": right[:2, :, :2], gradients.BY_DIFFERENCES: right})
    assert all(value < 1e-12 for value in off.values())
    wrong = right.copy()
    wrong[2, 0, 4] *= 1 + 1e-6  # mu, whose slope is the smallest but one
    with pytest.raises(ArithmeticError, match="C adjoint differs from jaxilc by 1e-06"):
        agreement(results | {gradients.BY_ADJOINT: wrong})
    agreement(results | {gradients.BY_DIFFERENCES: wrong})
    wrong[0, 0, 1] *= 1.01
    with pytest.raises(ArithmeticError, match=r"allowed is 0\.0001"):
        agreement(results | {gradients.BY_DIFFERENCES: wrong})
    with pytest.raises(ArithmeticError, match="by nan"):
        agreement(results | {"reverse": np.full_like(right, np.nan)})
    for error in (1001.0, np.nan, np.inf):
        metrics = results[OURS].copy()
        metrics[1, 2, 0] = error
        with pytest.raises(gradients.Diverges):
            agreement(results | {OURS: metrics})


# Operations
# --------------------------------------------------------------------------------------------------


N, J = 7, 3


def test_a_gradient_of_the_contest_is_of_the_plants_that_are_given():
    """Not of others that a tuning would draw."""
    of = contests.setting("cfdl", 3, 3, 12)
    weights = Weights.of(of.scheme, ("lam", "rho"))
    of = of._replace(scheme=replaced(of.scheme, weights.inside))
    found = gradients._learning(of).derivatives(weights, forward=False).run()
    rms = of.ours()()[:, -1, peers.METRICS.index("rms")]
    losses = slope_of("cfdl", 3, 3, 12).losses(rms**2)
    np.testing.assert_allclose(ours.of_each(found)[:, 0, 0], losses, rtol=1e-10)


def test_loops_sums_and_matrix_products_are_counted_as_by_hand():
    def trial(x, row):
        return jnp.sin(x) / row + 2.0, None

    def run(x, rows, A):
        x = lax.scan(lambda x, _: lax.scan(trial, x, rows), x, None, length=J)[0]
        return jnp.sum(A @ x)

    arguments = jnp.ones(4), jnp.ones(N), jnp.ones((5, 4))
    found = operations.counted(jax.make_jaxpr(run)(*arguments).jaxpr)
    products, summed = 5 * (4 + 3), 5
    expected = {"sin": 4 * N * J, "division": 4 * N * J, "simple": 4 * N * J + products + summed}
    assert found == Counter(expected)


@pytest.mark.parametrize("kind", [*operations.KINDS, "tanh"])
def test_every_kind_takes_some_time(kind, monkeypatch):
    monkeypatch.setattr(operations, "PASSES", 3)
    operations.seconds_of.cache_clear()
    try:
        assert 0 < operations.seconds_of(kind) < 1e-3
        few = operations.cost(Counter({kind: 10}), devices=2)
        assert few == pytest.approx(5 * operations.seconds_of(kind))
    finally:
        operations.seconds_of.cache_clear()


# The command
# --------------------------------------------------------------------------------------------------


SMALL = ["--trials", "4", "--samples", "24", "--long", "200", "--schemes", "cfdl", "--repeats", "1"]


@pytest.fixture
def of_no_size(monkeypatch):
    """Let what is measured by size compute nothing: each size would be a program."""
    by_size, nothing = contests.cost_by_size, SimpleNamespace(ours=lambda: lambda: None)

    def measured(*given, **more):
        with monkeypatch.context() as patched:
            patched.setattr(contests, "setting", lambda *_, **__: nothing)
            return by_size(*given, **more)

    monkeypatch.setattr(contests, "cost_by_size", measured)


@pytest.mark.thorough
@pytest.mark.usefixtures("of_no_size")
def test_the_command(tmp_path, capsys):
    file = tmp_path / "bench.json"
    compare.main(["--plants", "2", *SMALL, "--json", str(file)])
    numbers, text = json.loads(file.read_text()), capsys.readouterr().out
    assert set(numbers["rows"]) == {"cfdl/2", "cfdl gradient/2", "plant/2", "long/200"}
    ways = {OURS, "1 weight forward", "5 weights forward", "5 weights reverse"}
    ways |= {"5 weights native"} if importlib.util.find_spec("llvmlite") else set()
    assert ways <= set(numbers["rows"]["cfdl gradient/2"])
    assert {"python-control", "SciPy lfilter", OURS} == set(numbers["rows"]["plant/2"])
    assert {"SciPy lfilter", contests.BLOCKS, OURS} == set(numbers["rows"]["long/200"])
    for line in (timing.in_words(numbers["machine"]), *numbers["notes"]):
        assert line in text
    assert set(numbers["cost"]["cfdl"]) == {"plants", "trials", "samples"}


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--plants", "0"], "--plants 0 is outside"),
        (["--schemes", "pid"], "--schemes 'pid' is not one of cfdl, ffdl, noilc, ilc-asmc"),
        (["--samples", "3"], "samples = 3 is outside"),
        (["--long", "3"], "--long 3 is not 0 or a whole number from 4 on"),
        (["--repeats", "0"], "--repeats 0 is outside"),
        (["--plants", "1000000000000"], "plants = 1000000000000 and"),
        (["--scenario", "dai-2014"], "dai-2014 has no scheme that learns"),
        (["--scenario", "cao-2019", "--plants", "1000000000000"], "machines = 1000000000000 take"),
    ],
)
def test_bad_input_is_named(arguments, message):
    with pytest.raises(ValueError, match=message):
        compare.main([*SMALL, *arguments])


PID_ALONE = '[schemes.pid]\nclass = "PID"\nkp = 1.0\n'
FILE = f"trials = 3\n{first_order()}{follows(50.0, 0.02)}{p_type(5.0)}{PID_ALONE}{known_to(0.1)}"


def test_a_gradient_is_by_numbers_and_vectors_inside_their_ranges():
    both = WithFeedback(learning=PIDType(gamma_p=5.0), feedback=PID(kp=1.0))
    learned = {"learning.gamma_p", "learning.gamma_i", "learning.gamma_d"}  # leak is 0, an end
    assert set(ours.tunable(both)) == learned | {"feedback.kp", "feedback.ki", "feedback.kd"}
    assert set(ours.tunable(CFDLMFAILC())) == {"lam", "eta", "mu", "phi0", "epsilon"}  # rho is 1


def test_a_share_of_several_with_a_sum_is_no_weight_of_a_gradient():
    """The gradients of all schemes of a scenario with such a law could not be timed."""
    chosen = load("li-2020")
    scheme = chosen.schemes["higher-order"]
    of = ours.Learning(ours.drawn(chosen.machine, {}, 1), scheme, chosen.task, 2, Final("rms"), {})
    assert "learning.alpha" in ours.tunable(scheme)
    assert [ours._may_move(of, x) for x in ("learning.alpha", "feedback.kp")] == [False, True]


@pytest.mark.thorough
def test_the_command_times_the_schemes_of_a_file_that_learn(tmp_path, capsys):
    file, json_file = tmp_path / "axis.toml", tmp_path / "bench.json"
    file.write_text(FILE)
    arguments = ["--scenario", str(file), "--plants", "5", "--repeats", "2"]
    compare.main([*arguments, "--json", str(json_file)])
    assert "axis: 5 machines, 3 trials of 20 samples" in capsys.readouterr().out
    numbers = json.loads(json_file.read_text())
    assert list(numbers["rows"]) == ["axis/ilc/5"]  # pid does not learn
    rows = numbers["rows"]["axis/ilc/5"]
    assert list(rows) == [OURS, GRADIENT]
    for row in rows.values():
        assert (row["plants"], row["trials"], row["steps"]) == (5, 3, 5 * 3 * 20)
        assert len(row["seconds"]) == 2
    weights = ["gamma_p", "gamma_i", "gamma_d"]
    assert 0 < numbers["operations_ns"]["axis/ilc/5"] < min(r["ns_best"] for r in rows.values())
    assert numbers["gradients"]["axis/ilc/5"] == {"weights": weights, "dropped": 0}
