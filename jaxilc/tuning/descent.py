"""Descent on a loss of few numbers that takes long to evaluate: optimisers, and their state.

This module does not depend on what is tuned. A function `evaluate(z)` returns an `Evaluation`; a
method has the pure functions `init(z)` and `step(z, state)`.
"""

from __future__ import annotations

import json
import logging
import os
from collections.abc import Callable, Mapping
from contextlib import ExitStack
from pathlib import Path
from typing import NamedTuple, TypeAlias

import jax
import jax.numpy as jnp
import numpy as np
import optax
from jax import lax

from ..pytree.aliases import Leaf, Tree, Value
from ..runtime.provenance import need_described, need_same
from ..storage.files import need_free, only_one, remove_leftovers, to_disk, whole_folder, write_file
from ..storage.reading import tree_of
from ..storage.sealed import (
    Damaged,
    archive,
    as_json,
    json_text,
    read_arrays,
    read_json,
    sealed,
    unsealed,
    write_json,
)

Z: TypeAlias = jax.Array | np.ndarray  # the point of one start, or of all
DAMPING = 1e-2  # of least squares, at its start
OPTIMISERS = ("adam", "lbfgs", "least-squares")


class Evaluation(NamedTuple):
    """The loss and its derivatives at one z of P numbers.

    value: () the number that is minimised
    gradient: (P,) gradient of the value
    residuals: (R,) residuals for least squares
    slopes: (R, P) derivatives of the residuals by z
    dropped: () how many residuals had no finite slope
    """

    value: jax.Array
    gradient: jax.Array
    residuals: jax.Array
    slopes: jax.Array
    dropped: jax.Array


def counted(losses):
    """The losses, with the worst finite one in place of those that are not finite.

    All are infinite if none is finite.
    """
    finite = jnp.isfinite(losses)
    worst = jnp.max(jnp.where(finite, losses, -jnp.inf))
    return jnp.where(finite, losses, jnp.where(jnp.any(finite), worst, jnp.inf))


