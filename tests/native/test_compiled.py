"""Learning by compiled programs, against XLA, and what they refuse."""

import ctypes
import dataclasses
import itertools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from cases import CASES, SCHEMES, case, few

from jaxilc.learning import Disturbance, Sensor, learn
from jaxilc.native import code, llvm, loops, operations, rows, run, why_not
from jaxilc.native.program import Unknown
from jaxilc.native.run import Compiled, Native, differs
from jaxilc.pytree import pytree
from jaxilc.schemes import Feedforward, PIDType

TRIALS = 5
# what a program would need that the compiler does not know, by case
REFUSED = {
    "p_type_butterworth": "complex128",
    "cfdl_butterworth": "complex128",
    "error_filtered": "complex128",
    "learning_filter_butterworth": "complex128",
    "p_type_iir": "complex128",
    "basis_rational": "complex128",
    "norm_optimal_lifted": "two axes of samples",
    "two_step": "while",
    "constrained": "while",
    "basis_gradient": "eigh",
}
QUICK = ("ffdl_sign", "pid_type_leaky_limited", "at_samples", "motor_real")
# with those above and test_operations.py, each branch that any case takes through the compiler,
# each of its operations, and each reason to refuse
COVERING = (
    "asmc_carried_limited", "basis_gradient", "by_position", "cfdl_mfapc_moves", "constrained",
    "cross_coupled", "estimated_disturbance", "gradient", "model_free", "norm_optimal_lifted",
    "p_type_iir", "p_type_stop", "repetitive", "time_varying",
)  # fmt: skip
GAINS = 1 + 0.002 * np.arange(-8, 9)  # of 17 machines


def of_machine(common, gain):
    """Learning of a machine and a scheme whose every number is scaled."""
    (machine, scheme), task = common

    def scaled(x):
        return x * gain if jnp.issubdtype(jnp.asarray(x).dtype, jnp.floating) else x

    history = learn(*jax.tree.map(scaled, (machine, scheme)), task, TRIALS)
    return history.metrics, history.diverged, history.grown_from, history.final.y, history.memory


def arguments(name):
    machine, scheme, task = case(name)
    return (machine, scheme), task


REFERENCE = np.sin(np.arange(12.0))


def of_lag(reference, gain):
    """Five trials of a lag that learns: a small program, where it does not matter which."""

    def sample(x, u):
        return 0.5 * x + gain * u, x

    def trial(u, _):
        e = reference - jax.lax.scan(sample, 0.0, u)[1]
        return u + 0.5 * e, jnp.max(jnp.abs(e))

    return jax.lax.scan(trial, 0.1 * reference, length=TRIALS)


@pytest.fixture(scope="module")
def of_p_type():
    """The program of a scheme, which several tests run."""
    return Compiled(of_machine, arguments("p_type"), 1.0)


@pytest.mark.parametrize(
    "name",
    [n if n in QUICK else pytest.param(n, marks=pytest.mark.slow)
     for n in few(QUICK + COVERING, CASES)],
)  # fmt: skip
def test_every_case_learns_as_by_xla_or_is_refused_by_name(name):
    """With unequal machines in the lanes, and a group that is not full."""
    common = arguments(name)
    if name in REFUSED:
        with pytest.raises(Unknown, match=REFUSED[name]):
            Compiled(of_machine, common, 1.0)
        return
    found = Compiled(of_machine, common, 1.0)(common, GAINS)
    wanted = jax.jit(jax.vmap(of_machine, (None, 0)))(common, GAINS)
    assert differs(found, wanted) is None


@pytest.mark.thorough
def test_a_window_of_samples_divides_a_loop_and_is_not_read_in_each_sample(monkeypatch, of_p_type):
    common, found, masks = arguments("p_type"), [], []
    monkeypatch.setattr(rows, "FEW_RUNS", 0)
    for program in (of_p_type, Compiled(of_machine, common, 1.0)):
        found.append(jax.tree.leaves(program(common, GAINS)))
        buffers = [x for loop in program._loops for x in loop._function.plan.buffers]
        masks.append(sum(x.kind == "given" and x.dtype == bool for x in buffers))
    assert masks[0] == 0 < masks[1]
    for x, y in zip(*found, strict=True):
        np.testing.assert_array_equal(x, y)


