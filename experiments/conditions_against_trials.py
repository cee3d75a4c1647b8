"""Conditions against 1000 trials in NumPy: short trials, whole sets, sliding, and Cao 2019's d2.

Beside `conditions_under_attack.py`, which looks at resonances in trials of 200 samples. 1000 trials
are the 1000th power of the dense learning matrix, from wherever learning begins; where its norm is
not below 1, its eigenvalues decide.

    short       plants of order 1 to 4 under causal and non-causal laws in 48 samples
    robust      the same, and plants P (1 + W D) with a weight over frequency, W of minimum phase
                and D an all-pass, a delay or a constant
    channels    plants of two inputs and outputs in 24 samples
    family      boxes of two gains: the dense learning matrix of the plants that were tried
    corners, boxes   state-space models with uncertain gains, and process models with an uncertain
                gain, frequency and damping: 20 random plants of the box on dense lines against
                what is proved of the whole set
    sampled, printed   laws of Xu 2024 in their boundary layer, sample by sample
    sliding     trials of SMC and ASMC, sample by sample, half of which start off their path
    d2          static and dynamic machines under CFDL-MFAILC: the bound in all trials

A class ends after 600 s of processor time; `tried` says how many cases it came to. Every 20 cases
that many are told, and each that is wrong at once, so that a run that is stopped has said what it
tried.
"""

import sys
import time
from collections import Counter

import numpy as np
import output
import scipy.linalg
import scipy.signal
from conditions_under_attack import (
    DT,
    TRIALS,
    Counted,
    ends,
    lifted,
    mirrored,
    q_response,
    response,
    sampled,
    symmetric,
    task_of,
    within,
)

import jaxilc
from jaxilc import Machine, Task
from jaxilc.filters import ZeroPhaseButterworth, ZeroPhaseFIR
from jaxilc.plants import ProcessModel, StateSpace, TimeVaryingStateSpace
from jaxilc.schemes import ASMC, CFDLMFAILC, SMC, ExponentialPD, Filtered, PIDType, WithFeedback
from jaxilc.signals.task import Trial
from jaxilc.theory import bounds_of, frequency
from jaxilc.theory.frequency import bound_of_set, tried_plants
from jaxilc.theory.law import law_of
from jaxilc.theory.sliding import printed_condition, sampled_condition, sliding
from jaxilc.uncertainty import Population, Uniform

PREMISES = ("linear", "alone", "signs", "damped", "printed")


def small_plant(rng, channels: int = 1):
    """(A, B, C) of order 1 to 4 for each channel, stable, with a response at once of about 0.2."""
    n = int(rng.integers(1, 5)) if channels == 1 else 4
    A, slowest = np.zeros((n, n)), rng.choice([0.5, 0.9, 0.98])
    i = 0
    while i < n:
        size, angle = slowest * rng.uniform(0.2, 1.0), rng.uniform(0.0, 2.5)
        if n - i > 1 and rng.random() < 0.5:
            turn = np.array([[np.cos(angle), np.sin(angle)], [-np.sin(angle), np.cos(angle)]])
            A[i : i + 2, i : i + 2], i = size * turn, i + 2
        else:
            A[i, i], i = size, i + 1
    B, C = rng.standard_normal((n, channels)), rng.standard_normal((channels, n))
    if channels > 1:
        weak = np.eye(2) + rng.choice([0.05, 0.3]) * rng.standard_normal((2, 2))
        return A, B @ np.linalg.solve(C @ B, rng.uniform(0.2, 1.0) * weak), C
    f = np.linspace(1.0, 499.0, 200)
    n = 4 - n  # filled up, so that all compile once
    A, B, C = np.pad(A, ((0, n), (0, n))), np.pad(B, ((0, n), (0, 0))), np.pad(C, ((0, 0), (0, n)))
    size = rng.choice([abs((C @ B)[0, 0]), np.max(np.abs(response((A, B, C), f)))])
    return A, B * rng.uniform(0.3, 1.4) * np.sign((C @ B)[0, 0]) / size, C


