"""These tests compare the loop over trials with the same loop by hand, and check the metrics."""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from cases import ALGEBRA, ARX, DT, PLANTS, PRINTED, SCHEMES, case
from dense import lifted_difference

from jaxilc.learning import (
    Disturbance,
    Machine,
    Sensor,
    feedforward,
    learn,
    measure,
    measured_trial,
    next_memory,
    run_trial,
    truncated,
)
from jaxilc.learning.over_trials import _blocks
from jaxilc.plants import DifferenceEquation
from jaxilc.pytree import replaced
from jaxilc.schemes import CFDLMFAILC, PID, PIDType
from jaxilc.signals import Task, Trial
from jaxilc.signals.task import product
from jaxilc.sweeps import Sweep

TRIALS = 5


def y_and_u(trial):
    return {"y": trial.y, "u": trial.u}


def assert_trees_close(one, other, **tolerance):
    jax.tree.map(
        lambda a, b: np.testing.assert_allclose(a, b, **(tolerance or ALGEBRA)), one, other
    )


@pytest.mark.thorough(but=["p_type_over_pid"])
@pytest.mark.parametrize("name", ["pd_type", "ffdl_book", "p_type_over_pid", "cfdl_lead_limited"])
def test_learn_is_the_loop_by_hand(name, machine, task):
    """Trial j uses the key folded with j, and the scheme learns after each trial.

    What is loaded and learned from the record alone, as on a real machine, is the same. A pass of
    the loop holds two trials here, as in a user's sweep, and in the other tests one (conftest.py).
    """
    trials = 8  # two blocks of two passes
    scheme, key = SCHEMES[name], jax.random.key(4)
    noisy = Machine(
        machine.plant, sensor=Sensor(noise=1e-3), disturbance=Disturbance(input_noise=0.01)
    )
    history = learn(noisy, scheme, task, trials, key=key, save=y_and_u, trials_a_pass=2)

    one_trial, learn_from, judge = jax.jit(run_trial), jax.jit(type(scheme).learn), jax.jit(measure)
    memory = scheme.initial_memory(task)
    for j in range(1, trials + 1):
        trial = one_trial(noisy, scheme, task, memory, jax.random.fold_in(key, j))
        before, memory = memory, learn_from(scheme, memory, trial)
        y, u = (np.asarray(of) for of in (trial.y, trial.u))
        assert_trees_close(next_memory(scheme, task, before, y, u, **trial.signals), memory)
        if name != "ffdl_book":  # whose input follows from the outputs of the trial, too
            learned = u - trial.signals.get("feedback", 0.0)
            np.testing.assert_allclose(feedforward(scheme, task, before), learned, **ALGEBRA)
        assert_trees_close(
            jax.tree.map(lambda saved, j=j: saved[j - 1], history.saved), y_and_u(trial)
        )
        assert_trees_close(
            jax.tree.map(lambda figure, j=j: figure[j - 1], history.metrics), judge(trial, task)
        )
    assert_trees_close(history.memory, memory)
    assert_trees_close(history.final, trial)
    assert int(history.diverged_at) == 0


@pytest.mark.thorough(but=["model_free"])
@pytest.mark.parametrize("name", ["p_type", "model_free"])
def test_truncated_learning_is_learning_from_any_first_trial(name):
    """The second part has the noise of its trials, and experiments are judged as such."""
    plain, scheme, task = case(name)
    machine = Machine(plain.plant, sensor=Sensor(noise=1e-2))
    if name == "model_free":  # its experiments have larger errors than what it learns
        scheme, machine = replaced(scheme, {"amplitude": 30.0}), plain
    whole = learn(machine, scheme, task, TRIALS, first=3)
    parts = truncated(machine, scheme, task, TRIALS, 2, first=3)
    assert_trees_close(parts, whole)
    assert_trees_close(truncated(machine, scheme, task, TRIALS, TRIALS, first=3), whole)


def test_truncated_learning_has_the_gradient_of_the_last_trials_by_the_task_too():
    machine, scheme, task = case("p_type")
    before = learn(machine, scheme, task, TRIALS - 1)

    def last(x, run):
        scaled = dataclasses.replace(task, reference=x * jnp.asarray(task.reference))
        return jnp.sum(run(machine, scheme, scaled).rms[-1])

    def alone(*of):
        return learn(*of, 1, first=TRIALS, memory=before.memory)

    found, wanted = (
        jax.jit(jax.grad(lambda x, run=run: last(x, run)))(1.0)
        for run in (lambda *of: truncated(*of, TRIALS, 1), alone)
    )
    np.testing.assert_allclose(found, wanted, rtol=1e-9)


