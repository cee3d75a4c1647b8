"""`jaxilc explore`: a page on this computer, whose sliders move weights and machines."""

from __future__ import annotations

import secrets
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from typer import Option

from .console import begin, out
from .options import Machines, OutFolder, Simulated, at_least
from .progress import working

if TYPE_CHECKING:
    import socket

    import xarray as xr

    from ..pytree.aliases import Value

LOOPBACK = "127.0.0.1"


def explore(
    what: Simulated,
    machines: Machines = 32,
    grid: list[str] | None = None,
    port: int = 5006,
    address: str = LOOPBACK,
    browser: Annotated[bool, Option("--browser/--no-browser")] = True,
    out_dir: OutFolder = None,
) -> None:
    """A page with sliders for weights, lead, cutoff and spread; the errors follow at once.

    They are those of the first scheme that learns. It runs on this computer only, until Ctrl-C.
    The weights found are saved as a file for --params. With --grid, or the folder of a grid for
    --params, it has a map; a click moves the sliders.

    port: Port of the page; 0 for any that is free.
    address: Address to listen on; others than this computer may then connect.
    browser: Open the page in a browser.

    Example: jaxilc explore cao-2019 --scheme ffdl-mfailc
    """
    at_least(1, machines=machines)
    if not 0 <= port <= 65535:
        raise ValueError(f"--port {port} is outside its allowed range [0, 65535]")
    for one in _place(address, port):  # before anything is compiled
        one.close()
    request = what.request()
    with working("explore") as told:
        begin()
        told("reading the scenario")
        chosen = request.scenario()
        from ..figures.explorer import explore as application
        from ..outcomes.request import open_grid
        from ..scenarios.from_file import load_scenario

        told("compiling")
        axes: dict[str, Value] | xr.Dataset | None = request.grid(grid, chosen) if grid else None
        if not grid and request.params and request.params.is_dir():
            axes = open_grid(request.params)
        shown = application(
            chosen,
            folder=out_dir or Path("out") / f"explore-{chosen.name}",
            machines=machines,
            source=request.source,
            repeated=request.repeated("run"),
            printed=load_scenario(request.source, chosen.options),
            grid=axes,
            progress=lambda name, done, fresh: told(f"map: {done} machines"),
        )
    _serve(shown, address, port, browser=browser)


def _place(address: str, port: int) -> list[socket.socket]:
    """The sockets of a page; raises ValueError where it cannot be served."""
    from tornado.netutil import bind_sockets

    if not address:  # which would be all addresses
        raise ValueError(f"--address {address!r} is no address; allowed is one of this computer")
    try:
        return bind_sockets(port, address)
    except (OSError, UnicodeError) as error:
        why = error.strerror if isinstance(error, OSError) else "no name of a computer"
        raise ValueError(
            f"--address {address} --port {port} cannot be used ({why}); --port 0 takes any port "
            "that is free"
        ) from None


def server_of(shown, address: str, port: int):
    """The server of a page, not started, and the address of the page."""
    from bokeh.application import Application
    from bokeh.application.handlers.function import FunctionHandler
    from bokeh.server.server import BaseServer
    from bokeh.server.tornado import BokehTornado
    from tornado.httpserver import HTTPServer
    from tornado.ioloop import IOLoop

    from .doors import Doors

    sockets = _place(address, port)
    page = f"{address}:{sockets[0].getsockname()[1]}"
    application = BokehTornado(
        {"/": Application(FunctionHandler(shown))},
        extra_websocket_origins=["*"],  # Doors has seen that the origin is the page's own
        sign_sessions=True,  # a token that this server did not give opens nothing
        secret_key=secrets.token_bytes(32),
    )
    http = HTTPServer(Doors(application, address))
    http.add_sockets(sockets)
    return BaseServer(IOLoop.current(), application, http), f"http://{page}/"


def _serve(shown, address: str, port: int, *, browser: bool) -> None:
    """Serve the page until Ctrl-C; raises as `server_of`."""
    import webbrowser

    server, page = server_of(shown, address, port)
    out.print(f"{page} is the page; Ctrl-C ends it")
    server.start()
    if browser:
        server.io_loop.add_callback(webbrowser.open, page)
    try:
        server.io_loop.start()
    except KeyboardInterrupt:
        server.stop()
