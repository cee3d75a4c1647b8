"""A flatbed printer from its measured response to the errors of seven motions.

The records are not ours to give away: `JAXILC_MEASURED` names their folder, without which the
experiment says so and ends. They are the response of the gantry's x axis (`arizona_x_frf.csv`) and
seven motions of four trials under feedback alone (`arizona_x_trials.npz`).

1. The response is fitted at several orders, by a vector fitting of 40 lines and by `grow_response`;
   also with every second line held out.
2. The feedback is an exact linear relation of the recorded error and input: it is read off.
3. The error of the first trial is predicted from the reference alone, with the response alone, and
   with mass, friction and a constant force as the trials of the six other motions show them, which
   choose the order and give the band, too.
4. In simulation, a law of one model learns on another one, down to what is new in each trial.
"""

import numpy as np
import scipy.signal
from output import axes, folder, measured_folder, write_rows

import jaxilc
from jaxilc.identification import grow_response, grown_response, read_frequency_response
from jaxilc.theory.on_lines import MeasuredResponse

DT, MOTIONS, ORDERS = 1e-3, range(1, 8), (4, 8, 12, 18, 20)
TRIALS, GAIN, CUTOFF = 60, 0.2, 60.0  # of the law in simulation; [Hz]
ENDS = 0.05  # [s] of the learned input that rise from 0 and fall to it
INSIDE = 0.9  # share of the samples that a band is to hold