def small_law(rng):
    """A law, its gain, its lead, and its filter as a matrix and over frequency."""
    kind = rng.choice(["P", "FIR", "Butterworth", "leak"])
    gamma, lead = rng.uniform(0.2, 1.2), 0 if kind == "P" else int(rng.choice([0, 2]))
    P = PIDType(gamma_p=gamma, lead=lead)
    if kind == "P":
        return P, gamma, lead, lambda N: np.eye(N), lambda f: np.ones_like(f)
    if kind == "leak":
        leak = rng.uniform(0.02, 0.4)
        scheme = PIDType(gamma_p=gamma, lead=lead, leak=leak)
        return scheme, gamma, lead, lambda N: (1 - leak) * np.eye(N), None
    if kind == "FIR":
        a, b = rng.uniform(0.4, 0.7), rng.uniform(0.1, 0.15)
        taps = (a, b, (1 - a - 2 * b) / 2)

        def over(f):
            w = 2 * np.pi * f * DT
            return np.abs(taps[0] + 2 * taps[1] * np.cos(w) + 2 * taps[2] * np.cos(2 * w))

        return Filtered(P, ZeroPhaseFIR(taps)), gamma, lead, lambda N: symmetric(taps, N), over
    cutoff = rng.uniform(15, 200)

    def over(f):
        return q_response(cutoff, f)

    scheme = Filtered(P, ZeroPhaseButterworth(cutoff))
    return scheme, gamma, lead, lambda N: mirrored(over, N), over


def map_of(scheme, gamma, lead, matrix, plant, N, D=None):
    """The dense learning matrix; D: the lifted factor 1 + W D of the plant."""
    channels = plant[1].shape[1]
    G = lifted(*plant, N) if D is None else lifted(*plant, N) @ D
    keep, L = matrix(N), gamma * np.eye(N, k=lead)
    if isinstance(scheme, PIDType):  # a leak forgets what was played, not what is learned
        return np.kron(keep, np.eye(channels)) - np.kron(L, np.eye(channels)) @ G
    Q = np.kron(keep, np.eye(channels))
    return Q @ (np.eye(N * channels) - np.kron(L, np.eye(channels)) @ G)


def short(rng, count=120):
    found = Counted("learning, short trials")
    f = np.concatenate([np.geomspace(0.05, 20, 400), np.linspace(20, 499.9, 1500)])
    for _ in within(count):
        plant, law = small_plant(rng), small_law(rng)
        scheme, gamma, lead, matrix, over = law
        N = 48
        test = frequency.learning_condition(
            Machine(StateSpace(*plant, dt=DT)), scheme, task_of(N)
        ).condition
        M = map_of(scheme, gamma, lead, matrix, plant, N)
        wrong = not ends(M)
        if "causal" in test.theorem and "comes nearer" in test.theorem and lead == 0:
            wrong |= isinstance(scheme, PIDType) and np.linalg.norm(M, 2) > test.value * (1 + 1e-9)
        z = np.exp(2j * np.pi * f * DT * (1 + lead))
        keep = over(f) if over is not None else float(1 - scheme.leak)
        share = over(f) if over is not None else 1.0
        brute = np.max(np.abs(keep - share * gamma * z * response(plant, f)))
        found.add(test, wrong, test.value < brute * (1 - 1e-9))
    return found.row()


def perturbations(rng, N, a, b):
    """Lifted 1 + W D, W = b (1 + a z^-1) of minimum phase, D of size 1 and causal."""
    W = b * scipy.linalg.toeplitz(np.concatenate([[1.0, a], np.zeros(N - 2)]), np.eye(N)[0])
    Ds = [np.eye(N), -np.eye(N)]
    for _ in range(3):
        p = rng.uniform(-0.95, 0.95)
        _, taps = scipy.signal.dimpulse(([-p, 1.0], [1.0, -p], 1.0), n=N)
        Ds.append(
            rng.choice([1, -1]) * scipy.linalg.toeplitz(taps[0][:, 0], np.eye(N)[0] * taps[0][0, 0])
        )
    shift = int(rng.integers(1, 6))
    Ds += [np.eye(N, k=-shift), -np.eye(N, k=-shift)]
    return [np.eye(N) + W @ D for D in Ds]


