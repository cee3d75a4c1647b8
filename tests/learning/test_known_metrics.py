"""Metrics are declared once, and everything that uses them agrees.

This holds also for metrics that are added later.
"""

import dataclasses
from collections import namedtuple
from itertools import product

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from gain_case import STATIC, TASK
from jax import lax

import jaxilc
from jaxilc.learning import Keep, best_trial, metrics
from jaxilc.learning.known_metrics import METRICS, TUNED, Gathering, Metrics
from jaxilc.learning.metrics import Tally, measure
from jaxilc.schemes import PIDType
from jaxilc.signals import Task, Trial
from jaxilc.tuning.objectives import Final, judge


def test_best_trial_and_quantities():
    rms = np.array([[3.0, 1.0], [2.0, 2.5], [2.0, 1.0], [np.nan, 0.1], [2.5, 0.0]])
    np.testing.assert_array_equal(best_trial(rms), [1, 2, 3, 3, 3])
    np.testing.assert_array_equal(best_trial([[np.nan], [np.inf], [1.0]]), [1, 1, 3])
    with pytest.raises(ValueError, match="quantity = 'rms' is a metric or a signal that"):
        Keep.of({"rms": measure})
    with pytest.raises(ValueError, match=r"schemes is empty; at least one is needed"):
        jaxilc.run_schemes(STATIC, {}, TASK, 3)
    with pytest.raises(ValueError, match=r"signal 'rms' is not one of r, y, u, .*, e"):
        Keep(("y", "rms"))


def test_histories_datasets_and_objectives_know_each_metric():
    law, task = PIDType(gamma_p=0.4), dataclasses.replace(TASK, unit="mm", input_unit="V")
    dataset, histories = jaxilc.run_schemes(STATIC, {"p": law}, task, 3)
    for metric in METRICS:
        assert dataset[metric.name].dims == ("scheme", *metric.axes)
        assert dataset[metric.name].attrs.get("units") == (metric.unit_of(task) or None)
    for name in Metrics._fields:
        assert getattr(histories["p"], name) is getattr(histories["p"].metrics, name)
    swept = jaxilc.Sweep(STATIC, {"p": law}, TASK, 3, {}, machines=2).run()
    assert {metric.name for metric in METRICS if metric.swept} == set(swept.data_vars)
    of_all = sum(map(Final, TUNED), Final())
    assert np.isfinite(jax.jit(lambda: judge(STATIC, law, TASK, 3, of_all))())
    with pytest.raises(AttributeError, match=r"'speed'; its metrics are .*'rms'"):
        histories["p"].speed


KINDS = [Gathering(*kind) for kind in product("eu", ("largest", "root mean square"), (False, True))]


def test_a_long_trial_in_single_precision_has_the_root_mean_square_of_its_signals():
    """What each addition to a running sum loses is of one sign where the errors are constant."""
    N, rng = 100_000, np.random.default_rng(3)
    e = np.float32(0.1 + 1e-4 * rng.standard_normal((N, 2)))
    u = np.full((N, 1), 0.3, np.float32)

    @jax.jit
    def gathered(e, u):
        first = Tally.start(e[0], 1, N, settled=False)
        return lax.scan(lambda tally, now: (tally.add(*now, True), None), first, (e, u))[0]

    with jax.enable_x64(False):
        tally = gathered(e, u)
        trial = Trial(0 * e[[0, *range(N)]], -e[[0, *range(N)]], u, 1e-3)
        found = tally.metrics(trial, Task(np.zeros((N + 1, 2)), dt=1e-3, inputs=1))
    for name, x in (("rms", e), ("effort", u)):
        wanted = np.sqrt(np.mean(np.float64(x) ** 2, axis=0))
        np.testing.assert_allclose(found._asdict()[name], wanted, rtol=3e-7)
    double = Tally.start(np.float64(e[0]), 1, N, settled=False)
    assert not any(x is not None for x in double.lost), "double precision stays as it was"


@pytest.mark.thorough
@pytest.mark.parametrize("settle", [(0.0, 0.020), (0.004, 0.013)])
def test_every_way_to_gather_gives_the_metric_of_the_record(monkeypatch, settle):
    """Sample by sample and at once, with its derivative, against a plain formula.

    Two samples share the largest error; then the first of them has the derivative.
    """
    names = [f"metric_{i}" for i in range(len(KINDS))]
    monkeypatch.setattr(metrics, "GATHERED", tuple(zip(names, KINDS, strict=True)))
    monkeypatch.setattr(metrics, "Metrics", namedtuple("Metrics", (*names, "finite")))
    rng = np.random.default_rng(0)
    y, u = rng.standard_normal((21, 2)), jnp.asarray(rng.standard_normal((20, 3)))
    y[7, 0], y[9, 0] = 5.0, -5.0
    y = jnp.asarray(y)
    task = Task(np.zeros((21, 2)), dt=1e-3, settle=settle)
    start, stop, _ = task.settled.indices(21)

    def at_once(y, u):
        return measure(Trial(task.reference, y, u, task.dt), task)[:-1]

    def by_sample(y, u):
        trial, k = Trial(task.reference, y, u, task.dt), np.arange(1, 21)
        tally, _ = lax.scan(
            lambda tally, now: (tally.add(*now), None),
            Tally.start(trial.e[0], 3, 20, start == 0),
            (trial.e[1:], u, (start <= k) & (k < stop)),
        )
        return tally.metrics(trial, task)[:-1]

    def at_its_place(x):
        return jnp.take_along_axis(jnp.abs(x), jnp.argmax(jnp.abs(x), axis=0)[None], axis=0)[0]

    def formula(y, u):
        rows = {
            ("e", False): -y[1:],
            ("e", True): -y[start:stop],
            ("u", False): u,
            ("u", True): u[max(start - 1, 0) : stop - 1],  # u[k] acts on e[k+1]
        }
        return tuple(
            at_its_place(rows[signal, late])
            if of == "largest"
            else jnp.sqrt(jnp.mean(rows[signal, late] ** 2, axis=0))
            for signal, of, late in KINDS
        )

    def with_slopes(f):
        return jax.jit(lambda y, u: (f(y, u), jax.jacobian(f, (0, 1))(y, u)))(y, u)

    expected = with_slopes(formula)
    for found in (at_once, by_sample):
        values, slopes = zip(with_slopes(found), expected, strict=True)
        for one, other in zip(*values, strict=True):
            np.testing.assert_allclose(one, other, rtol=1e-12)
        for one, other in zip(*map(jax.tree.leaves, slopes), strict=True):
            np.testing.assert_allclose(one, other, rtol=1e-10, atol=1e-14)
