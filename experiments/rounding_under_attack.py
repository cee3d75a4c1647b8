"""Claims on machines that round or have hysteresis, against trials that NumPy runs by samples.

Random machines of `certificates_under_attack` learn under laws with filters, leaks, leads, memory,
feedback and limits. An encoder and a converter round, with steps from 1e-6 to 0.1 of the stroke;
on a third of the machines one of the two is so fine that it does not count. Under four laws the
input has the hysteresis of Dahl too, of 0.001 to 0.3 of a usual input. Each machine runs 1000
trials in NumPy twice, as it is and without rounding, hysteresis and limits.

A claim is contradicted where, in any trial, the error of the two runs differs by more than the
ball, or what was learned in them; where the error or the distance from the limit, of which it is
claimed that it falls, rises above the size down to which it does; and where the error that is left
is above what was told. The slack of a ball is its size over the largest difference that was seen.
"""

import sys
from collections import Counter

import jax
import numpy as np
import output
from certificates_under_attack import DT, SAMPLES, filter_matrix, plants, shifted
from conditions_under_attack import task_of

import jaxilc
from jaxilc import Actuator, Disturbance, Machine, Sensor
from jaxilc.filters import ZeroPhaseButterworth, ZeroPhaseFIR
from jaxilc.plants import Dahl, InputHysteresis, StateSpace
from jaxilc.schemes import PID, Filtered, HigherOrder, PIDType, WithFeedback
from jaxilc.theory import certify_each
from jaxilc.theory.certificates import long_run
from jaxilc.theory.rounding import linear_part

TRIALS, FINE, REPEATS = 1000, 1e-13, 1e-9
KP, KI = 0.1, 2.0
EYE, ZERO = np.eye(SAMPLES), np.zeros((SAMPLES, SAMPLES))
SMOOTH, FIR = filter_matrix("mirrored"), filter_matrix("FIR")
BUTTERWORTH, TAPS = ZeroPhaseButterworth(80.0), ZeroPhaseFIR((0.4, 0.2, 0.1))
# scheme; of the inputs, newest first; of the errors, likewise
OPEN = {
    "P": (PIDType(gamma_p=0.5), [EYE], [0.5 * EYE]),
    "P, fast": (PIDType(gamma_p=1.0), [EYE], [EYE]),
    "P, lead": (PIDType(gamma_p=0.5, lead=2), [EYE], [0.5 * shifted(2)]),
    "P, leak": (PIDType(gamma_p=0.5, leak=0.1), [0.9 * EYE], [0.5 * EYE]),
    "PI, leak": (
        PIDType(gamma_p=0.4, gamma_i=0.01, leak=0.05),
        [0.95 * EYE],
        [0.4 * EYE + 0.01 * np.tri(SAMPLES)],
    ),
    "Q": (
        Filtered(PIDType(gamma_p=0.5, lead=2), BUTTERWORTH),
        [SMOOTH],
        [0.5 * SMOOTH @ shifted(2)],
    ),
    "Q, FIR": (Filtered(PIDType(gamma_p=0.5, lead=1), TAPS), [FIR], [0.5 * FIR @ shifted(1)]),
    "higher order": (
        HigherOrder((0.7, 0.2), (0.4, 0.1)),
        [0.7 * EYE, 0.2 * EYE],
        [0.4 * EYE, 0.1 * EYE],
    ),
}


def over_pid(name: str) -> tuple:
    """A law of `OPEN` over a PID controller."""
    scheme, keep, gain = OPEN[name]
    return WithFeedback(scheme, PID(kp=KP, ki=KI)), keep, gain


# the same, and whether there are limits, feedback, hysteresis
LAWS = {name: (*law, "") for name, law in OPEN.items()} | {
    "over PID": (*over_pid("P"), "feedback"),
    "Q over PID": (*over_pid("Q"), "feedback"),
    "P, leak, limits": (*OPEN["P, leak"], "limits"),
    "Q, limits": (*OPEN["Q"], "limits"),
    "P, hysteresis": (*OPEN["P"], "hysteresis"),
    "P, leak, hysteresis": (*OPEN["P, leak"], "hysteresis"),
    "Q, hysteresis": (*OPEN["Q"], "hysteresis"),
    "over PID, hysteresis": (*over_pid("P"), "feedback, hysteresis"),
}


def rounded(x, step):
    return np.round(x / step) * step


