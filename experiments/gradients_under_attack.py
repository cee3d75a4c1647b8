"""Tests of the derivatives through learning against central differences.

There are twelve configurations, three metrics and 24 machines at once.

In each configuration some leaves of the plant, the actuator or the scheme are batched, and the
metric of the last trial, and the sum over all trials, is differentiated along a random direction of
each machine in three ways: in tiles, as one `jit(vmap(grad))`, and machine by machine without
either. These are 12 x 3 x 24 = 864 derivatives for each way and each of the two losses.

The largest error has a kink where another sample becomes the largest, and a limit causes one where
another sample reaches it. Kinks are detected, and not hidden in a tolerance: the step is reduced
where another sample is the largest, or where the differences to the two sides disagree by more than
the effect of curvature, which halves with the step. A kink that remains at the smallest step is
counted, and the derivative there must be that of one of the two sides.

Measured (two cores, AVX-512, jax 0.10.2): 0 of 2 x 864 derivatives are wrong in each of the three
ways; 18 are near a kink, none is at one. When the sample of the largest error was found by
equality, all 24 derivatives of a summed largest error were wrong in three configurations (order 1,
Butterworth, switching; 23 of 24 for one metric) under jit(vmap(grad)).
"""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import output

import jaxilc
from jaxilc import Machine, Task, learn, tiled
from jaxilc.filters import SwitchableFilter, ZeroPhaseButterworth
from jaxilc.learning import Actuator, Keep
from jaxilc.plants import DifferenceEquation, StateSpace
from jaxilc.pytree import get_at, replaced
from jaxilc.schemes import CFDLMFAILC, FFDLMFAILC, PID, Filtered, HigherOrder, PIDType, WithFeedback

METRICS, LOSSES, MACHINES = ("max_error", "settled_error", "rms"), ("last", "summed"), 24
STEPS = (1e-5, 1e-6, 1e-7)  # steps of the differences, relative to the leaf
AGREED = 1e-5  # allowed distance of a derivative from a difference, relative to the latter
ROUNDING = 1e-14  # absolute rounding error of a metric; the references have a size of about one
DT = 1e-3


class Configuration(NamedTuple):
    """A machine and a scheme, and the leaves that differ between the machines.

    subject: dictionary {"machine": ..., "scheme": ...}
    trials: number J of trials
    leaves: paths of the leaves in the subject that are batched
    samples, outputs: numbers of samples and outputs of the reference
    """

    subject: dict[str, Any]
    trials: int
    leaves: tuple[str, ...]
    samples: int = 60
    outputs: int = 1

    @property
    def task(self) -> Task:
        bump = np.sin(2 * np.pi * np.arange(self.samples + 1) / self.samples) ** 2
        return Task(
            np.stack([(1 + 0.3 * i) * bump for i in range(self.outputs)], axis=1),
            dt=DT,
            inputs=self.outputs,
        )

    def history(self, x, save=None):
        """The history of one machine.

        x: its values of the batched leaves, by name
        """
        subject = replaced(self.subject, x)
        return learn(subject["machine"], subject["scheme"], self.task, self.trials, save=save)

    def loss(self, x, metric: str, loss: str):
        by_trial = jnp.sum(getattr(self.history(x).metrics, metric), axis=1)
        return by_trial[-1] if loss == "last" else jnp.sum(by_trial)

    def batch(self, rng) -> tuple[dict, dict]:
        """Leaves of `MACHINES` machines, 5 % around the given ones, and a direction for each."""
        at = {name: np.asarray(get_at(self.subject, name)) for name in self.leaves}
        x = {
            name: value * (1 + 0.05 * rng.uniform(-1, 1, (MACHINES, *value.shape)))
            for name, value in at.items()
        }
        return x, {
            name: rng.standard_normal(value.shape) * np.abs(value) for name, value in x.items()
        }


