"""Point-to-point learning: errors count at chosen samples only, the rest of the motion is free."""

from __future__ import annotations

import dataclasses
from types import ModuleType

import jax.numpy as jnp
import numpy as np

from ..plants import Plant, StateSpace
from ..pytree.aliases import Array, Leaf, Tree, Value
from ..pytree.fields import child, leaf, pytree, static
from ..pytree.needs import known, need_numbers
from ..signals.task import Task, Trial, samples_within
from .gradient import Ready
from .guards import KeepUnmeasured
from .scheme import Part, Scheme, Wrapper, need_no_experiments, with_all_parts
from .weights import need_no_true_outputs, weighed


@pytree
class AtSamples(Wrapper):
    """A scheme for which errors count at chosen samples only (Freeman and Tan 2013, H -> Phi H).

        e'[k] = Phi[k] e[k],    Phi[k] = 1 within the windows, 0 elsewhere; or the given weight

    A law with a model (`NormOptimal`, `GradientILC`, `ConstrainedNormOptimal`, `TwoStep`,
    `BasisFunctions`, `EstimatedDisturbance`) predicts Phi H and so makes use of all of the motion
    before a point. Any other law learns from e', which is zero where the motion is free.

    Among the inputs that meet the points, norm-optimal learning with w_s = 0 comes to that of the
    least effort |u|^2, since it starts from zero; w_s > 0 weighs effort against the points, and w_d
    of `ConstrainedNormOptimal` the rate of the input. With `jerk_time` the motion itself is smooth:

        + |jerk_time^3 d^3 y / dt^3|^2_Wq    in the cost of a law with the model `with_jerk(model)`

    Where y[k] or one of the three samples before it was not measured, the jerk at k is unknown; its
    change counts in its place, so that a law leaves it as it is.

    scheme: any scheme that learns from the error
    windows: pairs (start, stop) of times at which errors count [s]; a point has stop = start
    weight: (N+1,) or (N+1, n_y) weights in place of windows, which may be batched
    jerk_time: () time whose third power is the weight of the jerk [s]; about the shortest time in
        which the motion should change its direction. None: the jerk does not count
    solved: leave None
    `check` raises ValueError unless either windows or weight are given and lie within the task, and
    for bounds of the output, which need all of the motion. It raises, too, for a scheme that makes
    experiments (`ModelFreeGradient`) or compares outputs within the trial (FFDL-MFAILC), for
    `KeepUnmeasured` within, which takes samples that do not count for lost, and for `jerk_time` of
    a scheme within, which is shown other outputs than the machine has.
    """

    scheme: Scheme = child()
    windows: tuple[Value, ...] = static(default=())
    weight: Leaf | None = leaf(default=None, interval="[0, inf)", optional=True)
    jerk_time: Leaf | None = leaf(default=None, interval="(0, inf)", optional=True)
    solved: Ready | None = child(default=None)

    def __post_init__(self) -> None:
        object.__setattr__(self, "windows", windows_of("AtSamples", self.windows))
        if bool(self.windows) == (self.weight is not None):
            raise ValueError(
                f"AtSamples: windows = {self.windows} and weight = {self.weight}; allowed is one "
                "of them"
            )
        need_numbers(self, "jerk_time")

    def parts(self, task: Task, memory: Tree) -> dict[str, Part]:
        if self.jerk_time is not None:
            r = jnp.asarray(task.reference)
            both = jnp.concatenate([r, jnp.zeros_like(r)], axis=-1)
            task = dataclasses.replace(task, reference=both, inputs=task.inputs, names=())
        return {"scheme": Part(self.scheme, task, memory)}

    def shown(self, trial: Trial) -> dict[str, Trial]:
        dt = trial.dt if self.solved is None else self.solved.dt
        Phi = self._weights(trial.r.shape, dt)
        if self.jerk_time is None:
            return {"scheme": weighed(trial, Phi)}
        jerk = _jerk(trial.y, dt)
        if trial.weight is not None:  # laws then leave the jerk of samples that were lost as it is
            jerk = jerk * _all_measured(trial.weight)
        both = trial._replace(
            r=jnp.concatenate([trial.r, jnp.zeros_like(jerk)], axis=1),
            y=jnp.concatenate([trial.y, jerk], axis=1),
            weight=None if trial.weight is None else _beside(trial.weight),
            signals=trial.signals | {"jerk": jerk[1:]},
        )
        W = jnp.concatenate([Phi, jnp.broadcast_to(self.jerk_time**3, Phi.shape)], axis=1)
        return {"scheme": weighed(both, W)}

    def check(self, task: Task) -> None:
        self._check_samples(task)
        need_no_true_outputs(self, task, "needs all of the motion")
        if self.jerk_time is not None and not self.scheme.plays_back:
            raise ValueError(
                f"AtSamples: jerk_time needs a law that plays back its input, not "
                f"{type(self.scheme).__name__}, which acts within the trial"
            )
        if any(isinstance(one.scheme, KeepUnmeasured) for one in with_all_parts(self, task)):
            raise ValueError(
                "AtSamples: KeepUnmeasured within takes samples that do not count for lost ones; "
                "allowed is KeepUnmeasured around AtSamples"
            )
        super().check(task)
        need_no_experiments(self, task, "whose answers are needed at all samples")

    def _check_samples(self, task: Task) -> None:
        for window in self.windows:
            samples_within("AtSamples: windows", window, task)
        W = self.weight
        if W is None:
            return
        if W.shape not in ((task.N + 1,), (task.N + 1, task.outputs)):
            raise ValueError(
                f"AtSamples: weight has shape {W.shape}; this task needs ({task.N + 1},) or "
                f"({task.N + 1}, {task.outputs})"
            )
        if known(W) and not np.any(np.asarray(W)[1:]):
            raise ValueError("AtSamples: weight is zero at all samples from k = 1 on")

    def prepared(self, task: Task) -> AtSamples:
        return dataclasses.replace(super().prepared(task), solved=Ready(dt=task.dt))

    def record(self, learned: Array, e: Array, task: Task) -> Trial:
        inner, seen, _ = self._inner(task)
        wide = jnp.zeros((task.N + 1, seen.outputs))
        r = jnp.asarray(task.reference)
        return inner.record(learned, wide, seen)._replace(r=r, y=r - e)

    def _weights(self, shape: tuple[int, ...], dt: float) -> Array:
        """(N+1, n_y) how each error counts."""
        if self.weight is not None:
            W = jnp.asarray(self.weight)
            return jnp.broadcast_to(W if W.ndim == 2 else W[:, None], shape)
        counted = np.zeros(shape)
        for start, stop in self.windows:
            counted[round(start / dt) : round(stop / dt) + 1] = 1.0
        return jnp.asarray(counted)


