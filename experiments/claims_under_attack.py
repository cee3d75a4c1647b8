"""Claims of theory on random machines under every scheme, against 1000 trials of an oracle.

Every learning scheme of `tests/cases.py`, with random weights, learns on random machines: a third
are near the plant of its case, the others have other poles, gains and coupling. Half of the rounds
have an actuator with limits. What `certificates.long_run` claims is compared with the trials that
an oracle runs:

    NumPy   the trial as a lifted matrix of the plant, the law as two matrices that are written down
            below; for the schemes of `PLAIN`
    learn   the simulation itself in double precision, which oracles of its own judge elsewhere; for
            all other schemes

In both, every step d_j = w_{j+1} - w_j of what is learned is looked at in place of its distance
from a limit that would have to be believed: for a linear law d_{j+1} = M d_j, so what is claimed of
the distance holds of the steps.

    monotone    no error, or no step, is above sigma times the one before
    converges   no step is above the growth and the factor that were told
    floor       at the end the error is the one that is told, within its doubt
    diverges    the steps grow at the end
"""

import argparse
import sys
import time
from collections import Counter
from functools import partial
from itertools import product
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import output
import scipy.signal
from conditions_under_attack import lifted, mirrored, stacked_machines, symmetric, task_of
from jax.flatten_util import ravel_pytree

import jaxilc
from jaxilc.learning import learn
from jaxilc.pytree import named_leaves, replaced
from jaxilc.schemes import ConstrainedNormOptimal
from jaxilc.theory.certificates import CONVERGES, DIVERGES, MONOTONE, NOTHING, long_run
from jaxilc.theory.learning_map import known_as, view_of

jaxilc.setup()  # before the cases make their plants
sys.path.append(str(Path(__file__).parents[1] / "tests"))

from cases import _FEW, CASES, DT, FEW, SAMPLES, SCHEMES  # noqa: E402

TRIALS, ROUNDS, MACHINES, ORDER = 1000, 5, 22, 4
LONG, LATE = 2**16, "seen late"
WIDE = 600  # samples of a trial whose map is no matrix
OF_ANY_LENGTH = ("p_type", "p_type_fir", "p_type_butterworth", "learning_filter_butterworth")
ALIKE = ("model", "filter", "inverse", "weight", "basis")  # parts that are moved a little only
IN_SHORT = {  # why nothing is claimed, without the numbers
    "is met in trial": "a limit is met",
    "is met later cannot be excluded": "a limit may be met later",
    "no power of the learning map": "no power of the map up to 64 contracts",
    "beyond the digits of the numbers": "it can grow beyond the digits before it falls",
    "was not seen to fall": "not seen to fall within 1024 trials",
}


# Machines and laws
# --------------------------------------------------------------------------------------------------


def random_plant(rng, n_u: int, n_y: int, like) -> tuple:
    """(A, B, C) of order 4, with the sign and about the size of another plant's first response."""
    A, slowest = np.zeros((ORDER, ORDER)), rng.choice([0.3, 0.6, 0.98])
    for i in (0, 2):
        size, angle = slowest * rng.uniform(0.1, 1.0), rng.choice([0.0, rng.uniform(0.0, 2.5)])
        turn = np.array([[np.cos(angle), np.sin(angle)], [-np.sin(angle), np.cos(angle)]])
        A[i : i + 2, i : i + 2] = size * turn + [[0, 0.3 * rng.standard_normal()], [0, 0]]
    B, C = rng.standard_normal((ORDER, n_u)), rng.standard_normal((n_y, ORDER))
    first, wanted = C @ B, size_of(*like)
    if n_u == n_y > 1:  # the first response of the other plant, with some coupling of its own
        own = wanted * (1 + 0.3 * rng.standard_normal(wanted.shape))
        return A, B @ np.linalg.solve(first, own), C
    share = np.sign(np.sum(first * wanted)) * np.linalg.norm(wanted) / np.linalg.norm(first)
    return A, B, C * share * 10 ** rng.normal(-0.3, 0.3) * rng.choice([1, 1, 1, 1, 1, 1, 1, -1])


def size_of(A, B, C) -> np.ndarray:
    """(n_y, n_u) the first response of a plant; of one slow plant, that at rest."""
    first = C @ B
    at_rest = C @ np.linalg.solve(np.eye(len(A)) - A + 1e-6 * np.eye(len(A)), B)
    return first if first.shape[0] == first.shape[1] > 1 else np.clip(at_rest, -1.5, 1.5)


