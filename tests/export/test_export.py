"""An exported law equals the package's: steps, interpreter, C, guard and certificate.

The interpreter is compared with JAX, and the C program, to the last bit, with the interpreter.
"""

import functools
import shutil
import subprocess

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from cases import CASES, SAMPLES, SCHEMES, few, task_for

from jaxilc.export import check, files_of, guard, interpret, law_of, program_of
from jaxilc.export.c import number
from jaxilc.export.certificate import CERTIFICATE, certificate_of
from jaxilc.export.guard import CODES, Trials
from jaxilc.export.steps import dft
from jaxilc.learning import Machine
from jaxilc.native.program import Unknown
from jaxilc.outcomes.exporting import need_single, trials_of_test
from jaxilc.plants import DifferenceEquation, StateSpace
from jaxilc.pytree import pytree
from jaxilc.schemes import (
    CFDLMFAILC,
    PID,
    BasisFunctions,
    Feedforward,
    HigherOrder,
    Ladder,
    LearningFilter,
    MultivariableILC,
    PIDType,
    PolynomialBasis,
    WarmStart,
    WithFeedback,
)
from jaxilc.signals import Task, Trial
from jaxilc.storage.sealed import read_json, seal_of, write_json

FEW = 12
OFTEN = {"cfdl_book", "ffdl_lead_limited", "p_type_fir", "p_type_stop", "ilc_asmc", "higher_order"}
REFUSED = {"basis_gradient"}
LONG = {"constrained", "two_step", "basis_rational"}  # whose solvers iterate
WARNINGS = ("-std=c99", "-O0", "-Wall", "-Wextra", "-pedantic", "-Werror", "-ffp-contract=off")
CHECKED = ("-fsanitize=address,undefined", "-fno-sanitize-recover=all")
needs_c = pytest.mark.skipif(shutil.which("cc") is None, reason="there is no C compiler")
# with those above, each operation of the export and each way to print it
COVERING = {
    "at_samples", "cfdl_mfapc_moves", "cfdl_smooth", "error_filtered", "estimated_disturbance",
    "gradient", "inverses", "learning_filter_butterworth", "model_free", "p_type_iir",
    "p_type_ladder", "p_type_on_reference", "p_type_switchable", "repetitive", "smc_hold_limited",
}  # fmt: skip
# numbers with and without a fraction, functions, constants, branches, whole numbers and states
SINGLE = OFTEN | {"cfdl_mfapc_moves", "inverses", "p_type_on_reference", "repetitive", "p_type_iir"}
EVERY = [
    name if name in OFTEN else pytest.param(name, marks=pytest.mark.slow)
    for name in few(OFTEN | COVERING, [n for n in SCHEMES if n not in REFUSED | LONG])
]


class Signals(dict):
    """Signals of which those that learning does not read are zero."""

    def __missing__(self, name):
        return jnp.zeros((FEW, 1))


def task_of(name):
    """Return the task of a case, with few samples where its times allow it."""
    return task_for(CASES[name][0], SAMPLES if "switchable" in name else FEW)


@functools.cache
def exported(name):
    """Return the law of a case, which two tests take."""
    return law_of(SCHEMES[name], task_of(name), 1e3)


def compiled(folder, texts, *flags, driver="law_test.c", given=b""):
    """Return what a compiled program prints; a warning of the compiler fails."""
    for file, text in texts.items():
        (folder / file).write_text(text)
    made = ["cc", *WARNINGS, *flags, "-o", "law", "law.c", driver, "-lm"]
    found = subprocess.run(made, cwd=folder, capture_output=True, text=True, check=False)
    assert found.returncode == 0, found.stderr
    (folder / "given").write_bytes(given)
    with (folder / "given").open() as file:
        return subprocess.run(
            ["./law"], cwd=folder, stdin=file, capture_output=True, text=True, check=False
        )


@needs_c
@pytest.mark.parametrize("name", EVERY)
def test_the_program_in_c_equals_the_interpreter_to_the_last_bit(name, tmp_path):
    law = exported(name)
    for single in (False, True) if name in SINGLE else (False,):
        ran = compiled(tmp_path, files_of(law, [], "0" * 64, trials_of_test(law), single=single))
        assert (ran.returncode, ran.stdout) == (0, "law: all numbers are equal\n"), ran.stdout


