"""A grid that `jaxilc sweep` stored, and its best point as settings of another command."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

if TYPE_CHECKING:
    import xarray as xr

    from ..scenarios import Scenario

SHOWN = 3  # settings in which a scenario differs, of those that are told


def open_grid(folder: Path) -> xr.Dataset:
    """The dataset over a grid in a folder for results, or at the place of the store itself.

    Raises ValueError for a folder without a sweep, a sweep that is damaged or not complete, and one
    without a grid.
    """
    from ..sweeps.store import open_dataset, stored_configuration

    store = folder / "dataset.zarr"
    store = store if store.is_dir() else folder
    try:
        known = stored_configuration(store)
    except ValueError:
        raise ValueError(
            f"--params {folder} is neither a parameter file nor the folder of a sweep"
        ) from None
    if "grid" not in known:
        raise ValueError(f"--params {folder} has no grid; a sweep with --grid has one")
    dataset = open_dataset(store)
    left = int((dataset["diverged_at"] < 0).sum())
    if left:
        raise ValueError(
            f"--params {folder} is not complete: {left} of {dataset['diverged_at'].size} runs are "
            "missing; the same sweep with --resume goes on"
        )
    return dataset


def best_of(
    folder: Path, settings: Mapping[str, str], load: Callable[[Mapping[str, str]], Scenario]
) -> dict[str, Any]:
    """The values of all axes at the best point of a stored grid, by name.

    It is the best one by the metric and the tolerance of the scenario, over its schemes.

    settings: texts of `--set`, which may differ from the sweep
    load: the scenario with such texts
    Raises ValueError as `open_grid` does, and for a sweep of another scenario, or one of which more
    than 5 % of the machines diverge at every point.
    """
    from ..sweeps.points import best_points, labels_of

    dataset = open_grid(folder)
    axes = {*labels_of(dataset)}
    bare = load(
        {path: text for path, text in settings.items() if not {path, f"machine.{path}"} & axes}
    )
    schemes = [name for name in bare.schemes if name in dataset["scheme"]]
    if not schemes:
        raise ValueError(
            f"--params {folder} has the schemes {', '.join(map(str, dataset['scheme'].values))}, "
            f"and none of {', '.join(bare.schemes)}"
        )
    _need_same(folder, dataset.attrs["configuration"], bare, schemes, settings)
    limit = None if bare.tolerance is None else bare.tolerance / bare.shown(bare.judged_by)[0]
    found = best_points(dataset.sel(scheme=schemes), limit, metric=bare.judged_by)
    best = min(found, key=lambda of: of.rank)
    if not np.isfinite(best.error):
        raise ValueError(f"--params {folder}: {best.sentences[0]}")
    return point_of(dataset, best.point)


def point_of(dataset: xr.Dataset, point: Mapping[str, Any]) -> dict[str, Any]:
    """The values of a point by all names of its axes; those of an array are text for `--set`."""
    from ..sweeps.points import labels_of

    here = dataset.coords.to_dataset().sel(point)
    found = {name: here[name].item() for name in labels_of(dataset)}
    return {
        name: x.replace(" ", ",") if isinstance(x, str) and "." in name else x
        for name, x in found.items()
    }


def _need_same(folder, stored: Mapping[str, Any], bare: Scenario, schemes, settings) -> None:
    """Raises ValueError where a sweep had another machine, task or law than `--set` explains."""
    from ..pytree.named_paths import owner_of
    from ..runtime.provenance import describe, differences
    from ..storage.sealed import as_json

    of = {name: describe(bare.schemes[name]) for name in schemes}
    now = as_json({"machine": describe(bare.machine), "task": describe(bare.task), "schemes": of})
    then = {name: stored[name] for name in ("machine", "task")}
    then["schemes"] = {name: stored["schemes"][name] for name in schemes}
    given = []
    for owner, path in (owner_of(path.partition("[")[0], bare.schemes) for path in settings):
        given.append(f"{owner}.{path}" if owner == "machine" else f"schemes.{owner}.{path}")
    wrong = [
        line
        for line in differences(then, now)
        if not any(line.startswith((f"{path}:", f"{path}.")) for path in given)
    ]
    if wrong:
        more = f" and {len(wrong) - SHOWN} more" if len(wrong) > SHOWN else ""
        raise ValueError(
            f"--params {folder} is a grid of another scenario, or of other settings; it differs in "
            f"{'; '.join(wrong[:SHOWN])}{more}"
        )
