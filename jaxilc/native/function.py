"""A function that learns, as one of JAX that programs for this processor compute."""

from __future__ import annotations

import logging
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from functools import cache, partial
from typing import TypeAlias, TypeVar, TypeVarTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.custom_derivatives import CustomVJPPrimal, SymbolicZero

from ..runtime.jax_internals import with_batches
from .run import Compiled, Native

log = logging.getLogger("jaxilc")
Given = TypeVarTuple("Given")  # trees of arrays
Found = TypeVar("Found")
Array = TypeVar("Array")
Arrays: TypeAlias = list[jax.Array]
Kept: TypeAlias = tuple[Arrays, list[float | None]]  # and a number for what a slope is asked for
Operands: TypeAlias = Sequence[jax.Array | np.ndarray]
Program: TypeAlias = Compiled[Operands, Operands, Arrays]
AT_FIRST = 3  # machines near the example, whose results are compared with those of XLA
NEAR = 1e-3  # by which the numbers of each of them differ from those of the one before


def compiled(fn: Callable[[*Given], Found], *example: *Given) -> Callable[[*Given], Found]:
    """The function, computed by programs for this processor, under `jit`, `vmap` and `grad` too.

    fn: function of pytrees; it learns over trials
    example: arguments, of which shapes and types are those of every later call

    Under `vmap`, however often, the machines are in the lanes of the processor. Its gradient is
    that of another program, and so on; derivatives forward (`jvp`) are not known. For each pattern
    of what `vmap` moves and of what a slope is asked for, a program is made when it is first
    traced. It then computes a few machines near the example, and so does XLA. Where the results
    differ by more than 1e-9 of the largest of a machine, XLA computes this pattern, and a warning
    says so; also where the program cannot be made, which the log tells (`--verbose`).
    Later calls are not compared.
    Raises ValueError for arguments of other shapes or types than those of the example.
    """
    leaves, structure = jax.tree.flatten(example)
    leaves = [jnp.asarray(x) for x in leaves]
    shapes = [jax.typeof(x) for x in leaves]
    results = jax.tree.structure(jax.eval_shape(fn, *example))

    def of_leaves(*given: jax.Array) -> Arrays:
        return jax.tree.leaves(fn(*jax.tree.unflatten(structure, given)))

    function = _Function(of_leaves, leaves)

    def call(*arguments: *Given) -> Found:
        given, of = jax.tree.flatten(arguments)
        given = [jnp.asarray(x) for x in given]
        if of != structure:  # type: ignore[operator]  # of JAX
            raise ValueError(f"compiled: arguments = {of} are not {structure}, as in the example")
        for i, (x, like) in enumerate(zip(given, shapes, strict=True)):
            if (x.shape, x.dtype) != (like.shape, like.dtype):
                path = jax.tree_util.keystr(jax.tree.flatten_with_path(arguments)[0][i][0])
                raise ValueError(
                    f"compiled: arguments{path} = {jax.typeof(x)} is not {like}, as in the example"
                )
        return jax.tree.unflatten(results, function(*given))

    return call


