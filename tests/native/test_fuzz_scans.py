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


def program(rng, without=()):
    """Return N, instructions, which rows and numbers are remembered, and which numbers are kept."""
    N, rows, numbers, lines = int(rng.integers(12, 40)), 3, 2, []
    for _ in range(rng.integers(5, 14)):
        kind = pick(rng, [kind for kind in KINDS + MOVING * 2 if kind not in without])
        a = rows - min(int(rng.geometric(0.5)), rows)  # mostly one of the last
        b = int(rng.integers(rows))
        s, c = int(rng.integers(numbers)), float(np.round(rng.uniform(-1, 1), 2))
        lines.append((kind, a, b, s, c, int(rng.integers(1, 4))))
        if kind in ("sum", "max", "pick", "largest", "dot", "worst", "solve"):
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
            zeros = jnp.zeros(d)
            match kind:
                case "mix":
                    rows.append(c * x + y)
                case "product":
                    rows.append(x * y / (1 + y * y))
                case "bend":
                    rows.append(jnp.where(x > 0, x, c * x) - jnp.minimum(jnp.abs(y), 1.0))
                case "delay":
                    rows.append(jnp.concatenate([zeros, x[:-d]]))
                case "ahead":
                    rows.append(jnp.pad(x[d:], (0, d)))
                case "flip":
                    rows.append(x[::-1])
                case "scan" | "back":

                    def tick(state, now, c=c):
                        x, y = now
                        state = 0.7 * state + x + c * jnp.tanh(y)
                        return state, state - 0.5 * y

                    last, found = jax.lax.scan(tick, 0.1 * z, (x, y), reverse=kind == "back")
                    rows.append(found)
                    numbers.append(last)
                case "sum":
                    numbers.append(jnp.sum(x) / N)
                case "max":
                    numbers.append(jnp.max(x) + jnp.min(y))
                case "scale":
                    rows.append(x * (z / (1 + jnp.abs(z))))
                case "first":
                    rows.append(x.at[0].set(z))
                case "pick":
                    numbers.append(x[d] + c * y[-1])
                case "cumsum":
                    rows.append(jnp.cumsum(x) / N)
                case "cummax":
                    rows.append(jax.lax.cummax(x))
                case "cummin":
                    rows.append(jax.lax.cummin(x, reverse=True))
                case "difference":
                    rows.append(jnp.diff(jnp.concatenate([z[None], x])))
                case "largest":
                    numbers.append(jnp.argmax(x) / N)
                case "channels":
                    both = jnp.stack([x, y], axis=1) @ jnp.array([[1.0, c], [0.2, -0.3]])
                    rows.append(both[:, 0] * 0.5 + both[:, 1])
                case "dot":
                    numbers.append(x @ y / N)
                case "filter":
                    rows.append(jnp.convolve(x, jnp.array([0.25, 0.5, c]), mode="same"))
                case "gain":
                    rows.append(x / (2 + x * x) + 0.01 * j)
                case "around":
                    rows.append(x[jnp.clip(jnp.arange(N) - d, 0, N - 1)])
                case "search":
                    rows.append(x[(jnp.abs(y) * N).astype(int) % N])
                case "solve":  # of which no row is always the first
                    A = jnp.array([[z, 1 + x[d] ** 2], [2.0, y[d]]])
                    numbers.append(jnp.tanh(jnp.linalg.solve(A, jnp.array([1.0, c]))[0]))
                case "worst":
                    numbers.append(jnp.where(jnp.any(x > 1), 1.0, 0.5 * jnp.all(y < 2)))
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
            if kind == "mix":
                rows.append(c * x + y)
            if kind == "product":
                rows.append(x * y / (1 + y**2))
            if kind == "bend":
                rows.append(
                    [(v if v > 0 else c * v) - min(abs(w), 1) for v, w in zip(x, y, strict=True)]
                )
            if kind == "delay":
                rows.append([x[k - d] if k >= d else 0 for k in range(N)])
            if kind == "ahead":
                rows.append([x[k + d] if k + d < N else 0 for k in range(N)])
            if kind == "flip":
                rows.append([x[N - 1 - k] for k in range(N)])
            if kind in ("scan", "back"):
                state, out = 0.1 * z, np.zeros(N)
                for k in range(N) if kind == "scan" else range(N - 1, -1, -1):
                    state = 0.7 * state + x[k] + c * np.tanh(y[k])
                    out[k] = state - 0.5 * y[k]
                rows.append(out)
                numbers.append(state)
            if kind == "sum":
                numbers.append(sum(x) / N)
            if kind == "max":
                numbers.append(max(x) + min(y))
            if kind == "scale":
                rows.append(x * z / (1 + abs(z)))
            if kind == "first":
                rows.append([z, *x[1:]])
            if kind == "pick":
                numbers.append(x[d] + c * y[N - 1])
            if kind == "cumsum":
                rows.append([*itertools.accumulate(x / N)])
            if kind == "cummax":
                rows.append([max(x[: k + 1]) for k in range(N)])
            if kind == "cummin":
                rows.append([min(x[k:]) for k in range(N)])
            if kind == "difference":
                rows.append([x[k] - (x[k - 1] if k else z) for k in range(N)])
            if kind == "largest":
                numbers.append(list(x).index(max(x)) / N)
            if kind == "channels":
                rows.append(0.5 * (x + 0.2 * y) + c * x - 0.3 * y)
            if kind == "dot":
                numbers.append(sum(v * w for v, w in zip(x, y, strict=True)) / N)
            if kind == "filter":
                wide = [0, *x, 0]
                rows.append([0.25 * wide[k + 2] + 0.5 * wide[k + 1] + c * wide[k]
                             for k in range(N)])  # fmt: skip
            if kind == "gain":
                rows.append(x / (2 + x**2) + 0.01 * j)
            if kind == "around":
                rows.append([x[max(k - d, 0)] for k in range(N)])
            if kind == "search":
                rows.append([x[int(abs(v) * N) % N] for v in y])
            if kind == "solve":
                A = [[z, 1 + x[d] ** 2], [2.0, y[d]]]
                numbers.append(np.tanh(np.linalg.solve(A, [1.0, c])[0]))
            if kind == "worst":
                numbers.append(1.0 if any(v > 1 for v in x) else 0.5 * all(w < 2 for w in y))
            rows[-1] = np.asarray(rows[-1], float)
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
