"""A flatbed printer in running operation: what its records of 30 s show, told from its response.

The records are not ours to give away: `JAXILC_MEASURED` names their folder, without which the
experiment says so and ends. They are the response of the axis (`arizona_x_frf.csv`) and 30 s each
under feedback, with feedforward, under repetitive control of 6 s and of 10 s, and with 20 basis
functions (`arizona_x_repetitive.npz`).

1. What was played is read off: u = C e + what is added. The feedback alone and the control of 10 s
   have neither the disturbance nor the feedforward in them; the three others have both.
2. From the response and the disturbance alone, with a law that learns all of its period or of its
   functions at once, the error of each is told, by fifths. No recorded error is used.
3. The same with the mass, the friction and what is new in a trial as the seven other motions of the
   axis show them, which the response from 3 Hz on does not. No run that is told is looked at,
   but for the feedforward that was played.
4. The same with the error that feedforward leaves, as the record of that run shows it.
5. Two periods at once, 6 s and 10 s, reach what none of the recorded ones does. Its law is designed
   on one model, its condition is told on the measured lines, and it runs on another model.
"""

import jax.numpy as jnp
import numpy as np
import scipy.signal
from flatbed_printer import DT, MOTIONS, closed_loop, feedback_at, plant_at, rms
from output import folder, measured_folder, write_rows

import jaxilc
from jaxilc import theory
from jaxilc.identification import grow_response, grown_response, read_frequency_response
from jaxilc.pytree.fields import leaf, pytree
from jaxilc.schemes import LearningFilter, RepetitiveControl, Scheme, WithFeedback
from jaxilc.theory.on_lines import MeasuredResponse

DESIGN, ACTUAL = 14, 18  # orders of the models
RUNS = "feedback", "repetitive_6s", "repetitive_10s", "basis_20"
PERIODS = 6.0, 10.0  # [s]
FUNCTIONS = 20  # of the recorded run: a constant and the 19 lowest lines of the disturbance
RIGID, TURNING = 8.0, 1e-3  # below which the axis is a mass [Hz], and friction turns [m/s]
LINE = 0.02  # amplitude of a line that is no leakage
GAIN, CUTOFF, TAPS = 1.0, 12.0, 400  # of the proposed law; [Hz]


def controller(e, u):
    """(num, den) of C of order 2 in u = C e, and its relative residual."""
    A = np.column_stack([e[2:], e[1:-1], e[:-2], u[1:-1], u[:-2]])
    size = np.linalg.norm(A, axis=0)
    x = np.linalg.lstsq(A / size, u[2:])[0] / size
    return x[:3], np.append(1.0, -x[3:]), float(np.linalg.norm(A @ x - u[2:]) / np.linalg.norm(u))


def later(x, period):
    """The signal a period later, zero before."""
    n = round(period / DT)
    return np.concatenate([np.zeros(n), x[:-n]])


def lowest_lines(d, count):
    """The frequencies [Hz] of the lowest lines of a signal of 30 s."""
    size = np.abs(np.fft.rfft(d)) / (len(d) / 2)
    return np.flatnonzero(size > LINE)[:count] / (len(d) * DT)


def without(e, lines):
    """The error less what sines at these frequencies explain of it, all learned at once."""
    t = DT * np.arange(len(e))
    A = np.column_stack([wave(2 * np.pi * f * t) for f in lines for wave in (np.cos, np.sin)])
    return e - A @ np.linalg.lstsq(A, e)[0]


def of_motions(place, which=MOTIONS):
    """Mass, viscous and Coulomb friction of other motions, and what is new in each trial."""
    with np.load(place / "arizona_x_trials.npz") as file:
        motions = [[file[f"exp{i}_{name}"].astype(float) for name in "rue"] for i in which]
    A, u = [], []
    for r, inputs, _ in motions:
        v = np.gradient(r / 4) / DT
        A.append(np.column_stack([np.gradient(v) / DT, v, np.tanh(v / TURNING), np.ones(len(v))]))
        u.append(np.mean(inputs[1:], axis=0))  # the first trial began elsewhere
    new = [np.sqrt(np.mean(np.var(e[1:], axis=0, ddof=1))) for *_, e in motions]
    return *np.linalg.lstsq(np.vstack(A), np.concatenate(u))[0][:3], float(np.median(new))


def force_over_position(measured, f, mass, viscous):
    """1 / P at frequencies [Hz] of the measured response with another mass and viscous friction."""
    lines = measured.frequencies
    shape = (2j * np.pi * lines) ** 2 * measured.response
    rigid = np.median(np.abs(shape[lines < RIGID]))
    H = np.interp(f, lines, shape.real) + 1j * np.interp(f, lines, shape.imag)
    H = np.where(f < lines[0], rigid, H) / (rigid * mass)
    s = 2j * np.pi * f
    return s**2 / H + viscous * s