class _Function:
    """A function of arrays that returns a list of arrays.

    fn: the function
    example: arrays, near which programs are compared with XLA
    """

    def __init__(self, fn: Callable[..., Arrays], example: Operands):
        self._fn, self._example = fn, example
        self._outs = jax.eval_shape(fn, *example)
        self.over = cache(self._over)
        self._slopes, self._program = cache(self._slopes_by), cache(self._program_of)
        one = self.over((False,) * len(example))
        call = jax.custom_vjp(lambda *given: one(*given))

        def forward(*given: CustomVJPPrimal) -> tuple[Arrays, Kept]:
            values = [x.value for x in given]
            return call(*values), (values, [0.0 if x.perturbed else None for x in given])

        def backward(
            kept: Kept, slopes: Sequence[jax.Array | SymbolicZero]
        ) -> tuple[jax.Array | None, ...]:
            values, asked = kept
            known = tuple(not isinstance(x, SymbolicZero) for x in slopes)
            by = tuple(x is not None for x in asked)
            given = [x for x in slopes if not isinstance(x, SymbolicZero)]
            found = iter(self._slopes(by, known)(*values, *given) if any(known) else [])
            return tuple(next(found, None) if b else None for b in by)

        call.defvjp(forward, backward, symbolic_zeros=True)
        self._call = call

    def __call__(self, *given: jax.Array) -> Arrays:
        return self._call(*given)

    def _slopes_by(self, by: tuple[bool, ...], known: tuple[bool, ...]) -> _Function:
        """The function that gives, from the slopes of some results, those of some operands."""
        n = len(self._example)

        def slopes(*given: jax.Array) -> Arrays:
            values, of_results = list(given[:n]), list(given[n:])

            def some(moved: Arrays) -> Arrays:
                new = iter(moved)
                found = self._fn(*(next(new) if b else x for x, b in zip(values, by, strict=True)))
                return [x for x, k in zip(found, known, strict=True) if k]

            at = [x for x, b in zip(values, by, strict=True) if b]
            return jax.vjp(some, at)[1](of_results)[0]

        ones = [np.ones(x.shape, x.dtype) for x, k in zip(self._outs, known, strict=True) if k]
        return _Function(slopes, [*self._example, *ones])

    def _over(self, moved: tuple[bool, ...], machines: int = 1) -> Callable[..., Arrays]:
        """The function of machines; the operands that are moved have an axis of them in front."""
        several = any(moved)

        def batched(count: int, outer: Sequence[bool], *given: jax.Array) -> Arrays:
            of_all = []
            for x, inside, outside in zip(given, moved, outer, strict=True):
                if inside and not outside:
                    x = jnp.broadcast_to(x, (count, *x.shape))
                if outside and several and not inside:
                    x = jnp.repeat(x, machines, axis=0, total_repeat_length=count * machines)
                of_all.append(x.reshape(-1, *x.shape[2:]) if inside else x)
            both = tuple(a or b for a, b in zip(moved, outer, strict=True))
            found = self.over(both, count * machines)(*of_all)
            return [x.reshape(count, machines, *x.shape[1:]) for x in found] if several else found

        outs = tuple(jax.ShapeDtypeStruct((machines, *x.shape) if several else x.shape, x.dtype)
                     for x in self._outs)  # fmt: skip
        return with_batches(partial(self._computed, moved), batched, outs)

    def _computed(self, moved: tuple[bool, ...], *given: jax.Array) -> Arrays:
        """The results of machines, by a program where one can be made, else by XLA."""
        if not given:
            return self._fn()
        if not any(moved):
            alone = self._computed((True,) * len(given), *(x[None] for x in given))
            return [x[0] for x in alone]
        program = self._program(moved)
        if program is None:
            return jax.vmap(self._fn, [0 if m else None for m in moved])(*given)
        return program(*_parts(given, moved))

    def _program_of(self, moved: tuple[bool, ...]) -> Program | None:
        """The program of machines whose moved operands differ; None where XLA computes them.

        It is made in a thread of its own, since JAX may trace what calls this function in this one.
        """
        with ThreadPoolExecutor(1) as aside:
            return aside.submit(self._made, moved).result()

    def _made(self, moved: tuple[bool, ...]) -> Program | None:

        def of_one(common: Operands, one: Operands) -> Arrays:
            source = iter(common), iter(one)
            return self._fn(*(next(source[m]) for m in moved))

        def near(x: jax.Array | np.ndarray) -> jax.Array:
            real = jnp.issubdtype(x.dtype, jnp.floating)
            return jnp.stack([x * (1 + NEAR * k) if real else x for k in range(AT_FIRST)])

        native = Native(of_one, many=True)
        common, one = _parts(self._example, moved)
        arguments = common, [near(x) for x in one]
        reason = native.why_not(*arguments)
        log.info("native: compiled: %s", reason or "a program for this processor")
        return native.program(*arguments) if reason is None else None


def _parts(given: Sequence[Array], moved: Sequence[bool]) -> tuple[list[Array], list[Array]]:
    """What is common, and what is not."""
    pairs = [*zip(given, moved, strict=True)]
    return [x for x, m in pairs if not m], [x for x, m in pairs if m]
