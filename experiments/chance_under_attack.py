"""Claims on single runs, where trials differ by chance, against runs that NumPy draws by itself.

Random machines of `certificates_under_attack` learn under eight laws, and of their records samples
are lost, late, delayed, cut off, or several of these. Each machine runs in 50 seeds of 500 trials,
by matrices that NumPy and SciPy make from the equations, and where a claim is for every draw from a
second start with the same draws. Of the machines whose error is then below that of the first trial
in every seed are counted those that something is claimed of, and those that are claimed to diverge.
Of the others that nothing is claimed of, those have turned whose error over all seeds has grown by
a tenth in the second half of the trials.

A claim is contradicted

    that learning is monotone or converges: where a run overflows, or, in mean square or for every
        draw, the root mean square error of all seeds exceeds a hundred times what theory expects
        of that trial (a positive number exceeds t times its mean with a chance below 1 / t)
    monotone for every draw: where the distance of the two runs grew in any trial of any seed
    that learning diverges: almost surely, where the errors of any seed are all below that of the
        first trial in the last fifty, of which some are cut off before their errors are large; in
        mean square, where the root mean square error of all seeds in the last one is. Such a claim
        has 10,000 trials, since the error may fall before it grows slowly; it has less where every
        seed has a billion times its first error

With --norm they are judged as trials of more than 512 inputs are, by bounds in norm. Each machine
has random numbers of its own, so that --machines 3:5 takes the fourth and the fifth of each law and
kind out of those of a longer run.
"""

import argparse
import itertools
from collections import Counter

import jax
import numpy as np
import output
from certificates_under_attack import DT, SAMPLES, laws, matrices, plants
from conditions_under_attack import lifted

import jaxilc
from jaxilc import Disturbance, Machine, Task
from jaxilc.learning.variation import Variation
from jaxilc.plants import StateSpace
from jaxilc.theory import certificates
from jaxilc.theory.certificates import long_run
from jaxilc.theory.chance import under_chance
from jaxilc.theory.learning_map import view_of

LAWS = ("P", "P, small", "P, lead", "P, leak", "exponential", "Q", "Q, odd extension", "Q, FIR")
KINDS = {
    "lost": lambda rng: {"dropped": rng.uniform(0.02, 0.5)},
    "late": lambda rng: {"late": 2},
    "delayed": lambda rng: {"delayed": rng.uniform(0.05, 0.6), "delay": 3},
    "cut off": lambda rng: {"shortest": rng.uniform(0.4, 0.95)},
    "lost, late": lambda rng: {"dropped": rng.uniform(0.02, 0.5), "late": 1},
    "delayed, cut off": lambda rng: {
        "delayed": rng.uniform(0.05, 0.6),
        "delay": 2,
        "shortest": rng.uniform(0.4, 0.95),
    },
}
FALLS = "monotone", "converges"
SEEDS, TRIALS, LATE, LAST, ROWS = 50, 500, 10_000, 50, SAMPLES + 1
GONE = 1e9  # times its first error; then a seed has surely diverged
FAR = 100.0  # times a root mean square; a positive number is 10^4 times its mean once in 10^4


def record_of(rng, how: dict, y):
    """(SEEDS, 2, ROWS) what the record of each seed holds, and whether a sample is in it."""
    k = np.arange(ROWS)
    at = np.broadcast_to(k, (SEEDS, ROWS))
    if "late" in how:
        at = np.maximum(k - rng.integers(0, how["late"] + 1, SEEDS)[:, None], 0)
    if "delayed" in how:
        slow = rng.random((SEEDS, ROWS)) < how["delayed"]
        delta = np.where(slow, rng.integers(1, how["delay"] + 1, (SEEDS, ROWS)), 0)
        delta[:, 0] = 0
        newest = np.zeros((SEEDS, ROWS), int)
        for sample in range(ROWS):
            there = sample + delta[:, sample]
            late = k[None] >= there[:, None]
            newest = np.where(late, np.maximum(newest, sample), newest)
        at = np.take_along_axis(at, newest, axis=1)
    there = np.ones((SEEDS, ROWS), bool)
    if "dropped" in how:
        there &= (rng.random((SEEDS, ROWS)) >= how["dropped"]) | (k == 0)
    last = np.full(SEEDS, SAMPLES)
    if "shortest" in how:
        last = np.floor(SAMPLES * (how["shortest"] + (1 - how["shortest"]) * rng.random(SEEDS)))
        there &= k <= last[:, None]
    held = np.take_along_axis(y, np.broadcast_to(at[:, None], y.shape), axis=2)
    return held, there[:, None], last


def runs_of(rng, G, d, r, keep, L, how: dict, starts: int, trials: int, gone: float = np.inf):
    """(SEEDS, trials) errors of the first run, and distances of the last from it, with its draws.

    starts: 1 or 2 of them; with one there is no distance. From an overflow on all are infinite, and
        after `TRIALS` as soon as every error is `gone` times the first one
    """
    u = np.zeros((SEEDS, starts, SAMPLES))
    moved = np.any(np.concatenate([keep - np.eye(SAMPLES), L], axis=1) != 0, axis=1)
    u[:, 1:] = np.where(moved, rng.standard_normal((SEEDS, starts - 1, SAMPLES)), 0.0)
    errors, distances = np.full((2, SEEDS, trials), np.inf)
    for trial in range(trials):
        if not np.all(np.isfinite(u)):
            break
        if trial >= TRIALS and np.all(errors[:, trial - 1] > gone * errors[:, 0]):
            break
        y = np.broadcast_to(d, (SEEDS, starts, ROWS)).copy()
        y[:, :, 1:] += u @ G.T
        held, there, last = record_of(rng, how, y)
        counts = np.arange(1, ROWS) <= last[:, None]
        squares = np.where(counts, (r[1:] - y[:, 0, 1:]) ** 2, 0.0)
        errors[:, trial] = np.sqrt(np.sum(squares, axis=1) / last)
        distances[:, trial] = np.linalg.norm(u[:, -1] - u[:, 0], axis=1)
        e = np.where(there, r - held, 0.0)
        u = u @ keep.T + e[:, :, 1:] @ L.T
    return errors, distances


