"""These tests compare the contour metrics with a full search over dense chords, in NumPy.

Their slopes are compared with central differences.
"""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from cases import ALGEBRA
from dense import distances

from jaxilc.learning import Machine, learn
from jaxilc.learning.quantities import WAYS, ContourMetric, contour_metrics
from jaxilc.plants import StateSpace
from jaxilc.schemes import PIDType
from jaxilc.signals import Task, Trial
from jaxilc.tuning import Tuning
from jaxilc.tuning.objectives import EveryTrial, Final
from jaxilc.uncertainty import Uniform

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


def metric_of(of, y, path, window=64):
    inputs = jnp.zeros((len(path) - 1, path.shape[1]))
    return ContourMetric(of, window)(Trial(jnp.asarray(path), jnp.asarray(y), inputs, DT))


@pytest.mark.parametrize("of", WAYS)
@pytest.mark.parametrize(
    ("kind", "d"), [("open", 2), ("open", 3), ("closed", 2), ("closed", 3), ("dwelling", 2)]
)
def test_slopes_by_the_outputs_and_the_path_are_differences(kind, d, of):
    s, rng, h = np.linspace(0, 1, 121), np.random.default_rng(d), 1e-7
    turns = 2 * np.pi * s if kind == "closed" else 4 * s
    path = np.stack([5 * np.cos(turns), 3 * np.sin(turns), np.sin(2 * turns)][:d], axis=1)
    if kind == "dwelling":
        path[40:50] = path[40]
    for window, noise in ((3, 0.02), (64, 0.02), (64, 0.3)):
        y = path + noise * rng.standard_normal(path.shape)
        by_y, by_path = rng.standard_normal((2, *path.shape))
        if kind == "closed":
            by_path[-1] = by_path[0]  # the corner there is one
        if kind == "dwelling":
            by_path[40:50] = by_path[40]
        slopes = jax.grad(metric_of, (1, 2))(of, jnp.asarray(y), jnp.asarray(path), window)
        after, before = (metric_of(of, y + x * by_y, path + x * by_path, window) for x in (h, -h))
        found = np.vdot(slopes[0], by_y) + np.vdot(slopes[1], by_path)
        np.testing.assert_allclose(found, (after - before) / (2 * h), rtol=1e-5, atol=1e-7)


def test_slopes_at_a_tie_at_the_last_sample_and_on_the_path():
    """At a tie the first of the largest has the slope; on the path there is none, and no NaN."""
    straight = np.stack([np.arange(11.0), np.zeros(11)], axis=1)
    y = straight.copy()
    assert not np.any(jax.grad(metric_of, 1)("largest", y, straight))
    assert not np.any(jax.grad(metric_of, 1)("root mean square", y, straight))
    y[[4, 7], 1] = 0.25, -0.25
    slope = np.zeros((11, 2))
    slope[4, 1] = 1.0
    np.testing.assert_array_equal(jax.grad(metric_of, 1)("largest", y, straight), slope)
    y[[0, 10], 1] = -5.0, -0.5  # sample 0 does not count
    slope = np.zeros((11, 2))
    slope[10, 1] = -1.0
    np.testing.assert_array_equal(jax.grad(metric_of, 1)("largest", y, straight), slope)
    y[4:, 1] = 0.0
    y[10] = 10.3, 0.4  # beyond the end the distance is that of the end
    slope[10] = 0.6, 0.8
    np.testing.assert_allclose(jax.grad(metric_of, 1)("largest", y, straight), slope, atol=1e-12)


@pytest.mark.parametrize("mode", ["forward", "reverse"])
@pytest.mark.parametrize("of", ["contour_max", "contour_rms"])
def test_a_tuning_has_the_slope_of_its_differences(of, mode):
    """The spiral opens, so that the nominal machine errs most at its last sample."""
    s = np.linspace(0, 3, 91)
    task = Task(np.stack([s * s * np.sin(2 * s), s**3], axis=1), dt=DT, inputs=2)
    A, B, C = [[0.7, 0.1], [0.05, 0.6]], [[0.3, 0.05], [-0.02, 0.4]], [[1.0, 0.1], [0.2, 1.0]]
    machine, law = Machine(StateSpace(A, B, C, dt=DT)), PIDType((0.5, 0.4), gamma_d=(0.1, 0.2))
    y = learn(machine, law, task, 3).final.y
    slopes = jax.grad(metric_of, 1)("largest", y, task.reference)
    assert np.flatnonzero(np.any(slopes != 0, axis=1)).tolist() == [90]
    problem = Tuning(
        machine, law, task, 3, ["gamma_p", "gamma_d"],
        {"plant.B[0][0]": Uniform(0.8, 1.2, relative=True)},
        Final(of) + 0.3 * EveryTrial(of), machines=5, mode=mode, clip=np.inf,
        quantities=contour_metrics(task),
    )  # fmt: skip
    evaluate, z = jax.jit(problem.evaluation[0]), problem._weights.starts(1, 0.0, 0)[0]
    here, rng, h = evaluate(z), np.random.default_rng(5), 1e-6
    for direction in rng.standard_normal((3, len(z))):
        after, before = (evaluate(z + x * direction).value for x in (h, -h))
        found = np.dot(here.gradient, direction)
        np.testing.assert_allclose(found, (after - before) / (2 * h), rtol=1e-6, atol=1e-8)
