"""What a page of sliders computes is what the commands compute; its server keeps to itself."""

import asyncio
import dataclasses
import html
import http.server
import json
import queue
import re
import shlex
import socket
import threading
import time
import urllib.error
import urllib.request
from unittest import mock

import jax
import numpy as np
import pytest
from browser import looking_at, needs_chromium
from cases import first_order, follows, p_type
from command import done

from jaxilc import Machine, Sensor, Sweep, Task, learn, load_scenario
from jaxilc.cli.explore import LOOPBACK, _place, server_of
from jaxilc.figures.explorer import Exploration, Explorer, _computed
from jaxilc.filters.zero_phase import ZeroPhaseButterworth
from jaxilc.plants import StateSpace
from jaxilc.scenarios import Scenario
from jaxilc.scenarios.parameters import warn_of_another, with_parameters, write_parameters
from jaxilc.schemes import AtSamples, Filtered, Ladder, PIDType
from jaxilc.uncertainty import Normal, Uniform, draw, drawn_machine

DT, N, TRIALS = 1e-3, 60, 5


def axis() -> Scenario:
    plant = StateSpace([[0.9]], [[0.1]], [[1.0]], dt=DT)
    task = Task(np.sin(np.linspace(0, 2 * np.pi, N + 1)), dt=DT, unit="mm")
    ilc = Filtered(PIDType(gamma_p=0.8, lead=2), ZeroPhaseButterworth(cutoff=100.0, order=2))
    return Scenario(
        "axis", "an axis", Machine(plant), task, {"ilc": ilc}, TRIALS,
        {"plant.B": Uniform(0.9, 1.1, relative=True)}, shown_scale=1e3, shown_unit="µm",
        judged_by="rms",
    )  # fmt: skip


@pytest.fixture(scope="module")
def explored() -> Exploration:
    return Exploration(axis(), machines=4, source="axis.toml")


@pytest.mark.thorough
def test_a_slider_gives_what_learning_gives(explored):
    """The errors of each machine are those of `learn` on this machine alone."""
    found = explored.outcome({"scheme.gamma_p": 0.5}, 0.2)
    s, law = explored.scenario, explored.scheme_with({"scheme.gamma_p": 0.5})
    wide = {"plant.B": Uniform(0.8, 1.2, relative=True)}
    drawn = draw(s.machine, wide, 4, sampling="sobol")
    for i in (0, 3):
        machine = drawn_machine(s.machine, wide, {"plant.B": drawn["plant.B"][i]})
        alone = learn(machine, law, s.task, TRIALS)
        np.testing.assert_allclose(found.errors[i], 1e3 * np.asarray(alone.rms)[:, 0], rtol=1e-9)
    np.testing.assert_allclose(found.e, 1e3 * (found.r - found.y))
    # Q and L in closed form: a lead of 2 and the one sample of the plant's own delay
    z = np.exp(2j * np.pi * found.f * DT)
    P = 0.1 / (z - 0.9)
    low = found.f < 20.0  # where Q is 1
    np.testing.assert_allclose(found.size[0, low], np.abs(1 - 0.5 * z**3 * P)[low], atol=2e-3)


@pytest.mark.thorough
def test_a_resonance_between_the_frequencies_of_the_page_is_not_called_safe(tmp_path):
    """A mode of a width of 2 mHz lies between two lines, at which |Q - L P| is below 1."""
    z = np.exp(2j * np.pi * DT * 30.05)
    a, b = (1 - 1e-5) * z.real, (1 - 1e-5) * z.imag
    A, B, C = [[0.9, 0, 0], [0, a, -b], [0, b, a]], [[0.1], [1e-4], [0]], [[1.0, 1, 0]]
    machine = Machine(StateSpace(A, B, C, dt=DT))
    s = dataclasses.replace(axis(), machine=machine, uncertainty={})
    page = Explorer(Exploration(s, machines=1), tmp_path)
    assert np.max(page.size.data["size"]) < 1
    P = C @ np.linalg.solve(z * np.eye(3) - A, B)
    assert 0.98 * abs(1 - 0.8 * z**3 * P) > 1  # Q is 0.99 at 30 Hz
    assert "at 240 frequencies: 0." in page.told.text