def robust(rng, count=120):
    found = Counted("robust, weight over frequency")
    for _ in within(count):
        plant, law = small_plant(rng), small_law(rng)
        scheme, gamma, lead, matrix, _ = law
        N, a, b = 48, rng.uniform(-0.9, 0.9), 10 ** rng.uniform(-2, -0.2)

        def weight(f, a=a, b=b):
            return b * np.abs(1 + a * np.exp(-2j * np.pi * np.asarray(f) * DT))

        test = frequency.robust_condition(
            Machine(StateSpace(*plant, dt=DT)), scheme, task_of(N), weight
        ).condition
        wrong = False
        if test.holds:
            for D in perturbations(rng, N, a, b):
                M = map_of(scheme, gamma, lead, matrix, plant, N, D)
                wrong |= not ends(M)
                if lead == 0 and isinstance(scheme, PIDType):
                    wrong |= np.linalg.norm(M, 2) > test.value * (1 + 1e-9)
        found.add(test, wrong)
    return found.row()


def channels(rng, count=100):
    found = Counted("learning, two channels")
    f = np.concatenate([np.geomspace(0.1, 20, 30), np.linspace(20, 499.9, 90)])
    for _ in within(count):
        plant, law = small_plant(rng, 2), small_law(rng)
        scheme, gamma, lead, matrix, over = law
        N = 24
        bump = np.sin(np.pi * np.arange(N + 1) / N) ** 2
        test = frequency.learning_condition(
            Machine(StateSpace(*plant, dt=DT)),
            scheme,
            Task(np.stack([bump, 0.5 * bump], axis=1), dt=DT, inputs=2),
        ).condition
        M = map_of(scheme, gamma, lead, matrix, plant, N)
        A, B, C = plant
        keep = over(f) if over is not None else np.full_like(f, float(1 - scheme.leak))
        share = over(f) if over is not None else np.ones_like(f)
        brute = max(
            np.linalg.norm(
                k * np.eye(2)
                - s * gamma * z ** (1 + lead) * C @ np.linalg.solve(z * np.eye(len(A)) - A, B),
                2,
            )
            for z, k, s in zip(np.exp(2j * np.pi * f * DT), keep, share, strict=True)
        )
        found.add(test, not ends(M), test.value < brute * (1 - 1e-9))
    return found.row()