def configurations() -> dict[str, Configuration]:
    """Plants of random matrices with laws of 30 % of their inverse gain, from a fixed seed."""
    rng = np.random.default_rng(0)

    def stable(order):
        A = np.diag(rng.uniform(0.3, 0.9, order)) + 0.1 * rng.standard_normal((order, order)) * (
            order > 1
        )
        A *= 0.9 / max(0.9, np.max(np.abs(np.linalg.eigvals(A))))
        B, C = rng.standard_normal((order, 1)), rng.standard_normal((1, order))
        plant = StateSpace(A, B, C, dt=DT)
        return plant, 0.3 / (C @ B).item()

    def of(plant, scheme, trials, *leaves, actuator=None, **options):
        return Configuration(
            {"machine": Machine(plant, actuator), "scheme": scheme}, trials, leaves, **options
        )

    (first, g1), (second, g2), (third, g3), (fourth, g4) = map(stable, (1, 2, 3, 4))
    two = StateSpace(
        [[0.7, 0.1], [0.05, 0.6]], [[0.3, 0.05], [-0.02, 0.4]], [[1.0, 0.1], [0.2, 1.0]], dt=DT
    )
    arx = DifferenceEquation((1.6, -0.65), (0.06, 0.03), dt=DT)
    cfdl = CFDLMFAILC(lam=0.2, eta=0.9, mu=0.05, rho=0.9, phi0=0.065, reset="none")
    ffdl = FFDLMFAILC(
        lam=0.02, eta=0.9, mu=0.05, rho=0.9, phi0=(0.5, -0.1, 0.06, 0.03), reset="none"
    )
    switching = SwitchableFilter((60.0, 150.0, 90.0), (0.0183, 0.0387), 0.006, padding=9)
    largest = float(
        jnp.max(
            jnp.abs(
                learn(
                    Machine(second), PIDType(gamma_p=g2), Configuration({}, 1, ()).task, 8
                ).final.u
            )
        )
    )
    over_pid = WithFeedback(PIDType(gamma_p=g3), PID(kp=g3 / 3))
    return {
        "order 1": of(first, PIDType(gamma_p=g1), 8, "machine.plant.C"),
        "order 3 over PID": of(third, over_pid, 3, "machine.plant.C"),
        "order 2, 100 samples": of(second, PIDType(gamma_p=g2), 8, "machine.plant.A", samples=100),
        "order 4": of(fourth, PIDType(gamma_p=g4), 3, "machine.plant.B", "machine.plant.C"),
        "two by two": of(two, PIDType(gamma_p=0.5), 5, "machine.plant.C", outputs=2),
        "limit": of(
            second,
            PIDType(gamma_p=g2),
            8,
            "machine.actuator.limit",
            "machine.plant.B",
            actuator=Actuator(limit=0.6 * largest),
        ),
        "rate": of(
            second,
            PIDType(gamma_p=g2),
            5,
            "machine.actuator.rate",
            "machine.plant.C",
            actuator=Actuator(rate=0.06 * largest / DT),
        ),
        "CFDL-MFAILC": of(
            arx, cfdl, 8, *(f"scheme.{name}" for name in ("lam", "eta", "mu", "rho", "phi0"))
        ),
        "FFDL-MFAILC": of(
            arx, ffdl, 5, "scheme.lam", "scheme.rho", "scheme.phi0", "machine.plant.b"
        ),
        "higher order": of(
            arx,
            HigherOrder((0.7, 0.3), (2.0, 1.0)),
            5,
            "scheme.alpha",
            "scheme.gamma",
            "machine.plant.a",
        ),
        "Butterworth": of(
            first,
            Filtered(PIDType(gamma_p=g1), ZeroPhaseButterworth(80.0)),
            5,
            "scheme.filter.cutoff",
            "scheme.scheme.gamma_p",
        ),
        "switching": of(
            first,
            Filtered(PIDType(gamma_p=g1), switching),
            5,
            *(f"scheme.filter.{name}" for name in ("cutoff", "times", "width")),
        ),
    }


class Differences(NamedTuple):
    """The finite differences of one metric and loss, (S,) each.

    left, right: differences to the two sides
    allowed: largest difference that a derivative may have
    kink: whether the two sides differ
    shrunk: whether the step was reduced
    """

    left: np.ndarray
    right: np.ndarray
    allowed: np.ndarray
    kink: np.ndarray
    shrunk: np.ndarray

    def wrong(self, slope) -> np.ndarray:
        """(S,) whether a slope is not the central difference nor, at a kink, a one-sided one."""
        central = np.abs(slope - (self.left + self.right) / 2) <= self.allowed
        one_sided = (
            np.minimum(np.abs(slope - self.left), np.abs(slope - self.right)) <= self.allowed
        )
        return ~np.where(self.kink, one_sided, central)