def test_truncated_learning_refuses_what_it_cannot_do(machine, task):
    for last in (0, TRIALS + 1):
        with pytest.raises(ValueError, match=rf"truncated: last = {last} .*\[1, 5\]"):
            truncated(machine, SCHEMES["p_type"], task, TRIALS, last)
    with pytest.raises(ValueError, match="truncated: watch"):
        truncated(machine, SCHEMES["p_type"], task, TRIALS, 2, watch=object())


def test_cfdl_on_a_static_plant_contracts_by_d1_and_d2(task):
    """CFDL-MFAILC on a static plant contracts by d1 and d2, sample by sample.

    The plant is y(k+1) = phi u(k). |e| falls by 1 - rho phi phi^/(lam + phi^^2), and phi^ - phi
    falls by 1 - eta Du^2/(mu + Du^2).
    """
    phi, start, lam, rho, eta, mu = 0.8, 0.5, 0.3, 0.7, 0.6, 0.4
    scheme = CFDLMFAILC(phi0=start, lam=lam, rho=rho, eta=eta, mu=mu, reset="none")
    machine, r = Machine(DifferenceEquation([0.0], [phi], dt=DT)), np.asarray(task.reference)[1:, 0]
    memory, estimate, e = None, np.full(task.N, start), r
    for _ in range(5):
        history = learn(machine, scheme, task, 1, memory=memory)
        np.testing.assert_allclose(history.final.e[1:, 0], e, **ALGEBRA)
        before, memory = memory, history.memory
        if before is not None:
            du = np.asarray(memory.u - before.u)[:, 0]
            estimate = phi + (1 - eta * du**2 / (mu + du**2)) * (estimate - phi)
        np.testing.assert_allclose(np.ravel(memory.phi), estimate, **ALGEBRA)
        e = (1 - rho * phi * estimate / (lam + estimate**2)) * e
    assert np.max(np.abs(estimate - phi)) < 0.31
    assert np.max(np.abs(e)) < 0.3


@pytest.mark.parametrize("plant", [PRINTED, ARX])
@pytest.mark.parametrize("m", [0, 2])
def test_lifted_error_recursion(plant, m, task):
    """The errors obey the lifted recursion e_{j+1} = ((1 - leak) I - G L) e_j + leak r.

    G and L are dense matrices, and e = e(1..N).
    """
    (a, b), N, r = plant, task.N, np.asarray(task.reference)[1:, 0]
    p, i, d, leak = *(np.sign(sum(b)) * np.array([0.6, 0.02, 1.5])), 0.1
    scheme = PIDType(gamma_p=p, gamma_i=i, gamma_d=d, leak=leak, lead=m)
    machine = Machine(DifferenceEquation(a, b, dt=DT))
    saved = learn(machine, scheme, task, TRIALS, save=lambda trial: trial.e).saved
    e, G = np.asarray(saved)[:, 1:, 0], lifted_difference(a, b, N)
    D = np.eye(N, k=m) - np.eye(N, k=m - 1)
    D[N - m :] = 0.0  # no difference extends beyond the end of the trial
    L = p * np.eye(N, k=m) + i * np.tril(np.ones((N, N))) + d * D
    np.testing.assert_allclose(e[0], r, atol=1e-15)
    for j in range(TRIALS - 1):
        np.testing.assert_allclose(
            e[j + 1],
            ((1 - leak) * np.eye(N) - G @ L) @ e[j] + leak * r,
            atol=1e-12 * np.max(np.abs(e)),
        )
    assert np.max(np.abs(e[1] - e[0])) > 0.05


@pytest.mark.parametrize("shape", [(3, 1), (4, 8), (2, 12)])
def test_small_products_are_products(shape):
    rng = np.random.default_rng(1)
    matrix, vector = rng.normal(size=shape), rng.normal(size=shape[1])
    np.testing.assert_allclose(
        product(jnp.asarray(matrix), jnp.asarray(vector)), matrix @ vector, rtol=1e-13, atol=1e-13
    )


def test_save_keeps_what_it_returns(machine, task):
    assert learn(machine, SCHEMES["p_type"], task, 3).saved is None
    saved = learn(
        machine, SCHEMES["p_type"], task, 3, save=lambda trial: (trial.u[::10], jnp.max(trial.y))
    ).saved
    assert [s.shape for s in saved] == [(3, 6, 1), (3,)]


