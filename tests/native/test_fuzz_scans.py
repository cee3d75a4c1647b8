"""Random loops over trials, compiled, against the same in NumPy, machine by machine.

A program is a list of instructions on rows of samples and on single numbers. Both sides read it;
they share nothing else.
"""

import itertools

import jax
import jax.numpy as jnp
import numpy as np
from fuzz import fuzz, pick

from jaxilc.native.run import Compiled, differs

TRIALS = 4
MOVING = ("delay", "ahead", "flip", "scan", "back")
KINDS = ("mix", "product", "bend", "delay", "ahead", "flip", "scan", "back", "sum", "max", "scale",
         "first", "pick", "cumsum", "cummax", "cummin", "difference", "largest", "channels", "dot",
         "filter", "gain", "worst", "around", "search", "solve")  # fmt: skip


NUMBERS = ("sum", "max", "pick", "largest", "dot", "worst", "solve")  # the other kinds make rows


def both_channels(x, y, c):
    found = jnp.stack([x, y], axis=1) @ jnp.array([[1.0, c], [0.2, -0.3]])
    return found[:, 0] * 0.5 + found[:, 1]


def solved(x, y, z, c, d):
    """Return the first of two unknowns, of whose rows none is always the larger one."""
    A = jnp.array([[z, 1 + x[d] ** 2], [2.0, y[d]]])
    return jnp.tanh(jnp.linalg.solve(A, jnp.array([1.0, c]))[0])


# by kind, but for the scans: of rows x and y, a number z, constants c and d, and the trial j
BY_JAX = {
    "mix": lambda x, y, z, c, d, j: c * x + y,
    "product": lambda x, y, z, c, d, j: x * y / (1 + y * y),
    "bend": lambda x, y, z, c, d, j: jnp.where(x > 0, x, c * x) - jnp.minimum(jnp.abs(y), 1.0),
    "delay": lambda x, y, z, c, d, j: jnp.concatenate([jnp.zeros(d), x[:-d]]),
    "ahead": lambda x, y, z, c, d, j: jnp.pad(x[d:], (0, d)),
    "flip": lambda x, y, z, c, d, j: x[::-1],
    "sum": lambda x, y, z, c, d, j: jnp.sum(x) / len(x),
    "max": lambda x, y, z, c, d, j: jnp.max(x) + jnp.min(y),
    "scale": lambda x, y, z, c, d, j: x * (z / (1 + jnp.abs(z))),
    "first": lambda x, y, z, c, d, j: x.at[0].set(z),
    "pick": lambda x, y, z, c, d, j: x[d] + c * y[-1],
    "cumsum": lambda x, y, z, c, d, j: jnp.cumsum(x) / len(x),
    "cummax": lambda x, y, z, c, d, j: jax.lax.cummax(x),
    "cummin": lambda x, y, z, c, d, j: jax.lax.cummin(x, reverse=True),
    "difference": lambda x, y, z, c, d, j: jnp.diff(jnp.concatenate([z[None], x])),
    "largest": lambda x, y, z, c, d, j: jnp.argmax(x) / len(x),
    "channels": lambda x, y, z, c, d, j: both_channels(x, y, c),
    "dot": lambda x, y, z, c, d, j: x @ y / len(x),
    "filter": lambda x, y, z, c, d, j: jnp.convolve(x, jnp.array([0.25, 0.5, c]), mode="same"),
    "gain": lambda x, y, z, c, d, j: x / (2 + x * x) + 0.01 * j,
    "worst": lambda x, y, z, c, d, j: jnp.where(jnp.any(x > 1), 1.0, 0.5 * jnp.all(y < 2)),
    "around": lambda x, y, z, c, d, j: x[jnp.clip(jnp.arange(len(x)) - d, 0, len(x) - 1)],
    "search": lambda x, y, z, c, d, j: x[(jnp.abs(y) * len(x)).astype(int) % len(x)],
    "solve": lambda x, y, z, c, d, j: solved(x, y, z, c, d),
}
BY_NUMPY = {
    "mix": lambda x, y, z, c, d, j: c * x + y,
    "product": lambda x, y, z, c, d, j: x * y / (1 + y**2),
    "bend": lambda x, y, z, c, d, j: [(v if v > 0 else c * v) - min(abs(w), 1)
                                      for v, w in zip(x, y, strict=True)],
    "delay": lambda x, y, z, c, d, j: [x[k - d] if k >= d else 0 for k in range(len(x))],
    "ahead": lambda x, y, z, c, d, j: [x[k + d] if k + d < len(x) else 0 for k in range(len(x))],
    "flip": lambda x, y, z, c, d, j: [x[len(x) - 1 - k] for k in range(len(x))],
    "sum": lambda x, y, z, c, d, j: sum(x) / len(x),
    "max": lambda x, y, z, c, d, j: max(x) + min(y),
    "scale": lambda x, y, z, c, d, j: x * z / (1 + abs(z)),
    "first": lambda x, y, z, c, d, j: [z, *x[1:]],
    "pick": lambda x, y, z, c, d, j: x[d] + c * y[len(x) - 1],
    "cumsum": lambda x, y, z, c, d, j: [*itertools.accumulate(x / len(x))],
    "cummax": lambda x, y, z, c, d, j: [max(x[: k + 1]) for k in range(len(x))],
    "cummin": lambda x, y, z, c, d, j: [min(x[k:]) for k in range(len(x))],
    "difference": lambda x, y, z, c, d, j: [now - before for before, now in
                                            itertools.pairwise([z, *x])],
    "largest": lambda x, y, z, c, d, j: list(x).index(max(x)) / len(x),
    "channels": lambda x, y, z, c, d, j: 0.5 * (x + 0.2 * y) + c * x - 0.3 * y,
    "dot": lambda x, y, z, c, d, j: sum(v * w for v, w in zip(x, y, strict=True)) / len(x),
    "filter": lambda x, y, z, c, d, j: [0.25 * after + 0.5 * now + c * before for
                                        before, now, after in zip([0, *x[:-1]], x, [*x[1:], 0],
                                                                  strict=True)],
    "gain": lambda x, y, z, c, d, j: x / (2 + x**2) + 0.01 * j,
    "worst": lambda x, y, z, c, d, j: 1.0 if any(v > 1 for v in x) else 0.5 * all(y < 2),
    "around": lambda x, y, z, c, d, j: [x[max(k - d, 0)] for k in range(len(x))],
    "search": lambda x, y, z, c, d, j: [x[int(abs(v) * len(x)) % len(x)] for v in y],
    "solve": lambda x, y, z, c, d, j: np.tanh(
        np.linalg.solve([[z, 1 + x[d] ** 2], [2.0, y[d]]], [1.0, c])[0]
    ),
}  # fmt: skip