def dahl(z, way, slope, most):
    """The hysteresis after a way from z: it comes nearer to its end by exp(-slope |way| / most)."""
    end = np.where(way < 0, -most, most)
    return end + (z - end) * np.exp(-slope * np.abs(way) / most)


def trials_of(machines: dict, r, law, *, exact: bool):
    """(S, TRIALS, N, n) errors and what was learned, of all machines sample by sample."""
    _, keep, gain, kind = law
    A, B, C, d = (machines[name] for name in "ABCd")
    size, n = len(A), C.shape[1]
    limit, rate = machines["limit"][:, None], machines["rate"][:, None]
    learned = [np.zeros((size, SAMPLES, n)) for _ in keep]
    before, errors, inputs = [np.zeros((size, SAMPLES, n)) for _ in gain[1:]], [], []
    for _ in range(TRIALS):
        x, integral, v, z, before_k = (np.zeros((size, m)) for m in (A.shape[1], n, n, n, n))
        e, own = np.zeros((2, size, SAMPLES + 1, n))
        for k in range(SAMPLES + 1):
            y = np.einsum("sij,sj->si", C, x) + d[:, k]
            e[:, k] = r[k] - (y if exact else rounded(y, machines["of_y"][:, None]))
            if k == SAMPLES:
                break
            feedback = np.zeros((size, n))
            if "feedback" in kind:
                integral = integral + KI * DT * e[:, k]
                feedback = KP * e[:, k] + integral
            u = learned[0][:, k] + feedback
            if not exact:
                if kind == "limits":
                    v = v + np.clip(u - v, -rate * DT, rate * DT)
                    u = v = np.clip(v, -limit, limit)
                u = rounded(u, machines["of_u"][:, None])
                u = np.clip(u, -limit, limit) if kind == "limits" else u
            own[:, k] = u - feedback
            if "hysteresis" in kind and not exact:
                way, before_k = u - before_k, u
                z = dahl(z, way, machines["slope"][:, None], machines["most"][:, None])
                u = u - z
            x = np.einsum("sij,sj->si", A, x) + np.einsum("sij,sj->si", B, u)
        errors.append(e[:, 1:])
        inputs.append(learned[0])
        played, seen = [own[:, :SAMPLES], *learned[1:]], [e[:, 1:], *before]
        pairs = [*zip(keep, played, strict=True), *zip(gain, seen, strict=True)]
        following = sum(np.einsum("ij,sjn->sin", matrix, signal) for matrix, signal in pairs)
        learned, before = [following, *played[:-1]], seen[:-1]
    return np.stack(errors, axis=1), np.stack(inputs, axis=1)


def drawn(rng, count: int, channels: int) -> dict:
    A, B, C = plants(rng, count, channels)
    found = {"A": A, "B": B, "C": C, "d": 0.1 * rng.standard_normal((count, SAMPLES + 1, channels))}
    found["d"][:, 0] = 0.0
    steps = 10 ** rng.uniform(-6, -1, (2, count))
    which = rng.integers(0, 3, count)
    found["of_y"] = np.where(which == 1, FINE, steps[0])
    found["of_u"] = np.where(which == 0, FINE, steps[1])
    found["limit"], found["rate"] = (
        10 ** rng.uniform(0, 1.5, count),
        10 ** rng.uniform(2.5, 5, count),
    )
    found["slope"], found["most"] = (
        rng.uniform(0.05, 0.9, count),
        10 ** rng.uniform(-3, -0.5, count),
    )
    return found


def stacked(machines: dict, kind: str) -> Machine:
    several = []
    for i in range(len(machines["A"])):
        A, B, C, d, of_y, of_u, limit, rate, slope, most = (x[i] for x in machines.values())
        far = {"limit": limit, "rate": rate} if kind == "limits" else {}
        plant = StateSpace(A, B, C, dt=DT)
        plant = InputHysteresis(plant, Dahl(slope, most)) if "hysteresis" in kind else plant
        several.append(
            Machine(
                plant,
                Actuator(resolution=of_u, **far),
                Sensor(resolution=of_y),
                Disturbance(output=d),
            )
        )
    return jax.tree.map(lambda *leaves: np.stack(leaves), *several)


def size_of(signal, axes=(-2, -1)):
    return np.sqrt(np.mean(signal**2, axis=axes))


def rises(sizes, least) -> bool:
    """Whether a size by trial rises above what it was before, or above the least one."""
    before = np.maximum(sizes[:-1], least)
    return bool(np.any(sizes[1:] > before * (1 + REPEATS) + 1e-12 * sizes[0]))


