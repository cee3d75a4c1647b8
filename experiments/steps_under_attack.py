"""Learning in single precision, in parts, in passes, step by step, on two devices: against `learn`.

Every scheme of `tests/cases.py` with random weights runs on random machines near that of its case,
with a disturbance, a limit of the input and, but in single precision, noise. Each is compared with
`learn` of all trials at once, in double precision, in all that it returns:

    truncated       the trials in two parts, of which a gradient sees the last, cut at random
    trials_a_pass   several trials in each pass of the loop
    two devices     `tiled` on two devices, beside one
    next_memory     the memory after the last trial, from the record of each one, as a real machine
                    learns; and what `feedforward` says that each trial plays
    float32         single precision

The number of trials, of the first one, and the cut are drawn for each scheme.

How far two ways to compute a number may differ follows from how rounding grows in the program
itself: its operations are interpreted in double precision, and the result of each is rounded at
random, up or down, to a number of single precision whose mean it is (stochastic arithmetic: Vignes
1993, Parker 1997). A sum of k products has sqrt(k) such errors, a factorisation those of the
entries of its matrix, and a Fourier transform of n numbers those of log2(n) stages, each of which
multiplies by a factor that is rounded, and adds. A machine is wrong where a leaf of the result lies
further off than

    in float32      8.5 times the root mean square of what 32 such runs are off. By Student's
                    distribution one more such run is that far off with a chance of 1e-9 at most,
                    so that of the 2e5 leaves that are compared none should be
    in float64      that times 2^-29, the ratio of the two units of rounding, and at least 1e-12 of
                    the size of the leaf

In float32 nothing is told of a machine where these runs have no digit of the errors in common, as
where a decision hangs on the last digit, or where a number overflows.
"""

import sys
import time
from collections import Counter
from functools import partial
from operator import itemgetter
from unittest import mock

import claims_under_attack  # noqa: F401  sets JAX up, and the path of the cases
import jax
import jax.numpy as jnp
import numpy as np
import output
import scipy.stats
from cases import SCHEMES, case
from claims_under_attack import moved
from jax.extend.core import ClosedJaxpr, Literal

from jaxilc import Actuator, Disturbance, Machine, Sensor, Task, tiled
from jaxilc.learning import learn, next_memory, truncated

MACHINES, DRAWS, CHANCE, LANES = 104, 32, 1e-9, 8
SIGMAS = scipy.stats.t.isf(CHANCE / 2, DRAWS)
UNIT, RATIO, NEAR, NO_DIGIT = 2.0**-24, 2.0**-29, 1e-12, 0.1
KINDS = ("truncated", "trials_a_pass", "two devices", "next_memory", "float32")


# Rounding at random
# --------------------------------------------------------------------------------------------------

SUMS = ("dot_general", "reduce_sum", "cumsum", "conv_general_dilated", "scatter-add", "add_any")
FACTORS = ("cholesky", "lu", "triangular_solve", "eigh", "householder_product", "geqrf", "svd")


def noise(x, salt):
    """(...) numbers in [0, 2^29), by the digits of x and by `salt`."""
    bits = jax.lax.bitcast_convert_type(x, jnp.uint64) + salt
    bits = (bits ^ (bits >> 33)) * jnp.uint64(0xFF51AFD7ED558CCD)
    bits = (bits ^ (bits >> 29)) * jnp.uint64(0xC4CEB9FE1A85EC53)
    return bits >> 35


def rounded(x, salt):
    """x in double precision, rounded to single precision, up or down with the mean x."""
    if x.dtype == jnp.complex128:
        return jax.lax.complex(rounded(jnp.real(x), salt), rounded(jnp.imag(x), salt + 3))
    if x.dtype != jnp.float64:
        return x
    bits = jax.lax.bitcast_convert_type(x, jnp.uint64) + noise(x, salt)
    cut = jax.lax.bitcast_convert_type(bits & ~jnp.uint64(2**29 - 1), jnp.float64)
    return jnp.where(jnp.isfinite(x), cut, x)


def off(x, size, salt):
    """x, off by the size times a number of [-1, 1], in both parts of a complex x."""
    if jnp.iscomplexobj(x):
        return jax.lax.complex(off(jnp.real(x), size, salt), off(jnp.imag(x), size, salt + 5))
    return x + size * (noise(x, salt) * 2.0**-28 - 1)