def program(rng, without=()):
    """Return N, instructions, which rows and numbers are remembered, and which numbers are kept."""
    N, rows, numbers, lines = int(rng.integers(12, 40)), 3, 2, []
    for _ in range(rng.integers(5, 14)):
        kind = pick(rng, [kind for kind in KINDS + MOVING * 2 if kind not in without])
        a = rows - min(int(rng.geometric(0.5)), rows)  # mostly one of the last
        b = int(rng.integers(rows))
        s, c = int(rng.integers(numbers)), float(np.round(rng.uniform(-1, 1), 2))
        lines.append((kind, a, b, s, c, int(rng.integers(1, 4))))
        if kind in NUMBERS:
            numbers += 1
        elif kind in ("scan", "back"):
            rows, numbers = rows + 1, numbers + 1
        else:
            rows += 1
    memory = [int(i) for i in rng.integers(rows, size=2)]
    if not any(line[0] in ("scan", "back") for line in lines):
        lines.append(("scan", rows - 1, 0, 0, 0.5, 1))
        rows, numbers = rows + 1, numbers + 1
    return N, lines, memory, int(rng.integers(numbers)), numbers


def by_jax(of):
    """Return the function of one machine: (N,) reference and a gain."""
    N, lines, memory, number, _ = of

    def trial(carry, j, r, gain):
        rows, numbers = [r, *carry[0]], [gain, carry[1]]
        for kind, a, b, s, c, d in lines:
            x, y, z = rows[a], rows[b], numbers[s]
            if kind not in ("scan", "back"):
                (numbers if kind in NUMBERS else rows).append(BY_JAX[kind](x, y, z, c, d, j))
                continue

            def tick(state, now, c=c):
                x, y = now
                state = 0.7 * state + x + c * jnp.tanh(y)
                return state, state - 0.5 * y

            last, found = jax.lax.scan(tick, 0.1 * z, (x, y), reverse=kind == "back")
            rows.append(found)
            numbers.append(last)
        kept = [rows[i] for i in memory]
        kept = [x / (1 + jnp.max(jnp.abs(x))) for x in kept]
        seen = [jnp.arange(1, N + 1) @ x / N for x in rows]  # so that each row is read by somebody
        return (tuple(kept), jnp.tanh(numbers[number])), jnp.stack(numbers + seen)

    def learning(_, one):
        r, gain = one
        start = ((jnp.zeros(N), 0.5 * r), 0.2)
        return jax.lax.scan(lambda c, j: trial(c, j, r, gain), start, jnp.arange(TRIALS))

    return learning