def differences(case: Configuration, x, d) -> dict[tuple[str, str], Differences]:
    """The differences by metric and loss, at the first step that meets no kink."""

    def look(one):
        history = case.history(one, save=Keep(signals=("e",)))
        size = jnp.abs(history.saved["e"])
        by_trial = {metric: jnp.sum(getattr(history.metrics, metric), axis=1) for metric in METRICS}
        largest = jnp.argmax(size[:, 1:], axis=1), jnp.argmax(size[:, case.task.settled], axis=1)
        return {(m, "last"): v[-1] for m, v in by_trial.items()} | {
            (m, "summed"): jnp.sum(v) for m, v in by_trial.items()
        }, largest

    run = tiled(lambda _, one: look(one))

    def at(h):
        return jax.tree.map(
            np.asarray, run((), {name: jnp.asarray(x[name] + h * d[name]) for name in x})
        )

    here, found = at(0.0)[0], {}
    for h in STEPS:
        (after, which_after), (before, which_before), (nearer, _), (nearer_before, _) = (
            at(h),
            at(-h),
            at(h / 2),
            at(-h / 2),
        )
        moved = [
            np.any(one != other, axis=(1, 2))
            for one, other in zip(which_after, which_before, strict=True)
        ]
        for (metric, loss), value in here.items():
            key = metric, loss
            left, right = (value - before[key]) / h, (after[key] - value) / h
            allowed = (
                AGREED * np.abs(left + right) / 2 + ROUNDING * np.maximum(1.0, np.abs(value)) / h
            )
            bend, nearer_bend = right - left, 2 * (nearer[key] - 2 * value + nearer_before[key]) / h
            kink = (
                np.abs(bend - 2 * nearer_bend) > 6 * allowed
            )  # the effect of curvature halves with the step, that of a kink does not
            kink |= (
                np.abs((left + right) / 2 - (nearer[key] - nearer_before[key]) / h) > allowed / 2
            )  # the step is too long
            kink |= moved[METRICS.index(metric)] if metric != "rms" else False
            now = Differences(left, right, allowed, kink, np.full(kink.shape, h < STEPS[0]))
            old = found.get(key, now)
            found[key] = Differences(
                *(np.where(old.kink, n, o) for n, o in zip(now, old, strict=True))
            )
    return found


def derivative(case: Configuration, metric: str, loss: str):
    """The derivative of a machine's loss along a direction, a function of (leaves, direction)."""

    def along(one):
        gradient = jax.grad(lambda x: case.loss(x, metric, loss))(one[0])
        return sum(jnp.vdot(gradient[name], one[1][name]) for name in gradient)

    return along


def slopes(case: Configuration, metric: str, loss: str, x, d) -> dict[str, np.ndarray]:
    """(S,) derivatives along d, by the way in which they were computed."""
    along, batch = derivative(case, metric, loss), jax.tree.map(jnp.asarray, (x, d))
    machines = [jax.tree.map(lambda leaf, i=i: leaf[i], batch) for i in range(MACHINES)]
    return {
        "tiled": np.asarray(tiled(lambda _, one: along(one))((), batch)),
        "jit(vmap(grad))": np.asarray(jax.jit(jax.vmap(along))(batch)),
        "grad": np.array([along(one) for one in machines]),
    }


def main():
    jaxilc.setup()
    folder, rows = output.folder(__file__), []
    for name, case in configurations().items():
        x, d = case.batch(np.random.default_rng(1))
        expected = differences(case, x, d)
        for (metric, loss), at in expected.items():
            row = {
                "configuration": name,
                "metric": metric,
                "loss": loss,
                "step shrunk": int(at.shrunk.sum()),
                "kinks": int(at.kink.sum()),
            }
            for way, slope in slopes(case, metric, loss, x, d).items():
                row |= {
                    f"{way}: wrong": int(at.wrong(slope).sum()),
                    f"{way}: zero": int((slope == 0).sum()),
                }
            rows.append(row)
            jax.clear_caches()
    output.write_rows(folder / "rows.csv", rows)
    total = MACHINES * len(rows) // len(LOSSES)
    for loss in LOSSES:
        of = [row for row in rows if row["loss"] == loss]
        wrong = {
            way.removesuffix(": wrong"): sum(row[way] for row in of)
            for way in rows[0]
            if way.endswith(": wrong")
        }
        beside, at = (sum(row[name] for row in of) for name in ("step shrunk", "kinks"))
        kinks = f"{beside} beside a kink, {at} at a kink"
        print(
            f"{loss}: of {total} derivatives, {kinks}, wrong: "
            f"{', '.join(f'{n} {way}' for way, n in wrong.items())}"
        )


if __name__ == "__main__":
    main()
