"""Functions of one start of a tuning, applied to many, and their compilation."""

from __future__ import annotations

from collections.abc import Callable, Generator, Mapping
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np


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


def in_rounds(f: Callable, rows: Mapping[str, np.ndarray], size: int) -> np.ndarray:
    """The (n,) results of f for n rows, of which it takes `size` at a time.

    So a function that is compiled for `size` rows need not be compiled again. The last row is
    repeated to fill up the last round.

    rows: (n,) values by name
    """
    n = len(next(iter(rows.values())))
    rounds = np.minimum(np.arange(-(-n // size) * size), n - 1).reshape(-1, size)
    results: list[Any] = [f({name: of[k] for name, of in rows.items()}) for k in rounds]
    return np.concatenate(results)[:n]


def arguments_like(method, z) -> tuple[Any, Any]:
    """The arguments of the compiled step of a method for all starts: z (K, P) and the state.

    Only shapes are worked out; nothing is computed.
    """
    state = jax.eval_shape(method.programs[0], z)
    return z, jax.tree.map(lambda s: jax.ShapeDtypeStruct(s.shape, s.dtype), state)


@contextmanager
def compiled_beside(run, *arguments) -> Generator[None]:
    """A context at whose end a jitted function is compiled, in a thread, for these arguments.

    The block compiles another one meanwhile.
    """
    with ThreadPoolExecutor(1) as compiler:
        compiled = compiler.submit(lambda: run.lower(*arguments).compile())
        yield
    compiled.result()