@pytest.mark.thorough
def test_what_the_sample_before_has_computed_is_not_computed_again(monkeypatch):
    """FFDL-MFAILC reads the increments of two samples, of which one was read a sample before."""
    handed, common = [], arguments("ffdl_none")
    really = llvm.handed_on

    def noted(*args):
        handed.append(really(*args))
        return handed[-1]

    monkeypatch.setattr(llvm, "handed_on", noted)
    found = Compiled(of_machine, common, 1.0)(common, GAINS)
    assert max(map(len, handed)) >= 2
    monkeypatch.setattr(llvm, "handed_on", lambda *_: [])
    anew = Compiled(of_machine, common, 1.0)(common, GAINS)
    for x, y in zip(*map(jax.tree.leaves, (found, anew)), strict=True):
        np.testing.assert_array_equal(x, y)


@pytest.mark.thorough
@pytest.mark.parametrize("name", ["ffdl_lead_limited", "fast_tool_servo_nonlinear"])
def test_single_precision_is_compiled_too(name):
    """As precisely as the numbers of XLA, which are singles; one has functions of the C library."""
    common, gains = arguments(name), GAINS.astype(np.float32)
    jax.config.update("jax_enable_x64", False)
    try:
        found = Compiled(of_machine, common, gains[0])(common, gains)
        wanted = jax.jit(jax.vmap(of_machine, (None, 0)))(common, gains)
    finally:
        jax.config.update("jax_enable_x64", True)
    assert {x.dtype.name for x in jax.tree.leaves(found)} >= {"float32"}
    assert not any(x.dtype == float for x in jax.tree.leaves(found))
    assert differs(found, wanted) is None


@pytest.mark.thorough
def test_numbers_do_not_depend_on_lanes_groups_threads_or_what_was_in_the_ram(monkeypatch):
    """To the last bit: alone, in groups of 1, 3 and 8 lanes, on 1 and 5 threads, poisoned RAM."""
    common = arguments("ffdl_lead_limited")
    whole = jax.tree.leaves(Compiled(of_machine, common, 1.0)(common, GAINS))

    def same(lanes, gains, part):
        found = jax.tree.leaves(Compiled(of_machine, common, 1.0, lanes=lanes)(common, gains))
        for x, y in zip(found, whole, strict=True):
            np.testing.assert_array_equal(x, np.asarray(y)[part])

    same(8, GAINS[4:5], slice(4, 5))
    same(1, GAINS[:3], slice(0, 3))
    mallopt, poison = ctypes.CDLL(None).mallopt, -6
    assert mallopt(poison, 0x80)  # what is allocated is full of 1.4e306
    try:
        for threads, lanes, order in ((5, 4, 1), (1, 8, -1)):
            for module in (run, code):
                monkeypatch.setattr(module, "cores", lambda threads=threads: threads)
            same(lanes, GAINS[::order], slice(None, None, order))
    finally:
        mallopt(poison, 0)


def test_each_core_has_room_of_its_own_in_the_bytes_that_are_told(of_p_type, monkeypatch):
    told, work = {}, max(loop.work for loop in of_p_type._loops)
    for cores in (1, 4):
        for module in (run, code):
            monkeypatch.setattr(module, "cores", lambda cores=cores: cores)
        told[cores] = of_p_type.bytes_of(machines=1)
        assert np.prod(code.room(work)) == pytest.approx(cores * work, abs=cores * 2 * code.ALIGNED)
    assert told[4] - told[1] == 3 * work > 0


def test_a_machine_that_diverges_touches_no_other(of_p_type):
    common = arguments("p_type")
    calm = jax.tree.leaves(of_p_type(common, GAINS))
    wild = jax.tree.leaves(of_p_type(common, np.where(np.arange(17) == 5, 1e90, GAINS)))
    others = np.arange(17) != 5
    for x, y in zip(calm, wild, strict=True):
        np.testing.assert_array_equal(np.asarray(x)[others], np.asarray(y)[others])
    assert not np.all(np.isfinite(np.asarray(wild[0])[5]))
    assert np.all(np.isfinite(np.asarray(wild[0])[others]))


