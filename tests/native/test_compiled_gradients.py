"""Gradients by compiled programs, against XLA, and a tuning and a search by them."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from cases import SCHEMES, case
from jax import lax

from jaxilc.learning import Actuator, Disturbance, learn
from jaxilc.learning.over_trials import outputs_suffice
from jaxilc.native import llvm, operations, rows, run
from jaxilc.native.program import Const, Numbering, flat, loops, lowered, of_trials
from jaxilc.native.run import Compiled, Native, differs
from jaxilc.runtime.lanes import all_stored
from jaxilc.tuning import Tuning, worst_case_search
from jaxilc.tuning.objectives import Bounded, Final, judge
from jaxilc.uncertainty import Uniform

TRIALS = 5
GAINS = 1 + 0.002 * np.arange(-5, 6)
UNCERTAIN = {"plant.b": Uniform(0.9, 1.1, relative=True)}
NAMES = ("cfdl_smooth", "p_type_fir", "p_type_switchable")


def by_all_leaves(common, gain):
    """The loss of a machine, and its slopes by every number of the machine and of the scheme."""
    (parts, key), task = common
    leaves, structure = jax.tree.flatten(parts)
    real = [i for i, x in enumerate(leaves) if jnp.issubdtype(jnp.asarray(x).dtype, jnp.floating)]

    def loss(values):
        moved = [*leaves]
        for i, x in zip(real, values, strict=True):
            moved[i] = x
        history = learn(*jax.tree.unflatten(structure, moved), task, TRIALS, key=key)
        return jnp.sum(history.rms[-1] ** 2) + 0.1 * jnp.sum(history.rms)

    value, slopes = jax.value_and_grad(loss)([leaves[i] * gain for i in real])
    return value, jnp.concatenate([jnp.ravel(x) for x in slopes])


def arguments(name, **changed):
    machine, scheme, task = case(name)
    return ((dataclasses.replace(machine, **changed), scheme), jax.random.key(3)), task


@pytest.mark.thorough(but=["p_type_fir", "p_type_switchable"])
@pytest.mark.parametrize(
    "name", [n if n == "p_type_switchable" else pytest.param(n, marks=pytest.mark.slow)
             for n in NAMES]
)  # fmt: skip
def test_slopes_by_every_number_are_those_of_xla(name):
    common = arguments(name)
    found = Compiled(by_all_leaves, common, 1.0)(common, GAINS)
    wanted = jax.jit(jax.vmap(by_all_leaves, (None, 0)))(common, GAINS)
    assert differs(found, wanted) is None


def test_slopes_are_the_same_in_tiles_under_jit_and_beside_others(monkeypatch):
    """To the last bit; with noise, which is drawn once for both ways."""
    common = arguments("p_type", disturbance=Disturbance(input_noise=1e-2))
    program = Compiled(by_all_leaves, common, 1.0, lanes=2)
    whole = jax.tree.leaves(program(common, GAINS))
    wanted = jax.jit(jax.vmap(by_all_leaves, (None, 0)))(common, GAINS)
    assert differs(whole, jax.tree.leaves(wanted)) is None
    monkeypatch.setattr(run, "AT_ONCE", 0)
    monkeypatch.setattr(run, "cores", lambda: 2)
    program = Compiled(by_all_leaves, common, 1.0, lanes=2)
    assert program.tile == 4
    for x, y in zip(jax.tree.leaves(jax.jit(program)(common, GAINS)), whole, strict=True):
        np.testing.assert_array_equal(x, y)
    twice = jax.jit(jax.vmap(program, (None, 0)))(common, np.stack([GAINS, GAINS[::-1]]))
    for x, y in zip(jax.tree.leaves(twice), whole, strict=True):
        np.testing.assert_array_equal(x[0], y)
        np.testing.assert_array_equal(x[1], y[::-1])


@pytest.mark.thorough
def test_a_machine_has_the_same_slopes_beside_machines_that_pass_the_level(monkeypatch):
    """To the last bit. A group of which no machine has passed it computes none of the choices."""
    monkeypatch.setattr(rows, "FEW_SAMPLES", 1)
    machine, scheme, task = case("p_type")

    def slope(machine, gain):
        def loss(gain):
            moved = dataclasses.replace(scheme, gamma_p=-gain)
            return judge(machine, moved, task, 9, Final("rms"), ceiling=1.5)

        return jax.value_and_grad(loss)(gain)

    gains, beside = np.array([0.3, 0.25, 0.2, 0.1]), np.array([0.3, 40.0, 0.2, -3.0])
    program = Compiled(slope, machine, 1.0, lanes=4)
    whole, mixed = program(machine, gains), program(machine, beside)
    assert differs(mixed, jax.jit(jax.vmap(slope, (None, 0)))(machine, beside)) is None
    assert mixed[0][1] > np.log(1.5 / 1e-6) > mixed[0][0]
    for x, y in zip(whole, mixed, strict=True):
        np.testing.assert_array_equal(x[::2], y[::2])


@pytest.mark.parametrize("share", [None, 0.9])
def test_numbers_are_rounded_alike_with_and_without_a_choice(monkeypatch, share):
    """A quotient beside a reciprocal that a later loop computes, and a product by itself."""
    monkeypatch.setattr(rows, "FEW_SAMPLES", 1)
    fresh = jnp.linspace(0.1, 1.0, 40)

    def learning(_, gain):
        def trial(carry, j):
            before, passed = carry
            begun = jnp.where(passed, fresh, before if share is None else share * before)
            total, after = lax.scan(lambda s, b: (s + gain / (b + j), gain / (b + j)), 0.0, begun)
            other, _ = lax.scan(lambda s, b: (s + 1.0 / (b + j), None), total, begun)
            return (after, passed | (gain > 5.0)), other

        return lax.scan(trial, (0.3 * fresh, gain > 8.0), jnp.arange(2.0, 6.0))

    program = Compiled(learning, 0.0, 1.0, lanes=4)
    gains, beside = np.array([1.3, 2.0, 3.1, 2.0]), np.array([1.3, 9.0, 3.1, 9.0])
    whole, mixed = program(0.0, gains), program(0.0, beside)
    assert differs(mixed, jax.vmap(learning, (None, 0))(0.0, beside)) is None
    for x, y in zip(jax.tree.leaves(whole), jax.tree.leaves(mixed), strict=True):
        np.testing.assert_array_equal(x[::2], y[::2])


@pytest.mark.parametrize(
    ("read", "once"),
    [("what begins", 0), ("what was before", 0), ("another choice", 0), ("without a choice", 1),
     ("a result", 0)],
)  # fmt: skip
def test_what_a_trial_begins_with_is_stored_once_unless_something_else_is_chosen(
    monkeypatch, read, once
):
    """A later sample reads what was there, or something else."""
    found, taped = [], llvm._taped
    monkeypatch.setattr(llvm, "_taped", lambda plan: found.append(taped(plan)) or found[-1])
    fresh = jnp.linspace(0.1, 1.0, 40)

    def learning(_, gain):
        def trial(carry, j):
            before, passed = carry
            begun = before if read == "without a choice" else jnp.where(passed, fresh, before)
            late = {"what was before": before, "another choice": jnp.where(passed, 2.0, before)}
            late, told = (
                jnp.concatenate([x[:1], x[:-1]])
                for x in (late.get(read, begun), before if read == "a result" else begun)
            )
            total, after = lax.scan(
                lambda s, b: (s + b[1], 0.9 * b[0] - 0.3 * b[1] + 1e-3 * s), 0.0, (begun, late)
            )
            return (after, passed | (gain * total > 60.0)), (total, begun, told)

        return lax.scan(trial, (gain * fresh, gain > 8.0), jnp.arange(6.0))

    gains = np.array([1.3, 2.0, 2.2, 2.5, 3.0, 9.0, 1.0])
    program = Compiled(learning, 0.0, 1.0, lanes=4)
    assert differs(program(0.0, gains), jax.vmap(learning, (None, 0))(0.0, gains)) is None
    assert [len(of) for of in found] == [once]


def runs_again(program):
    """The loops over samples in which the way back of a gradient runs forward."""
    back = next(step for _, step in program._parts if step.params["reverse"])
    return [loop for loop in loops(back.params["body"]) if not loop.params["reverse"]]


@pytest.mark.parametrize(
    "name",
    [*(pytest.param(n, marks=pytest.mark.thorough) for n in
       ("cfdl_book", "pfdl_sign", "ffdl_none", "ffdl_smooth", "higher_order", "model_free")),
     "ffdl_lead_limited"],
)  # fmt: skip
@pytest.mark.parametrize("blocks", [1, 3])
def test_a_way_back_runs_no_trial_again_whose_outputs_tell_it(name, blocks):
    """Of a linear machine under an elementwise law; the memory after a trial is read, too."""
    common = arguments(name)

    def slope(common, gain):
        ((machine, scheme), _), task = common

        def loss(gain):
            moved = jax.tree.map(
                lambda x: x * gain if jnp.issubdtype(jnp.asarray(x).dtype, jnp.floating) else x,
                scheme,
            )
            return judge(machine, moved, task, TRIALS, Final("rms"), ceiling=1e3)

        return jax.value_and_grad(loss)(gain)

    program = Compiled(slope, common, 1.0, blocks=blocks)
    assert not runs_again(program)
    wanted = jax.jit(jax.vmap(slope, (None, 0)))(common, GAINS)
    assert differs(program(common, GAINS), wanted) is None


def test_outputs_are_stored_of_elementwise_laws_on_linear_machines_alone():
    machine, scheme, task = case("ffdl_sign")
    limited = dataclasses.replace(machine, actuator=Actuator(limit=1e9))
    real = case("motor_real")[0]
    feedback = case("cfdl_mfapc")[1]
    assert not outputs_suffice(machine, scheme, task)  # by XLA
    with all_stored():
        assert outputs_suffice(machine, scheme, task)
        assert not outputs_suffice(limited, scheme, task)
        assert not outputs_suffice(real, scheme, task)
        assert not outputs_suffice(machine, feedback, task)
        assert outputs_suffice(machine, Bounded.around(scheme, task), task)


@pytest.mark.parametrize("blocks", [1, 2])
def test_what_is_carried_a_sample_late_becomes_rows_where_it_is_stored(blocks):
    """The plant would run again; what is carried is its output and that of two samples before."""
    reference = jnp.sin(jnp.arange(12.0))

    def loss(gain, memory):
        def sample(carry, u):
            x, y, before = carry
            u = u - 0.3 * y * before
            x = 0.7 * x + u
            return (x, x - 0.1, y), (x - 0.1, y * before)

        def trial(carry, j):
            u, _ = carry
            _, (y, products) = lax.scan(sample, (0.0, 0.5, 0.2), u)
            e = reference - jnp.concatenate([y[1:], y[-1:]])
            after = u + gain * e / (1.0 + u * u) + 0.01 * products
            return (after, y), jnp.sum(e * e)

        stored = jax.checkpoint(trial)
        return jnp.sum(lax.scan(stored, (memory, memory), jnp.arange(6.0))[1])

    def slopes(memory, gain):
        return jax.grad(loss, (0, 1))(gain, memory * gain)

    memory, gains = 0.1 * reference, np.array([0.1, 0.2, 0.3])
    program = Compiled(slopes, memory, 0.1, lanes=2, blocks=blocks)
    wanted = jax.vmap(slopes, (None, 0))(memory, gains)
    assert differs(program(memory, gains), wanted) is None


def test_a_loop_takes_parts_and_sums_of_rows_that_it_reads_itself():
    """Those of a law at sample k and of the learning from it at k + 1 are the same numbers."""

    def slope(common, gain):
        rows, level = common

        def loss(gain):
            def sample(x, now):
                v, r = now
                return (y := 0.9 * x + gain * jnp.clip(v, r - level, r + level)), y

            def trial(u, _):
                y = lax.scan(sample, 0.0, (u, rows[:-1]))[1]
                seen = jnp.clip(y, rows[1:] - level, rows[1:] + level)
                return u - 0.3 * seen + jnp.broadcast_to(level, 40), jnp.sum(seen)

            return jnp.sum(lax.scan(trial, jnp.ones(40), jnp.arange(4.0))[1])

        return jax.value_and_grad(loss)(gain)

    common, gains = (np.sin(np.arange(41.0)), 0.4), np.linspace(0.3, 1.7, 7)
    program = Compiled(slope, common, 1.0, lanes=2)
    wanted = jax.vmap(slope, (None, 0))(common, gains)
    assert differs(program(common, gains), wanted) is None
    _, there = program._parts[0]
    known = there.ins[: there.params["consts"]]
    assert [x.shape for x in known if x.shape != ()] == [(41,)]


@pytest.mark.parametrize(
    ("shape", "prepared"),
    [((40,), lambda x: x[::2]), ((20, 20), lambda x: x[3]), ((30, 20), lambda x: x[3]),
     ((20, 2), lambda x: x.reshape(40)[:20]), ((2, 20), lambda x: x.reshape(20, 2)[:, 0]),
     ((20,), lambda x: x.astype("float16").astype(float))],
)  # fmt: skip
def test_a_loop_leaves_what_it_cannot_take_itself_to_the_steps_before_it(shape, prepared):
    """Every other sample, a row of a matrix, samples that become channels, and few digits."""

    def last(common, gain):
        r = prepared(common)

        def trial(u, _):
            y = lax.scan(lambda x, now: (0.9 * x + now, x), 0.0, u)[1]
            return u + gain * (r - y), None

        return lax.scan(trial, jnp.zeros(20), jnp.arange(4))[0]

    common, gains = np.random.default_rng(5).normal(size=shape), np.array([0.3, 0.8])
    wanted = jax.vmap(last, (None, 0))(common, gains)
    assert differs(Compiled(last, common, 1.0, lanes=2)(common, gains), wanted) is None


@pytest.mark.parametrize("some", [slice(None, None, 2), slice(1, None, 3), slice(2, -1, 4)])
def test_samples_in_even_steps_are_taken_there_and_back(some):
    """A slice of them was refused."""

    def last(common, gain):
        def trial(u, _):
            y = lax.scan(lambda x, now: (0.9 * x + now, x), 0.0, u)[1]
            return u + gain * jnp.mean((common - y)[some]), None

        return jnp.sum(lax.scan(trial, jnp.zeros(14), jnp.arange(4))[0] ** 2)

    both = jax.value_and_grad(last, argnums=1)
    common, gains = np.random.default_rng(6).normal(size=14), np.array([0.03, 0.08, -0.05])
    wanted = jax.vmap(both, (None, 0))(common, gains)
    assert differs(Compiled(both, common, 1.0, lanes=2)(common, gains), wanted) is None


@pytest.mark.parametrize(
    "used",
    [lambda p, x, r: x / (p + 3.0), lambda p, x, r: x * (p + 1.0) + r,
     lambda p, x, r: jnp.where(p > 0, r, x) + r, lambda p, x, r: x / (p + 1.0) + r,
     lambda p, x, r: jnp.clip(1 / p, -1, 1)],
)  # fmt: skip
def test_a_share_of_zero_gives_the_same_digits_beside_other_shares(monkeypatch, used):
    monkeypatch.setattr(rows, "FEW_SAMPLES", 1)
    r = jnp.asarray(np.random.default_rng(6).normal(size=40))

    def learning(_, one):
        share, gain = one

        def trial(u, _):
            seen = used(jnp.where(u > r, 1.0, -1.0) * share, u * gain, r)
            y = lax.scan(lambda x, now: (0.9 * x + now, x), 0.1, seen)[1]
            return jnp.tanh(u + 0.3 * (r - y)), seen

        return lax.scan(trial, 0.3 * r[::-1], jnp.arange(3))

    shares, gains = np.array([0.0, 0.0, 0.0, 0.7]), np.array([0.4, 0.7, 0.9, 0.7])
    program = Compiled(learning, (), (1.0, 1.0), lanes=2)
    found = program((), (shares, gains))  # the third machine is beside a share that is not zero
    alone = program((), (shares[[2, 2]], gains[[2, 2]]))
    assert differs(found, jax.vmap(learning, (None, 0))((), (shares, gains))) is None
    for x, y in zip(found, alone, strict=True):
        np.testing.assert_array_equal(x[2], y[0])


def test_a_gradient_computes_no_number_of_a_trial_that_nobody_reads():
    machine, scheme, task = case("p_type")

    def slope(machine, gain):
        def loss(gain):
            moved = dataclasses.replace(scheme, gamma_p=gain)
            return judge(machine, moved, task, 4, Final("rms"))

        return jax.grad(loss)(gain)

    program = Compiled(slope, machine, 1.0)
    read = {*program._program.outs}
    read |= {x for step in program._after for x in step.ins}
    for before, loop in reversed(program._parts):
        assert read.issuperset(loop.outs[loop.params["carry"] :])
        read.update(loop.ins)
        for step in reversed(before):
            assert not read.isdisjoint(step.outs)
            read.update(step.ins)


def test_a_product_less_itself_is_zero():
    """Else the slopes of a choice between it and 0 are those of another choice."""

    def slopes(_, gain):
        def trial(u, _):
            y = lax.scan(lambda x, v: (0.9 * x + v * gain, x * v - x * v), gain, u)[1]
            return 0.9 * u + jnp.maximum(y, u - lax.stop_gradient(u)), jnp.sum(y)

        return jax.value_and_grad(lambda u: jnp.sum(lax.scan(trial, u, jnp.arange(3.0))[0]))(
            gain * jnp.sin(jnp.arange(1.0, 9.0))
        )

    gains = np.linspace(0.3, 1.7, 7)
    found = Compiled(slopes, 0.0, 1.0, lanes=2)(0.0, gains)
    assert differs(found, jax.vmap(slopes, (None, 0))(0.0, gains)) is None


def numbers_of(fn, *arguments):
    program = lowered(jax.make_jaxpr(fn)(*arguments), 1)
    found = Numbering()
    found.add(program.steps)
    return [found(x) for x in program.outs]


def test_values_have_the_same_number_where_they_are_computed_alike():
    rows, more = np.arange(3000.0), np.where(np.arange(3000) == 1500, 0.5, np.arange(3000.0))

    def sums(x, k, first=0.0, reverse=False):
        return lax.scan(lambda s, a: (s + k * a, s * k), first, x, reverse=reverse)

    def of(x, y):
        late = lax.scan(lambda s, a: (a, s), 0.0, x)[1]
        return [
            x * y, x * y, y * x, *(x * jnp.asarray(known) for known in (rows, rows, more)),
            *sums(x, 2.0), *sums(x, 2.0), *sums(x, 3.0), *sums(x, 2.0, 1.0),
            *sums(x, 2.0, reverse=True), *sums(y, 2.0), late,
            lax.scan(lambda s, a: (a, a), 0.0, x)[1],
            lax.scan(lambda s, a: (s + 2.0 * a, (s * 2.0, 2.0 * a)), 0.0, x)[1][0],
            lax.scan(lambda s, a: (s, 2.0 * a), 0.0, x)[1],
            lax.scan(lambda s, a: (s + a, 2.0 * a), 0.0, x)[1],
        ]  # fmt: skip

    found = numbers_of(of, rows, more)
    same = [(0, 1), (3, 4), (6, 8), (7, 9), (7, 20), (9, 20), (21, 22)]
    for i, x in enumerate(found):
        for j, y in enumerate(found[:i]):
            assert (x == y) == ((j, i) in same), (j, i)
    assert Numbering()(Const(rows)) == 0


def test_a_number_of_each_trial_is_told_from_one_of_each_sample():
    """Of an array that is read both ways, with as many trials as samples."""
    given = np.arange(1.0, 7.0)

    def learning(u):
        def trial(u, now):
            by_trial = lax.scan(lambda s, a: (s, a * now), 0.0, u)[1]
            by_sample = lax.scan(lambda s, both: (s, both[0] * both[1]), 0.0, (u, given))[1]
            return 0.5 * u, (by_trial, by_sample)

        return lax.scan(trial, u, jnp.asarray(given))[1]

    ((before, loop),) = of_trials(flat(jax.make_jaxpr(learning)(given)))[0]
    numbers = Numbering()
    numbers.add(before)
    found, body = numbers.within(loop, "memory"), loop.params["body"]
    found.add(body.steps)
    by_trial, by_sample = map(found, body.outs[loop.params["carry"] :])
    assert by_trial != by_sample


@pytest.mark.parametrize("samples", [4, 5, 40])
def test_what_is_begun_early_or_asked_for_changes_no_bit(monkeypatch, samples):
    """Of trials as short as what is read ahead, too."""
    begun, early = [], rows.begun_early
    monkeypatch.setattr(
        llvm, "begun_early", lambda *given: begun.append(early(*given)) or begun[-1]
    )

    def loss(gain, lam):
        def trial(carry, _):
            u, phi, y = carry
            wide = u + phi / (lam + phi * phi) * (1.0 - y)
            out = lax.scan(lambda x, v: (0.5 * x + gain * v,) * 2, 0.0, wide)[1]
            du, dy = wide - u, out - y
            last = jnp.concatenate([du[:1], du[:-1]])
            phi = phi + du / (0.1 + du * du + last * last) * (dy - phi * du)
            return (wide, jnp.sqrt(phi * phi + 1e-3), out), jnp.sum((1.0 - out) ** 2)

        first = (jnp.zeros(samples), jnp.full(samples, 0.8), jnp.zeros(samples))
        return jnp.sum(lax.scan(jax.checkpoint(trial), first, None, length=7)[1])

    def slopes(_, gain):
        return jax.value_and_grad(loss, (0, 1))(gain, 0.5 * gain)

    gains, found = np.array([0.5, 0.9, 1.1]), []
    for share, followed in ((0.0, 999), (0.3, 999), (0.9, 0)):
        monkeypatch.setattr(rows, "EARLY", share)
        monkeypatch.setattr(llvm, "FOLLOWED", followed)
        begun.clear()
        found.append(jax.tree.leaves(Compiled(slopes, 0.0, 1.0, lanes=2)(0.0, gains)))
        assert any(begun) == (share > 0.0)
    wanted = jax.tree.leaves(jax.vmap(slopes, (None, 0))(0.0, gains))
    for one, two, three, x in zip(*found, wanted, strict=True):
        np.testing.assert_allclose(one, x, rtol=1e-10)
        np.testing.assert_array_equal(one, two)
        np.testing.assert_array_equal(one, three)


@pytest.mark.thorough
def test_a_loop_keeps_no_rows_that_only_dead_steps_read():
    """As of a solve, whose matrix no slope reads: for such rows there is no room."""

    def loss(gain):
        def trial(u, j):
            y = jax.lax.scan(lambda x, k: (0.5 * x + u, x * gain), gain, jnp.arange(8))[1]
            A = jnp.array([[gain, 1 + y[-1] ** 2], [2.0, u]])
            return jnp.tanh(jnp.linalg.solve(A, y[:2])[0]), jnp.mean(y**2)

        return jnp.sum(jax.lax.scan(trial, gain, jnp.arange(3))[1])

    def slopes(_, gain):
        return jax.value_and_grad(loss)(gain)

    found = Compiled(slopes, (), 1.0)((), GAINS)
    assert differs(found, jax.jit(jax.vmap(slopes, (None, 0)))((), GAINS)) is None


def of_37_trials(first, gain):
    """Slopes by a gain and by what the first trial plays, beside rows and numbers of each trial."""

    def loss(gain, u):
        def sample(x, k):
            return 0.5 * x + gain * k[0] + 0.1 * k[1], x

        def trial(carry, j):
            u, best = carry
            y = jax.lax.scan(sample, gain, (u, jnp.roll(u, 1)))[1]
            e, good = jnp.cos(0.2 * j + jnp.arange(28.0)) - y, y[-1] > 0.1
            u = u + jnp.where(good, 0.3, 0.2 * best) * jnp.roll(e, -1)
            return (u, jnp.minimum(best, jnp.mean(e**2))), (jnp.mean(e**2), y[3], good)

        (u, best), (means, third, good) = jax.lax.scan(trial, (u, 1.0), jnp.arange(37))
        return means[-1] + 0.1 * jnp.sum(third * means) + best * u[5] + 0.01 * jnp.sum(good)

    value, slopes = jax.value_and_grad(loss, argnums=(0, 1))(gain, first)
    return value, *slopes


FIRST = 0.1 * np.arange(28.0)


@pytest.fixture(scope="module")
def at_once():
    """The slopes of all trials at once, which are those of XLA."""
    found = Compiled(of_37_trials, FIRST, 1.0, blocks=1)(FIRST, GAINS)
    assert differs(found, jax.jit(jax.vmap(of_37_trials, (None, 0)))(FIRST, GAINS)) is None
    return found


@pytest.mark.parametrize("count", [2, 36, 99])
def test_slopes_in_blocks_are_those_of_all_trials_at_once(at_once, count):
    """To the last bit: of 19 and 18 trials; of 2 but for the last one; and more than trials."""
    found = Compiled(of_37_trials, FIRST, 1.0, blocks=count)(FIRST, GAINS)
    for x, y in zip(found, at_once, strict=True):
        np.testing.assert_array_equal(x, y)


def test_trials_that_read_those_of_another_loop_in_their_order_are_no_way_back():
    """They are run where they are, and not in blocks from the last one on."""

    def learning(first, gain):
        def trial(u, e):
            y = lax.scan(lambda x, k: (0.5 * x + gain * k, x), 0.0, u)[1]
            return u + 0.3 * (jnp.cos(e) - jnp.roll(y, -1)), u

        _, inputs = lax.scan(trial, first, jnp.arange(9.0))
        return lax.scan(lambda u, before: trial(0.5 * u + before, u[0]), first, inputs)

    program = Compiled(learning, FIRST, 1.0, blocks=3)
    assert program.memories == ""
    wanted = jax.jit(jax.vmap(learning, (None, 0)))(FIRST, GAINS)
    assert differs(program(FIRST, GAINS), wanted) is None


def test_memories_that_the_ram_cannot_hold_are_in_blocks_and_it_is_told(monkeypatch, caplog):
    caplog.set_level("INFO", "jaxilc")
    monkeypatch.setattr(run, "agreed", lambda key: True)  # other tests compare them with XLA

    def told(room):
        monkeypatch.setattr(run, "host_bytes", lambda: room)
        caplog.clear()
        return Native(of_37_trials).why_not(FIRST, GAINS), caplog.text

    of_all, of_blocks = (
        run.cores() * Compiled(of_37_trials, FIRST, 1.0, blocks=n)._held / run.SHARE for n in (1, 6)
    )
    assert of_blocks < 0.8 * of_all
    assert "stores the memories of all 37 trials" in told(of_all)[1]
    reason, text = told(of_blocks)
    assert reason is None
    assert "runs the trials once more, in 6 blocks of 7, and stores" in text
    assert "the memories of" in told(0.99 * of_blocks)[0]


def test_memories_are_in_blocks_where_the_cache_holds_one_of_them_and_not_all(monkeypatch):
    """And where few operations compute them again; nothing is known of the cache elsewhere."""

    def told(share, few=run.FEW_OPERATIONS):
        cache = None if share is None else int(share * stored)
        monkeypatch.setattr(run, "cache_bytes", lambda: cache)
        monkeypatch.setattr(run, "FEW_OPERATIONS", few)
        return Compiled(of_37_trials, FIRST, 1.0).memories

    stored = Compiled(of_37_trials, FIRST, 1.0, blocks=1)._between
    assert "once more, in 6 blocks of 7" in told(0.45)
    for whole in (told(None), told(0.6), told(0.3), told(0.45, few=1)):
        assert "the memories of all 37 trials" in whole


@pytest.mark.thorough
def test_a_wrong_slope_is_refused(monkeypatch, caplog):
    """Of an operation that only the way back has."""
    common = arguments("p_type")
    wrong = lambda n, _, x, y: n.of("sub", x, y)  # noqa: E731
    monkeypatch.setitem(operations.COMPOSED, "add_any", wrong)
    native = Native(by_all_leaves)
    assert "another result than that of XLA" in native.why_not(common, GAINS)
    assert "XLA computes instead" in caplog.text


def test_a_tuning_and_a_search_are_those_of_xla(monkeypatch):
    """Of two starts; a tuning says what computed its slopes.

    XLA compiles nothing ahead, since both call the programs from programs of their own.
    """
    machine, _, task = case("arx")
    of = (machine, SCHEMES["p_type"], task, 4, ("gamma_p",), UNCERTAIN)
    how = {"machines": 5, "held_out": 0, "steps": 2, "starts": 2}

    def found():
        tuning = Tuning(*of, **how)
        worst = worst_case_search(
            lambda machine: jnp.sum(learn(machine, SCHEMES["p_type"], task, 4).rms[-1]),
            machine, UNCERTAIN, starts=3, steps=2,
        )  # fmt: skip
        return tuning.run().slope, worst.loss, "native" in tuning.configuration()["environment"]

    slopes, loss, native = found()
    ahead = []
    monkeypatch.setattr(Compiled, "compile", lambda *_: ahead.append(1))
    monkeypatch.setenv("JAXILC_NATIVE", "on")
    by_program, worst, compiled = found()
    assert (native, compiled, ahead) == (False, True, [])
    np.testing.assert_allclose(worst, loss, rtol=1e-11)
    np.testing.assert_allclose(by_program, slopes, rtol=1e-8)
    assert np.any(by_program != slopes)  # another did compute them