def one(eqn, args, salt):
    """The results of a primitive operation, each rounded at random."""
    name, do = eqn.primitive.name, partial(eqn.primitive.bind, **eqn.params)
    if name in FACTORS:
        args = [off(x, UNIT * jnp.max(jnp.abs(x), initial=0.0), salt) for x in args]
    out = do(*args)
    real = [getattr(x, "dtype", None) == jnp.float64 for x in args]
    several = out if eqn.primitive.multiple_results else [out]
    if name in SUMS and all(real):
        terms = max(np.size(x) for x in args) // max(np.size(several[0]), 1)
        sizes = do(*(jnp.abs(x) for x in args))
        several = [off(several[0], UNIT * np.sqrt(max(terms, 1)) * sizes, salt)]
    if name == "fft":  # with a product, its factor and a sum in each stage
        stages = np.log2(max(np.prod(eqn.params["fft_lengths"]), 2))
        size = jnp.sqrt(jnp.mean(jnp.abs(several[0]) ** 2, axis=-1, keepdims=True))
        several = [off(several[0], UNIT * np.sqrt(2 * stages) * size, salt)]
    return [rounded(x, salt + jnp.uint64(7 * i)) for i, x in enumerate(several)]


def interpreted(jaxpr, consts, salt, args):
    """The results of a program whose operations are rounded at random, by `salt`."""
    known = dict(zip((*jaxpr.constvars, *jaxpr.invars), (*consts, *args), strict=True))
    read = lambda v: v.val if isinstance(v, Literal) else known[v]  # noqa: E731
    for number, eqn in enumerate(jaxpr.eqns):
        salt = salt * jnp.uint64(6364136223846793005) + jnp.uint64(2 * number + 1)
        outs = of_equation(eqn, [read(v) for v in eqn.invars], salt)
        known |= dict(zip(eqn.outvars, outs, strict=True))
    return [read(v) for v in jaxpr.outvars]


def of_equation(eqn, args, salt):
    name, p = eqn.primitive.name, eqn.params
    if name == "scan":
        n, m = p["num_consts"], p["num_consts"] + p["num_carry"]

        def turn(carry, xs):
            outs = run(p["jaxpr"], carry[0], [*args[:n], *carry[1], *xs])
            return (carry[0] * jnp.uint64(3935559000370003845) + 1, outs[: m - n]), outs[m - n :]

        how = {"length": p["length"], "reverse": p["reverse"]}
        (_, last), rows = jax.lax.scan(turn, (salt, args[n:m]), args[m:], **how)
        return [*last, *rows]
    if name == "while":
        c, b = p["cond_nconsts"], p["cond_nconsts"] + p["body_nconsts"]
        going = lambda now: run(p["cond_jaxpr"], now[0], [*args[:c], *now[1]])[0]  # noqa: E731
        body = lambda now: (now[0] + 2, run(p["body_jaxpr"], now[0], [*args[c:b], *now[1]]))  # noqa: E731
        return jax.lax.while_loop(going, body, (salt, args[b:]))[1]
    if name == "cond":
        branches = [lambda *x, inner=inner: run(inner, salt, x) for inner in p["branches"]]
        return jax.lax.switch(args[0], branches, *args[1:])
    if name == "custom_linear_solve":
        c = p["const_lengths"]
        n, m = c.matvec + c.vecmat, c.matvec + c.vecmat + c.solve
        return run(p["jaxprs"].solve, salt, [*args[n:m], *args[m + c.transpose_solve :]])
    inner = next((p[key] for key in ("jaxpr", "call_jaxpr", "fun_jaxpr") if key in p), None)
    if inner is not None:
        return run(inner, salt, args)
    if any(isinstance(value, ClosedJaxpr) for value in jax.tree.leaves(list(p.values()))):
        raise NotImplementedError(f"{name} has a program of its own")
    return one(eqn, args, salt)


def run(program, salt, args):
    closed = isinstance(program, ClosedJaxpr)
    return interpreted(*((program.jaxpr, program.consts) if closed else (program, [])), salt, args)


def rounded_at_random(function, salt, *args):
    """What the function returns if each of its operations is rounded at random."""
    program, shape = jax.make_jaxpr(function, return_shape=True)(*args)
    outs = run(program, salt, jax.tree.leaves(args))
    return jax.tree.unflatten(jax.tree.structure(shape), outs)