def repaired(losses, slopes, clip: float):
    """Losses and slopes that can be averaged, and which slopes were finite: (S,), (S, P), (S,).

    A loss that is not finite is replaced as in `counted`; a slope that is not finite becomes zero.
    Each slope is shortened to at most `clip` times the larger of the median length and 1. The
    median is below 1 once most machines are below an objective's floor. A machine that chatters may
    have a slope of 1e70 in any direction; the bound limits its weight among the others. The bound
    is relative, since the usual length of a slope is not known beforehand.
    """
    good = jnp.isfinite(losses) & jnp.all(jnp.isfinite(slopes), axis=1)
    slopes = jnp.where(good[:, None], slopes, 0.0)
    largest = jnp.max(jnp.abs(slopes), axis=1)
    length = largest * jnp.linalg.norm(
        slopes / jnp.where(largest > 0, largest, 1.0)[:, None], axis=1
    )
    median = jnp.sort(jnp.where(good, length, jnp.inf))[(jnp.sum(good) - 1) // 2]
    longest = clip * jnp.maximum(1.0, median)
    return (
        counted(losses),
        slopes * jnp.minimum(1.0, longest / jnp.where(length > 0, length, 1.0))[:, None],
        good,
    )


class Method(NamedTuple):
    """An optimiser for one start, with two pure functions."""

    init: Callable[[Z], Tree]
    step: Callable[[Z, Tree], tuple[Z, Tree, Step]]


class Step(NamedTuple):
    """The record of one step, taken at the z from which it started.

    loss: () value of the loss
    slope: () length of the gradient
    dropped: () how many residuals had no finite slope
    """

    loss: jax.Array
    slope: jax.Array
    dropped: jax.Array


def by_gradient(
    evaluate: Callable[[jax.Array], Evaluation], optimiser: optax.GradientTransformation
) -> Method:
    """The method that an optax transformation defines.

    A line search uses the loss and the gradient that `evaluate` returns.
    """
    optimiser = optax.with_extra_args_support(optimiser)

    @jax.custom_vjp
    def loss(z):
        return evaluate(z).value

    def forward(z):
        found = evaluate(z)
        return found.value, found.gradient

    loss.defvjp(forward, lambda gradient, cotangent: (cotangent * gradient,))

    def step(z, state):
        found = evaluate(z)
        updates, state = optimiser.update(
            found.gradient, state, z, value=found.value, grad=found.gradient, value_fn=loss
        )
        return (
            optax.apply_updates(z, updates),
            state,
            Step(found.value, jnp.linalg.norm(found.gradient), found.dropped),
        )

    return Method(optimiser.init, step)


def by_least_squares(evaluate: Callable[[jax.Array], Evaluation]) -> Method:
    """Levenberg-Marquardt on the residuals r with the Jacobian J (Marquardt 1963).

        (J^T J + damping diag(J^T J)) dz = -J^T r

    The step is taken only if |r| falls. Then the damping is divided by 3;
    otherwise it is multiplied by 4. The state is the damping of the next step, and what is known
    of the present point.
    """

    def init(z):
        return jnp.full((), DAMPING, z.dtype), evaluate(z)

    def step(z, state):
        damping, here = state
        r, J = here.residuals, here.slopes
        normal = J.T @ J
        ridge = damping * jnp.diag(normal) + jnp.finfo(z.dtype).tiny ** 0.5
        moved = z - jnp.linalg.solve(normal + jnp.diag(ridge), J.T @ r)
        there = evaluate(moved)
        better = jnp.sum(there.residuals**2) < jnp.sum(r**2)
        at = jax.tree.map(lambda new, old: jnp.where(better, new, old), there, here)
        return (
            jnp.where(better, moved, z),
            (jnp.where(better, damping / 3.0, damping * 4.0), at),
            Step(here.value, jnp.linalg.norm(here.gradient), here.dropped),
        )

    return Method(init, step)


def method_of(
    optimiser: str | optax.GradientTransformation,
    evaluate: Callable[[jax.Array], Evaluation],
    rate: float,
    steps: int,
) -> Method:
    """The method of an optimiser on a loss.

    rate, steps: rate of adam, and the number of steps over which it falls to zero
    """
    if optimiser == "least-squares":
        return by_least_squares(evaluate)
    if isinstance(optimiser, str):
        lbfgs = optimiser == "lbfgs"
        optimiser = optax.lbfgs() if lbfgs else optax.adam(optax.cosine_decay_schedule(rate, steps))
    return by_gradient(evaluate, optimiser)


# Many starts
# --------------------------------------------------------------------------------------------------


def over_starts(f: Callable) -> Callable:
    """The function f of one start, for arguments with a leading axis of K starts.

    It is `jax.vmap`. But for a single start f is called alone, which is traced and compiled faster.
    """

    def of_all(*arguments):
        if len(jax.tree.leaves(arguments)[0]) > 1:
            return jax.vmap(f)(*arguments)
        results = f(*jax.tree.map(lambda x: x[0], arguments))
        return jax.tree.map(lambda x: jnp.asarray(x)[None], results)

    return of_all


def for_starts(method: Method) -> tuple[jax.stages.Wrapped, jax.stages.Wrapped]:
    """Both functions of a method for many starts at once, compiled into one program for all steps.

    They take arrays of the host, for a random key the array of its data. What they return is to be
    copied there: a compiled program depends on the device of its arguments, and would be compiled
    again for others.
    """

    @jax.jit
    def init(z):
        return _without_keys(over_starts(method.init)(z))

    @jax.jit
    def step(z, state):
        like = over_starts(method.init)(z)
        moved, following, record = over_starts(method.step)(z, _with_keys(state, like))
        return (
            moved,
            jax.tree.map(
                lambda new, old: lax.convert_element_type(new, old.dtype),
                _without_keys(following),
                state,
            ),
            record,
        )

    return init, step


def _without_keys(tree: Tree) -> Tree:
    return jax.tree.map(lambda x: jax.random.key_data(x) if _is_key(x) else x, tree)


def _with_keys(tree: Tree, like: Tree) -> Tree:
    """The random keys of `like` from their data in a tree."""

    def key(data: Leaf, of: Leaf) -> Leaf:
        return jax.random.wrap_key_data(data, impl=jax.random.key_impl(of)) if _is_key(of) else data

    return jax.tree.map(key, tree, like)


def _is_key(x: Leaf) -> bool:
    return jnp.issubdtype(jnp.result_type(x), jax.dtypes.prng_key)


# The state
# --------------------------------------------------------------------------------------------------


class State(NamedTuple):
    """The state of a descent after `step` steps from K starts, complete for continuing it.

    z: (K, P) present points
    best_z, best, best_step: (P,), (), () the z with the least held-out loss, this loss, its step
    stale: () how often the held-out loss was computed since `best_step`
    loss, slope, dropped: (steps, K) records of the steps, see `Step`
    path: (steps, K, P) z at each step
    held_out: (steps + 1, K) the held-out loss, NaN where it was not computed
    """

    step: np.ndarray
    z: np.ndarray
    inner: Tree
    best_z: np.ndarray
    best: np.ndarray
    best_step: np.ndarray
    stale: np.ndarray
    loss: np.ndarray
    slope: np.ndarray
    dropped: np.ndarray
    path: np.ndarray
    held_out: np.ndarray

    @classmethod
    def start(cls, z, inner, steps: int) -> State:
        """The state before the first of `steps` steps."""
        (K, P), dtype = z.shape, z.dtype
        blank = [np.full((steps, K), np.nan, dtype) for _ in range(3)]
        none = np.asarray(0)
        return cls(
            none, z, inner, z[0], np.asarray(np.inf, dtype), none, none, *blank,
            np.full((steps, K, P), np.nan, dtype), np.full((steps + 1, K), np.nan, dtype),
        )  # fmt: skip

    def validated(self, losses) -> State:
        """The state with the (K,) held-out losses of its z; only a finite loss can be best."""
        losses = np.asarray(losses)
        self.held_out[int(self.step)] = losses
        k = int(np.argmin(np.where(np.isfinite(losses), losses, np.inf)))
        if not losses[k] < self.best:
            return self._replace(stale=self.stale + 1)
        return self._replace(
            best_z=self.z[k], best=losses[k], best_step=self.step, stale=np.zeros_like(self.stale)
        )

    def advanced(self, z, inner, record: Step) -> State:
        """The state after one more step."""
        step = int(self.step)
        for kept, value in zip(
            (self.loss, self.slope, self.dropped, self.path), (*record, self.z), strict=True
        ):
            kept[step] = value
        return self._replace(step=self.step + 1, z=z, inner=inner)


def descended(
    step: jax.stages.Wrapped,
    now: State,
    held_out: Callable[[Z], Leaf],
    *,
    validate_every: int,
    patience: int,
    after_step: Callable[[State, Step], None],
) -> tuple[State, str]:
    """The state at the end of the descent, and the reason why it ended.

    step: of a method, see `for_starts`
    validate_every: steps from one computation of the held-out losses to the next
    patience: number of computations without improvement that are allowed
    """
    steps = len(now.loss)
    while True:
        if now.step % validate_every == 0 or now.step == steps:
            now = now.validated(jax.device_get(held_out(now.z)))
        if now.step == steps or now.stale > patience:
            return now, "steps" if now.step == steps else "patience"
        z, inner, record = jax.device_get(step(now.z, now.inner))
        if not np.any(np.isfinite(record.loss)):
            return now, "no machine has a finite loss"
        now = now.advanced(z, inner, record)
        after_step(now, record)


# The folder of a descent
# --------------------------------------------------------------------------------------------------

CONFIGURATION = "configuration.json"
STATE, PREVIOUS, FRESH = "state.npz", "previous.npz", "fresh.npz"

log = logging.getLogger("jaxilc")


class Folder:
    """The folder of a descent, which no other process can open while it is open here.

    It has the configuration, the newest state, and the state before that, each with a checksum. A
    state also holds the configuration, so that a tuning survives damage to any single file: it
    continues from the undamaged files, and ends with the same numbers, bit for bit.
    """

    def __init__(self, path: Path, configuration: Mapping[str, object], resume: bool):
        """Open the folder, or make it.

        Raises FileExistsError, and ValueError for a folder that is in use, does not belong to a
        tuning, or was made with another configuration, as `Tuning.run` says.
        """
        self.path, self._recipe = path, json_text(configuration)
        if not path.exists():
            need_described(configuration)
            with whole_folder(path) as unfinished:
                write_json(unfinished / CONFIGURATION, sealed(configuration))
        elif not resume:
            need_free(path)
        with ExitStack() as closing:
            closing.enter_context(only_one(path))
            remove_leftovers(path)
            self._whole, self._damaged = _states(path)
            need_same(path, self._configuration(), json.loads(self._recipe))
            self._leave_others()
            self._newest_is_whole = STATE in self._whole
            self._closing = closing.pop_all()

    def __enter__(self) -> Folder:
        return self

    def __exit__(self, *_) -> None:
        self._closing.close()

    def write(self, state: State) -> None:
        """Store the newest state, so that at any moment one of the two states is undamaged."""
        leaves = {f"arr_{i}": _plain(leaf) for i, leaf in enumerate(jax.tree.leaves(state))}
        content = archive(leaves | {"configuration": np.asarray(self._recipe)})
        write_file(self.path / FRESH, content)
        if self._newest_is_whole:  # else only the state before it is undamaged
            os.replace(self.path / STATE, self.path / PREVIOUS)
        os.replace(self.path / FRESH, self.path / STATE)
        self._newest_is_whole = True
        to_disk(self.path)

    def latest(self, state: State) -> State:
        """The newest undamaged state, or the given one if none was stored.

        Raises ValueError where both stored states are damaged.
        """
        if self._damaged and not self._whole and (self.path / PREVIOUS).exists():
            raise ValueError(f"{'; '.join(self._damaged)}; remove {self.path} and start again")
        for damage in self._damaged:
            log.warning("%s; the tuning goes on from the state before it", damage)
        if not self._whole:
            return state
        name, newest = next(iter(self._whole.items()))
        leaves, structure = jax.tree.flatten(state)
        found = [newest.get(f"arr_{i}") for i in range(len(leaves))]
        if [_kind(leaf) for leaf in found] != [_kind(_plain(leaf)) for leaf in leaves]:
            said = f"{self.path / name} is not a state of this tuning"
            raise ValueError(f"{said}; remove {self.path} and start again")
        pairs = zip(found, leaves, strict=True)
        return jax.tree.unflatten(
            structure, [np.asarray(x).view(np.asarray(like).dtype) for x, like in pairs]
        )

    def _leave_others(self) -> None:
        """Count a state that holds another configuration, such as a borrowed one, as damaged."""
        for name, state in list(self._whole.items()):
            file = self.path / name
            try:
                made = tree_of(str(state.get("configuration")), json.loads, file)
                need_same(file, made, json.loads(self._recipe))
            except ValueError as error:
                self._damaged.append(str(error))
                del self._whole[name]

    def _configuration(self) -> dict[str, Value]:
        """The configuration of the folder; a damaged file is repaired from a state."""
        file, found = self.path / CONFIGURATION, None
        try:
            return as_json(unsealed(read_json(file)))
        except (OSError, Damaged):
            for name, state in list(self._whole.items())[:1]:
                found = tree_of(str(state.get("configuration")), json.loads, self.path / name)
        if not isinstance(found, dict):
            said = f"{self.path} is not a tuning that can be resumed"
            raise ValueError(f"{said}; choose another folder, or remove it")
        log.warning("%s was missing or damaged, and is written again", file)
        write_json(file, sealed(found))
        return found


def stored_lanes(path: Path) -> int | None:
    """The lanes in the configuration of a folder; None where it has no such undamaged file."""
    try:
        lanes = as_json(unsealed(read_json(path / CONFIGURATION))).get("lanes")
    except (OSError, Damaged, AttributeError):
        return None
    return lanes if type(lanes) is int and lanes >= 1 else None


def _kind(leaf: Leaf) -> tuple[tuple[int, ...], np.dtype]:
    return np.shape(leaf), np.asarray(leaf).dtype


def _plain(leaf: Leaf) -> np.ndarray:
    """An array that NumPy can store: one of a type like bfloat16 as whole numbers of its bits."""
    array = np.asarray(leaf)
    return array if array.dtype.isbuiltin == 1 else array.view(f"u{array.dtype.itemsize}")


def _states(path: Path) -> tuple[dict[str, dict[str, np.ndarray]], list[str]]:
    """The undamaged states by name, the newest first, and what is wrong with the others."""
    whole: dict[str, dict[str, np.ndarray]] = {}
    damaged: list[str] = []
    for name in (STATE, PREVIOUS):
        try:
            whole[name] = read_arrays(path / name)
        except FileNotFoundError:
            continue
        except Damaged as error:
            damaged.append(str(error))
    return whole, damaged