@pytest.mark.thorough
def test_moving_a_weight_compiles_nothing(explored):
    explored.outcome({"scheme.gamma_p": 0.4}, 0.15)
    before = _computed._cache_size()
    for gain, cutoff, spread in ((0.3, 50.0, 0.1), (0.7, 80.0, 0.3)):
        explored.outcome({"scheme.gamma_p": gain, "filter.cutoff": cutoff}, spread)
    assert _computed._cache_size() == before
    with pytest.raises(ValueError, match="gamma_p"):
        explored.outcome({"scheme.gamma_p": float("nan")})


def test_of_a_slider_that_moves_on_the_last_value_is_answered(explored, tmp_path, monkeypatch):
    """While the first value is computed the slider passes three others: only the last counts."""
    from bokeh.document import Document

    page, document, computed = Explorer(explored, tmp_path), Document(), []
    document.add_root(page.layout())
    slider, outcome = page.sliders["scheme.gamma_p"], Exploration.outcome

    def slowly(self, values, spread=None, *, alone=False):
        computed.append((round(values["scheme.gamma_p"], 6), alone))
        for gain in (0.5, 0.4, 0.3) if len(computed) == 1 else ():
            slider.value = np.log10(gain) if slider.start < 0 else gain
        return outcome(self, values, spread, alone=alone)

    monkeypatch.setattr(Exploration, "outcome", slowly)
    monkeypatch.setattr("jaxilc.figures.explorer.LATEST", 1e9)
    monkeypatch.setattr(Document, "add_next_tick_callback", lambda self, work: work())
    page.asked, page.busy = 1, True
    asyncio.run(page._answer())
    assert computed == [(0.8, True), (0.3, True), (0.3, False)]
    assert not page.busy
    found = outcome(explored, {"scheme.gamma_p": 0.3})
    np.testing.assert_allclose(page.errors.data["nominal"], found.errors[0], rtol=1e-6)
    np.testing.assert_allclose(page.errors.data["worst"], found.errors.max(axis=0), rtol=1e-6)


def test_a_click_on_the_map_moves_the_sliders_there_and_the_error_is_that_of_the_map(tmp_path):
    """The map comes from `Sweep`, the errors from the page: at each point they are the same."""
    grid = {"ilc.scheme.gamma_p": [0.01, 0.2, 900.0], "plant.A[0][0]": [0.9, 0.95]}
    explored = Exploration(
        axis(), machines=4, source="axis.toml", grid=grid, repeated=("--trials", "5")
    )
    page = Explorer(explored, tmp_path)
    points, of_machine = page.map.points, "machine.plant.A[0][0]"
    assert page.layout() is not None
    assert points.data["t2"][4:].tolist() == ["diverged"] * 2
    for i in (1, 2, 5, 0):
        points.selected.indices = [i]
        at = page.map.at(i)
        assert page.values() == pytest.approx(
            page.values() | {"scheme.gamma_p": at["ilc.scheme.gamma_p"], of_machine: at[of_machine]}
        )
        assert page.here.data == {"x": [pytest.approx(at["ilc.scheme.gamma_p"])],
                                  "y": [pytest.approx(at[of_machine])]}  # fmt: skip
        found = explored.outcome(page.values()).errors[:, -1]
        shown = points.data["value"][i] / page.map.factor * 1e3
        assert np.isinf(found.max()) == np.isnan(shown) == (i == 5)
        np.testing.assert_allclose(found.max(), np.nan_to_num(shown, nan=np.inf), rtol=1e-6)
        assert points.selected.indices == []  # the same cell can be clicked again
    page.sliders["scheme.gamma_p"].value = 0.0
    points.selected.indices = [0]
    points.selected.indices = []  # a click beside the map moves nothing
    assert page.here.data["x"] == [pytest.approx(0.01)]
    assert explored.command(page.values() | {of_machine: 0.95}) == (
        "jaxilc run axis.toml --scheme ilc --trials 5 --set ilc.scheme.gamma_p=0.01 --set "
        "'machine.plant.A[0][0]=0.95'"
    )