def near(rng, like) -> tuple:
    """(A, B, C) near those of another plant."""
    A, B, C = (
        x * (1 + s * rng.standard_normal(x.shape))
        for x, s in zip(like, (0.03, 0.1, 0.1), strict=True)
    )
    return A, B * 10 ** rng.normal(0, 0.25), C


def of_case(name: str) -> tuple:
    """(A, B, C) of the plant of a case at rest, from the slopes of its step; of order 4 or less."""
    plant = CASES[name][0].sampled(DT)
    x, unravel = ravel_pytree(jax.tree.map(lambda v: 0.0 * v, plant.initial_state()))

    def step(x, u):
        return ravel_pytree(plant.step(unravel(x), u, DT))[0]

    u = jnp.zeros(plant.n_u)
    A, B = jax.jacfwd(step, argnums=(0, 1))(x, u)
    C = jax.jacfwd(lambda x: plant.output(unravel(x)))(x)
    return tuple(np.asarray(M, float) for M in (A, B, C))


def padded(A, B, C, order: int) -> tuple:
    n = order - len(A)
    return np.pad(A, ((0, n), (0, n))), np.pad(B, ((0, n), (0, 0))), np.pad(C, ((0, 0), (0, n)))


def machines_of(rng, name: str, count: int, limited: bool, samples: int | None) -> tuple:
    """The machines with a leading axis, and their task."""
    like = of_case(name)
    n_u, n_y = like[1].shape[1], like[2].shape[0]
    order = max(ORDER, len(like[0]))
    drawn = [
        padded(*(near(rng, like) if i % 3 == 0 else random_plant(rng, n_u, n_y, like)), order)
        for i in range(count)
    ]
    A, B, C = (np.stack(M) for M in zip(*drawn, strict=True))
    N = samples or (FEW if name in _FEW else SAMPLES)
    d = 0.1 * rng.standard_normal((count, N + 1, n_y))
    limits = [10 ** rng.uniform(-0.5, 4.0, count), 10 ** rng.uniform(3, 7, count)]
    return stacked_machines(A, B, C, d, limits if limited else ()), task_of(N, n_y, n_u)


def moved(rng, scheme):
    """The scheme with other weights; where one would be out of its range it stays."""
    leaves, bounded = named_leaves(scheme), isinstance(scheme, ConstrainedNormOptimal)
    wider = rng.choice([0.0, 100.0]) if bounded else 0.0  # what bounds of the output leave besides
    for name, value in leaves.items():
        part, value = name.split(".")[-1], np.asarray(value)
        spread = 0.02 if any(one in name for one in ALIKE) else 0.6
        far = rng.uniform(0.0, 3.0) if part in ("limit", "rate") else 0.0
        by = np.exp(far + rng.normal(0, spread))
        bounds = {"y_low": value - wider, "y_high": value + wider, "tube": value + wider}
        try:
            scheme = replaced(scheme, {name: bounds.get(part, value * by)})
        except ValueError:
            continue
    return scheme


# What the oracles run
# --------------------------------------------------------------------------------------------------


def p_type(scheme, task):
    """With the parts of a PID law; a gain on changes has a lead."""
    N, m = task.N, int(scheme.lead)
    ahead = np.eye(N, k=m)
    change = np.where(np.arange(N)[:, None] + m < N, ahead - np.eye(N, k=m - 1), 0.0)
    parts = zip("pid", (ahead, np.tri(N), change), strict=True)
    L = sum(float(getattr(scheme, f"gamma_{of}")) * part for of, part in parts)
    return (1 - float(scheme.leak)) * np.eye(N), L


def by_taps(scheme, task):
    N, taps, keep = task.N, np.asarray(scheme.L), np.asarray(scheme.keep)
    n, m = len(taps) // 2, len(keep) // 2
    L = sum(tap * np.eye(N, N + 1, k=1 + scheme.lead + i - n) for i, tap in enumerate(taps))
    ends = np.pad(np.eye(N), ((m, m), (0, 0)), mode="symmetric")
    return sum(tap * ends[i : i + N] for i, tap in enumerate(keep)), L