def windows_of(owner: str, windows: Value) -> tuple[tuple[float, float], ...]:
    """Pairs of times; raises ValueError for what is none."""
    pairs = tuple(tuple(w) if isinstance(w, list | tuple) else (w, w) for w in windows)
    good = all(
        len(pair) == 2 and all(isinstance(x, int | float) for x in pair) and pair[0] <= pair[1]
        for pair in pairs
    )
    if not good:
        raise ValueError(
            f"{owner}: windows = {windows} are not times or pairs (start, stop) with start <= stop "
            "[s]"
        )
    return tuple((float(a), float(b)) for a, b in pairs)


def with_jerk(model: Plant, dt: float | None = None) -> StateSpace:
    """The model with the jerk of each output as a further output, for `AtSamples` with `jerk_time`.

        (y[k] - 3 y[k-1] + 3 y[k-2] - y[k-3]) / dt^3,    at rest before the first sample

    model: linear model, a discrete `StateSpace`, or one that becomes so at the sample time dt
    dt: sample time [s]; None: that of the model
    Raises ValueError for a model that is no linear one.
    """
    found: Tree = model if dt is None else model.sampled(dt)
    if not isinstance(found, StateSpace) or not found.dt:
        raise ValueError(
            f"with_jerk: the model is a {type(found).__name__}; allowed is a StateSpace in "
            "discrete time, or a linear model and dt"
        )
    xp: ModuleType = np if known(found) else jnp
    A, B, C = (xp.asarray(M) for M in (found.A, found.B, found.C))
    n, m = A.shape[0], C.shape[0]
    eye, still = np.eye(m), np.zeros((m, m))
    before = xp.block([[C, still, still, still], [np.zeros((2 * m, n)), np.eye(2 * m, 3 * m)]])
    top = xp.concatenate([A, np.zeros((n, 3 * m))], axis=1)
    jerk = xp.concatenate([C, -3 * eye, 3 * eye, -eye], axis=1) / found.dt**3
    outputs = xp.concatenate([C, np.zeros((m, 3 * m))], axis=1)
    return StateSpace(
        xp.concatenate([top, before]),
        xp.concatenate([B, np.zeros((3 * m, B.shape[1]))]),
        xp.concatenate([outputs, jerk]),
        dt=found.dt,
    )


def _jerk(y: Array, dt: float) -> Array:
    """(N+1, n_y) the jerk of an output that rests before the trial."""
    held = jnp.pad(y, ((3, 0), (0, 0)), mode="edge")
    return (held[3:] - 3 * held[2:-1] + 3 * held[1:-2] - held[:-3]) / dt**3


def _all_measured(W: Array) -> Array:
    """(N+1, n_y) 1 where each sample that the jerk is made of was measured, else 0."""
    there = jnp.where(jnp.any(W != 0, axis=2), 1.0, 0.0)
    held = jnp.pad(there, ((3, 0), (0, 0)), mode="edge")
    return held[3:] * held[2:-1] * held[1:-2] * held[:-3]


def _beside(W: Array) -> Array:
    """The weight of the outputs, and beside it that of their jerks, which all count."""
    m = W.shape[1]
    jerk = jnp.broadcast_to(jnp.eye(m), W.shape)
    return jnp.concatenate(
        [jnp.pad(W, ((0, 0), (0, 0), (0, m))), jnp.pad(jerk, ((0, 0), (0, 0), (m, 0)))], axis=1
    )