def test_noise_differs_from_machine_to_machine_and_is_that_of_the_map(explored, tmp_path):
    """`Sweep` computes the map: at its points the sliders have the error of each machine."""
    machine = dataclasses.replace(axis().machine, sensor=Sensor(noise=0.05))
    s = dataclasses.replace(axis(), machine=machine, uncertainty={})
    noisy = Exploration(s, machines=6, grid={"ilc.scheme.gamma_p": [0.2, 0.6]})
    for gain in (0.2, 0.6):
        found = noisy.outcome({"scheme.gamma_p": gain}).errors
        at = noisy.map[0].sel({"scheme": "ilc", "ilc.scheme.gamma_p": gain})
        np.testing.assert_allclose(found, 1e3 * at.rms.values, rtol=1e-6)
        assert len(np.unique(found[:, -1])) == 6
    page, quiet = Explorer(noisy, tmp_path), Explorer(explored, tmp_path)
    assert np.all(page.errors.data["high"] > page.errors.data["low"])
    assert "that of a sweep; run draws another" in page.told.text
    assert "run draws" not in quiet.told.text
    for one in (page, quiet):
        assert [len(of) for of in one.errors.data.values()] == [TRIALS] * 5


def test_an_axis_that_no_slider_moves_is_refused_before_the_sweep():
    for name, values in {"task.settle": [None, (0.01, 0.02)], "trials": [2, 3]}.items():
        with pytest.raises(ValueError, match=f"no slider can move the axis {name}"):
            Exploration(axis(), machines=2, grid={name: values})


def test_a_stored_map_needs_the_scenario_to_be_at_its_other_axes():
    s = axis()
    sweep = Sweep(
        s.machine, s.schemes, s.task, 2, machines=1, uncertainty={},
        grid={"trials": [1, 2], "ilc.scheme.gamma_p": "0.1:0.9:3", "plant.A[0][0]": "0.8:0.9:3"},
    )  # fmt: skip
    grid = sweep.run()
    at_best = dataclasses.replace(s, trials=2)
    assert Exploration(at_best, machines=1, grid=grid).map is not None
    with pytest.raises(ValueError, match="no slider can move the axis trials"):
        Exploration(s, machines=1, grid=grid)
    with pytest.raises(ValueError, match="the grid has no scheme 'ilc'"):
        Exploration(at_best, machines=1, grid=grid.assign_coords(scheme=["other"]))
    point = {"trials": [1], "ilc.scheme.gamma_p": [0], "machine.plant.A[0][0]": [0]}
    with pytest.raises(ValueError, match="no axis of a grid with several values"):
        Exploration(at_best, machines=1, grid=grid.isel(point))


def test_what_was_found_can_be_shared(explored, tmp_path):
    values = {control.path: control.value for control in explored.controls}
    assert {"scheme.gamma_p", "scheme.lead", "filter.cutoff"} <= set(values)
    assert explored.changed(values) == {}
    values["scheme.gamma_p"], values["scheme.lead"] = 0.25, 3
    assert explored.command(values, 0.2) == (
        "jaxilc sweep axis.toml --scheme ilc --set ilc.scheme.gamma_p=0.25 "
        "--set ilc.scheme.lead=3 --spread 0.2"
    )
    path = explored.save(values, tmp_path / "new" / "params.json")
    law = with_parameters(explored.scenario, path).schemes["ilc"]
    assert jax.tree.all(jax.tree.map(np.array_equal, law, explored.scheme_with(values)))


def test_the_file_of_a_page_holds_what_was_set_before_it_was_opened(tmp_path, monkeypatch):
    file, found = tmp_path / "axis.toml", tmp_path / "found.json"
    file.write_text(f"{first_order()}{follows(50.0, 0.02)}{p_type(0.5)}")
    write_parameters(found, "axis", {"ilc": {"gamma_p": 0.7, "leak": 0.1}}, {})

    def page(*of, folder, progress, **how):
        return Exploration(*of, **how)

    monkeypatch.setattr("jaxilc.figures.explorer.explore", page)
    with mock.patch("jaxilc.cli.explore._serve") as served:
        done("explore", file, "--params", found, "--set", "ilc.lead=1", "--port", "0")
    served.call_args.args[0].save({"gamma_p": 0.3}, tmp_path / "params.json")
    law = with_parameters(load_scenario(file), tmp_path / "params.json").schemes["ilc"]
    assert (law.gamma_p, law.leak, law.lead) == (0.3, 0.1, 1)