def zero_phase(q, samples: int):
    """A filter that is mirrored at the ends of its signal."""

    def once(f):
        if hasattr(q, "a"):
            return scipy.signal.freqz(np.asarray(q.b), np.asarray(q.a), f, fs=1 / DT)[1]
        edges = [q.low, q.high] if hasattr(q, "low") else [q.cutoff]
        kind = "bandstop" if len(edges) > 1 else "lowpass"
        edges = np.squeeze(np.array(edges, float))
        sections = scipy.signal.butter(q.order, edges, kind, fs=1 / DT, output="sos")
        return scipy.signal.sosfreqz(sections, f, fs=1 / DT)[1]

    return mirrored(lambda f: abs(once(f)) ** 2, samples)


def filtered(scheme, task):
    law = by_taps if hasattr(scheme.scheme, "L") else p_type
    (keep, L), Q = law(scheme.scheme, task), zero_phase(scheme.filter, task.N)
    return Q @ keep, Q @ L


def error_filtered(scheme, task):
    keep, L = p_type(scheme.scheme, task)
    return keep, np.pad(L, ((0, 0), (1, 0))) @ zero_phase(scheme.filter, task.N + 1)


def fir(scheme, task):
    Q = symmetric(np.asarray(scheme.filter.taps), task.N)
    return Q, Q @ p_type(scheme.scheme, task)[1]


def on_basis(scheme, task):
    functions = np.asarray(scheme.basis.functions)[:, 0]
    onto = functions @ np.linalg.pinv(functions)
    return onto, onto @ p_type(scheme.scheme, task)[1]


def at_samples(scheme, task):
    counted = np.zeros(task.N)
    for start, stop in scheme.windows:
        counted[round(start / DT) - 1 : round(stop / DT)] = 1.0
    keep, L = p_type(scheme.scheme, task)
    return keep, L * counted


def on_table(scheme, task):
    """The second of two outputs."""
    keep, L = p_type(scheme.scheme, task)
    return keep, np.kron(L, [0.0, 1.0])