def contradicted(found, i: int, real, exact) -> str:
    """What contradicts the claim on a machine; empty where nothing does."""
    if found.claim[i] == "not claimed":
        return ""
    (errors, inputs), (without, free) = real, exact
    slack = REPEATS * np.max(size_of(without))
    if not np.all(np.isfinite(errors)):
        return "overflows"
    if np.max(size_of(errors - without)) > found.ball.error[i] * (1 + REPEATS) + slack:
        return "the error left the ball"
    apart = np.linalg.norm((inputs - free).reshape(TRIALS, -1), axis=1)
    if np.max(apart) > found.ball.learned[i] * (1 + REPEATS) + slack:
        return "what is learned left the ball"
    settled = np.max(np.abs(free[-1] - free[-2])) < 1e-13 * max(np.max(np.abs(free[-1])), 1e-9)
    if (
        settled
        and size_of(errors[-1]) > found.floor[i] + found.doubt[i] + found.ball.error[i] + slack
    ):
        return "more is left than was told"
    if found.claim[i] != "monotone":
        return ""
    until = found.ball.until(found.of_error, found.sigma)[i]
    if found.of_error[i]:
        return "the error rose" if rises(size_of(errors), until) else ""
    if not settled or found.outlook.limit.shape[1] > inputs[0].size:
        return ""  # of a law with memory the distance is that of all that it knows
    far = np.linalg.norm((inputs - free[-1]).reshape(TRIALS, -1), axis=1)
    return "the distance rose" if rises(far, until) else ""


def attacked(name: str, channels: int, machines: dict, ratios: dict) -> tuple[dict, list]:
    law = LAWS[name]
    task = task_of(SAMPLES, channels)
    r = np.asarray(task.reference)
    several = stacked(machines, law[3])
    found = certify_each(several, law[0], task, TRIALS)
    due = np.isin(long_run(linear_part(several), law[0], task).claim, ("monotone", "converges"))
    with np.errstate(all="ignore"):
        real, exact = (trials_of(machines, r, law, exact=how) for how in (False, True))
    count, wrong, of_law = Counter(found.claim.tolist()), [], []
    for i in range(len(found.claim)):
        why = contradicted(found, i, *([one[i] for one in run] for run in (real, exact)))
        if why:
            wrong.append((name, channels, i, str(found.claim[i]), why, str(found.reason[i])))
        if found.claim[i] != "not claimed":
            seen = np.max(size_of(real[0][i] - exact[0][i]))
            of_law.append(found.ball.error[i] / seen)
    count["contradicted by its own runs"] = len(found.broken_promises())
    count["claimed if nothing were rounded"] = int(np.sum(due))
    count["of these claimed"] = int(np.sum(due & (found.claim != "not claimed")))
    ratios.setdefault(name, []).extend(of_law)
    reasons = Counter(
        reason
        for reason, claim in zip(found.reason, found.claim, strict=True)
        if claim == "not claimed"
    )
    print(
        name, channels, dict(count), "slack", np.median(of_law or [np.nan]), len(wrong), flush=True
    )
    print("   ", reasons.most_common(3), flush=True)
    return {"law": name, "channels": channels, "machines": len(found.claim)} | dict(count), wrong


def main(count: int, names: list[str]) -> None:
    jaxilc.setup()
    rng, rows, wrong, ratios = np.random.default_rng(380), [], [], {}
    for name in output.asked(names, LAWS):
        for channels in (1, 2) if name in ("P", "Q", "over PID") else (1,):
            some = drawn(rng, count if channels == 1 else count // 2, channels)
            row, broken = attacked(name, channels, some, ratios)
            rows.append(row)
            wrong += broken
            for one in broken:
                print(one, flush=True)
    rows = output.filled(rows)
    output.write_rows(output.folder(__file__) / "rounding.csv", rows)
    total = {name: n for name, n in output.sums(rows).items() if name != "channels"}
    every = np.concatenate([np.asarray(one) for one in ratios.values()])
    at = np.quantile(every, (0, 0.5, 0.9))
    print(f"{total}; contradicted: {len(wrong)}; slack of the ball: {at} (least, median, 90 %)")


if __name__ == "__main__":
    main(int(sys.argv[1]) if len(sys.argv) > 1 else 40, sys.argv[2:])  # machines of each law