def figures_by_hand(y, u, r, window):
    e = [[r[k, i] - y[k, i] for k in range(len(r))] for i in range(r.shape[1])]
    return {
        "max_error": [max(abs(v) for v in channel[1:]) for channel in e],
        "rms": [(sum(v * v for v in channel[1:]) / (len(channel) - 1)) ** 0.5 for channel in e],
        "settled_error": [max(abs(channel[k]) for k in window) for channel in e],
        "effort": [(sum(v * v for v in u[:, i]) / len(u)) ** 0.5 for i in range(u.shape[1])],
        "finite": True,
    }


@pytest.mark.parametrize(
    ("settle", "window"),
    [
        (None, range(10, 21)),
        ((0.005, 0.012), range(5, 13)),
        ((0.0, 0.02), range(21)),
        ((0.02, 9.0), range(20, 21)),
    ],
)
def test_metrics_against_numpy(settle, window):
    rng, N = np.random.default_rng(8), 20
    r, y, u = rng.normal(size=(N + 1, 2)), rng.normal(size=(N + 1, 2)), rng.normal(size=(N, 3))
    y[0] += 100.0  # no input acts on the first sample
    figures = measure(Trial(r, y, u, DT, {}), Task(r, dt=DT, settle=settle, inputs=3))._asdict()
    for name, expected in figures_by_hand(y, u, r, window).items():
        np.testing.assert_allclose(figures[name], expected, rtol=1e-12, err_msg=name)
    for spoiled in (y, u):
        spoiled[5, 1] = np.nan
        assert not measure(Trial(r, y, u, DT, {}), Task(r, dt=DT, inputs=3)).finite
        spoiled[5, 1] = 0.0


@pytest.mark.parametrize(
    ("settle", "window"),
    [((0.0, 9.0), range(61)), ((0.01, 0.02), range(10, 21)), ((0.059, 9.0), range(59, 61))],
)
def test_metrics_gathered_while_learning_are_those_of_the_record(settle, window, machine, task):
    """The settled windows begin with the trial, lie within it, and end with it."""
    task = Task(task.reference, dt=DT, settle=settle)
    history = learn(machine, SCHEMES["ffdl_book"], task, 3, save=y_and_u)
    for j in range(3):
        y, u = (np.asarray(history.saved[name][j]) for name in "yu")
        for name, expected in figures_by_hand(y, u, np.asarray(task.reference), window).items():
            np.testing.assert_allclose(
                getattr(history.metrics, name)[j], expected, rtol=1e-12, err_msg=name
            )


def test_trials_are_divided_near_their_root():
    """A gradient stores B + J / B memories of J trials; a prime J cannot be divided."""
    memory = jnp.zeros(2**20)
    for trials, blocks in ((100, 10), (80, 8), (82, 2), (97, 1)):
        assert _blocks(trials, memory, 2**22) == blocks
    assert _blocks(100, jnp.zeros(8), 2**22) == 1  # all of them are stored


@pytest.mark.thorough
def test_memory_of_a_gradient_grows_like_the_root_of_the_trials():
    """B + J / B memories are stored: 8 for J = 16, and 16 for 64.

    The slope of 64 trials is that of 61 and of 3, which are primes and stored one by one. In short
    trials, all memories are stored.
    """

    def gradients(N):
        machine, task = Machine(PLANTS["arx"]), Task(np.sin(np.arange(N + 1) / 50), dt=DT)

        def last(lam, *trials):
            memory, first, scheme = None, 1, CFDLMFAILC(phi0=0.3, lam=lam)
            for J in trials:
                history = learn(machine, scheme, task, J, memory=memory, first=first)
                memory, first = history.memory, first + J
            return history.rms[-1, 0]

        @functools.cache
        def compiled(*trials):
            return jax.jit(jax.grad(lambda lam: last(lam, *trials))).lower(0.5).compile()

        return compiled

    def growth(compiled):
        sizes = [compiled(J).memory_analysis().temp_size_in_bytes for J in (16, 64)]
        return sizes[1] / sizes[0]

    long, short = gradients(40_000), gradients(1000)
    assert growth(long) < 2.2
    assert 3.0 < growth(short) < 4.0
    np.testing.assert_allclose(long(64)(0.5), long(61, 3)(0.5), rtol=1e-9)


