"""Several experiments, each from rest, are one record."""

import jax
import numpy as np
import pytest
import scipy.signal

from jaxilc.identification import Record, identify
from jaxilc.identification.estimation import _inner_products
from jaxilc.identification.problem import checked_record
from jaxilc.identification.records import first_of, output_from_rest, task_of
from jaxilc.learning import Machine
from jaxilc.plants import ProcessModel

N, DT, POLE, TRIALS = 30, 0.01, 9.0, 3


@pytest.fixture(scope="module")
def record():
    """Return a record of a first-order lag of gain 1 that starts from rest each time, by SciPy."""
    u = np.random.default_rng(1).normal(size=(TRIALS, N))
    kept = np.exp(-POLE * DT)
    y = scipy.signal.lfilter([0.0, 1 - kept], [1.0, -kept], np.pad(u, ((0, 0), (0, 1))))
    return Record(u.reshape(-1, 1), y.reshape(-1, 1), DT, TRIALS)


def test_every_experiment_starts_at_rest(record):
    plant = ProcessModel(1.0, [], [POLE], [], [])
    task = task_of(plant, first_of(record), DT)
    simulated = jax.jit(output_from_rest)(Machine(plant), task, record.u)
    np.testing.assert_allclose(simulated, record.y, rtol=0, atol=1e-12)
    # The sums by which the starts of a fit are compared are those of these outputs.
    fitted = np.arange(len(record.y)) < 70
    common = (task, record.u, 2 * record.y + 1, fitted)
    products = jax.jit(_inner_products)(common, plant)
    columns = np.stack([np.ones(70), record.y[:70, 0], 2 * record.y[:70, 0] + 1])
    np.testing.assert_allclose(products, columns @ columns.T, rtol=1e-12)


def test_lengths_that_do_not_fit_are_refused(record):
    assert checked_record(record).trials == TRIALS
    for wrong in (record._replace(trials=1), record._replace(trials=2)):
        with pytest.raises(ValueError, match="allowed is one more row in y than in u"):
            identify(wrong)
    with pytest.raises(ValueError, match=r"trials = 0 is outside its allowed range \[1, inf\)"):
        identify(record._replace(trials=0))
