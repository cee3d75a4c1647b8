"""These tests compare the contour metrics with a full search over dense chords, in NumPy."""

import jax.numpy as jnp
import numpy as np
import pytest
from cases import ALGEBRA
from dense import distances

from jaxilc.learning.quantities import ContourMetric, contour_metrics
from jaxilc.signals import Task, Trial

DT = 1e-3


@pytest.mark.parametrize("d", [2, 3])
def test_the_metrics_are_those_of_a_full_search(d):
    s = np.linspace(0, 2.5, 161)
    path = np.stack([5 * np.sin(s), 3 * np.sin(2 * s), s**2][:d], axis=1)
    rng = np.random.default_rng(d)
    late = np.maximum(np.arange(161) - 9, 0)  # a lag along the path does not count
    y = path[late] + 0.02 * rng.standard_normal((161, d))
    trial = Trial(jnp.asarray(path), jnp.asarray(y), jnp.zeros((160, d)), DT)
    expected = distances(y, path)[1:]
    metrics = contour_metrics(Task(path, dt=DT))
    assert float(metrics["contour_max"](trial)) == pytest.approx(max(expected), **APPROX)
    rms = np.sqrt(np.mean(expected**2))
    assert float(metrics["contour_rms"](trial)) == pytest.approx(rms, **APPROX)
    assert metrics == contour_metrics(Task(2 * path, dt=DT))  # so a compiled program is shared


APPROX = {"rel": ALGEBRA["rtol"], "abs": ALGEBRA["atol"]}


def test_what_is_refused():
    with pytest.raises(ValueError, match="ContourMetric: window = 0 is outside"):
        ContourMetric("largest", 0)
    with pytest.raises(ValueError, match="ContourMetric: of = 'mean' is unknown"):
        ContourMetric("mean", 3)