@pytest.mark.thorough
def test_gradient_of_a_figure_that_is_zero_is_finite():
    """In the first trial u is 0, and so is the effort.

    A machine whose reference is 0 has no error. Tuning must work in both cases.
    """
    machine = Machine(PLANTS["arx"])

    @jax.jit
    @jax.jacrev
    def totals(lam, r):
        history = learn(machine, CFDLMFAILC(phi0=0.3, lam=lam), Task(r, dt=DT), 3)
        figures = history.effort, history.rms, history.max_error, history.settled_error
        return jnp.stack([jnp.sum(figure) for figure in figures])

    for r in (np.zeros(11), np.append(np.zeros(5), np.ones(6))):
        assert np.all(np.isfinite(totals(0.5, r)))


MEASURED = [
    ({"y": np.zeros(60)}, r"y has shape \(60, 1\); this task needs \(61, 1\)"),
    ({"u": np.zeros(61)}, r"u has shape \(61, 1\); this task needs \(60, 1\)"),
    ({"y": np.zeros((61, 2))}, r"y has shape \(61, 2\); this task needs \(61, 1\)"),
    ({"y": np.where(np.arange(61) == 7, np.nan, 0.0)}, "y is not finite at sample 7"),
    ({"y": np.ma.masked_equal(np.arange(61.0), 7)}, "y is not finite at sample 7"),
    ({"u": np.where(np.arange(60) >= 9, np.inf, 0.0)}, "u is not finite at sample 9"),
]


@pytest.mark.parametrize(("signals", "said"), MEASURED)
def test_a_measured_trial_that_does_not_fit_is_named(signals, said, task):
    with pytest.raises(ValueError, match=f"measured_trial: {said}"):
        measured_trial(task, **({"y": np.zeros(61), "u": np.zeros(60)} | signals))


@pytest.mark.parametrize("trials", [0, -3, 2.5, None, "3", True])
def test_trials_must_be_a_positive_number(trials, machine, task):
    said = (
        rf"{trials!r} is not a number"
        if trials in (None, "3", True)
        else rf"{trials} is outside its allowed range \[1, inf\)"
    )
    with pytest.raises(ValueError, match=f"learn: trials = {said}"):
        learn(machine, SCHEMES["p_type"], task, trials)
    with pytest.raises(ValueError, match="learn: first = "):
        learn(machine, SCHEMES["p_type"], task, 1, first=trials)


def test_whole_numbers_may_be_0d_arrays_and_are_told_what_they_are(machine, task):
    law = SCHEMES["p_type"]
    of = [learn(machine, law, task, J, first=J).rms for J in (2, np.array(2), jnp.array(2))]
    np.testing.assert_array_equal(of[1:], of[:1] * 2)
    for trials, said in ((2.0, "= 2.0 is a float; allowed is a whole"), (2.5, "= 2.5 is outside")):
        with pytest.raises(ValueError, match=f"learn: trials {said}"):
            learn(machine, law, task, trials)
    with pytest.raises(ValueError, match="learn: trials is traced; allowed is a static value"):
        jax.jit(lambda trials: learn(machine, law, task, trials).rms)(2)
    for first in (2**31, 2**32 + 1, 2**63):  # the noise of 2**32 + 1 would be that of 1
        with pytest.raises(ValueError, match=r"learn: first = .* range \[1, 2e\+09\] of whole"):
            learn(machine, law, task, 1, first=first)


def test_a_memory_in_the_byte_order_of_another_machine_goes_on_as_it_was(machine, task):
    law = SCHEMES["cfdl_sign"]
    memory = learn(machine, law, task, 2).memory
    wide = jax.tree.map(np.asarray, memory)
    other = jax.tree.map(lambda x: x.astype(x.dtype.newbyteorder(">")), wide)
    key = jax.random.key(0)
    for after in (
        lambda memory: learn(machine, law, task, 2, memory=memory).rms,
        lambda memory: run_trial(machine, law, task, memory, key).y,
    ):
        np.testing.assert_array_equal(after(other), after(wide))


def test_what_a_user_asks_of_the_ranks_of_his_own_arrays_is_not_asked_of_learning(machine, task):
    law = SCHEMES["ilc_mfapc"]
    wanted = learn(machine, law, task, 2).rms
    with jax.numpy_rank_promotion("raise"):
        np.testing.assert_array_equal(learn(machine, law, task, 2).rms, wanted)
        swept = Sweep(machine, {"p": law}, task, 2, {}, machines=1).run()
        with pytest.raises(ValueError, match="could not be broadcast"):
            jnp.ones((2, 3)) + jnp.ones(3)
    np.testing.assert_allclose(swept["rms"][0, 0], wanted[:, 0], rtol=1e-12)


