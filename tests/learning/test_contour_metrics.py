"""These tests compare the contour metrics with a full search over dense chords, in NumPy."""

import itertools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from cases import ALGEBRA, DIFFERENCES

from jaxilc.learning.quantities import ContourMetric, contour_metrics
from jaxilc.signals import Task, Trial

DT = 1e-3


def distances(y, path):
    """Return the distance of each point from all chords of the path, one by one."""
    found = []
    for point in y:
        nearest = np.inf
        for a, b in itertools.pairwise(path):
            if np.any(a != b):
                share = np.clip((point - a) @ (b - a) / ((b - a) @ (b - a)), 0, 1)
                nearest = min(nearest, np.linalg.norm(point - a - share * (b - a)))
        found.append(nearest)
    return np.array(found)


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


@pytest.mark.thorough
def test_the_metrics_have_a_slope():
    s = np.linspace(0, 3, 101)
    path = np.stack([5 * np.sin(s), 3 * np.cos(s)], axis=1)
    direction = np.random.default_rng(0).standard_normal(path.shape)

    def of(metric, step):
        y = jnp.asarray(path + 0.1 * np.sin(9 * path) + step * direction)
        return metric(Trial(jnp.asarray(path), y, jnp.zeros((100, 2)), DT))

    for metric in contour_metrics(Task(path, dt=DT)).values():
        h = 1e-6
        slope = (of(metric, h) - of(metric, -h)) / (2 * h)
        np.testing.assert_allclose(
            jax.grad(lambda step, metric=metric: of(metric, step))(0.0), slope, **DIFFERENCES
        )


def test_what_is_refused():
    with pytest.raises(ValueError, match="ContourMetric: window = 0 is outside"):
        ContourMetric("largest", 0)
    with pytest.raises(ValueError, match="ContourMetric: of = 'mean' is unknown"):
        ContourMetric("mean", 3)