def contradicted(claim: str, sense: str, expected, errors, distances) -> str:
    """What contradicts a claim; empty where nothing does."""
    if claim == "diverges":
        ends, begins = np.max(errors[:, -LAST:], axis=1), errors[:, 0]
        if sense == "in mean square":
            ends, begins = (np.sqrt(np.mean(e**2)) for e in (errors[:, -1], begins))
        return "ends below its start" if np.any(ends < begins) else ""
    if claim == "not claimed":
        return ""
    if not np.all(np.isfinite(errors)):
        return "overflows"
    if sense == "for every draw" and np.any(np.diff(distances) > 1e-9 * distances[:, :-1] + 1e-13):
        return "the distance grew"
    if sense == "almost surely":
        return ""
    seen = np.sqrt(np.mean(errors**2, axis=0))
    far = np.argmax(seen - FAR * expected)
    if seen[far] > FAR * expected[far] + 1e-9:
        return f"has {seen[far]:.3g} in trial {far + 1}, where {expected[far]:.3g} was expected"
    return ""


def main(machines: range, laws_named: list[str], kinds: list[str], seed: int) -> None:
    oracles, rows, wrong = matrices(), [], []
    r = np.sin(np.pi * np.arange(ROWS) / SAMPLES) ** 2
    task = Task(r[:, None], dt=DT, settle=(DT, SAMPLES * DT))
    for law, kind in itertools.product(laws_named, kinds):
        (keep, L, _), scheme = oracles[law], laws(1)[law]
        view, of_group = view_of(scheme, task), (LAWS.index(law), [*KINDS].index(kind))
        rngs = [np.random.default_rng([seed, *of_group, i]) for i in machines]
        A, B, C = (np.concatenate(M) for M in zip(*(plants(g, 1, 1) for g in rngs), strict=True))
        d, hows = [0.1 * g.standard_normal((ROWS, 1)) for g in rngs], [KINDS[kind](g) for g in rngs]
        several = [
            Machine(
                StateSpace(A[i], B[i], C[i], dt=DT),
                disturbance=Disturbance(output=d[i]),
                variation=Variation(**hows[i]),
            )
            for i in range(len(rngs))
        ]
        stacked = jax.tree.map(lambda *leaves: np.stack(leaves), *several)
        found = long_run(stacked, scheme, task)
        due = np.flatnonzero(np.isin(found.claim, FALLS))
        some = jax.tree.map(lambda leaf, due=due: leaf[due], stacked)
        in_norm = certificates.DENSE == 0
        each_due = under_chance(some, scheme, task, view, TRIALS, in_norm=in_norm)
        expected = {i: one.rms for i, one in zip(due, each_due, strict=True)}
        count = Counter()
        for i, rng in enumerate(rngs):
            claim, sense = str(found.claim[i]), str(found.sense[i])
            G, starts = lifted(A[i], B[i], C[i], SAMPLES), 1 + (sense == "for every draw")
            how = (LATE, GONE) if claim == "diverges" else (TRIALS,)
            with np.errstate(all="ignore"):
                runs = runs_of(rng, G, d[i][:, 0], r, keep, L, hows[i], starts, *how)
            fell = bool(np.all(runs[0][:, TRIALS - 1] < runs[0][:, 0]))
            count.update({"not claimed" if claim == "not claimed" else f"{claim}, {sense}": 1})
            count.update({"every seed falls": fell})
            count.update({"of these claimed to fall": fell & (claim in FALLS)})
            count.update({"of these claimed to diverge": fell & (claim == "diverges")})
            why = contradicted(claim, sense, expected.get(i), *runs)
            if fell and claim == "not claimed":
                half, end = (np.mean(runs[0][:, at - 50 : at] ** 2) for at in (250, TRIALS))
                turned = bool(end > 1.1**2 * half)
                count.update({"not claimed, turned": turned})
                print("  silent", "turned" if turned else "", hows[i], found.reason[i])
            if why:
                wrong.append({"law": law, "kind": kind, "claim": claim, "sense": sense, "why": why})
                print(wrong[-1], machines[i], hows[i], found.reason[i], flush=True)
        rows.append({"law": law, "kind": kind, "machines": len(rngs)} | dict(count))
        print(rows[-1], flush=True)
    rows = output.filled(rows)
    output.write_rows(output.folder(__file__) / "chance.csv", rows)
    print(f"{output.sums(rows)}; contradicted: {len(wrong)}")


if __name__ == "__main__":
    jaxilc.setup()
    asked = argparse.ArgumentParser()
    asked.add_argument("--machines", default="0:11", help="of each law and kind, FIRST:LAST")
    asked.add_argument("--laws", nargs="+", default=LAWS)
    asked.add_argument("--kinds", nargs="+", default=[*KINDS])
    asked.add_argument("--seed", type=int, default=38)
    asked.add_argument("--norm", action="store_true")
    of = asked.parse_args()
    if of.norm:
        certificates.DENSE = 0
    main(range(*map(int, of.machines.split(":"))), of.laws, of.kinds, of.seed)