def test_stacked_tasks_are_named_as_stacked_schemes_are(machine, task):
    two = jax.tree.map(lambda r: np.stack([r, r]), task)
    with pytest.raises(
        ValueError, match=r"Task: reference has shape \(2, 61, 1\); .*write jax.vmap"
    ):
        learn(machine, SCHEMES["p_type"], two, 1)


def test_no_memory_is_that_before_the_first_trial(machine, task):
    scheme = SCHEMES["cfdl_sign"]
    begun = scheme.initial_memory(task)
    np.testing.assert_array_equal(feedforward(scheme, task, None), np.zeros((task.N, 1)))
    y, u = np.sin(np.arange(task.N + 1.0)), np.cos(np.arange(float(task.N)))
    for one, other in zip(
        jax.tree.leaves(next_memory(scheme, task, None, y, u)),
        jax.tree.leaves(next_memory(scheme, task, begun, y, u)),
        strict=True,
    ):
        np.testing.assert_array_equal(one, other)
    of_both = (run_trial(machine, scheme, task, x, jax.random.key(1)).y for x in (None, begun))
    np.testing.assert_array_equal(*of_both)


@pytest.mark.parametrize("name", ["machine", "scheme", "task"])
def test_what_is_to_learn_is_what_it_is_called(name, machine, task):
    asked = {"machine": machine, "scheme": SCHEMES["p_type"], "task": task} | {name: -np.inf}
    with pytest.raises(
        ValueError, match=f"{name} = -inf is a float; allowed is a {name.capitalize()}"
    ):
        learn(**asked, trials=1)


TASKS = [
    ({"reference": np.zeros(1)}, r"reference has shape \(1,\)"),
    ({"reference": np.zeros((4, 4, 4))}, r"reference has shape \(4, 4, 4\)"),
    ({"reference": np.zeros((4, 0))}, r"reference has shape \(4, 0\); .* and n_y >= 1"),
    ({"reference": [0.0, np.nan]}, "reference = .*nan.* is outside"),
    ({"reference": [0.0, 1e300]}, r"reference = .* is outside its .* \[-1e\+12, 1e\+12\]"),
    (
        {"reference": [0.0, 1e-300]},
        "reference is 1e-300 at most; allowed is none at all, or one from 1e-15",
    ),
    ({"dt": 0.0}, r"dt = 0.0 is outside its allowed range \[1e-12, 1e\+09\]"),
    ({"dt": 1e300}, r"dt = 1e\+300 is outside its allowed range \[1e-12, 1e\+09\]"),
    ({"dt": 1j}, "dt = 1j is a complex; allowed is a number in"),
    ({"settle": (0.0, np.inf)}, r"settle = \(0.0, inf\) s is not a window"),
    ({"settle": (0.006, 0.002)}, r"settle = \(0.006, 0.002\) s is not a window"),
    ({"settle": (0.5, 0.7)}, r"settle = \(0.5, 0.7\) s is not a window that begins within \[0, 0"),
    ({"settle": 0.005}, r"settle = 0.005 is a float; allowed are a tuple \(a number, a number\)"),
    ({"settle": "late"}, "settle = 'late' is a str; allowed are"),
    ({"unit": 3}, "unit = 3 is a int; allowed is text"),
    ({"inputs": 0}, "inputs = 0"),
]


@pytest.mark.parametrize(("fields", "said"), TASKS)
def test_a_task_that_cannot_be_is_named(fields, said):
    with pytest.raises(ValueError, match=f"Task: {said}"):
        Task(**({"reference": np.zeros(11), "dt": DT} | fields))


def test_a_task_describes_itself():
    task = Task(np.zeros((11, 2)), dt=DT)
    assert (task.N, task.outputs, task.inputs, task.duration) == (10, 2, 2, pytest.approx(0.01))
    np.testing.assert_allclose(task.time, np.arange(11) * 1e-3)
    assert Task(np.zeros(11), dt=DT).reference.shape == (11, 1)


def test_a_pure_feedback_has_nothing_to_load(task):
    with pytest.raises(ValueError, match="PID"):
        feedforward(PID(kp=1.0), task, ())