def with_friction(measured, num, den, r, forces, mass, viscous, coulomb):
    """The error of the measured response with another mass and friction, under the feedback."""
    N = 2 ** int(np.ceil(np.log2(2 * len(r))))
    f = np.fft.rfftfreq(N, DT)
    D, C = force_over_position(measured, f, mass, viscous), feedback_at(num, den, f)
    acting = forces - coulomb * np.tanh(np.gradient(r) / DT / TURNING)
    E = (D * np.fft.rfft(r - r[0], N) - np.fft.rfft(acting, N)) / (D + C)
    return np.fft.irfft(E, N)[: len(r)]


def beside(e, new):
    """An error with what is new in a trial beside it, as a random one of this rms."""
    return e + new * np.random.default_rng(0).normal(size=len(e))


def fifths(e):
    return [1e6 * rms(part) for part in np.split(np.asarray(e, float), 5)]


def row(run, told, e, recorded):
    """One row of the table: predicted by fifths, and the last one over what was recorded."""
    found = fifths(e)
    return {
        "run": run,
        "told_from": told,
        **{f"fifth_{i + 1}_um": value for i, value in enumerate(found)},
        **{f"recorded_{i + 1}_um": value for i, value in enumerate(recorded)},
        "last_over_recorded": found[-1] / recorded[-1],
        "largest_ratio": max(max(a / b, b / a) if a * b else np.inf
                             for a, b in zip(found, recorded, strict=True)),
    }  # fmt: skip


def transfer(one, num, den, f):
    """T = P / (1 + P C) of a model at frequencies [Hz]."""
    at = np.maximum(f, 1e-3)
    P = plant_at(one, at)
    return P / (1 + P * feedback_at(num, den, at))


def taps_of(one, num, den):
    """L = GAIN Q / T and Q as taps -TAPS..TAPS, of a design on a model."""
    N = 2**15
    f = np.fft.rfftfreq(N, DT)
    Q = 1 / (1 + (f / CUTOFF) ** 6)
    T = transfer(one, num, den, f)
    window = np.hanning(2 * TAPS + 3)[1:-1]
    return [
        window * np.roll(np.fft.irfft(part, N), TAPS)[: 2 * TAPS + 1] for part in (GAIN * Q / T, Q)
    ]


@pytree
class ReadOff(Scheme):
    """u = C e, with C of order 2."""

    num: jnp.ndarray = leaf()
    den: jnp.ndarray = leaf()

    def initial_state(self, task):
        return jnp.zeros((2, 1))

    def act(self, state, sample):
        e = sample.r - sample.y
        u = self.num[0] * e + state[0]
        kept = jnp.stack([state[1], 0 * u])
        return kept + jnp.outer(self.num[1:], e) - jnp.outer(self.den[1:], u), u


def condition(response, law, num, den, sigmas):
    """What theory tells of the law for two periods at once, on lines of the machine alone."""
    L, Q = law
    filters = LearningFilter(np.append(L[-2::-1], 0.0), keep=Q[::-1])  # e of one sample later
    scheme = WithFeedback(RepetitiveControl(filters, PERIODS), ReadOff(num, den))
    task = jaxilc.Task(np.zeros(4 * TAPS), dt=DT)
    return theory.repetitive_condition(response, scheme, task, points=2, sigmas=sigmas)


def learned(loop, e_0, law):
    """The error under two periods at once: v = W (Q v + L e), with W = W_1 + W_2 - W_1 W_2.

    Block by block: all that looks back is a period away, so each block follows from those before.
    """
    n = [round(p / DT) for p in PERIODS]
    back = [(1.0, n[0]), (1.0, n[1]), (-1.0, sum(n))]
    L, Q = law
    v, e, block = np.zeros(len(e_0)), e_0.copy(), n[0] - TAPS - 1
    for start in range(0, len(e_0), block):
        end = min(start + block, len(e_0))
        e = e_0 + loop(np.zeros(len(e_0)), v)
        seen = scipy.signal.fftconvolve(e, L, "same") + scipy.signal.fftconvolve(v, Q, "same")
        for sign, lag in back:
            first = max(start, lag)
            if first < end:
                v[first:end] += sign * seen[first - lag : end - lag]
    return e_0 + loop(np.zeros(len(e_0)), v)


