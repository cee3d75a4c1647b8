"""What passes between machine, scheme and learning: the task, one sample, one trial.

Conventions everywhere: `k` counts samples 0..N, `j` counts trials 1..J. `u[k]` acts on `y[k+1]`;
`y[0]` is measured before `u[0]` is applied. `e = r - y`.
"""

from __future__ import annotations

import dataclasses
import re
from collections.abc import Sequence
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jax import lax

from ..pytree.aliases import Array, Leaf, Tree
from ..pytree.fields import leaf, pytree, static
from ..pytree.in_short import in_short
from ..pytree.needs import known
from ..runtime.jax_internals import COLUMNS, product_by_columns

_NAME = re.compile(r"[^\W\d_]\w{0,19}")  # of an output
SMALLEST = 1e-15  # largest |r| of a reference that is not zero


@pytree
class Task:
    """What the machine repeats.

    reference: (N+1, n_y) desired output `r`; a flat (N+1,) array means one output
    dt:        sample time [s], from a picosecond to decades
    settle:    (start, stop) [s], the part of the trial that counts as settled, to the end of the
               trial where that is before stop; None is its second half
    inputs:    number of inputs n_u; None means as many as outputs
    unit, input_unit: of y and of u, for labels only
    names:     names of the outputs, such as ("x", "y"), for labels only; () where they have numbers

    Raises ValueError for a reference that is not finite, too short, of more than two dimensions, or
    so large or small that the squares of its errors would leave the range of single precision.
    """

    reference: Leaf = leaf(interval="[-1e12, 1e12]")
    dt: float = static(interval="[1e-12, 1e+09]")
    settle: tuple[float, float] | None = static(default=None)
    inputs: int = static(default=None, interval="[1, inf)", whole=True, optional=True)
    unit: str = static(default="")
    input_unit: str = static(default="")
    names: tuple[str, ...] = static(default=())

    def __post_init__(self) -> None:
        r = self.reference
        if r.ndim == 1:
            r = r[:, None]
        if r.ndim != 2 or len(r) < 2 or not r.shape[1]:
            raise ValueError(
                f"Task: reference has shape {self.reference.shape}; allowed are (N+1,) and (N+1, "
                "n_y) with N >= 1 and n_y >= 1"
            )
        if known(r) and 0 < np.max(np.abs(r)) < SMALLEST:
            raise ValueError(
                f"Task: reference is {np.max(np.abs(r)):g} at most; allowed is none at all, or one "
                f"from {SMALLEST:g} on"
            )
        object.__setattr__(self, "reference", r)
        object.__setattr__(self, "inputs", r.shape[1] if self.inputs is None else self.inputs)
        _check_names(self.names, r.shape[1])
        if self.settle is not None:
            start, stop = self.settle
            if not 0 <= start < stop < float("inf") or start > self.duration:
                raise ValueError(
                    f"Task: settle = {self.settle} s is not a window that begins within [0, "
                    f"{self.duration:g}] s with a later, finite stop, which may be beyond the trial"
                )

    @property
    def N(self) -> int:
        """Number of samples of the input; the outputs have N+1."""
        return self.reference.shape[-2] - 1

    @property
    def outputs(self) -> int:
        return self.reference.shape[-1]

    @property
    def labels(self) -> tuple[str, ...] | tuple[int, ...]:
        """The names of the outputs, or their numbers where they have none."""
        return self.names or tuple(range(self.outputs))

    def of_outputs(self, outputs: tuple[int, ...]) -> Task:
        """The task of these outputs only, with the same inputs.

        Raises ValueError for an output that it does not have.
        """
        if any(not -self.outputs <= i < self.outputs for i in outputs):
            raise ValueError(
                f"Task: outputs = {outputs} are not there; allowed are 0 to {self.outputs - 1}"
            )
        different = len(set(outputs)) == len(outputs)
        names = tuple(self.names[i] for i in outputs) if self.names and different else ()
        reference = self.reference[..., list(outputs)]
        return dataclasses.replace(self, reference=reference, names=names)

    @property
    def duration(self) -> float:
        return self.N * self.dt

    @property
    def time(self) -> np.ndarray:
        """(N+1,) time of each output sample [s]."""
        return np.arange(self.N + 1) * self.dt

    @property
    def settled(self) -> slice:
        """The samples of the settled window."""
        if self.settle is None:
            return slice((self.N + 1) // 2, self.N + 1)
        start, stop = self.settle
        return slice(round(start / self.dt), min(round(stop / self.dt), self.N) + 1)


def _check_names(names: Sequence[str], outputs: int) -> None:
    """Raises ValueError unless each output has a name of its own, or none has one."""
    if not names:
        return
    good = all(isinstance(name, str) and _NAME.fullmatch(name) for name in names)
    if not good or len(names) != outputs or len(set(names)) != outputs:
        raise ValueError(
            f"Task: names = {names} is not one name for each of the {outputs} outputs; allowed are "
            "different names of up to 20 letters, digits and _, a letter first"
        )


def samples_within(name: str, window: tuple[float, float], task: Task) -> slice:
    """The samples of a window (start, stop) [s] of a task, both ends included.

    Raises ValueError, with the name, for a window that is not within the task, or has no sample
    that an input can reach.
    """
    start, stop = window
    if not 0 <= start <= stop <= task.duration * (1 + 1e-9) or round(stop / task.dt) < 1:
        raise ValueError(
            f"{name} = ({start:g}, {stop:g}) s is not a window within [0, {task.duration:g}] s "
            "with a sample that an input can reach"
        )
    return slice(round(start / task.dt), round(stop / task.dt) + 1)


class Sample(NamedTuple):
    """What a scheme sees at sample `k`, when it must decide `u[k]`.

    r:       (n_y,) reference r[k]
    ahead:   (preview, n_y) r[k+1], r[k+2], ... as far as the scheme's `preview` asks; held at its
             end value
    y:       (n_y,) measured output y[k]
    row:     the k-th row of the scheme's schedule
    dt:      sample time [s]
    applied: (n_u,) what the actuator made of the input of the sample before, zero at k = 0. None
             where there is no actuator, or where nobody can tell; it is then what was commanded
    """

    r: Array
    ahead: Array
    y: Array
    row: Tree
    dt: float
    applied: Array | None = None

    def __repr__(self) -> str:
        return in_short(self)


class Trial(NamedTuple):
    """The record of a trial, simulated or measured.

    r:       (N+1, n_y) reference
    y:       (N+1, n_y) measured output
    u:       (N, n_u) input as the actuator applied it
    dt:      sample time [s]
    signals: the scheme's own signals by name, each (N, ...); empty for a measured trial
    weight:  (N+1, n_y, n_y) by which the error of each sample was multiplied before it is shown,
             zero where nothing was measured; None: each error counts as it is
    """

    r: Array
    y: Array
    u: Array
    dt: float
    signals: dict[str, Array] = {}  # noqa: RUF012  never written to
    weight: Array | None = None

    def __repr__(self) -> str:
        return in_short(self)

    @property
    def e(self) -> Array:
        """(N+1, n_y) tracking error r - y."""
        return self.r - self.y


class Limit(NamedTuple):
    """What a limit acts on.

    signal: (K, n)
    bound:  () or (n,) largest |signal| that passes unchanged
    """

    signal: Array
    bound: Array


def quantise(x: Array, step: Array) -> Array:
    """Round to multiples of `step`. The gradient is straight-through: d quantise / dx = 1."""
    return x + lax.stop_gradient(jnp.round(x / step) * step - x)


def root(squared: Array) -> Array:
    """The square root; where it is zero, its gradient is also zero, not NaN."""
    return jnp.where(squared > 0, jnp.sqrt(jnp.where(squared > 0, squared, 1.0)), 0.0 * squared)


def product(matrix: Array, vector: Array) -> Array:
    """matrix @ vector, for a loop over samples.

    Up to 8 columns are taken as their sum, which vectorises over a batch, up to twice as fast.
    """
    few = 0 < matrix.shape[-1] <= COLUMNS
    return product_by_columns(matrix, vector) if few else matrix @ vector