@pytree
class OfLastRise(PIDType):
    """A law that learns a sum of powers, here of one, behind the last rise of the error."""

    def initial_memory(self, task):
        return {'input "u"\\': jnp.zeros((task.N, 1)), "nothing": jnp.zeros((0, 2))}

    def schedule(self, memory, task):
        return Feedforward(memory['input "u"\\'])

    def learn(self, memory, trial):
        ((name, u), (nothing, empty)), e = memory.items(), trial.e[1:]
        last = jnp.max(jnp.where(e[1:] > e[:-1], jnp.arange(1, len(e))[:, None], -1))
        table = jnp.interp(e, jnp.array([-0.2, 0.0, 0.4]), jnp.array([0.1, 0.0, 0.3]))
        table += u.at[last + 5].get(mode="fill", fill_value=0.1)
        bent = jnp.where(e > 0.5, jnp.tanh(e), jnp.sin(e + 0.1 * jnp.abs(u))) + table
        powers = sum(0.1 * bent**i for i in range(1)) + 0.01 * (last // 2 % 3 + (~last & 5))
        u = jnp.where(jnp.arange(len(e))[:, None] > last, powers, u)
        return {name: u, nothing: 2 * empty}


@pytree
class Cancels(PIDType):
    """A law that takes the difference of numbers that are one in single precision."""

    def learn(self, memory, trial):
        return Feedforward(trial.u + self.gamma_p * ((1 + trial.e[1:] / self.gamma_p) - 1))


def test_a_law_that_single_precision_changes_is_refused():
    """A regression played 640 V for 0.85 V: it knows of the rounding of double precision only."""
    need_single(law_of(Cancels(gamma_p=1.0), task_of("p_type"), 1e3), "law")
    said = r"--number float: in single precision inputs of law are off .* is --number double"
    with pytest.raises(ValueError, match=said):
        need_single(law_of(Cancels(gamma_p=1e9), task_of("p_type"), 1e3), "law")


@needs_c
def test_the_least_whole_number_a_power_of_0_and_any_name_are_printed_without_a_warning(tmp_path):
    law = law_of(OfLastRise(), task_of("p_type"), 1e3)
    ran = compiled(tmp_path, files_of(law, [], "0" * 64, trials_of_test(law)), *CHECKED)
    assert (ran.returncode, ran.stdout) == (0, "law: all numbers are equal\n"), ran.stderr


@jax.jit
def by_jax(scheme, memory, task, y, u, signals):
    """Return what a scheme learns from a trial."""
    return scheme.learn(memory, Trial(task.reference, y, u, task.dt, Signals(signals)))


@pytest.mark.parametrize("name", EVERY)
def test_the_interpreter_equals_jax_where_the_guard_is_silent(name):
    """The guard changes no bit, and the law is that of the scheme."""
    scheme, task = SCHEMES[name], task_of(name)
    guarded = exported(name)
    bare = law_of(scheme, task, 1e3, guarded=False)
    played, alone = guarded.played(), bare.played()
    structure = jax.tree.structure(bare.scheme.initial_memory(task))
    for y in trials_of_test(guarded)[:3]:
        before = {name: x for name, x in played.known.items() if name.startswith("memory")}
        (u, code), (v, _) = played.trial(y), alone.trial(y)
        assert u.tobytes() == v.tobytes()
        known = alone.known
        signals = {f.split("signals.")[1]: x for f, x in known.items() if "signals." in f}
        memory = jax.tree.unflatten(structure, before.values())
        learned = by_jax(bare.scheme, memory, task, y, known["record.u"], signals)
        for field, theirs in zip(before, jax.tree.leaves(learned), strict=True):
            np.testing.assert_allclose(known[field], theirs, rtol=1e-10, atol=1e-12)
        if code:  # the law itself has left its limits, and what follows differs
            assert all(np.array_equal(x, played.known[n], equal_nan=True)
                       for n, x in before.items())  # fmt: skip
            break
        for field in before:
            assert played.known[field].tobytes() == alone.known[field].tobytes()


@pytest.mark.parametrize("n", [1, 2, 12, 17, 34, 60, 2 * 997])
def test_the_transform_of_any_length_is_that_of_numpy(n):
    x = np.random.default_rng(n).normal(size=(2, n))
    program = program_of(lambda re, im: dft(re, im, -1.0), *x)
    re, im = interpret(program, list(x))
    np.testing.assert_allclose(re + 1j * im, np.fft.fft(x[0] + 1j * x[1]), atol=1e-12)


def test_a_long_transform_can_be_printed():
    """Loops do not nest deeper with each factor of the length."""
    program = program_of(lambda x: dft(x, 0 * x, -1.0), np.zeros(1024))
    assert all(len(x.shape) <= 3 for step in program.steps for x in step.outs)


def test_a_loop_without_passes_leaves_no_array_without_elements():
    def looped(x, rows):
        return jax.lax.scan(lambda c, row: (c + row[0], c * row), 3.0 * x, rows)

    program = program_of(looped, 1.5, jnp.zeros((0, 2)))
    assert [step.name for step in program.steps] == ["mul"]
    found, rows = interpret(program, [np.float64(1.5), np.zeros((0, 2))], np.float64)
    assert (found, rows.shape) == (4.5, (0, 2))


IN_FLOAT = """#include <math.h>
#include <stdio.h>

int main(void)
{
    for (int i = 1; i <= 1000; ++i) {
        const float x = 0.0078125f * (float) i;
        printf("%a %a %a %a\\n", sinf(x), tanhf(x), powf(x, x), expf(20.0f * x));
    }
    return 0;
}
"""


@needs_c
def test_functions_in_float_are_those_of_the_c_library(tmp_path):
    """Numbers of double precision, rounded, are others."""
    found = compiled(tmp_path, {"law.c": IN_FLOAT}, driver="-lm").stdout.split()
    program = program_of(
        lambda x: [jnp.sin(x), jnp.tanh(x), jnp.power(x, x), jnp.exp(20 * x)], np.zeros(1000)
    )
    wanted = interpret(program, [np.arange(1, 1001, dtype=np.float32) / 128], np.float32)
    assert np.array_equal(np.reshape([*map(float.fromhex, found)], (-1, 4)), np.transpose(wanted))


@pytest.mark.parametrize(("value", "text"), [
    (0.1, "0.1f"), (-0.0, "(-0.0f)"), (1e39, "INFINITY"), (-1e39, "(-INFINITY)"),
])  # fmt: skip
def test_a_number_beyond_the_range_of_float_is_infinite_there(value, text):
    assert number(value, float, single=True) == text


def test_what_cannot_be_exported_is_refused_by_name():
    key = jax.random.key(0)
    with pytest.raises(Unknown, match="draws random numbers"):
        program_of(lambda k: jax.random.normal(jax.random.fold_in(key, k)), jnp.int32(1))
    with pytest.raises(Unknown, match="draws random numbers"):
        program_of(lambda k: jax.random.bits(jax.random.wrap_key_data(k)), np.zeros(2, np.uint32))
    with pytest.raises(Unknown, match="sorts its samples"):
        program_of(jnp.sort, jnp.arange(3.0))
    for divided, message in (
        (lambda i: i // i, "div of int32 by what is no positive constant"),
        (lambda i: jax.lax.scan(lambda j, _: (j % i, None), i, length=3), "rem of int32 by what"),
        (lambda i: i.astype(float) % 2.0, "rem of float64 and float64"),
    ):
        with pytest.raises(Unknown, match=message):
            program_of(divided, jnp.int32(7))
        assert not program_of(lambda i, of=divided: (of(i), i)[1], jnp.int32(7)).steps  # not read
    with pytest.raises(Unknown, match="nobody knows how long"):
        program_of(lambda x: jax.lax.while_loop(lambda y: y > 1, lambda y: y / 3, x), 9.0)


@pytest.mark.parametrize("kind", ["int32", "int64", "uint32"])
def test_whole_numbers_are_divided_as_jax_divides_them(kind):
    def of(i):
        by = jnp.asarray(4, kind)
        divided = [i // 3, i % 3, jax.lax.div(i, by), jax.lax.rem(i, by), jnp.sign(i)]
        return [*divided, i & 5, i | 6, i ^ 9, ~i]

    ends = np.iinfo(kind)
    i = np.array([ends.min, ends.max, *(np.arange(12) + max(-6, ends.min))], kind)
    np.testing.assert_array_equal(interpret(program_of(of, i), [i]), of(jnp.asarray(i)))


@pytest.mark.parametrize("side", ["left", "right"])
def test_a_table_is_searched_for_any_number_as_numpy_does(side):
    at = np.array([-1.0, 0.0, 2.0])
    program = program_of(lambda x: jnp.searchsorted(at, x, side=side), 0.0)
    for x in (-np.inf, -1.0, -0.5, -0.0, 0.0, 1.9, 2.0, np.inf, np.nan):
        assert interpret(program, [np.asarray(x)]) == [np.searchsorted(at, x, side)]


def test_a_table_is_read_at_any_places_as_jax_reads_it():
    """Where JAX gives NaN beyond the end, the last entry was read, and 65 places were refused."""
    rng = np.random.default_rng(0)
    table, at = jnp.asarray(rng.normal(size=(4, 5))), rng.integers(-9, 9, (2, 35))

    def read(i):
        ends = [jnp.take(table, i, axis=1), jnp.take(table[0], i[0, 1]), table[i[0, 0], i[0, 1]]]
        filled = [x.at[i].get(mode="fill") for x in (table, jnp.arange(5), table[0] > 0)]
        return [*ends, *filled, table[:, i], jnp.interp(i / 3.0, jnp.arange(5.0), table[0])]

    for found, wanted in zip(interpret(program_of(read, at), [at]), read(at), strict=True):
        np.testing.assert_allclose(found, wanted, rtol=1e-14)


def test_a_learning_filter_with_segments_is_exported():
    """With y = 0 it learns L r, by the taps of the segment of each sample."""
    r, taps = np.sin(np.arange(FEW + 1) / 3.0), np.array([[0.1, 0.8, 0.2], [0.0, 0.5, 0.3]])
    played = law_of(LearningFilter(taps, starts=(5,)), Task(r, 1e-3), 1e3, guarded=False).played()
    played.trial(np.zeros((FEW + 1, 1)))
    u, _ = played.trial(np.zeros((FEW + 1, 1)))
    after = np.append(r, 0.0)
    expected = [taps[int(k >= 5)] @ after[k : k + 3] for k in range(FEW)]
    np.testing.assert_allclose(u[:, 0], expected, rtol=1e-12, atol=1e-13)


def test_the_guard_goes_back_to_the_last_good_input():
    """NaN, a stuck sensor, growth and a large input each have their code; none is learned from."""
    task = task_of("p_type")
    law = exported("p_type")
    r = np.asarray(task.reference)
    good, bad = trials_of_test(law)[:2], np.where(np.arange(len(r))[:, None] == 3, np.nan, r)
    for y, code in ((bad, "SENSOR"), (0 * r, "STUCK"), (1e3 * r, "GROWN")):
        played = law.played()
        first = played.trial(good[0])[0], played.known["memory.u"]
        assert played.trial(good[1])[1] == 0
        assert CODES[played.trial(y)[1]] == code
        assert played.known["seen.learned"] == 1  # as the memory was then
        u = played.trial(good[1])[0]
        assert not np.array_equal(first[1], played.known["memory.u"])
        assert np.array_equal(u, np.asarray(first[1]))
    for limit in (np.inf, -1.0):
        with pytest.raises(ValueError, match="law_of: limit = "):
            law_of(SCHEMES["p_type"], task, limit)
    small = law_of(SCHEMES["p_type"], task, 0.1).played()
    assert CODES[small.trial(good[0])[1]] == "TOO_LARGE"
    assert np.max(np.abs(small.trial(good[0])[0])) <= 0.1


@pytest.mark.parametrize("beside", [(), (10,)])  # the travel of another axis, which moves
def test_the_guard_lets_an_axis_that_sticks_learn_to_break_away(beside):
    r = np.linspace(0, 1, FEW + 1)[:, None] ** 2 * [*beside, 1]
    law = law_of(PIDType(gamma_p=0.25), Task(r, 1e-3), 10.0)
    for breaks, codes in (
        (0.7, [0, 0, 0, 0, 0, 2, 0, 0]),  # breaks away in trial 4; a sensor that dies later is told
        (9.0, [0, 0, 0, 0, 2, 0, 2, 0]),  # a dead encoder, too, from a tenth of the limit on
    ):
        played, y, found = law.played(), 0 * r, []
        for j in range(len(codes)):
            y[1:] = played.known["schedule.u"]
            y[1:, -1] = np.maximum(y[1:, -1] - breaks, 0) * (j != 5)
            found.append(played.trial(y)[1])
        assert found == codes


@pytest.mark.thorough
@pytest.mark.parametrize(("largest", "code"), [(0.9, 0), (1.1, 2)])
def test_the_guard_takes_any_input_for_that_of_an_axis_where_there_are_more(largest, code):
    r = jnp.linspace(0, 1, FEW + 1)[:, None]
    task = Task(r, 1e-3, inputs=2)
    trial = Trial(r, 0 * r, jnp.hstack([0 * r, largest * r])[1:], 1e-3)
    seen = guard.nothing_seen(PID(), task, ())
    assert guard.of_trial(PID(), task, seen, (), trial, 10.0)[0] == code


def test_the_guard_holds_what_a_feedback_has_learned_to_the_limit():
    inner = WithFeedback(PIDType(gamma_p=0.5), PID(kp=0.01))
    for limit, code in ((1e3, "LEARNED"), (0.1, "TOO_LARGE")):
        law = law_of(WithFeedback(PIDType(gamma_p=1e-6), inner), task_of("p_type"), limit)
        assert CODES[law.played().trial(trials_of_test(law)[0])[1]] == code


def test_a_feedback_under_a_dead_sensor_begins_as_at_rest_on_the_reference():
    """An output of 0 in its place would be an error of the whole position, here of 100."""
    r = 100 + np.arange(FEW + 1)[:, None] ** 2 / 64
    law = law_of(WithFeedback(PIDType(gamma_p=0.5), PID(kp=2.0)), Task(r, 1e-3), 1e3)
    for dead, wanted in ((FEW + 1, 2 * (r - r[0])[:-1]), (1, 0 * r[:-1])):
        played, y = law.played(), r.copy()
        for _ in range(2):  # the second one begins where the first one has ended
            y[:dead] = np.nan
            u, code = played.trial(y)
            assert (np.array_equal(u, wanted), CODES[code]) == (True, "SENSOR")
            played.trial(r)


def test_the_guard_lets_a_law_of_higher_order_learn_from_an_error_that_stays():
    played = law_of(HigherOrder((1.0, 0.0), (0.1, 0.5)), task_of("p_type"), 1e3).played()
    y = np.asarray(task_of("p_type").reference) - 1.0
    assert [CODES[played.trial(y)[1]] for _ in range(3)] == ["LEARNED"] * 3


@pytest.mark.thorough
@pytest.mark.parametrize("law", [
    WarmStart(PIDType(gamma_p=0.5), PolynomialBasis((0,)), theta=[0.1]),
    BasisFunctions(PolynomialBasis((0,)), StateSpace([[0.0]], [[0.5]], [[1.0]], dt=1e-3),
                   start=[0.1]),
])  # fmt: skip
def test_the_guard_lets_a_law_learn_that_does_not_begin_with_zero(law):
    """On the plant y[k+1] = u[k] / 2 both have to play far more than they begin with."""
    r = np.sin(np.arange(FEW + 1) / 3)[:, None]
    played, y, rms = law_of(law, Task(r, 1e-3), 1e3).played(), np.zeros(r.shape), []
    for _ in range(6):
        y[1:] = played.known["schedule.u"] / 2
        rms.append(np.sqrt(np.mean(np.square(r - y))))
        assert CODES[played.trial(y)[1]] == "LEARNED"
    assert rms[-1] < 0.4 * rms[0]


def test_the_guard_bounds_what_is_learned_beside_what_the_law_began_with():
    """A constant error of -4 moves u from 1 to -1, -3 and -5; then +-1.1 (5 + (5 + 1) / 3)."""
    r = np.ones((FEW + 1, 1))
    scheme = WarmStart(PIDType(gamma_p=0.5), PolynomialBasis((0,)), theta=[1.0])
    law = law_of(scheme, Task(r, 1e-3), 1e3)
    for last, code in ((-5.0, "LEARNED"), (-6.0, "TOO_LARGE")):
        played = law.played()
        assert [CODES[played.trial(r - e)[1]] for e in (-4.0,) * 3] == ["LEARNED"] * 3
        assert np.array_equal(played.known["schedule.u"].ravel(), np.full(FEW, -5.0))
        assert CODES[played.trial(r - last)[1]] == code


@pytest.mark.parametrize(("phi0", "code"), [(0.3, "LEARNED"), (0.05, "TOO_LARGE")])
def test_the_guard_stops_an_estimate_that_rises_far_above_its_start(phi0, code):
    """The plant is y[k+1] = 0.7 y[k] + 0.3 u[k], and the law without the guard learns from both."""
    r = 20 * np.sin(np.linspace(0, np.pi, FEW + 1))[:, None]
    scheme = CFDLMFAILC(lam=0.3, rho=0.6, eta=0.5, mu=0.5, phi0=phi0)
    law = law_of(scheme, Task(r, 1e-3), 1e3)
    played, codes = law.played(), []
    for _ in range(6):
        y, u = np.zeros(r.shape), played.known["schedule.u"]
        for k in range(FEW):
            y[k + 1] = 0.7 * y[k] + 0.3 * u[k]
        codes.append(CODES[played.trial(y)[1]])
    assert codes == ["LEARNED", *(code,) * 5]
    found = law.codes(Machine(DifferenceEquation([0.7], [0.3], 1e-3)), 6, jax.random.key(0))
    assert [CODES[i] for i in found] == codes, "as `export` finds them"


def test_the_guard_counts_the_steps_of_a_law_that_repeats_its_trials():
    """An error that stays at 1 moves u by 0.5 in every third trial, to 1.5; then to 2.2 at most."""
    r = np.ones((FEW + 1, 1))
    law = law_of(Ladder(PIDType(gamma_p=0.5), repeats=3), Task(r, 1e-3), 1e3)
    for last, code in ((1.3, "LEARNED"), (1.5, "TOO_LARGE")):
        played = law.played()
        assert {CODES[played.trial(r - 1)[1]] for _ in range(9)} == {"LEARNED"}
        assert np.array_equal(played.known["schedule.u"].ravel(), np.full(FEW, 1.5))
        assert CODES[[played.trial(r - last)[1] for _ in range(3)][-1]] == code


def test_a_law_goes_on_after_a_trial_that_was_refused():
    """A law that learns from constant errors of 1, 1 and 1 meets the bound on its next input."""
    r = np.ones((FEW + 1, 1))
    played = law_of(PIDType(gamma_p=0.5), Task(r, 1e-3), 1e3).played()
    codes = [CODES[played.trial(r - e)[1]] for e in (1.0, np.nan, 1.0, 1.0, 1.0)]
    assert codes == ["LEARNED", "SENSOR", "LEARNED", "LEARNED", "LEARNED"]


def test_the_guard_compares_a_learned_reference_with_the_nearest_output():
    scheme, r = MultivariableILC(PIDType(gamma_p=1e-3), PID(kp=0.01)), task_of("p_type").reference
    task = Task(np.hstack([r + 1, r]), 1e-3, inputs=1)
    for correction, code in ((0.1, "LEARNED"), (1e-6, "TOO_LARGE")):
        law = law_of(scheme, task, 1e3, correction=correction)
        assert CODES[law.played().trial(trials_of_test(law)[0])[1]] == code


def test_a_law_starts_with_what_a_campaign_has_learned():
    task, scheme = task_of("p_type"), SCHEMES["p_type"]
    memory = Feedforward(jnp.arange(FEW, dtype=float)[:, None] / FEW)
    of_guard = Trials(
        best=0.25, learned=3, largest={"u": 1.5}, begun={"u": 0.5}, moved=np.array([True])
    )
    played = law_of(scheme, task, 9.0, memory=memory, trials=of_guard).played()
    names = ("best", "learned", "largest.u", "begun.u", "moved")
    assert [played.known[f"seen.{name}"] for name in names] == [0.25, 3, 1.5, 0.5, True]
    assert np.array_equal(played.trial(np.asarray(task.reference))[0], memory.u)


FUZZ = """#include "law.h"
#include <math.h>
#include <stdio.h>

int main(void)
{
    static law l;
    static const law_real limit[LAW_INPUTS] = LAW_LIMIT;
    law_real y[LAW_OUTPUTS], u[LAW_INPUTS] = { 0 };
    law_start(&l);
    for (int k = 0; fread(y, sizeof y, 1, stdin); k = (k + 1) % (LAW_SAMPLES + 1)) {
        if (k == 0) {
            law_begin(&l);
        }
        if (k < LAW_SAMPLES) {
            law_sample(&l, k, y, u);
        } else if (law_end(&l, y) > 4) {
            return 2;
        }
        if (!(fabs(u[0]) <= limit[0])) {
            return 1;
        }
    }
    return 0;
}
"""


@pytest.mark.thorough
@needs_c
@pytest.mark.parametrize("name", ["ilc_asmc", "ffdl_lead_limited"])
def test_no_output_of_a_sensor_makes_an_input_beyond_its_limit(name, tmp_path):
    """Any bits at all, what is no number, the least number and 0 in every second trial."""
    law, rng = law_of(SCHEMES[name], task_of(name), 1.5), np.random.default_rng(0)
    usual, size = rng.uniform(-1, 1, (8000, FEW + 1)), (4000, FEW + 1)
    any_bits = rng.integers(0, 2**64, size, np.uint64).view(float)
    wild = [any_bits, np.full(size, np.nan), np.full(size, np.inf), np.full(size, 5e-324)]
    usual[::2] = np.choose(rng.integers(0, 8, size), [*wild, *[usual[::2]] * 3, 0 * usual[::2]])
    texts = files_of(law, [], "0" * 64, trials_of_test(law)[:1]) | {"fuzz.c": FUZZ}
    ran = compiled(tmp_path, texts, *CHECKED, driver="fuzz.c", given=usual.tobytes())
    assert ran.returncode == 0, ran.stdout + ran.stderr


def test_what_was_changed_is_named(tmp_path):
    """Each file, the digest in the code, and what the certificate claims."""
    law = law_of(SCHEMES["p_type"], task_of("p_type"), 1.0)
    plant = tmp_path / "axis.toml"
    plant.write_text("dt = 1")
    of_plant = {"path": str(plant), "sha256": "0" * 64}
    claims = {"scheme": "p_type", "verdict": ["none"], "plant_file": None}
    files = files_of(law, [], seal_of(claims), trials_of_test(law)[:1])

    def write():
        for name, text in files.items():
            (tmp_path / name).write_text(text)
        write_json(tmp_path / CERTIFICATE, certificate_of(claims, files))

    write()
    assert check(tmp_path) == claims
    for name in files:
        write()
        (tmp_path / name).write_text(files[name] + " ")
        with pytest.raises(ValueError, match=f"{name} was changed"):
            check(tmp_path)
    (tmp_path / "law.c").unlink()
    with pytest.raises(ValueError, match=r"law.c is missing"):
        check(tmp_path)
    write()
    (tmp_path / "law.h").write_text(files["law.h"].replace(seal_of(claims), "1" * 64))
    with pytest.raises(ValueError, match="carries the certificate 111111111111 of another law"):
        check(tmp_path)
    write()
    content = read_json(tmp_path / CERTIFICATE)
    write_json(tmp_path / CERTIFICATE, content | {"scheme": "other"})
    with pytest.raises(ValueError, match=r"certificate.json was changed"):
        check(tmp_path)
    claims["plant_file"] = of_plant
    files = files_of(law, [], seal_of(claims), trials_of_test(law)[:1])
    write()
    with pytest.raises(ValueError, match=r"axis.toml, from which the law was made, was changed"):
        check(tmp_path)