def test_noise_is_drawn_ahead_and_a_table_is_searched_at_each_sample():
    """Each machine has noise of its own in each trial, and one of them a number out of the way."""
    machine, scheme, task = case("p_type")
    noisy = dataclasses.replace(
        machine, sensor=Sensor(noise=1e-2), disturbance=Disturbance(input_noise=1e-2)
    )

    def of_key(common, number):
        machine, scheme, task, x, y = common
        key = jax.random.fold_in(jax.random.key(1), number)
        history = learn(machine, scheme, task, TRIALS, key=key)

        def tick(k, e):
            return k + 1, jnp.interp(e + 0.01 * k, x, y)

        def trial(carry, row):
            found = jax.lax.scan(tick, carry, row[:, 0])[1]
            return jnp.tanh(jnp.sum(found)), found[-1]

        signals = jnp.stack([history.final.y, jnp.pad(history.final.u, ((0, 1), (0, 0)))])
        return history.metrics, jax.lax.scan(trial, 0.0, signals)

    x = jnp.array([-1.0, -0.0, 0.0, 0.3, 1.0])
    common, numbers = (noisy, scheme, task, x, jnp.sin(3 * x)), np.arange(11, dtype=np.uint32)
    found = Compiled(of_key, common, np.uint32(0))(common, numbers)
    assert differs(found, jax.jit(jax.vmap(of_key, (None, 0)))(common, numbers)) is None
    for part in found:
        assert len(np.unique(np.asarray(jax.tree.leaves(part)[0]).reshape(11, -1)[:, -1])) == 11


def test_another_result_than_that_of_xla_is_refused_and_told(monkeypatch, caplog):
    once = iter(["not that of XLA in haste"])
    monkeypatch.setattr(run, "differs", lambda *of: next(once, None) or differs(*of))
    assert Native(of_lag).why_not(REFERENCE, GAINS) is None
    assert next(once, None) is None
    wrong = dataclasses.replace(operations.INSTRUCTIONS["sub"], text={"f": "fadd"})
    monkeypatch.setitem(operations.INSTRUCTIONS, "sub", wrong)
    reason = Native(of_lag).why_not(REFERENCE, GAINS)
    assert "another result than that of XLA" in reason
    assert "XLA computes instead" in caplog.text


def test_a_few_machines_are_in_fewer_lanes_unless_more_may_come():
    """A shorter register divides sooner. What XLA makes between the loops is rounded otherwise."""
    full = run.width() // 8
    assert [run.lanes_of(n) for n in (1, 2, 3, 99, None)] == [2, 2, min(4, full), full, full]
    native, many = Native(of_lag), Native(of_lag, many=True)
    found = {}
    for of in (GAINS[:1], GAINS):
        assert native.why_not(REFERENCE, of) is None
        assert native.program(REFERENCE, of).lanes == run.lanes_of(len(of))
        found[len(of)] = native.program(REFERENCE, of)(REFERENCE, of)
    jax.tree.map(lambda x, y: np.testing.assert_array_equal(x, y[:1]), *found.values())
    assert many.why_not(REFERENCE, GAINS[:1]) is None
    assert many.program(REFERENCE, GAINS[:1]).lanes == full
    common = arguments("p_type_switchable")
    one, several = (Compiled(of_machine, common, 1.0, lanes)(common, GAINS[:2]) for lanes in (2, 8))
    assert differs(one, several) is None


def test_xla_compiles_for_the_next_call_beside_the_comparison(caplog):
    native = Native(of_lag)
    with jax.log_compiles():
        assert native.why_not(REFERENCE, GAINS, ahead=True) is None
        for batch, compiles in ((GAINS, False), (GAINS[:5], True)):
            caplog.clear()
            native.program(REFERENCE, batch)(REFERENCE, batch)
            assert ("Finished XLA compilation" in caplog.text) == compiles


def test_the_comparison_finds_a_difference_of_one_machine_and_one_number():
    wanted = {"a": np.array([[1.0, 1e6], [np.nan, np.inf]]), "b": np.array([1, 2])}
    assert differs(wanted, wanted) is None
    for name, at, value in (
        ("a", (0, 0), 1.01), ("a", (1, 0), 0.0), ("a", (1, 1), -np.inf), ("a", (0, 1), np.nan),
        ("b", (0,), 2),
    ):  # fmt: skip
        found = {key: x.copy() for key, x in wanted.items()}
        found[name][at] = value
        assert f"['{name}'] of machine {at[0]}" in differs(found, wanted)
    near = {**wanted, "a": wanted["a"] * (1 + 1e-12)}
    assert differs(near, wanted) is None