# Random cases, and what is compared
# --------------------------------------------------------------------------------------------------


def cases_of(rng, name: str, count: int):
    """The machines and schemes with a leading axis, in digits of single precision; their task."""
    machine, scheme, task = case(name)
    N, n_y, several = task.N, task.outputs, []
    for _ in range(count):
        leaves, shape = jax.tree.flatten(machine.plant)
        near = [np.asarray(x) * (1 + 0.01 * rng.standard_normal(np.shape(x))) for x in leaves]
        d = 0.05 * rng.standard_normal((N + 1, n_y))
        of_it = Machine(
            jax.tree.unflatten(shape, near),
            Actuator(limit=10 ** rng.uniform(-0.3, 2)),
            Sensor(noise=10 ** rng.uniform(-4, -1)),
            Disturbance(output=d),
        )
        several.append((of_it, moved(rng, scheme), np.float64(rng.integers(2**20))))
    stacked = jax.tree.map(lambda *x: np.stack(x).astype(np.float32).astype(float), *several)
    r = np.asarray(task.reference).astype(np.float32).astype(float)
    return stacked, Task(r, dt=task.dt, inputs=task.inputs)


def record(trial):
    return trial.y, trial.u, trial.signals


def quiet(machine):
    still = 0.0 * machine.sensor.noise
    return Machine(machine.plant, machine.actuator, Sensor(noise=still), machine.disturbance)


def of(how, trials: int, first: int, task, case, **options):
    """What `learn` or `truncated` returns of one case, without what was no number before."""
    machine, scheme, seed = case
    key = jax.random.key(seed.astype(int))
    how = partial(how, key=key, save=record, first=first)
    found = how(machine, scheme, task, trials, **options)
    return found._replace(final=record(found.final))


def steps(cases, task, history):
    """(memory in the end, u of each trial) by `next_memory`, from the records of `learn`.

    A record that is not finite is refused, so of such a machine both are as in `learn`.
    """
    after = jax.jit(lambda scheme, memory, trial: scheme.learn(memory, trial._replace(dt=task.dt)))
    plays = jax.jit(lambda scheme, memory: scheme.feedforward(memory, task))
    memories, played = [], []
    known = cases[1], cases[0].actuator.limit, history.saved, history.memory
    for scheme, limit, (y, u, signals), last in each(*known):
        if not np.all(np.isfinite(y)):
            memories.append(last)
            played.append(u if scheme.plays_back else np.array([]))
            continue
        step = mock.Mock(learn=lambda m, t, s=scheme: after(s, m, t._replace(dt=None)))
        memory, inputs = scheme.initial_memory(task), []
        for j in range(len(y)):
            if scheme.plays_back:
                inputs.append(np.clip(plays(scheme, memory), -limit, limit))
            of_trial = {n: x[j] for n, x in signals.items() if x.shape[-1] == task.inputs}
            memory = next_memory(step, task, memory, y[j], u[j], **of_trial)
        memories.append(memory)
        played.append(np.array(inputs))
    return jax.tree.map(lambda *x: np.stack(x), *memories), np.stack(played)


def each(*trees):
    """The parts of each machine, from those of all."""
    trees = jax.tree.map(np.asarray, trees)
    for i in range(len(jax.tree.leaves(trees)[0])):
        yield jax.tree.map(itemgetter(i), trees)


def of_all(function):
    return jax.jit(jax.vmap(function, in_axes=(None, 0)))


def distances(one, other) -> tuple[np.ndarray, np.ndarray]:
    """(L, S) of each leaf and machine: the distance of two results, and the size of the first."""
    apart, sizes = [], []
    for a, b in zip(jax.tree.leaves(one), jax.tree.leaves(other), strict=True):
        a, b = (np.asarray(x, float).reshape(len(x), -1) for x in (a, b))
        with np.errstate(all="ignore"):
            d = np.where((a == b) | (np.isnan(a) & np.isnan(b)), 0.0, np.abs(a - b))
        apart.append(np.linalg.norm(np.nan_to_num(d, nan=np.inf), axis=1))
        sizes.append(np.linalg.norm(np.where(np.isfinite(a), a, 0.0), axis=1))
    return np.array(apart), np.array(sizes)


