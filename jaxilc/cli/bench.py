"""The command line for speed: `jaxilc bench`."""

from __future__ import annotations

from typing import Annotated

import typer

from .options import Json, out, written


def register(app: typer.Typer) -> None:
    """Add the command to the command line."""
    app.command()(bench)


def bench(
    plants: Annotated[
        str, typer.Option(help="Numbers of plants, with commas between them.")
    ] = "1,16,1024",
    trials: Annotated[int, typer.Option(help="Trials J.")] = 80,
    samples: Annotated[int, typer.Option(help="Samples N of a trial.")] = 2000,
    schemes: Annotated[
        str, typer.Option(help="cfdl, ffdl, with opponents; noilc, ilc-asmc, alone; with commas.")
    ] = "cfdl,ffdl",
    long: Annotated[
        int,
        typer.Option(
            help="Samples of one long trial of one plant, by steps and in blocks; 0 for none."
        ),
    ] = 100_000,
    repeats: Annotated[int, typer.Option(help="Turns; contenders take turns.")] = 5,
    json_file: Json = None,
    precision: Annotated[
        str, typer.Option(help="float64 or float32; opponents are in float64.")
    ] = "float64",
) -> None:
    """Our speed beside NumPy, Numba, C, SciPy and python-control, on this machine, for the same
    numbers.

    Example: jaxilc bench --plants 1024 --json out/bench.json
    """
    from ..runtime.start import setup

    setup(precision=precision)
    import jax

    from ..bench import contests as measured
    from ..bench.timing import OURS, as_json, machine

    jax.config.update("jax_enable_compilation_cache", False)  # compiling is measured too
    sizes, names = _numbers(plants), [name.strip() for name in schemes.split(",")]
    for name in names:
        if name not in (*measured.SCHEMES, *measured.ALONE):
            raise ValueError(
                f"--schemes {name!r} is not one of {', '.join((*measured.SCHEMES, *measured.ALONE))}"
            )
    if long and long < 4:
        raise ValueError(f"--long {long} is not 0 or a whole number from 4 on")
    for size in sizes:
        measured.need_room(size, trials, samples)
    measured.need_room(1, 1, long)
    opponents, notes = measured.opponents()
    numbers: dict = {
        "machine": machine(),
        "precision": precision,
        "trials": trials,
        "samples": samples,
        "rows": {},
        "cost": {},
    }
    for note in notes:
        out.print(note, highlight=False, markup=False)
    for name in names:
        for size in sizes:
            if name in measured.ALONE:
                rows = {OURS: measured.alone(name, size, repeats=repeats)}
            else:
                rows = measured.compare(
                    measured.setting(name, size, trials, samples), opponents, repeats=repeats
                )
            _print(rows, f"{name}, {size} plants", OURS)
            numbers["rows"][f"{name}/{size}"] = as_json(rows)
    for size in sizes:
        rows = measured.compare_plant(measured.setting("cfdl", size, 1, samples), repeats=repeats)
        _print(rows, f"the plant alone, {size} plants", OURS)
        numbers["rows"][f"plant/{size}"] = as_json(rows)
    if long:
        rows = measured.compare_long(long, repeats=repeats)
        _print(rows, f"one plant, one trial of {long} samples", OURS)
        numbers["rows"][f"long/{long}"] = as_json(rows)
    for name in names:
        if name in measured.SCHEMES:
            of_size = measured.cost_by_size(
                name, min(max(sizes), 1024), trials, samples, repeats=repeats
            )
            numbers["cost"][name] = {
                what: {"seconds": best, **line._asdict()} for what, (best, line) in of_size.items()
            }
            for what, (best, line) in of_size.items():
                times = ", ".join(f"{size}: {seconds:.3g} s" for size, seconds in best.items())
                fit = f"{line.start:.3g} s + {1e6 * line.slope:.3g} us each, off by {100 * line.residual:.0f} % at most"
                out.print(f"{name} by {what}: {times}; {fit}", highlight=False)
    numbers["machine_after"] = machine()
    out.print(
        f"load of the machine: {numbers['machine']['load']} before, {numbers['machine_after']['load']} after",
        highlight=False,
    )
    written([], json_file, numbers)


def _numbers(text: str) -> list[int]:
    try:
        numbers = [int(part) for part in text.split(",")]
    except ValueError:
        numbers = []
    if not numbers or min(numbers) < 1:
        raise ValueError(
            f"--plants {text!r} is not whole numbers from 1 on, with commas between them"
        )
    return numbers


def _print(rows, title: str, ours: str) -> None:
    from statistics import median

    from rich.table import Table

    table = Table(
        "",
        "ran",
        "ns best",
        "ns median",
        "times ours",
        "lowest - highest",
        "cpu ns",
        "times ours",
        "compile s",
        "peak MB",
        "off by",
        title=title,
    )
    for row in rows.values():
        ratios = sorted(row.ratios(rows[ours]))
        table.add_row(
            row.name,
            f"{row.plants} x {row.trials}",
            f"{row.best:.3g}",
            f"{row.median:.3g}",
            f"{median(ratios):.3g}",
            f"{ratios[0]:.3g} - {ratios[-1]:.3g}",
            f"{row.cpu:.3g}",
            f"{median(row.ratios(rows[ours], 'cpu_seconds')):.3g}",
            f"{row.compile_seconds:.2f}",
            "" if row.peak_bytes is None else f"{row.peak_bytes / 1e6:.0f}",
            f"{row.difference:.1g}",
        )
    out.print(table)