def main() -> None:
    place = measured_folder()
    if place is None:
        return
    jaxilc.setup()
    out, measured = folder(__file__), read_frequency_response(place / "arizona_x_frf.csv")
    with np.load(place / "arizona_x_repetitive.npz") as file:
        record = {name: file[name].astype(float) for name in file}
    d, r = record["disturbance"], record["feedback_r"]
    r = np.append(r[1:], r[-1]) / 4  # as in the trials of this axis
    num, den, left = controller(record["feedback_e"], record["feedback_u"])
    print(f"u = C e to {left:.1e}, C(1) = {num.sum() / den.sum():.6g}")
    added = {
        run: record[f"{run}_u"] - scipy.signal.lfilter(num, den, record[f"{run}_e"])
        for run in (*RUNS, "feedback_feedforward")
    }
    forward = added["feedback_feedforward"] - d
    early = slice(1000, 5000)
    for run in RUNS:
        plain, with_both = added[run][early], (added[run] - forward - d)[early]
        print(f"{run}: from 1 s to 5 s there is added {rms(plain):.4f}, beyond feedforward and "
              f"disturbance {rms(with_both):.4f}")  # fmt: skip

    models = {one.parts.order: one for one in grow_response(measured, dt=DT)[0]}
    plants = {
        order: grown_response.model_of(one.parts, one.found.N)
        for order, one in models.items()
        if order in (DESIGN, ACTUAL)
    }
    loops = {order: closed_loop(plant, num, den) for order, plant in plants.items()}
    loop, lines = loops[DESIGN], lowest_lines(d, FUNCTIONS)
    moved, pushed = loop(r, 0 * d), loop(0 * r, d)
    recorded = {run: fifths(record[f"{run}_e"]) for run in RUNS}
    alone = "response and disturbance"
    forecast = {
        "feedback": moved,
        "repetitive_6s": pushed - later(pushed, 6.0),
        "repetitive_10s": moved - later(moved, 10.0),
        "basis_20": without(pushed, lines),
    }
    rows = [row(run, alone, forecast[run], recorded[run]) for run in RUNS]
    *axis, new = of_motions(place)
    names = "mass", "viscous friction", "Coulomb friction"
    print("; ".join(f"{name} {x:.4g}" for name, x in zip(names, axis, strict=True)),
          f"; new in each trial {1e6 * new:.3g} um")  # fmt: skip
    alone, both = (
        with_friction(measured, num, den, r, forces, *axis) for forces in (0 * d, d + forward)
    )
    forecast = {
        "feedback": beside(alone, new),
        "repetitive_6s": beside(both - later(both, 6.0), 2**0.5 * new),
        "repetitive_10s": beside(alone - later(alone, 10.0), 2**0.5 * new),
        "basis_20": beside(without(both, lines), new),
    }
    told = "response, disturbance and the seven other motions"
    rows += [row(run, told, e, recorded[run]) for run, e in forecast.items()]
    for i in MOTIONS:
        *one, _ = of_motions(place, (i,))
        e = without(with_friction(measured, num, den, r, d + forward, *one), lines)
        rows.append(
            row("basis_20", f"motion {i} alone in place of the seven", e, recorded["basis_20"])
        )
    late = np.where(np.arange(len(d)) * DT < 13, 0.0, record["repetitive_10s_e"])
    top = int(np.argmax(np.abs(late)))
    print(
        f"repetitive_10s: from 13 s on at most {1e6 * abs(late[top]):.0f} um, at {DT * top:.1f} s"
    )
    rest = record["feedback_feedforward_e"]
    own = record["feedback_e"]
    forecast = {
        "repetitive_6s": rest - later(rest, 6.0),
        "repetitive_10s": own - later(own, 10.0),
        "basis_20": without(rest, lines),
    }
    told = "the record of the run without learning"
    rows += [row(run, told, e, recorded[run]) for run, e in forecast.items()]
    write_rows(out / "predicted.csv", rows)

    law = taps_of(models[DESIGN], num, den)
    low = np.geomspace(0.02, measured.frequencies[0], 400, endpoint=False)
    below = {order: plant_at(models[order], low) for order in (DESIGN, ACTUAL)}
    at = measured.frequencies
    P = 1 / force_over_position(measured, at, *axis[:2])
    found = []
    for name, of, sigmas in (
        ("measured lines", measured, 0.0),
        ("them with mass and friction of the motions", MeasuredResponse(at, P, 0 * at), 0.0),
        ("measured lines, off by 3 std of one average", measured, 3.0),
        *((f"model of order {order}, below them", MeasuredResponse(low, P, 0 * low), 0.0)
          for order, P in below.items()),
    ):  # fmt: skip
        told = condition(of, law, num, den, sigmas)
        at = of.frequencies
        found.append({"on": name, "from_hz": at[0], "to_hz": at[-1], "at_hz": told.test.worst,
                      "condition": told.test.condition.value, "grows": told.worst,
                      "grows_at_hz": told.worst_at})  # fmt: skip
    print("3 |Q - L T| < 1 suffices for two periods at once:")
    write_rows(out / "condition.csv", found)
    proposed = [
        {"plant": f"model of order {order}", "start": name,
         **{f"fifth_{i + 1}_um": x for i, x in enumerate(fifths(learned(loops[order], e, law)))}}
        for order in (DESIGN, ACTUAL)
        for name, e in (("disturbance", loops[order](0 * r, d)), ("record with feedforward", rest))
    ]  # fmt: skip
    write_rows(out / "two_periods.csv", proposed)


if __name__ == "__main__":
    main()