def test_what_the_parameter_file_leaves_out_is_told_beside_it(tmp_path):
    s, moved = axis(), "machine.plant.B[0][0]"
    page = Explorer(Exploration(s, machines=4, grid={"plant.B[0][0]": [0.1, 0.2]}), tmp_path)
    page._save()
    assert page.told.text == f"written: {tmp_path / 'params.json'}, for --params"
    slider = page.sliders[moved]
    slider.value = np.log10(0.2) if slider.start < 0 else 0.2
    page.spread.value = 20.0
    page._save()
    said = html.unescape(page.told.text).partition("; beside it ")[2].partition(", which")[0]
    of_file = with_parameters(s, tmp_path / "params.json")
    with pytest.warns(RuntimeWarning, match="another machine: plant.B: .*0.2.* there, .*0.1"):
        warn_of_another(s, tmp_path / "params.json")
    warn_of_another(s.with_values({moved: 0.2}), tmp_path / "params.json", [moved])
    assert np.asarray(of_file.machine.plant.B).item() == 0.1
    words = shlex.split(said)
    assert words == ["--set", f"{moved}=0.2", "--spread", "0.2"]
    path, _, value = words[1].partition("=")
    assert np.asarray(of_file.with_values({path: value}).machine.plant.B).item() == 0.2


@pytest.fixture
def serving(explored, tmp_path):
    """The page's server, which runs beside the test, and its address."""
    from tornado.ioloop import IOLoop

    found, ready = {}, threading.Event()

    def application(document):
        document.add_root(Explorer(explored, tmp_path).layout())

    def serve():
        asyncio.set_event_loop(asyncio.new_event_loop())
        server, _ = found["both"] = server_of(application, LOOPBACK, 0)
        found["loop"] = IOLoop.current()
        server.start()
        ready.set()
        found["loop"].start()
        server.unlisten()
        server.stop()

    thread = threading.Thread(target=serve)
    thread.start()
    assert ready.wait(30)
    yield found["both"]
    found["loop"].add_callback(found["loop"].stop)
    thread.join()


def test_the_page_is_served_on_this_computer_and_loads_nothing_else(serving):
    """The page, asked for over HTTP, names no other site; another address is not listened on."""
    with urllib.request.urlopen(serving[1], timeout=60) as page:
        text = page.read().decode()
    assert "https://" not in text.replace("https://github.com", "")
    assert text.count("<script") >= 2
    assert socket.inet_aton(LOOPBACK)[0] == 127


def test_an_empty_address_does_not_open_the_page_to_all():
    with pytest.raises(ValueError, match="--address '' is no address"):
        _place("", 0)


def test_another_host_another_page_and_a_token_that_was_used_get_no_answer(serving):
    """A page elsewhere whose name points here gets neither the page nor a websocket."""
    served = serving[1]
    here = served.removeprefix("http://").rstrip("/")
    port = here.rpartition(":")[2]

    def asked(**headers):
        request = urllib.request.Request(served, headers=headers)
        try:
            with urllib.request.urlopen(request, timeout=60) as page:
                return page.status, page.read().decode()
        except urllib.error.HTTPError as error:
            with error:
                return error.code, error.read().decode()

    for host in (f"evil.example:{port}", "evil.example", "127.0.0.1.evil.example", "192.0.2.1", ""):
        assert asked(Host=host) == (403, "this is not an address of this page")
    for origin in (f"http://evil.example:{port}", "null", f"http://localhost:{port}"):
        assert asked(Origin=origin) == (403, "another page may not ask this one")
    assert asked(Host=f"localhost:{port}", Origin=f"http://localhost:{port}")[0] == 200
    framed = {"Sec-Fetch-Site": "cross-site", "Sec-Fetch-Dest": "iframe"}
    assert asked(**framed) == (403, "another page may not ask this one")
    assert asked(**framed | {"Sec-Fetch-Dest": "document"})[0] == 200  # a link to the page
    token = re.search(r'"token":"([^"]*)"', asked()[1])[1]

    def opens(origin, host=here):
        with socket.create_connection((LOOPBACK, int(port)), timeout=60) as line:
            lines = [
                "GET /ws HTTP/1.1", f"Host: {host}", "Upgrade: websocket", "Connection: Upgrade",
                "Sec-WebSocket-Version: 13", "Sec-WebSocket-Key: AAAAAAAAAAAAAAAAAAAAAA==",
                f"Sec-WebSocket-Protocol: bokeh, {token}",
                *([f"Origin: {origin}"] if origin else []),
            ]  # fmt: skip
            line.sendall("\r\n".join([*lines, "", ""]).encode())
            return int(line.recv(4096).split()[1])

    evil = f"evil.example:{port}"
    assert opens(f"http://{evil}", evil) == opens(f"http://{evil}") == opens("") == 403
    assert opens(f"http://{here}") == 101
    assert opens(f"http://{here}") == 403  # each token once


