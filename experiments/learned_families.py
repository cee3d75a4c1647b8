"""The families of machines on which `learned_laws.py` judges learning laws."""

import dataclasses
from collections.abc import Callable
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np

from jaxilc import Machine, Sensor, Sweep, Task, Uniform
from jaxilc.design.responses import Family, designed_on, family_of
from jaxilc.plants import ProcessModel
from jaxilc.plants.plant import Plant
from jaxilc.pytree import Leaf, child, leaf, pytree
from jaxilc.scenarios import load
from jaxilc.schemes import Scheme, WithFeedback
from jaxilc.uncertainty import Uncertainty


class Case(NamedTuple):
    """A family of machines, its task, and how learning on it is judged.

    trials: the trial whose error counts in tuning;  last: the last trial that is judged
    judged_on: machines that judge, the nominal one included; fewer where a trial is long
    real: the machine that judges, None for the one that is tuned on
    starts: of the segments of a scheduled law, () where none is judged
    tuned_on, steps: machines and steps of each tuning, the same for every law
    """

    machine: Machine
    task: Task
    uncertainty: Uncertainty
    trials: int = 10
    last: int = 500
    judged_on: int = 257
    feedback: Scheme | None = None
    real: Machine | None = None
    starts: tuple[int, ...] = ()
    tuned_on: int = 32
    steps: int = 60

    def budget(self) -> dict:
        """The settings that every tuning has."""
        return {"machines": self.tuned_on, "held_out": self.tuned_on, "steps": self.steps}

    def family(self, seed: int, drawn: dict | None = None, **how) -> Family:
        """The frequency responses of its machines.

        drawn: further arguments of `designed_on`;  how: of `family_of`
        """
        some = designed_on(self.machine, self.uncertainty, seed=seed, **drawn or {})
        return family_of(some, self.feedback, self.task, **how)

    def under(self, scheme: Scheme) -> Scheme:
        return scheme if self.feedback is None else WithFeedback(scheme, self.feedback)

    def named(self, bounds: dict) -> dict:
        prefix = "" if self.feedback is None else "learning."
        return {prefix + name: of for name, of in bounds.items()}


def errors_of(
    case: Case, scheme: Scheme, metric: str, trials: int, machines: int, seed: int
) -> tuple[np.ndarray, np.ndarray]:
    """(machines, trials) errors of the worst channel, and which are lost; their errors are inf."""
    dataset = Sweep(
        case.real or case.machine, {"law": scheme}, case.task, trials, case.uncertainty,
        machines=machines, seed=seed,
    ).run()  # fmt: skip
    lost = ~dataset["finite"].values[0] | dataset["diverged"].values[0]
    errors = dataset[metric].values[0].reshape(machines, trials, -1).max(-1)
    return np.where(lost, np.inf, errors), lost


def relative(**widths: float) -> Uncertainty:
    return {
        "plant." + name.replace("_0", "[0]").replace("_1", "[1]"): Uniform(
            1 - w, 1 + w, relative=True
        )
        for name, w in widths.items()
    }


def motion(frequencies, amplitudes, dt: float = 1e-3, samples: int = 1000) -> Task:
    """Sines that begin and end at rest."""
    t = np.arange(samples + 1) * dt
    rest = np.sin(np.pi * np.clip((t - 0.05) / (t[-1] - 0.1), 0, 1)) ** 2
    sines = [a * np.sin(2 * np.pi * f * t + i) for i, (f, a) in
             enumerate(zip(frequencies, amplitudes, strict=True))]  # fmt: skip
    return Task(rest * np.sum(sines, axis=0), dt=dt, unit="mm")


def servo() -> Case:
    plant = ProcessModel(1.0, frequencies=2 * np.pi * np.r_[60.0, 180.0], dampings=[0.7, 0.02])
    spread = relative(frequencies_0=0.2, frequencies_1=0.15, dampings_1=0.5, gain=0.1)
    return Case(
        Machine(plant, None, Sensor(noise=1e-4)), motion([5, 20, 45], [0.6, 0.3, 0.15]), spread
    )


def non_minimum_phase() -> Case:
    plant = ProcessModel(
        1.0,
        zeros=[2 * np.pi * 25.0],
        frequencies=2 * np.pi * np.r_[30.0, 140.0],
        dampings=[0.8, 0.03],
    )
    spread = relative(frequencies_0=0.15, frequencies_1=0.1, zeros_0=0.1, gain=0.1)
    return Case(
        Machine(plant, None, Sensor(noise=1e-4)), motion([3, 8, 15], [0.6, 0.3, 0.1]), spread
    )


def li_axis() -> Case:
    s = load("li-2020")
    return Case(
        s.machine,
        s.task,
        s.uncertainty,
        judged_on=33,
        feedback=s.schemes["p-type"].feedback,
        tuned_on=8,
        steps=20,
    )


@pytree
class ClosedDrive(Plant):
    """The ball-screw drive under its position loop: from the command [mm] to the table [mm]."""

    drive: Plant = child()
    kp: Leaf = leaf()

    def sampled(self, dt: float) -> Plant:
        return dataclasses.replace(self, drive=self.drive.sampled(dt))

    def initial_state(self):
        return self.drive.initial_state()

    def step(self, x, u, dt: float):
        return self.drive.step(x, self.kp * (u - self.drive.output(x)[:1]), dt)

    def output(self, x):
        return self.drive.output(x)[1:]


def ball_screw() -> Case:
    """Laws are found on the linear drive, and judged on that with friction, encoder and limits."""
    s = load("milc-2024", reading="long-stroke")
    real = ClosedDrive(s.machine.plant, s.schemes["dilc"].feedback.scheme.kp)
    left_out = dict.fromkeys(
        ("motor_friction", "table_friction", "compensation", "lead_error", "encoder_step",
         "force_limit")
    )  # fmt: skip
    plant = dataclasses.replace(real, drive=dataclasses.replace(real.drive, **left_out))
    noise = Sensor(noise=float(np.asarray(s.machine.sensor.noise)[1]))
    spread = {name.replace("plant.", "plant.drive."): of for name, of in s.uncertainty.items()}
    r = jnp.asarray(s.task.reference)[:, 1]
    task = Task(r, dt=float(s.task.dt), unit="mm")
    return Case(
        Machine(plant, None, noise), task, spread, judged_on=33, tuned_on=8, steps=20,
        real=Machine(real, None, noise),
    )  # fmt: skip


def voice_coil() -> Case:
    s = load("cao-2019", reading="amplitude", plant="exact")
    return Case(s.machine, s.task, s.uncertainty, starts=(100,))


FAMILIES: dict[str, Callable[[], Case]] = {
    "servo": servo,
    "non-minimum-phase": non_minimum_phase,
    "li-2020": li_axis,
    "milc-2024": ball_screw,
    "cao-2019": voice_coil,
}
