"""The machine around a plant: actuator, sensors and disturbances.

Each of these parts is optional and takes no time when it is absent.
"""

from __future__ import annotations

import dataclasses
from typing import NamedTuple, TypeVar

import jax
import jax.numpy as jnp

from ..plants import Plant
from ..pytree.aliases import Array, Leaf, Tree, Value
from ..pytree.fields import child, leaf, pytree
from ..pytree.needs import need_channels, need_scalars
from ..schemes.scheme import limited
from ..signals.rows import plus
from ..signals.task import Limit, Task, Trial, quantise
from .variation import Variation

T = TypeVar("T")


@pytree
class Actuator:
    """Rate limit, saturation and converter of the input, in this order.

        v[k] = clip(v[k-1] + clip(u - v[k-1], -rate dt, rate dt), -limit, limit)
        applied: clip(Q(v[k]), -limit, limit)

    limit: () or (n_u,) largest |u| [unit of u]; the gradient is zero beyond it
    rate: () or (n_u,) largest |du/dt| [unit of u per s]; the gradient is zero beyond it
    resolution: () or (n_u,) step of the converter [unit of u]; its gradient is that of the
        identity (straight-through)
    With None there is no limit, no rate limit or no converter.
    """

    limit: Leaf | None = leaf(default=None, interval="(0, inf)", optional=True)
    rate: Leaf | None = leaf(default=None, interval="(0, inf)", optional=True)
    resolution: Leaf | None = leaf(default=None, interval="(0, inf)", optional=True)

    def apply(self, u: Array, v_last: Array, dt: float) -> tuple[Array, Array]:
        """The state v (n_u,) of the actuator and the applied input (n_u,).

        u: (n_u,) commanded input [unit of u]
        v_last: (n_u,) v of the sample before [unit of u]
        dt: () sample time [s]
        """
        v = u
        if self.rate is not None:
            v = v_last + jnp.clip(u - v_last, -self.rate * dt, self.rate * dt)
        v = limited(v, self.limit)
        if self.resolution is None:
            return v, v
        return v, limited(quantise(v, self.resolution), self.limit)

    def limits(self, u: Array, dt: float) -> dict[str, Limit]:
        """The signals that must stay within their bounds so that no limit has an effect, by name.

        u: (N, n_u) input commanded in a trial [unit of u]
        dt: () sample time [s]
        """
        rate = jnp.diff(u, axis=0, prepend=jnp.zeros_like(u[:1])) / dt
        found = {"actuator.limit": (u, self.limit), "actuator.rate": (rate, self.rate)}
        return {
            name: Limit(signal, bound)
            for name, (signal, bound) in found.items()
            if bound is not None
        }


@pytree
class Sensor:
    """An encoder with quantisation Q and noise: y_measured = Q(y + noise).

    resolution: () or (n_y,) step [unit of y]; its gradient is that of the identity
        (straight-through); None: no quantisation
    noise: () or (n_y,) standard deviation of white noise [unit of y]; None: no noise
    """

    resolution: Leaf | None = leaf(default=None, interval="(0, inf)", optional=True)
    noise: Leaf = leaf(default=None, interval="[0, inf)", optional=True)

    def measure(self, y: Array, noise: Array | None) -> Array:
        if noise is not None:
            y = y + self.noise * noise
        return y if self.resolution is None else quantise(y, self.resolution)


@pytree
class Disturbance:
    """The disturbances that act on the machine, repetitive and not repetitive.

    The repetitive part is the same in each trial; the noise is drawn anew for each trial.

    input: (N, n_u) repetitive part, added to the input of the plant [unit of u]
    output: (N+1, n_y) repetitive part, added to the output of the plant [unit of y]
    input_noise: () or (n_u,) standard deviation of the white noise at the input [unit of u]
    output_noise: () or (n_y,) standard deviation of the white noise at the output [unit of y]; it
        is true motion, unlike the noise of the sensor
    """

    input: Leaf | None = leaf(default=None, optional=True)
    output: Leaf | None = leaf(default=None, optional=True)
    input_noise: Leaf | None = leaf(default=None, interval="[0, inf)", optional=True)
    output_noise: Leaf | None = leaf(default=None, interval="[0, inf)", optional=True)