def family(rng, count=100):
    found = Counted("family, plants tried")
    for _ in within(count):
        plant, law = small_plant(rng), small_law(rng)
        scheme, gamma, lead, matrix, _ = law
        spread = rng.uniform(0.05, 0.4)
        box = {
            "plant.B": Uniform(1 - spread, 1 + spread, relative=True),
            "plant.C": Uniform(0.8, 1.2, relative=True),
        }
        N = 40
        test = frequency.family_condition(
            Machine(StateSpace(*plant, dt=DT)),
            box,
            scheme,
            task_of(N),
            machines=16,
            climbers=2,
            steps=10,
        )
        wrong, drawn = False, np.stack(list(test.drawn.values()), axis=1)
        if test.condition.holds:
            for row in drawn[:: max(1, len(drawn) // 12)]:
                A, B, C = plant
                one = A, B * row[0], C * row[1]
                wrong |= not ends(map_of(scheme, gamma, lead, matrix, one, N))
        found.add(test.condition, wrong)
    return found.row()


def whole(rng, kind, count):
    names = ("tried", "proved", "wrong", "not proved")
    counts, why = Counter(), Counter()
    f = np.concatenate([np.geomspace(0.1, 20, 150), np.linspace(20, 499.9, 600)])
    for _ in within(count):
        gamma, lead, cutoff = rng.uniform(0.2, 0.9), int(rng.choice([0, 3])), rng.uniform(20, 150)
        law = Filtered(PIDType(gamma_p=gamma, lead=lead), ZeroPhaseButterworth(cutoff))
        if kind == "corners":
            plant = small_plant(rng)
            spread = rng.uniform(0.05, 0.4)
            box = {
                "plant.B": Uniform(1 - spread, 1 + spread, relative=True),
                "plant.C": Uniform(0.6, 1.3, relative=True),
            }
            machine = Machine(StateSpace(*plant, dt=DT))

            def drawn(x, plant=plant):
                A, B, C = plant
                return A, B * x[0], C * x[1]

        else:
            w, zeta = rng.uniform(150, 900), 10 ** rng.uniform(-1.3, -0.1)
            pole = rng.uniform(50, 400)
            model = ProcessModel(gain=1.0, poles=(pole,), frequencies=(w,), dampings=(zeta,))
            box = {
                "plant.gain": Uniform(0.8, 1.2, relative=True),
                "plant.frequencies": Uniform(0.9, 1.1, relative=True),
            }
            if rng.random() < 0.5:
                box["plant.dampings"] = Uniform(0.8, 1.3, relative=True)
            machine = Machine(model)

            def drawn(x, w=w, zeta=zeta, pole=pole):
                z = zeta * x[2] if len(x) > 2 else zeta
                wn = w * x[1]
                den = np.polymul([1 / pole, 1.0], [1 / wn**2, 2 * z / wn, 1.0])
                return sampled([x[0]], den)

        task = task_of(60)
        of = Population(machine, box, count=4, sampling="latin-hypercube")
        tried = tried_plants(of, law, task, climbers=0)
        proof = bound_of_set(of, law, task, law_of(law, task), tried)
        counts.update(["tried", "proved" if proof.proved else "not proved"])
        if not proof.proved:
            why.update([proof.how.split(",")[0]])
            continue
        low, high = np.array([d.corners() for d in box.values()]).T
        Q, z = q_response(cutoff, f), gamma * np.exp(2j * np.pi * f * DT * (1 + lead))
        worst = max(
            np.max(Q * np.abs(1 - z * response(drawn(low + (high - low) * x), f)))
            for x in rng.uniform(0, 1, (20, len(low)))
        )
        wrong = worst > proof.bound * (1 + 1e-9)
        counts["wrong"] += int(wrong)
        if wrong:
            print(f"   WRONG: case {counts['tried']} of {kind}", flush=True)
    row = {n: counts[n] for n in names}
    text = "; ".join(f"{k} {v}" for k, v in why.most_common())
    return {
        "class": f"whole set, {kind}",
        "tried": row["tried"],
        "claimed": row["proved"],
        "wrong": row["wrong"],
        "value too low": "",
        "fails": "",
        "abstained": row["not proved"],
        "why": text,
    }


# Sliding
# --------------------------------------------------------------------------------------------------


def smc_trial(plant, law: SMC, steep, r, w, off=0.0):
    """(N+1, m) y and (N+1, m) sigma of SMC with a linear reaching rate, for m learned inputs w."""
    A, B, C = plant
    lam1, lam2, tau = float(law.lam1), float(law.lam2), float(law.tau)
    a1, a2, b, N = float(law.a1), float(law.a2), float(law.b), len(r) - 1
    x, m = np.zeros((len(A), w.shape[1])), w.shape[1]
    x[0] = off
    e_before = slope = total = np.zeros(m)
    before = r[0]
    ys, sigmas = [], []
    for k in range(N):
        y = (C @ x)[0]
        e = y - r[k]
        share = np.exp(-DT / tau) if tau > 0 else 0.0
        slope = share * slope + (1 - share) * (e - e_before) / DT
        total = total + e
        following = r[k + 1]
        acceleration, velocity = (
            (following - 2 * r[k] + before) / DT**2,
            (following - before) / (2 * DT),
        )
        wanted = a1 * y + a2 * (velocity + slope) + acceleration - lam1 * slope - lam2 * e
        sigma = slope + lam1 * e + lam2 * DT * total
        u = (wanted - steep(sigma)) / b + w[k]
        ys.append(y)
        sigmas.append(sigma)
        x, e_before, before = A @ x + B * u, e, r[k]
    ys.append((C @ x)[0])
    return np.array(ys), np.array(sigmas)


def servo(rng):
    """A servo, its model of a1, a2, b, and the machine that differs from it by up to 10 %."""
    a1, a2, b = rng.uniform(0, 5e4), rng.uniform(50, 500), 1e5
    true = np.array([a1, a2, b]) * (1 + rng.choice([0.0, 0.1]) * rng.uniform(-1, 1, 3))
    return {"a1": a1, "a2": a2, "b": b}, held_servo(*true)


def held_servo(a1, a2, b):
    """(A, B, C) of y'' = b u - a1 y - a2 y', sampled with a hold."""
    A, B, C = np.array([[0.0, 1.0], [-a1, -a2]]), np.array([[0.0], [b]]), np.array([[1.0, 0.0]])
    return (*scipy.signal.cont2discrete((A, B, C, np.zeros((1, 1))), DT)[:2], C)


def xu(rng, kind, count=120):
    found = Counted(f"{kind} condition of Xu 2024")
    for _ in within(count):
        model, plant = servo(rng)
        k_n, lam1 = rng.uniform(50, 500), rng.uniform(100, 500)
        N, lam0 = 40, rng.choice([0.0, 5.0, 20.0])
        K_P = lam1 * k_n * 10 ** rng.uniform(-1.5, 0.4)
        K_D = (lam1 + k_n) * 10 ** rng.uniform(-2, 0.1) * rng.choice([0, 1])
        own = model | {"k_n": k_n, "lam1": lam1, "lam2": rng.choice([0.0, 10.0]), "eta": 0.0}
        feedback = SMC(**own) if rng.random() < 0.6 else ASMC(**own, phi=0.0, Delta=100.0)
        learning = ExponentialPD(K_P=K_P, K_D=K_D, lam0=lam0, b=model["b"])
        taps = (0.8, 0.1)
        filtered = kind == "sampled" and rng.random() < 0.6
        scheme = WithFeedback(
            Filtered(learning, ZeroPhaseFIR(taps)) if filtered else learning, feedback
        )
        task = task_of(N)
        if kind == "sampled":
            test = sampled_condition(Machine(StateSpace(*plant, dt=DT)), scheme, task).condition
        else:
            plant = held_servo(**model)
            test = printed_condition(scheme, task, reaching=k_n).condition
        wrong = False
        if test.holds:
            r, gain = np.asarray(task.reference)[:, 0], np.exp(lam0 * DT * np.arange(N))[:, None]

            def learned(w, plant=plant, feedback=feedback, k_n=k_n, r=r, gain=gain):
                y, _ = smc_trial(plant, feedback, lambda s: k_n * s, r, w)
                e = r[:, None] - y
                slope = np.gradient(e, DT, axis=0)
                following = w + gain * (K_P * e[1:] + K_D * slope[1:]) / model["b"]  # noqa: B023
                if filtered:  # noqa: B023
                    held_ends = np.pad(following, ((1, 1), (0, 0)), mode="edge")
                    following = 0.8 * following + 0.1 * (held_ends[:-2] + held_ends[2:])
                return following, np.sqrt(np.mean(e[1:] ** 2, axis=0))

            at_zero = learned(np.zeros((N, 1)))[0]
            M = learned(np.eye(N))[0] - at_zero
            wrong = not ends(M)
            if kind == "printed":
                w, errors = np.zeros((N, 1)), []
                for _ in range(TRIALS):
                    w, error = learned(w)
                    errors.append(error[0])
                wrong |= bool(errors[-1] > errors[0])
        found.add(test, wrong)
    return found.row()


def slides(rng, count=120):
    found = Counted("sliding along a trial")
    for _ in within(count):
        model, plant = servo(rng)
        N, eta = int(rng.choice([60, 200, 600])), 10 ** rng.uniform(1, 4)
        own = model | {
            "eta": eta,
            "k_n": rng.uniform(50, 400),
            "lam1": rng.uniform(50, 300),
            "lam2": rng.choice([0.0, 1e3]),
            "tau": rng.choice([0.0, 1e-3]),
        }
        layer = eta / rng.uniform(100, 600)
        law = SMC(**own) if rng.random() < 0.5 else ASMC(**own, phi=0.0, Delta=layer)
        size = 10 ** rng.uniform(-3, -1)
        r = size * np.sin(np.pi * np.arange(N + 1) / N) ** 2
        switch = np.sign if type(law) is SMC else lambda s, layer=layer: np.clip(s / layer, -1, 1)
        push = rng.uniform(0, 1.2) * eta * np.sin(rng.uniform(1, 60) * DT * np.arange(N))
        off = rng.choice([0, 1]) * 10 ** rng.uniform(-4, -1)
        y, sigma = smc_trial(
            plant,
            law,
            lambda s, k_n=own["k_n"], eta=eta, switch=switch: k_n * s + eta * switch(s),
            r,
            push[:, None] / model["b"],
            off,
        )
        u = np.zeros((N, 1))
        trial = Trial(r[:, None], y, u, DT, {"sigma": sigma, "eta_hat": np.full((N, 1), eta)})
        run = sliding(law, trial)
        s, band = np.abs(sigma[:, 0]), run.band[0]
        outside = s[:-1] > band * (1 + 1e-9)
        rising = bool(np.any(s[1:][outside] > s[:-1][outside] * (1 + 1e-9)))
        wide = bool(run.reached == 0 and np.max(np.abs(r - y[:, 0])) > run.error_band[0])
        left = bool(np.any((s[:-1] <= band) & (s[1:] > band * (1 + 1e-9))))
        found.add(run.condition, rising or wide or left)
    return found.row()


def d2(rng, count=300):
    found = Counted("d2 of Cao 2019")
    for _ in within(count):
        N, phi0 = 20, rng.uniform(0.3, 2.0)
        static = rng.random() < 0.8
        gain = rng.uniform(0.3, 2.0, N) if static else np.full(N, rng.uniform(0.3, 2.0))
        pole = 0.0 if static else rng.choice([0.05, 0.5, 0.9])
        lam, rho = 10 ** rng.uniform(-1.5, 1.0), rng.uniform(0.3, 1.0)
        eta, mu, epsilon = 1.0, 1.0, 1e-5
        scheme = CFDLMFAILC(
            phi0=phi0, lam=lam, rho=rho, eta=eta, mu=mu, epsilon=epsilon, reset="sign"
        )
        r = np.sin(np.pi * np.arange(N + 1) / N) ** 2
        d = 0.1 * rng.standard_normal(N + 1) * (rng.random() < 0.5)
        u, phi, ys, us = np.zeros(N), np.full(N, phi0), [], []
        for j in range(TRIALS):
            y = np.zeros(N + 1)
            for k in range(N):
                y[k + 1] = pole * y[k] + gain[k] * u[k]
            y = y + d
            if j:
                du, dy = u - us[-1], y[1:] - ys[-1][1:]
                phi = phi + eta * du / (mu + du**2) * (dy - phi * du)
                phi = np.where(np.sign(phi) != np.sign(phi0), phi0, phi)
            ys.append(y)
            us.append(u)
            u = u + rho * phi / (lam + phi**2) * (r[1:] - y[1:])
        e = r[None, 1:] - np.array(ys)[:, 1:]
        rows = np.ones((N, 1, 1))
        plant = TimeVaryingStateSpace(pole * rows, gain[:, None, None] * rows, rows, dt=DT)
        bounds = bounds_of(Machine(plant), scheme, Task(r, dt=DT))
        ratio = np.abs(e[1:]) / np.maximum(np.abs(e[:-1]), 1e-300)
        seen = np.abs(e[:-1]) > 1e-9
        broken = [name for name in PREMISES if getattr(bounds, name) != 1.0]
        claimed = not broken
        found.counts.update({"tried": 1, "claimed" if claimed else "abstained": 1})
        found.counts["wrong"] += claimed and bool(
            np.any(seen & (ratio > float(bounds.d2) * (1 + 1e-6) + 1e-9))
        )
        found.why.update(broken[:1])
    return found.row()


CLASSES = {
    "short": short,
    "robust": robust,
    "channels": channels,
    "family": family,
    "corners": lambda rng: whole(rng, "corners", 120),
    "boxes": lambda rng: whole(rng, "boxes", 100),
    "sampled": lambda rng: xu(rng, "sampled"),
    "printed": lambda rng: xu(rng, "printed"),
    "sliding": slides,
    "d2": d2,
}

if __name__ == "__main__":
    jaxilc.setup()
    rows = []
    for name in output.asked(sys.argv[1:], CLASSES):
        start = time.perf_counter()
        rows.append(CLASSES[name](np.random.default_rng(38)))
        print(name, f"{time.perf_counter() - start:.0f} s", rows[-1], flush=True)
    output.write_rows(output.folder(__file__) / "rows.csv", rows)