def vector_fitting(f, G, weights, order, at, sweeps=30):
    """The response at frequencies `at` [Hz] of a relaxed vector fitting (Gustavsen 2006)."""

    def basis(f):
        s, p = 2j * np.pi * np.asarray(f)[:, None], poles
        one, other = 1 / (s - p), 1 / (s - p.conj())
        pairs = np.stack([one + other, 1j * (one - other)], axis=2).reshape(len(f), -1)
        real = 1 / (s - lags)
        return np.hstack([pairs, real, np.ones((len(f), 1))])

    def stacked(A):
        return np.concatenate([A.real, A.imag])

    def least_squares(A, b):
        size = np.linalg.norm(A, axis=0)
        return np.linalg.lstsq(A / size, b)[0] / size

    w = 2 * np.pi * np.geomspace(f[0], f[-1], order // 2)
    poles, lags = -w / 100 + 1j * w, np.zeros(0)
    for _ in range(sweeps):
        B = basis(f)
        n = B.shape[1]
        A = stacked(weights[:, None] * np.hstack([B, -G[:, None] * B]))
        size = np.linalg.norm(weights * G) / len(f)
        relaxed = np.append(np.zeros(n), np.sum(B.real, axis=0))  # not sigma(inf) = 1
        x = least_squares(
            np.vstack([A, size * relaxed]), np.append(np.zeros(len(A)), size * len(f))
        )
        c, d = x[n:-1], x[-1]
        q = 2 * len(poles)
        A = np.diag(np.append(np.repeat(poles.real, 2), lags))
        A[range(0, q, 2), range(1, q, 2)], A[range(1, q, 2), range(0, q, 2)] = (
            poles.imag,
            -poles.imag,
        )
        b = np.append(np.tile([2.0, 0.0], len(poles)), np.ones(len(lags)))
        zeros = np.linalg.eigvals(A - np.outer(b, c) / d)
        zeros = -np.abs(zeros.real) + 1j * zeros.imag
        poles, lags = zeros[zeros.imag > 0], zeros[zeros.imag == 0].real
    x = least_squares(stacked(weights[:, None] * basis(f)), stacked(weights * G))
    return basis(at) @ x


def plant_at(one, f):
    """P of a grown model at frequencies [Hz]."""
    return grown_response.columns(one.parts, f, DT) @ one.found.N


def feedback_at(num, den, f):
    """C(z) at frequencies [Hz]."""
    z = np.exp(-2j * np.pi * f * DT)
    return np.polyval(num[::-1], z) / np.polyval(den[::-1], z)


def quality(G, P, good):
    """Unweighted fit, and on lines of good coherence the median error and the shares within it."""
    error = (np.abs(G - P) / np.abs(G))[good]
    return {
        "fit_percent": 100 * float(1 - np.linalg.norm(G - P) / np.linalg.norm(G)),
        "median_percent": 100 * float(np.median(error)),
        "within_10_percent": 100 * float(np.mean(error <= 0.1)),
        "within_30_percent": 100 * float(np.mean(error <= 0.3)),
    }


def compared(measured):
    """Rows of both methods, and the models of `grow_response` by order, with the one chosen."""
    f, G, c = measured.frequencies, measured.response, measured.coherence
    weights, rows = np.sqrt(c / (1 - c)) / np.abs(G), []
    even = np.arange(len(f)) % 2 == 0
    half = MeasuredResponse(*(of[even] for of in measured[:4]), averages_known=False)
    (models, chosen), (of_half, _) = grow_response(measured, dt=DT), grow_response(half, dt=DT)
    for name, among, judged, grown in (
        ("all lines", np.ones(len(f), bool), np.ones(len(f), bool), models),
        ("every second, judged on the others", even, ~even, of_half),
    ):
        for order in ORDERS:
            row, good = {"lines": name, "order": order}, (c > 0.9)[judged]
            P = vector_fitting(f[among], G[among], weights[among], order, f[judged])
            rows.append({**row, "by": "vector fitting", **quality(G[judged], P, good)})
            one = next(one for one in grown if one.parts.order == order)
            P = plant_at(one, f[judged])
            by = "grown, chosen" if one is chosen else "grown"
            rows.append({**row, "by": by, **quality(G[judged], P, good)})
    return rows, {one.parts.order: one for one in models}, chosen


def feedback(trials):
    """(num, den) of C(z) of order 2, and the relative residual of u = C e over all trials."""
    A, b = [], []
    for i in MOTIONS:
        for e, u in zip(
            trials[f"exp{i}_e"].astype(float), trials[f"exp{i}_u"].astype(float), strict=True
        ):
            A.append(np.column_stack([e[2:], e[1:-1], e[:-2], u[1:-1], u[:-2]]))
            b.append(u[2:])
    A, b = np.vstack(A), np.concatenate(b)
    size = np.linalg.norm(A, axis=0)
    x = np.linalg.lstsq(A / size, b)[0] / size
    return x[:3], np.append(1.0, -x[3:]), float(np.linalg.norm(A @ x - b) / np.linalg.norm(b))


def closed_loop(plant, num, den):
    """A function (r, d) -> e of the loop e = r - P (C e + d)."""
    held = plant.sampled(DT)
    A, B, C = (np.asarray(M) for M in (held.A, held.B, held.C))
    A_c = np.array([[-den[1], 1.0], [-den[2], 0.0]])
    B_c = (num[1:] - den[1:] * num[0])[:, None]
    to_plant = B @ np.array([[1.0, 0.0]])
    whole = np.block([[A - num[0] * B @ C, to_plant], [-B_c @ C, A_c]])
    drive = np.block([[num[0] * B, B], [B_c, np.zeros((2, 1))]])
    seen = np.hstack([-C, np.zeros((1, 2))])
    system = (whole, drive, seen, np.array([[1.0, 0.0]]), DT)
    print(f"spectral radius of the loop {np.max(np.abs(np.linalg.eigvals(whole))):.4f}")
    return lambda r, d: scipy.signal.dlsim(system, np.column_stack([r, d]))[1][:, 0]


def opposing(r):
    """(N, 6) forces: direction, speed, held after and before motion, acceleration, a constant."""
    v = np.gradient(r, DT)
    moving = np.abs(v) > 1e-6
    direction = np.sign(v) * moving
    at = np.maximum.accumulate(np.where(moving, np.arange(len(r)), 0))
    after, before = direction[at] * ~moving, (np.cumsum(moving) == 0).astype(float)
    return np.column_stack([direction, v, after, before, np.gradient(v, DT), 0 * r + 1])


def rms(x):
    return float(np.sqrt(np.mean(np.square(x))))


def predicted(loop, trials, order):
    """Rows of the predictions of each motion, and (prediction, band, trials) of each.

    The band is one number: what holds nine samples of ten of the worst of the six other motions.
    """
    alone, forces, measured, told = {}, {}, {}, {}
    for i in MOTIONS:
        r = trials[f"exp{i}_r"]
        r = np.append(r[1:], r[-1]) / 4  # 4 e[k] = r[k+1] - p[k] in these records, to 3e-8 m
        alone[i] = loop(r, 0 * r)
        forces[i] = np.column_stack([loop(0 * r, -d) for d in opposing(r).T])
        measured[i] = trials[f"exp{i}_e"].astype(float)
    rows = []
    for i in MOTIONS:
        others = [j for j in MOTIONS if j != i]
        left = np.concatenate([measured[j].mean(axis=0) - alone[j] for j in others])
        A = np.vstack([forces[j] for j in others])
        x = np.linalg.lstsq(A, left)[0]
        off = {j: np.abs(alone[j] + forces[j] @ x - measured[j]) for j in others}
        band = max(float(np.quantile(of, INSIDE)) for of in off.values())
        e, mean = alone[i] + forces[i] @ x, measured[i].mean(axis=0)
        told[i] = e, band, measured[i]
        rows.append(
            {
                "motion": i,
                "order": order,
                "others_um": 1e6 * rms(left - A @ x),
                "measured_rms_um": 1e6 * rms(mean),
                "response_alone": rms(alone[i]) / rms(mean),
                "with_friction": rms(e) / rms(mean),
                "shape_error": rms(e - mean) / rms(mean),
                "band_um": 1e6 * band,
                "inside_percent": 100 * float(np.mean(np.abs(e - measured[i]) <= band)),
            }
        )
    return rows, told


def learned(loop, design, num, den, trials):
    """Rows: the error that a law leaves in simulation, beside what is new in recorded trials.

    Also the rms errors of all trials of the first motion.

        u_{j+1} = Q (u_j + GAIN (P S)^-1 e_j),    Q = 1 / (1 + (f / CUTOFF)^4)

    The law is designed on one model, and learns on the loop of another one. The ends of the input
    are faded, since the filters know nothing of the time before and after.
    """
    rows, rng, of_first = [], np.random.default_rng(0), []
    for i in MOTIONS:
        e = trials[f"exp{i}_e"].astype(float)
        new = (e - e.mean(axis=0)) * np.sqrt(4 / 3)  # of four trials about their mean
        N = e.shape[1]
        ends = scipy.signal.windows.tukey(N, 2 * ENDS / (N * DT))
        f = np.fft.rfftfreq(2 * N, DT)
        at = np.maximum(f, f[1] / 10)
        P, C = plant_at(design, at), feedback_at(num, den, at)
        Q, inverse = 1 / (1 + (f / CUTOFF) ** 4), (1 + P * C) / P
        u, errors = np.zeros(N), []
        for _ in range(TRIALS):
            now = e.mean(axis=0) + loop(0 * u, u) + new[rng.integers(4)]
            errors.append(rms(now))
            moved = np.fft.rfft(u, 2 * N) + GAIN * inverse * np.fft.rfft(now, 2 * N)
            u = ends * np.fft.irfft(Q * moved)[:N]
        floor, last = rms(new), float(np.mean(errors[-10:]))
        of_first = of_first or errors
        rows.append(
            {"motion": i, "first_um": 1e6 * errors[0], "last_um": 1e6 * last,
             "new_um": 1e6 * floor, "last_over_new": last / floor}
        )  # fmt: skip
    return rows, of_first


def drawn(out, measured, one, told, errors, floor) -> None:
    """The pictures: the response and its model, an error that was predicted, and learning."""
    f, G = measured.frequencies, measured.response
    P = plant_at(one, f)
    place = axes(size=(7.2, 3.6))
    place.loglog(f, np.abs(G), ".", color="0.6", ms=3, label="measured")
    place.loglog(f, np.abs(P), color="C0", lw=1.2, label=f"model of order {one.parts.order}")
    place.set(xlabel="frequency [Hz]", ylabel="position / input [m]")
    place.legend()
    place.figure.savefig(out / "response.png")
    place, (e, band, trial) = axes(size=(7.2, 3.6)), told
    t = DT * np.arange(len(e))
    place.plot(t, 1e6 * trial.T, color="0.6", lw=0.8, label="four recorded trials")
    place.plot(t, 1e6 * e, color="C0", lw=1.2, label="predicted")
    place.fill_between(t, 1e6 * (e - band), 1e6 * (e + band), color="C0", alpha=0.15, lw=0)
    place.set(xlabel="time [s]", ylabel="error [µm]")
    handles, labels = place.get_legend_handles_labels()
    by = dict(zip(labels, handles, strict=True))
    place.legend(by.values(), by.keys())
    place.figure.savefig(out / "predicted.png")
    place = axes(size=(7.2, 3.6))
    place.semilogy(1e6 * np.array(errors), ".-", color="C0", label="the law, in simulation")
    place.axhline(1e6 * floor, color="0.5", ls="--", label="new in each recorded trial")
    place.set(xlabel="trial", ylabel="rms error [µm]")
    place.legend()
    place.figure.savefig(out / "learned.png")


def main() -> None:
    place = measured_folder()
    if place is None:
        return
    jaxilc.setup()
    out, measured = folder(__file__), read_frequency_response(place / "arizona_x_frf.csv")
    trials = np.load(place / "arizona_x_trials.npz")
    rows, models, chosen = compared(measured)
    write_rows(out / "response.csv", rows)
    num, den, left = feedback(trials)
    print(f"u = C e to {left:.1e}: zeros {np.roots(num)}, poles {np.roots(den)}, C(1) "
          f"{num.sum() / den.sum():.6g}")  # fmt: skip
    predictions, loops, told = [], {}, {}
    for order in sorted({8, 12, 14, 18, chosen.parts.order}):
        one = models[order]
        plant = grown_response.model_of(one.parts, one.found.N)
        loops[order] = closed_loop(plant, num, den)
        rows, told[order] = predicted(loops[order], trials, order)
        predictions += rows
    write_rows(out / "predicted.csv", sorted(predictions, key=lambda row: row["motion"]))
    best = {}
    for row in sorted(predictions, key=lambda row: -row["others_um"]):
        best[row["motion"]] = row
    print("Each motion by the order that is best on the six others:")
    write_rows(out / "by_others.csv", [best[i] for i in MOTIONS])
    near = sum(abs(row["with_friction"] - 1) <= 0.15 for row in best.values())
    held = [row["inside_percent"] for row in best.values()]
    print(f"rms within 15 % on {near} of 7; inside the band {np.mean(held):.3g} % of all samples, "
          f"90 % on {sum(of >= 90 for of in held)} of 7")  # fmt: skip
    rows, errors = learned(loops[18], models[14], num, den, trials)
    write_rows(out / "learned.csv", rows)
    drawn(out, measured, chosen, told[best[1]["order"]][1], errors, 1e-6 * rows[0]["new_um"])


if __name__ == "__main__":
    main()