class Draws(NamedTuple):
    """The disturbances and the sensor noise of one trial; None where the machine has no such part.

    input: (N, n_u) disturbance at the input [unit of u]
    output: (N+1, n_y) disturbance at the output [unit of y]
    sensor: (N+1, n_y) sensor noise of variance 1
    """

    input: Array | None
    output: Array | None
    sensor: Array | None


@pytree
class Machine:
    """A plant with its actuator, sensors and disturbances, and how its trials differ."""

    plant: Plant = child()
    actuator: Actuator | None = child(default=None)
    sensor: Sensor | None = child(default=None)
    disturbance: Disturbance | None = child(default=None)
    variation: Variation | None = child(default=None)

    @property
    def answers_at_once(self) -> bool:
        """Whether a whole trial can be computed at once from an input that is known before it.

        For that the plant must have a `response`, and no rate may be limited.
        """
        return (
            self.plant.response is not None
            and (self.actuator is None or self.actuator.rate is None)
            and self.variation is None
        )

    def unlimited(self) -> Machine:
        """This machine without the limits of its actuator; the step of its converter is kept."""
        return dataclasses.replace(self, actuator=_without(self.actuator, "limit", "rate"))

    def unrounded(self) -> Machine:
        """This machine without the steps of its converter and of its sensors."""
        return dataclasses.replace(
            self,
            actuator=_without(self.actuator, "resolution"),
            sensor=_without(self.sensor, "resolution"),
        )

    def noiseless(self, *, averaged: bool = True) -> Machine:
        """This machine without the noise of its sensors and of its disturbances.

        averaged: whether what is drawn of the record of a trial has its mean, see
            `Variation.averaged`; if not, it is drawn, and only the initial state is not
        """
        variation = self.variation
        if variation is not None:
            variation = dataclasses.replace(variation, scatter=None, averaged=averaged)
        return dataclasses.replace(
            self,
            sensor=_without(self.sensor, "noise"),
            disturbance=_without(self.disturbance, "input_noise", "output_noise"),
            variation=variation,
        )

    def limits(self, trial: Trial) -> dict[str, Limit]:
        """The `limits` of its actuator, for the record of a trial of the `unlimited` machine."""
        return {} if self.actuator is None else self.actuator.limits(trial.u, trial.dt)

    def sampled(self, dt: float) -> Machine:
        """This machine with all of its plant that depends on dt computed before the scans.

        Its numbers are of the precision that JAX computes in, whatever that of its parameters.
        """
        wide = as_computed(self)
        plant, variation = wide.plant.sampled(dt), wide.variation
        if variation is not None and variation.change is not None and plant is not wide.plant:
            change = variation.change.sampled(wide.plant, dt)
            variation = dataclasses.replace(variation, change=change)
        return dataclasses.replace(wide, plant=plant, variation=variation)

    def at_trial(self, task: Task, j: Tree) -> tuple[Machine, Task]:
        """This machine, sampled, and the task, as they are in trial j; None for the long run."""
        machine, varies = self, self.variation
        if varies is not None and varies.change is not None:
            machine = dataclasses.replace(self, plant=varies.change.plant_at(self.plant, j))
        if varies is not None and varies.references is not None:
            task = dataclasses.replace(task, reference=varies.references.at(j))
        return machine, task

    def after_changes(self, task: Task) -> tuple[Machine, Task]:
        """This machine and the task as they are after the last change, from the first trial on.

        References that take turns go on doing so.
        """
        if self.variation is None:
            return self, task
        machine, at_last = self.at_trial(task, None)
        references = self.variation.references
        turns = references is not None and not references.first
        variation = dataclasses.replace(
            self.variation, change=None, references=references if turns else None
        )
        return dataclasses.replace(machine, variation=variation), task if turns else at_last

    def shown(self, trial: Trial, key: Array) -> Trial:
        """The record of a trial as it reaches the learning law. key: as for the trial"""
        return trial if self.variation is None else self.variation.shown(trial, key)

    @property
    def last_change(self) -> int:
        """Number of the trial from which on nothing changes; 1 where nothing does."""
        return 1 if self.variation is None else self.variation.last_change

    def said_of_claims(self) -> str:
        """Of which trials a claim is made, as the beginning of a sentence; empty for all alike."""
        return f"from trial {self.last_change} on: " if self.last_change > 1 else ""

    @property
    def carries(self) -> bool:
        """Whether a trial starts with a share of the state in which the one before has ended."""
        return self.variation is not None and self.variation.carried is not None

    def actuate(self, u: Array, v_last: Array, dt: float) -> tuple[Array, Array]:
        """The state of the actuator and the applied input, see `Actuator.apply`."""
        return (u, u) if self.actuator is None else self.actuator.apply(u, v_last, dt)

    def measure(self, y: Array, noise: Array | None) -> Array:
        return y if self.sensor is None else self.sensor.measure(y, noise)

    def draws(self, key: Array, task: Task) -> Draws:
        """The disturbances and the noise of one trial, drawn with the random key `key`."""
        of_input, of_output, of_sensor = jax.random.split(key, 3)
        d, shape_u, shape_y = self.disturbance, (task.N, task.inputs), (task.N + 1, task.outputs)
        noisy = self.sensor is not None and self.sensor.noise is not None
        return Draws(
            None if d is None else _total(d.input, d.input_noise, of_input, shape_u),
            None if d is None else _total(d.output, d.output_noise, of_output, shape_y),
            jax.random.normal(of_sensor, shape_y) if noisy else None,
        )

    def check(self, task: Task) -> None:
        """Raises ValueError where machine and task differ in channels or lengths.

        A plant of another sample time than the task's raises it where it is `sampled`.
        """
        for what, here, there in (
            ("inputs", self.plant.n_u, task.inputs),
            ("outputs", self.plant.n_y, task.outputs),
        ):
            if here != there:
                raise ValueError(
                    f"the task has {there} {what} but the plant {type(self.plant).__name__} has "
                    f"{here}"
                )
        need_scalars(self.plant)
        self.plant.check(task)
        if self.variation is not None:
            self.variation.check(self.plant, task)
        for part, names, channels in (
            (self.actuator, ("limit", "rate", "resolution"), task.inputs),
            (self.sensor, ("resolution", "noise"), task.outputs),
            (self.disturbance, ("input_noise",), task.inputs),
            (self.disturbance, ("output_noise",), task.outputs),
        ):
            if part is not None:
                need_channels(part, channels, *names)
        for name, shape in (
            ("input", (task.N, task.inputs)),
            ("output", (task.N + 1, task.outputs)),
        ):
            signal = getattr(self.disturbance, name, None)
            if signal is not None and signal.shape[-2:] != shape:
                raise ValueError(
                    f"Disturbance: {name} has shape {signal.shape}; this task needs {shape}"
                )


def as_computed(tree: T) -> T:
    """Parameters in single precision as JAX computes, so in double precision where it does."""
    return jax.tree.map(lambda x: jnp.asarray(x, float) if is_single(x) else x, tree)


def is_single(x: Leaf) -> bool:
    """Whether a leaf is in single precision."""
    return jnp.result_type(x) == jnp.float32


def _without(part: Value, *names: str) -> Value:
    """A part of a machine without what these fields say; None for no such part."""
    return None if part is None else dataclasses.replace(part, **dict.fromkeys(names))


def _total(
    repetitive: Leaf | None, std: Leaf | None, key: Array, shape: tuple[int, ...]
) -> Leaf | None:
    return repetitive if std is None else plus(std * jax.random.normal(key, shape), repetitive)
