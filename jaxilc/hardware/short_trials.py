"""Trials that a machine ended early, as trials of the whole task of which not all was measured."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from ..schemes.weights import weighed
from ..signals.task import Task, Trial
from .checks import Finding
from .trial_files import Measured, read_measured, rows_of_time


def read_short(
    path: Any,
    task: Task,
    others: Mapping[str, tuple[int, int]] | None = None,
    names: Mapping[str, str] | None = None,
    columns: Sequence[str] = (),
) -> Measured:
    """A measured trial that may have ended early, with `samples` of the input measured.

    Its signals have the length of the task: after the end, y is the reference, and the input and
    the other signals are NaN, until `completed` knows them.
    Raises ValueError as `read_measured`, and for a file of fewer than two samples.
    """
    last = rows_of_time(path, task, others, names, columns) - 1
    if last >= task.N:
        return read_measured(path, task, others, names, columns)
    if last < 1:
        raise ValueError(f"{path} has {last + 1} samples; a trial that ended early needs two")
    short = dataclasses.replace(task, reference=task.reference[: last + 1], settle=None)
    left = task.N - last
    shapes = {name: (rows - left, n) for name, (rows, n) in (others or {}).items()}
    found = read_measured(path, short, shapes, names, columns)

    def filled(values):
        return (
            None if values is None else np.pad(values, ((0, left), (0, 0)), constant_values=np.nan)
        )

    return found._replace(
        y=np.concatenate([found.y, np.asarray(task.reference)[last + 1 :]]),
        u=filled(found.u),
        others={name: filled(values) for name, values in found.others.items()},
        samples=last,
    )


def completed(
    measured: Measured, commanded, signals: dict[str, Any], played: Mapping[str, Any]
) -> tuple[Measured, Any, dict[str, Any]]:
    """The trial, its input and the signals of the scheme, all of the length of the task.

    What was commanded, computed and played stands in place of what was not measured.
    """
    known, others, u = {**signals, **played}, measured.others, measured.u
    if measured.samples is not None:
        others = {n: np.where(np.isnan(x), known[n], x) for n, x in others.items()}
        u = u if u is None else np.where(np.isnan(u), commanded, u)
    if "feedback" in others:
        signals = {**signals, "feedback": others["feedback"]}
    return measured._replace(u=u, others=others), commanded if u is None else u, signals


def ended(record: Trial, measured: Measured) -> tuple[Trial, list[Finding]]:
    """The record of which samples after the end have the weight zero, and a note that says so."""
    if measured.samples is None:
        return record, []
    N = len(record.u)
    there = (np.arange(N + 1) <= measured.samples).astype(float)
    W = jnp.asarray(np.broadcast_to(there[:, None], record.r.shape))
    shown = jax.device_get(weighed(record, W))
    text = (
        f"the trial ended after {measured.samples} of {N} samples; the rest is not learned from, "
        "and is played as it was"
    )
    return shown, [Finding("note", text)]


def stored(record: Trial) -> dict[str, Any]:
    """The arrays of a record as the journal keeps them; `weight` is there for one that ended early.

    Such a trial is no record of the machine to its end, so no plant is fitted to it.
    """
    arrays = {"y": record.y, "u": record.u} | {
        f"signals {name}": signal for name, signal in record.signals.items()
    }
    return arrays if record.weight is None else arrays | {"weight": record.weight}