def by_numpy(of, r, gain):
    """Return the same of one machine."""
    N, lines, memory, number, _ = of
    kept, carried, found = (np.zeros(N), 0.5 * r), 0.2, []
    for j in range(TRIALS):
        rows, numbers = [r, *kept], [gain, carried]
        for kind, a, b, s, c, d in lines:
            x, y, z = rows[a], rows[b], numbers[s]
            if kind in ("scan", "back"):
                state, out = 0.1 * z, np.zeros(N)
                for k in range(N) if kind == "scan" else range(N - 1, -1, -1):
                    state = 0.7 * state + x[k] + c * np.tanh(y[k])
                    out[k] = state - 0.5 * y[k]
                rows.append(out)
                numbers.append(state)
            elif kind in NUMBERS:
                numbers.append(BY_NUMPY[kind](x, y, z, c, d, j))
            else:
                rows.append(np.asarray(BY_NUMPY[kind](x, y, z, c, d, j), float))
        kept = [rows[i] for i in memory]
        kept = [x / (1 + max(abs(x))) for x in kept]
        carried = np.tanh(numbers[number])
        found.append([*numbers, *(np.arange(1, N + 1) @ x / N for x in rows)])
    return [*kept, carried, np.array(found)]


def test_a_random_program_computes_what_numpy_computes():
    def attempt(rng):
        of, machines = program(rng), int(pick(rng, (1, 3, 8, 11, 17)))
        r, gain = rng.normal(size=(machines, of[0])), rng.uniform(0.5, 1.5, machines)
        learning = by_jax(of)
        found = jax.tree.leaves(Compiled(learning, (), (r[0], gain[0]))((), (r, gain)))
        for machine in range(machines):
            wanted = by_numpy(of, r[machine], gain[machine])
            for x, y in zip(found, wanted, strict=True):
                scale = np.max(np.abs(y), initial=1e-300)
                np.testing.assert_allclose(x[machine], y, rtol=0, atol=1e-11 * scale,
                                           err_msg=f"{machine} {of}")  # fmt: skip

    assert fuzz(10, attempt, allowed=())  # none of them is refused


def test_the_gradient_of_a_random_program_is_that_of_jax():
    """By the reference and the gain, backward through all trials, unlike in each machine."""

    def attempt(rng):
        of, machines = program(rng, ("cummax", "cummin", "search")), int(pick(rng, (1, 5, 9)))
        r, gain = rng.normal(size=(machines, of[0])), rng.uniform(0.5, 1.5, machines)
        learning = by_jax(of)

        def loss(one):
            (rows, number), found = learning((), one)
            return jnp.tanh(number) + sum(jnp.mean(x**2) for x in rows) + jnp.mean(found[-1] ** 2)

        def slopes(_, one):
            return jax.value_and_grad(loss)(one)

        found = Compiled(slopes, (), (r[0], gain[0]))((), (r, gain))
        wanted = jax.jit(jax.vmap(slopes, (None, 0)))((), (r, gain))
        assert differs(found, wanted) is None, of

    attempt(np.random.default_rng(31))  # a maximum, and the rows that reach it, in two loops
    assert fuzz(2, attempt, allowed=())  # none of them is refused