# What a page elsewhere tries with a token that it should not have; it reports what opened.
ATTACK = """<body><script>
const said = {}
const tried = [
  ...["127.0.0.1", "evil.example", "localhost"].map(host => new Promise(done => {
    const line = new WebSocket(`ws://${host}:PORT/ws`, ["bokeh", "TOKEN"])
    line.onopen = () => { said["socket of " + host] = true; done() }
    line.onerror = () => { said["socket of " + host] = false; done() }
  })),
  ...["127.0.0.1", "evil.example"].map(host => new Promise(done => {
    const script = document.createElement("script")
    script.src = `http://${host}:PORT/autoload.js?bokeh-autoload-element=x`
    script.onload = () => { said["script of " + host] = true; done() }
    script.onerror = () => { said["script of " + host] = false; done() }
    document.body.append(script)
  })),
]
Promise.all(tried).then(() => fetch("/said", {method: "POST", body: JSON.stringify(said)}))
</script></body>"""


@needs_chromium
def test_in_a_browser_only_the_page_itself_reaches_its_server(serving, tmp_path):
    """A page of a second origin, with a good token, opens no websocket and gets no script."""
    server, page = serving
    with urllib.request.urlopen(page, timeout=60) as answer:
        token = re.search(r'"token":"([^"]*)"', answer.read().decode())[1]
    text = ATTACK.replace("PORT", page.rstrip("/").rpartition(":")[2]).replace("TOKEN", token)
    said: queue.Queue = queue.Queue()

    class Elsewhere(http.server.BaseHTTPRequestHandler):
        def do_GET(self):
            self.send_response(200)
            self.send_header("Content-Type", "text/html")
            self.end_headers()
            self.wfile.write(text.encode())

        def do_POST(self):
            said.put(json.loads(self.rfile.read(int(self.headers["Content-Length"]))))
            self.send_response(204)
            self.end_headers()

        def log_message(self, *args):
            pass

    with http.server.ThreadingHTTPServer((LOOPBACK, 0), Elsewhere) as other:
        threading.Thread(target=other.serve_forever).start()
        evil = f"http://evil.example:{other.server_port}/"
        with looking_at(evil, tmp_path, "--host-resolver-rules=MAP evil.example 127.0.0.1"):
            opened = said.get(timeout=60)
        other.shutdown()
    assert len(opened) == 5
    assert not any(opened.values()), opened
    assert [s.connection_count for s in server.get_sessions("/")] == [0]
    with looking_at(page, tmp_path):  # the page itself opens its websocket
        until = time.monotonic() + 60
        while time.monotonic() < until and not any(
            s.connection_count for s in server.get_sessions("/")
        ):
            time.sleep(0.1)
    assert len(server.get_sessions("/")) == 2
    assert not (tmp_path / "params.json").exists()


def test_the_ends_of_a_slider_are_those_of_the_server(explored, tmp_path):
    page = Explorer(explored, tmp_path)
    control = next(c for c in explored.controls if c.log)
    slider = page.sliders[control.path]
    slider.end = 400.0
    slider.value = 399.0
    assert page.values()[control.path] == pytest.approx(control.high)
    slider.start = -400.0
    slider.value = -399.0
    assert page.values()[control.path] == pytest.approx(control.low)
    page.spread.end = 1e6
    page.spread.value = 1e6
    assert page.spread_asked() == pytest.approx(0.6)


def test_a_machine_without_an_error_is_one_of_the_band(explored, tmp_path):
    """Of four machines the 5 and 95 % are the least and the largest; a log axis has no zero."""
    page, gone = Explorer(explored, tmp_path), np.inf
    errors = np.array([[4.0, 2, 1, 0, gone], [8, 4, 0, 0, gone], [8, 1, 0, 0, 3], [9, 5, 3, 0, 1]])
    page._show(explored.outcome({})._replace(errors=errors))
    shown = page.errors.data
    np.testing.assert_array_equal(shown["nominal"], [4, 2, 1, np.nan, np.nan])
    np.testing.assert_array_equal(shown["worst"], [9, 5, 3, np.nan, np.nan])
    np.testing.assert_array_equal(shown["low"], [4, 1, 1, 1, 1])
    np.testing.assert_array_equal(shown["high"], [9, 5, 3, 1, 9e3])
    assert page.told.text.startswith("last trial: diverged; worst of 4: diverged")
    page._show_errors(errors[:1] / 2)
    np.testing.assert_array_equal(page.errors.data["nominal"], [2, 1, 0.5, np.nan, np.nan])
    np.testing.assert_array_equal(page.errors.data["low"], [4, 1, 1, 1, 1])


