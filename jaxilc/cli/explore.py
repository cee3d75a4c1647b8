"""`jaxilc explore`: a page on this computer, whose sliders move weights and machines."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from .completion import schemes_from
from .console import out
from .options import (
    SIMULATE,
    GridAxes,
    Machines,
    OutFolder,
    Params,
    Precision,
    ScenarioName,
    Set,
    Trials,
    at_least,
)

LOOPBACK = "127.0.0.1"


def register(app: typer.Typer) -> None:
    """Add the command to the command line."""
    app.command(rich_help_panel=SIMULATE)(explore)


def explore(
    scenario: ScenarioName,
    scheme: Annotated[
        str | None,
        typer.Option(
            "--scheme",
            help="Scheme to explore; the first one that learns if not given.",
            autocompletion=schemes_from,
        ),
    ] = None,
    trials: Trials = None,
    machines: Machines = 32,
    grid: GridAxes = None,
    set_: Set = None,
    params: Params = None,
    port: Annotated[int, typer.Option(help="Port of the page; 0 for any that is free.")] = 5006,
    address: Annotated[
        str, typer.Option(help="Address to listen on; others than this computer may then connect.")
    ] = LOOPBACK,
    browser: Annotated[
        bool, typer.Option("--browser/--no-browser", help="Open the page in a browser.")
    ] = True,
    out_dir: OutFolder = None,
    precision: Precision = "float64",
) -> None:
    """A page with sliders for weights, lead, cutoff and spread; the errors follow at once.

    It runs on this computer only, until Ctrl-C. What was found is saved as a file for --params.
    With --grid, or the folder of a grid for --params, it has a map; a click moves the sliders.

    Example: jaxilc explore cao-2019 --scheme ffdl-mfailc
    """
    at_least(1, machines=machines)
    if not 0 <= port <= 65535:
        raise ValueError(f"--port {port} is outside its allowed range [0, 65535]")
    _try_place(address, port)
    from .progress import working

    with working("explore") as told:
        from .asked import begin, chosen_scenario, grid_asked

        begin(precision)
        told("reading the scenario")
        chosen = chosen_scenario(scenario, [scheme] if scheme else None, trials, set_, params)
        from ..figures.explorer import explore as application
        from .stored_grid import open_grid

        told("compiling")
        folder = out_dir or Path("out") / f"explore-{chosen.name}"
        axes = None
        if grid:
            axes = grid_asked(
                chosen, grid, lambda more: chosen_scenario(scenario, None, None, [more])
            )
        elif params and params.is_dir():
            axes = open_grid(params)
        shown = application(
            chosen,
            scheme,
            folder=folder,
            machines=machines,
            source=scenario,
            repeated=_repeated(trials, set_, params),
            grid=axes,
            progress=lambda name, done, fresh: told(f"map: {done} machines"),
        )
    _serve(shown, address, port, browser=browser)


def _repeated(trials: int | None, settings: list[str] | None, params: Path | None) -> list[str]:
    """The options of this command that the command line of a page repeats."""
    given = {"trials": [trials], "set": settings or [], "params": [params]}
    return [
        word
        for name, values in given.items()
        for value in values
        if value is not None
        for word in (f"--{name}", str(value))
    ]


def _try_place(address: str, port: int) -> None:
    """Raise ValueError, before anything is compiled, where the page could not be served."""
    from tornado.netutil import bind_sockets

    try:
        for one in bind_sockets(port, address):
            one.close()
    except OSError as error:
        raise _refused(address, port, error) from None


def _refused(address: str, port: int, error: OSError) -> ValueError:
    return ValueError(
        f"--address {address} --port {port} cannot be used ({error.strerror}); --port 0 takes any "
        "port that is free"
    )


def _serve(shown, address: str, port: int, *, browser: bool) -> None:
    """Serve the page until Ctrl-C.

    Raises ValueError for an address or a port that cannot be used.
    """
    from bokeh.application import Application
    from bokeh.application.handlers.function import FunctionHandler
    from bokeh.server.server import Server

    try:
        server = Server({"/": Application(FunctionHandler(shown))}, address=address, port=port)
    except OSError as error:
        raise _refused(address, port, error) from None
    page = f"http://{address}:{server.port}/"
    out.print(f"{page} is the page; Ctrl-C ends it", highlight=False)
    server.start()
    if browser:
        server.io_loop.add_callback(server.show, "/")
    try:
        server.io_loop.start()
    except KeyboardInterrupt:
        server.stop()