def cross_coupled(scheme, task):
    """On a straight path, as the one here is."""
    along = np.asarray(task.reference)[task.N // 2]
    t = along / np.linalg.norm(along)
    W = float(scheme.own) * np.eye(2) + float(scheme.contour) * (np.eye(2) - np.outer(t, t))
    keep, L = p_type(scheme.scheme, task)
    return np.kron(keep, np.eye(2)), np.kron(L, W)


def weighed(scheme, task, names: str):
    """The lifted model of a scheme and the named weights, of all samples."""
    A, B, C = (np.asarray(getattr(scheme.model, name)) for name in "ABC")
    found = [lifted(A, B, C, task.N)]
    for name in names:
        w, n = np.asarray(getattr(scheme, f"w_{name}"), float), len(C) if name == "q" else len(B.T)
        w = np.diag(np.broadcast_to(w, n)) if w.ndim < 2 else w
        found.append(np.kron(np.eye(task.N), w))
    return found


def gradient(scheme, task):
    """With the curvature that the scheme found, of which its step is a share."""
    G, Q, S = weighed(scheme, task, "qs")
    step = 1 / float(scheme.prepared(task).solved.curvature)
    return np.eye(len(S)) - step * S, step * G.T @ Q


def norm_optimal(scheme, task):
    G, Q, R, S = weighed(scheme, task, "qrs")
    H = G.T @ Q @ G + R + S
    return np.linalg.solve(H, G.T @ Q @ G + R), np.linalg.solve(H, G.T @ Q)


PLAIN = {
    **dict.fromkeys(("p_type", "pd_type", "pid_type_leaky_limited"), p_type),
    **dict.fromkeys(("norm_optimal", "norm_optimal_lifted"), norm_optimal),
    **dict.fromkeys(("p_type_butterworth", "learning_filter_butterworth", "p_type_iir"), filtered),
    "learning_filter": by_taps,
    "error_filtered": error_filtered,
    "gradient": gradient,
    "p_type_on_table": on_table,
    "keep_unmeasured": lambda scheme, task: p_type(scheme.scheme, task),
    "warm_start": lambda scheme, task: p_type(scheme.scheme, task),
    "p_type_fir": fir,
    "on_basis": on_basis,
    "at_samples_p_type": at_samples,
    "cross_coupled": cross_coupled,
}


def run_plain(name, machines, scheme, task) -> tuple:
    """(S, J) root mean square errors and (S, J) sizes of steps, in NumPy; without limits."""
    keep, L = PLAIN[name](scheme, task)
    w0 = np.asarray(scheme.feedforward(scheme.prepared(task).initial_memory(task), task)).ravel()
    errors, steps, reference = [], [], np.asarray(task.reference)
    parts = (*jax.tree.leaves(machines.plant), machines.disturbance.output)
    for A, B, C, d in zip(*map(np.asarray, parts), strict=True):
        G, r = lifted(A, B, C, task.N), (reference - d)[1:].ravel()
        of_first = L[:, : -len(r)] @ (reference - d)[0][: L.shape[1] - len(r)]
        w, of_errors, of_steps = w0, [], []
        with np.errstate(over="ignore", invalid="ignore"):
            for _ in range(TRIALS):
                e = r - G @ w
                following = keep @ w + L[:, -len(r) :] @ e + of_first
                of_errors.append(np.sqrt(np.mean(e**2)))
                of_steps.append(np.linalg.norm(following - w))
                w = following
        errors.append(of_errors)
        steps.append(of_steps)
    return np.array(errors), np.array(steps)


def run_learn(machines, scheme, task, view, trials: int = TRIALS) -> tuple:
    """The same by `learn`, one trial after the other, with the limits of machine and scheme."""

    return tuple(np.asarray(x) for x in _learning(machines, scheme, task, view, trials))


@partial(jax.jit, static_argnums=(3, 4))
@partial(jax.vmap, in_axes=(0, None, None, None, None))
def _learning(machine, scheme, task, view, trials):
    prepared = scheme.prepared(task)

    def turn(memory, j):
        found = learn(machine, scheme, task, 1, memory=memory, first=j)
        before, after = (known_as(m, prepared, task, view) for m in (memory, found.memory))
        error = jnp.sqrt(jnp.mean(found.final.e[1:] ** 2))
        return found.memory, (error, jnp.linalg.norm(after - before))

    return jax.lax.scan(turn, prepared.initial_memory(task), 1 + jnp.arange(trials))[1]


# What is claimed, against what was run
# --------------------------------------------------------------------------------------------------


def contradicted(found, i: int, e, d, sizes) -> str:
    """What of the claim on machine i is contradicted by its errors and steps; empty if nothing is.

    sizes: of what is learned and of the error, in whose last digits nothing is claimed
    """
    claim, largest = found.claim[i], np.max(d, where=np.isfinite(d), initial=0.0)
    fine = 1e-11 * (np.max(sizes) + largest)
    with np.errstate(over="ignore", invalid="ignore"):
        if claim == DIVERGES:
            return "" if grows(d, 200) else LATE
        if not (np.all(np.isfinite(d)) and np.all(np.isfinite(e))):
            return f"{claim}: overflows"
        sigma = found.sigma[i]
        if claim == MONOTONE and found.of_error[i]:
            up = e[1:] > sigma * e[:-1] * (1 + 1e-9) + 1e-11 * (np.max(e) + 1)
            return f"monotone: error in trial {2 + np.argmax(up)}" if np.any(up) else ""
        if claim == MONOTONE:
            up = d[1:] > sigma * d[:-1] * (1 + 1e-9) + fine
            if np.any(up):
                return f"monotone: step in trial {2 + np.argmax(up)}"
        decay = found.outlook.decay
        k, q, growth = int(decay.trials[i]), float(decay.factor[i]), float(decay.growth[i])
        if k:
            bound = growth * q ** (np.arange(len(d)) // k) * d[0]
        else:
            bound = np.full(len(d), 3 * growth * d[0])
            if 0 < decay.fallen[i] <= len(d) // 4:
                bound[-1] = d[0]
        over = d > bound * (1 + 1e-9) + fine
        if np.any(over):
            return f"{claim}: step {d[np.argmax(over)]:.3g} in trial {1 + np.argmax(over)}"
        floor, doubt = found.outlook.floor[i], found.outlook.doubt[i]
        if d[-1] <= 1e-12 * np.max(d) and abs(e[-1] - floor) > doubt + 1e-7 * np.max(e):
            return f"floor {floor:.6g} +- {doubt:.2g}: {e[-1]:.6g}"
    return ""


def grows(d, last: int) -> bool:
    """Whether steps grow from the trials before the last ones to these, by more than rounding."""
    if not np.all(np.isfinite(d)):
        return True
    return max(d[-last:]) > max(np.max(d[-2 * last : -last]), 1e-9 * np.max(d))


def grow_late(name: str, machines, some, scheme, task, view) -> list[bool]:
    """Whether the steps of some machines grow after all, within 2^16 trials, or 2^40 in NumPy.

    A single eigenvalue of 1.00001 in the map of a causal law is multiplied by a polynomial of the
    order of its samples, so that the steps can fall for tens of thousands of trials.
    """
    if not len(some):
        return []
    with np.errstate(all="ignore"):
        if name not in PLAIN:
            d = run_learn(machines, scheme, task, view, LONG)[1]
            return [grows(d[i], LONG // 8) for i in some]
        keep, L = PLAIN[name](scheme, task)
        every = [_lifted(machines, i, task.N) for i in some]
        return [_power_grows(keep - L[:, -len(G) :] @ G) for G in every]


def _lifted(machines, i: int, samples: int) -> np.ndarray:
    return lifted(*(np.asarray(leaf[i]) for leaf in jax.tree.leaves(machines.plant)), samples)


def _power_grows(M) -> bool:
    for _ in range(40):
        M = M @ M
    return not (np.all(np.isfinite(M)) and np.linalg.norm(M, 2) < 1e6)


def of_scheme(
    name: str, rounds: int, count: int, seed: int, samples: int | None = None
) -> tuple[dict, list]:
    """A row of the table, and what is contradicted.

    samples: of the trial; None for those of the case. Beyond 512 no matrix is made
    """
    rng = np.random.default_rng([seed, sum(map(ord, name))])
    claims, reasons, wrong, judged, plain = Counter(), Counter(), [], 0, name in PLAIN
    seen_late = 0
    for turn in range(rounds):
        scheme = moved(rng, SCHEMES[name])
        machines, task = machines_of(rng, name, count, turn % 2 == 1, samples)
        machines = jax.tree.map(jnp.asarray, machines)
        found = long_run(machines, scheme, task)
        claims.update(found.claim.tolist())
        reasons.update(in_short(why) for why in found.reason[found.claim == NOTHING])
        if np.all(found.claim == NOTHING):
            continue
        view = view_of(scheme, task)
        runs = [("learn", run_learn(machines, scheme, task, view))]
        if plain:
            runs.append(("NumPy", run_plain(name, machines, scheme, task)))
        limit, late = found.outlook.limit, {}
        for i in np.flatnonzero(found.claim != NOTHING):
            for oracle, (e, d) in runs:
                why = contradicted(found, i, e[i], d[i], [np.linalg.norm(limit[i]), e[i][0]])
                if why == LATE:
                    late[int(i)] = oracle, f"diverges: steps {d[i][0]:.2g} to {d[i][-1]:.6g}"
                elif why:
                    wrong.append((name, oracle, turn, int(i), why))
            judged += 1
        seen_late += len(late)
        grown = grow_late(name, machines, [*late], scheme, task, view)
        ended = [i for i, does in zip(late, grown, strict=True) if not does]
        wrong += [(name, late[i][0], turn, i, late[i][1]) for i in ended]
    title = name if samples is None else f"{name}, {samples} samples"
    row = {"class": title, "oracle": "NumPy, learn" if plain else "learn"}
    row |= {"tried": rounds * count, "claimed": judged}
    row |= {c: claims[c] for c in (MONOTONE, CONVERGES, DIVERGES)}
    row |= {"seen late": seen_late, "wrong": len({w[2:4] for w in wrong})}
    row |= {"abstained": claims[NOTHING]}
    return row | {"why": "; ".join(f"{why} {n}" for why, n in reasons.most_common())}, wrong


def in_short(reason: str) -> str:
    """A reason without its numbers."""
    return next((said for part, said in IN_SHORT.items() if part in reason), reason.split(";")[0])


def main(names: list[str], seeds: list[int]) -> None:
    every = [n for n, s in SCHEMES.items() if s.learns] + [f"{n}:{WIDE}" for n in OF_ANY_LENGTH]
    rows, start = [], time.perf_counter()
    for which, seed in product(names or every, seeds):
        name, _, samples = which.partition(":")
        size = (2, 52) if samples else (ROUNDS, MACHINES)
        row, wrong = of_scheme(name, *size, seed, int(samples) if samples else None)
        rows.append(row)
        print(f"{time.perf_counter() - start:.0f} s", row, flush=True)
        for one in wrong[:8]:
            print("   WRONG", *one, flush=True)
    output.write_rows(output.folder(__file__) / "rows.csv", rows)
    print("all", output.sums(rows))


if __name__ == "__main__":
    asked = argparse.ArgumentParser()
    asked.add_argument("names", nargs="*", help="of `SCHEMES`, or NAME:SAMPLES")
    asked.add_argument("--seeds", nargs="+", type=int, default=[38])
    of = asked.parse_args()
    main(of.names, of.seeds)