def test_why_not_names_the_reason():
    machine, scheme, task = case("p_type")
    assert why_not(machine, scheme, task) is None
    assert "all alike" in why_not(machine, SCHEMES["pid_position"], task)
    assert "complex128" in why_not(machine, SCHEMES["p_type_butterworth"], task)

    @pytree
    class ByTable(PIDType):
        """What is learned is few numbers, each of which is played for several samples."""

        def initial_memory(self, task):
            return jnp.zeros((4, 1))

        def schedule(self, memory, task):
            return Feedforward(memory[np.arange(task.N) * 4 // task.N])

        def learn(self, memory, trial):
            return memory + 0.1 * jnp.mean(trial.e)

    assert why_not(machine, ByTable(), task) == "gather that moves the axis of samples"


def test_an_error_of_the_compiler_is_a_reason_and_one_of_learning_is_raised(monkeypatch):
    def broken(*_):
        raise ZeroDivisionError("of ours")

    machine, scheme, task = case("p_type")
    with pytest.raises(ValueError, match="2 outputs"):
        why_not(machine, scheme, dataclasses.replace(task, reference=np.zeros((41, 2))))
    monkeypatch.setattr(run, "Compiled", broken)
    assert "ZeroDivisionError: of ours" in why_not(machine, scheme, task)


def test_without_llvmlite_the_reason_is_told(monkeypatch):
    monkeypatch.setattr(code, "_llvm", code._llvm.__wrapped__)
    monkeypatch.setitem(__import__("sys").modules, "llvmlite", None)
    monkeypatch.setitem(__import__("sys").modules, "llvmlite.binding", None)
    assert "pip install jaxilc[native]" in why_not(*case("p_type"))


def test_machine_code_is_kept_and_what_was_damaged_is_compiled_again(monkeypatch, tmp_path):
    """The code of one program under the name of another is not run either."""
    monkeypatch.setattr(code, "_folder", lambda: str(tmp_path))
    optimised, number = [], itertools.count()
    builder = code._llvm().create_pass_builder
    monkeypatch.setattr(
        code._llvm(), "create_pass_builder", lambda *of: optimised.append(1) or builder(*of)
    )

    def anew(text):
        name = f"kept_{next(number)}"
        code.Code(text).register(name)
        return name

    monkeypatch.setattr(loops, "target", anew)

    def computed():
        return Compiled(of_lag, REFERENCE, 1.0, lanes=2)(REFERENCE, GAINS[:3])

    wanted, (kept,) = computed(), tmp_path.glob("native-*")
    whole = kept.read_bytes()
    for written, again in ((whole, 1), (whole[:-1] + b"?", 2), (b"", 3), (b"?" * 99, 4)):
        kept.write_bytes(written)
        if again > 1:  # then it is written, and what a killed process left goes
            (tmp_path / ".unfinished-1-0123abcd").touch()
        for x, y in zip(computed(), wanted, strict=True):
            np.testing.assert_array_equal(x, y)
        assert len(optimised) == again
        assert kept.read_bytes()[32:] == whole[32:]
        assert [*tmp_path.iterdir()] == [kept]


def test_what_agreed_with_xla_is_not_compared_again(monkeypatch, tmp_path):
    """It is noted on disk, and XLA's own programs are found there: their text is the same again."""
    monkeypatch.setattr(code, "_folder", lambda: str(tmp_path))
    compared = []
    monkeypatch.setattr(run, "differs", lambda *of: compared.append(1) or differs(*of))

    def text():
        native = Native(of_lag)
        assert native.why_not(REFERENCE, GAINS[:2]) is None
        program = native.program(REFERENCE, GAINS[:2])
        return jax.jit(program).lower(REFERENCE, GAINS[:2]).as_text()

    assert text() == text()
    assert len(compared) == 1
    for noted in tmp_path.glob("native-*"):
        noted.write_bytes(b"agrees with XLA")  # which no process wrote
    text()
    assert len(compared) == 2