def runs_of(rng, cases, task, trials: int) -> tuple[dict, dict, np.ndarray]:
    """What each kind gives, what `learn` gives in its place, and (L, S) how far rounding leads."""
    first, last = int(rng.integers(1, 6)), int(rng.integers(1, trials))
    passes = int(rng.choice([2, trials // 2]))
    at_once, devices = partial(of, learn, trials, first), jax.devices()
    with mock.patch("jax.devices", return_value=devices[:1]):
        program = tiled(at_once, lanes=LANES)
    known, still = program(task, cases), (jax.vmap(quiet)(cases[0]), *cases[1:])
    exact = program(task, still)
    found = {
        "truncated": of_all(partial(of, truncated, trials, first, last=last))(task, cases),
        "trials_a_pass": of_all(partial(at_once, trials_a_pass=passes))(task, cases),
        "two devices": tiled(at_once, lanes=LANES)(task, cases),
    }
    wanted = dict.fromkeys(found, known) | {"float32": exact}
    with jax.enable_x64(False):
        single = jax.tree.map(lambda x: np.asarray(x, np.float32), (task, still))
        found["float32"] = of_all(at_once)(*single)
    memory, played = steps(cases, task, known)
    if jax.tree.leaves(memory) or played.size:
        saved = known.saved[0], played if played.size else known.saved[1], known.saved[2]
        found["next_memory"] = known._replace(memory=memory, saved=saved)
        wanted["next_memory"] = known
    salts = jnp.asarray(rng.integers(2**63, size=DRAWS), jnp.uint64)
    draw = jax.jit(jax.vmap(partial(rounded_at_random, at_once), in_axes=(None, None, 0)))
    drawn = [distances(exact, draw(salt, task, still))[0] for salt in salts]
    with np.errstate(all="ignore"):
        return found, wanted, SIGMAS * np.sqrt(np.mean(np.square(drawn), axis=0))


def of_scheme(name: str, count: int, seed: int) -> tuple[dict, list]:
    """A row of the table, and what is wrong."""
    rng = np.random.default_rng([seed, sum(map(ord, name))])
    cases, task = cases_of(rng, name, count)
    found, wanted, growth = runs_of(rng, cases, task, int(rng.choice([4, 6])))
    leaves = jax.tree_util.tree_leaves_with_path(wanted["float32"])
    names = [jax.tree_util.keystr(path) for path, _ in leaves]
    errors, row, wrong = names.index(".metrics.rms"), {"class": name}, []
    for kind in KINDS:
        row |= {kind: 0, f"{kind}, wrong": 0, f"{kind}, same bits": 0}
        if kind not in found:
            continue
        apart, sizes = distances(wanted[kind], found[kind])
        bound, told = np.maximum(growth, UNIT * sizes), np.ones(count, bool)
        if kind == "float32":
            told = np.isfinite(growth[errors]) & (growth[errors] < NO_DIGIT * sizes[errors])
        else:
            bound = np.maximum(np.where(np.isfinite(growth), growth * RATIO, 0.0), NEAR * sizes)
        if kind == "next_memory":
            told = np.isfinite(wanted[kind].saved[0]).all((1, 2, 3))
        far = (apart > bound) & told
        row |= {kind: int(np.sum(told)), f"{kind}, wrong": int(np.sum(np.any(far, axis=0)))}
        row[f"{kind}, same bits"] = int(np.sum(np.all(apart == 0, axis=0)))
        for leaf, i in np.argwhere(far):
            wrong.append((name, kind, int(i), names[leaf], apart[leaf, i], bound[leaf, i]))
    return row, wrong


def main(names: list[str], count: int = MACHINES) -> None:
    rows, wrong = [], []
    for name in output.asked(names, SCHEMES):
        start = time.perf_counter()
        row, of_it = of_scheme(name, count, 38)
        jax.clear_caches()
        rows.append(row)
        wrong += of_it
        print(row, f"{time.perf_counter() - start:.0f} s", flush=True)
        for kind, cases in Counter(w[1] for w in of_it).items():
            print("   WRONG", kind, cases, next(w for w in of_it if w[1] == kind), flush=True)
    output.write_rows(output.folder(__file__) / "rows.csv", rows)
    print(output.sums(rows))


if __name__ == "__main__":
    main(sys.argv[1:])