def test_the_last_trial_shows_the_largest_error_of_every_output(tmp_path):
    """Of 5001 samples one is not at rest; the second output is 30 times the first."""
    r = np.zeros((5001, 2))
    r[[1234, 1235]] = [1.0, 0.0], [0.0, 30.0]
    task = Task(r, dt=DT, unit="mm", names=("x", "y"))
    plant = StateSpace(np.zeros((2, 2)), np.eye(2), np.eye(2), dt=DT)
    s = dataclasses.replace(
        axis(), machine=Machine(plant), task=task, schemes={"ilc": PIDType(gamma_p=0.5)}
    )
    page = Explorer(Exploration(s, machines=1), tmp_path)
    of = page.signals.data
    assert len(of["t"]) == len(of["e_0"]) < 2000
    assert page.unit_of_e == "mm"
    last = 0.5 ** (TRIALS - 1)  # each trial takes half of the error away
    for c, height in enumerate((1.0, 30.0)):
        for name, value in (("e", height * last), ("r", height), ("y", height * (1 - last))):
            assert np.max(np.abs(of[f"{name}_{c}"])) == pytest.approx(value, rel=1e-6)
        at = of["t"][np.argmax(of[f"e_{c}"])]
        assert at == pytest.approx(1.2345, abs=0.01)
    *_, track, error = page.figures
    for one in (track, error):
        assert [item.label.value for item in one.legend[0].items] == ["x", "y"]


@pytest.mark.parametrize(
    ("of", "shown"),
    [
        (Uniform(0.2, 1.8, relative=True), 80.0), (Uniform(0.5, 0.9, relative=True), 50.0),
        (Uniform(0.997, 1.003, relative=True), 0.3), (Normal(1.0, 0.05, relative=True), 10.0),
    ],
)  # fmt: skip
def test_a_spread_is_shown_as_it_is_and_stays_until_its_slider_is_moved(of, shown, tmp_path):
    wide = dataclasses.replace(axis(), uncertainty={"plant.B": of})
    page = Explorer(Exploration(wide, machines=4, source="axis.toml"), tmp_path)
    assert (page.spread.value, page.spread_asked()) == (pytest.approx(shown), None)
    assert "--spread" not in page.line.text
    for moved in (60.0, 1.0):
        page.spread.value = moved
        assert page.spread_asked() == pytest.approx(moved / 100)


def test_the_page_offers_nothing_that_is_refused(tmp_path):
    """The slider of a leak in [0, 1) ended at 1, and that of a spread from 50 to 150 % at 150."""
    uneven = {"plant.B": Uniform(0.5, 2.5, relative=True)}
    s = dataclasses.replace(axis(), schemes={"ilc": PIDType(gamma_p=0.5)}, uncertainty=uneven)
    page = Explorer(Exploration(s, machines=2), tmp_path)
    for path in ("leak", "gamma_p"):
        for end in (page.sliders[path].start, page.sliders[path].end):
            page.of.scheme_with({path: end}).check(s.task)
    assert page.sliders["leak"].end > 0.99
    assert page.spread is None


def test_a_cutoff_beyond_its_slider_is_shown_as_it_is(tmp_path):
    s = axis().with_values({"ilc.filter.cutoff": 495.0})
    page = Explorer(Exploration(s, machines=1, source="axis.toml"), tmp_path)
    assert page.values()["filter.cutoff"] == pytest.approx(495.0, rel=1e-12)
    assert "--set" not in page.line.text


@pytest.mark.parametrize(
    "law",
    [
        AtSamples(PIDType(gamma_p=30.0, leak=0.2), windows=((0.01, 0.02),)),
        Ladder(PIDType(gamma_p=30.0), repeats=3),
    ],
)
def test_a_law_without_a_frequency_response_has_none_on_the_page(law, tmp_path):
    """The page told 0.8 and 0, below 1, of these, by the middle of the trial and by one trial."""
    s = dataclasses.replace(axis(), schemes={"ilc": law}, uncertainty={}, trials=30)
    page = Explorer(Exploration(s, machines=1), tmp_path)
    assert page.told.text == "last trial: diverged"
