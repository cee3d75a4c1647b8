"""Datasets as runs and sweeps have them, made of errors that a test gives."""

import numpy as np
import xarray as xr


def run_of(errors, reference=None, u=None, *, dt=1e-3, schemes=("a",), **coords):
    """The dataset of a run.

    errors: (scheme, trial, time, channel) [mm];  reference, u: zero where they are not given
    """
    e = np.asarray(errors, float)
    r = np.zeros(e.shape[2:]) if reference is None else reference
    u = np.zeros((*e.shape[:2], e.shape[2] - 1, 1)) if u is None else u
    dims = ("scheme", "trial", "time", "channel")
    with np.errstate(over="ignore"):
        rms = np.sqrt(np.mean(e**2, axis=(2, 3)))
    return xr.Dataset(
        {
            "r": (dims[2:], r),
            "y": (dims, r - e, {"units": "mm"}),
            "e": (dims, e, {"units": "mm"}),
            "u": (("scheme", "trial", "input_time", "input"), u, {"units": "V"}),
            "rms": (dims[:2], rms),
        },
        {
            "scheme": [*schemes],
            "trial": np.arange(1, e.shape[1] + 1),
            "time": np.arange(e.shape[2]) * dt,
            "input_time": np.arange(e.shape[2] - 1) * dt,
            **coords,
        },
    )


def sweep_of(errors, schemes=("law",), metric="rms", **axes):
    """The dataset of a sweep; errors (scheme, axes, sample, trial): infinite where one diverged."""
    errors = np.asarray(errors, float)
    dims = ("scheme", *axes, "sample", "trial")
    finite = np.isfinite(errors)
    return xr.Dataset(
        {
            metric: (dims, errors),
            "finite": (dims, finite),
            "diverged_at": (dims[:-1], np.where(finite[..., -1], 0, 2)),
        },
        {"scheme": [*schemes], "trial": np.arange(1, errors.shape[-1] + 1)}
        | {name: (name, *of) if isinstance(of, tuple) else of for name, of in axes.items()},
    )
