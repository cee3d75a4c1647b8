"""These tests check what the command line prints, writes and refuses.

They also kill a sweep with SIGKILL and resume it.
"""

import contextlib
import dataclasses
import inspect
import io
import itertools
import json
import os
import re
import shlex
import signal
import subprocess
import sys
import time
import warnings
from functools import partial
from types import SimpleNamespace

import numpy as np
import pytest
import xarray as xr
from cases import follows, known_to, p_type
from command import call, done, flat, mistakes, refused, write_columns
from rich.console import Console
from rich.text import Text
from typer.main import get_command
from typer.testing import CliRunner

import jaxilc
from jaxilc import outcomes
from jaxilc.cli import app, console, main, present, progress
from jaxilc.cli.entry import WITHOUT_DOCSTRINGS
from jaxilc.cli.hardware import OF_CAMPAIGN
from jaxilc.cli.options import DESIGN, MACHINE, PROVE, SIMULATE, Pages
from jaxilc.outcomes import Request, demonstrating, running, sweeping
from jaxilc.outcomes.certifying import watched_numbers
from jaxilc.pytree import replaced, settable
from jaxilc.scenarios import LISTED, identified_file
from jaxilc.scenarios.from_file import read_scenario
from jaxilc.scenarios.identified_file import StartingLaw
from jaxilc.sweeps import Sweep, host
from jaxilc.theory.bounds import frozen_growth

PLANT = f"""[plant]
kind = "transfer_function"
num = [3.0]
den = [1.0, 30.0]
[task]
dt = 0.001
{follows(10.0, 0.1)}"""
LEARNER = p_type(0.5)
PLAIN = {
    name: value
    for name, value in os.environ.items()
    if name not in ("FORCE_COLOR", "PY_COLORS", "GITHUB_ACTIONS", "NO_COLOR", "COLUMNS")
}
PROGRAM = (sys.executable, "-m", "jaxilc")
COLOUR = re.compile("\x1b\\[[0-9;]*3[0-7]")
pytestmark = pytest.mark.usefixtures("compiled_once", "unpainted")


def test_a_warning_of_the_library_is_one_line(monkeypatch, capsys):
    monkeypatch.setattr(warnings, "showwarning", warnings.showwarning)  # which main exchanges
    monkeypatch.setattr(sys, "argv", ["jaxilc", "--version"])
    with pytest.raises(SystemExit):
        main()
    warnings.showwarning(RuntimeWarning("one\ntwo"), RuntimeWarning, "file.py", 3)
    assert capsys.readouterr().err == "warning: one two\n"


def test_list_names_scenarios_and_all_that_can_be_set(here):
    out = done("list")
    assert "cao-2019" in out
    out = done("list", "cao-2019")
    for path in ("plant.poles", "ffdl-mfailc.phi0", "pid.form", "reference"):
        assert path in out
    flat = re.sub(r"\s", "", out)
    assert all(path in flat for path in settable(jaxilc.scenarios.load("cao-2019").machine))


def test_run_prints_ours_beside_the_published_and_writes_everything(here, tmp_path):
    asked = ("run", "cao-2019", "--trials", 40, "--scheme", "cfdl-mfailc", "--set", "plant=exact")
    out = done(*asked, "--out", "here", "--report", "here/run.json")
    assert "17.5 (18)" in out
    assert (
        "3 of 4 published numbers are met within 30 %: simulated is plant=exact. The paper is "
        "judged with --set plant=printed. "
        "jaxilc reproduce cao-2019 says how each number was read."
    ) in flat(out)
    numbers = json.loads((tmp_path / "here/run.json").read_text())
    of_scheme = numbers["schemes"]["cfdl-mfailc"]
    dataset = xr.open_zarr(tmp_path / "here/dataset.zarr", consolidated=False, chunks=None)
    np.testing.assert_allclose(
        of_scheme["settled_error"]["20"],
        1e3 * dataset["settled_error"].sel(scheme="cfdl-mfailc", trial=20)[0],
    )
    by_hand = np.abs(dataset["e"].sel(scheme="cfdl-mfailc", trial=20).values[1000:]).max()
    np.testing.assert_allclose(of_scheme["settled_error"]["20"], 1e3 * by_hand)
    assert [p["ours"] is None for p in of_scheme["published"] if p["trial"] == 50] == [True]
    for name in ("error-by-trial.png", "tracking-cfdl-mfailc.png"):
        assert (tmp_path / "here" / name).exists()


@pytest.mark.thorough
def test_settings_of_every_kind_reach_the_numbers_of_a_report(here, tmp_path):
    """An option of the scenario, a static field, a choice, an array and a number."""
    own = {"L_y": 1, "reset": "sign", "phi0": (0.5, -0.06, 0.0)}
    given = {"plant": "exact", "plant.gain": 7e3} | {f"ffdl-mfailc.{n}": v for n, v in own.items()}
    flags = [part for name, value in given.items() for part in ("--set", f"{name}={value}")]
    done("run", "cao-2019", "--scheme", "ffdl-mfailc", "--trials", 3, "--report", "a.json", *flags)
    s = jaxilc.scenarios.load("cao-2019", plant="exact")
    machine = replaced(s.machine, {"plant.gain": 7e3})
    law = dataclasses.replace(s.schemes["ffdl-mfailc"], **own)
    printed = json.loads((tmp_path / "a.json").read_text())["schemes"]["ffdl-mfailc"]["rms"]["3"]
    assert printed == pytest.approx(1e3 * jaxilc.learn(machine, law, s.task, 3).rms[-1, 0])


def test_sweep_prints_the_yield_and_resumes(here, tmp_path):
    sweep = (
        "sweep", "cao-2019", "--scheme", "cfdl-mfailc", "--trials", 3, "--machines", 8, "--spread",
        0.2, "--report", "sweep.json",
    )  # fmt: skip
    code, out, err = call("--verbose", *sweep, "--tolerance", 640)
    assert code == 0
    assert "8 machines" in out
    stages = ", ".join(rf"{name} ([\d.]+) s" for name in ("start", "compiling", "files", "figures"))
    told = re.search(rf"([\d.]+) s in compiled code, (\d+)% of ([\d.]+) s; {stages}", err)
    computing, share, whole, *rest = map(float, told.groups())
    assert computing + sum(rest) == pytest.approx(whole, abs=0.05)
    assert share == pytest.approx(100 * computing / whole, abs=1)
    numbers = json.loads((tmp_path / "sweep.json").read_text())
    dataset = jaxilc.open_dataset(tmp_path / "out/sweep-cao-2019/dataset.zarr")
    errors = 1e3 * dataset["settled_error"].sel(scheme="cfdl-mfailc", trial=3)
    assert numbers["schemes"]["cfdl-mfailc"]["yield"] == float((errors <= 640).mean())
    assert 0 < numbers["schemes"]["cfdl-mfailc"]["yield"] < 1
    assert float(abs(dataset["plant.gain"] - 1).max()) > 0.1
    assert "--resume" in refused(*sweep)
    by_its_old_name = ["--samples" if word == "--machines" else word for word in sweep]
    assert call(*by_its_old_name, "--resume")[0] == 0


@pytest.mark.thorough
def test_a_grid_is_told_at_its_best_point(here, tmp_path):
    gain = jaxilc.scenarios.load("cao-2019").machine.plant.gain
    grid = ["--grid", f"plant.gain={0.5 * gain}:{gain}:3", "--grid", "reading=stroke,amplitude"]
    sweep = ("sweep", "cao-2019", "--scheme", "cfdl-mfailc", "--trials", 3, "--machines", 4)
    files = ("--report", "grid.json", "--report", "grid.html")
    out = done(*sweep, *grid, *files)
    dataset = jaxilc.open_dataset(tmp_path / "out/sweep-cao-2019/dataset.zarr")
    assert dataset["rms"].dims[1:3] == ("machine.plant.gain", "reading")
    best = json.loads((tmp_path / "grid.json").read_text())["grid"]["best"]["cfdl-mfailc"]
    errors = dataset["settled_error"].sel(scheme="cfdl-mfailc", trial=3)
    of_points = np.sort(errors.values, axis=-1)[..., -1]  # of 4 machines, 95 % are all
    np.testing.assert_allclose(best["error"], 1e3 * of_points.min(), rtol=1e-12)
    at = errors.sel(best["point"]).max()
    np.testing.assert_allclose(best["error"], 1e3 * float(at), rtol=1e-12)
    assert f"cfdl-mfailc has its least error at machine.plant.gain = {gain:.4g}" in out.replace(
        "\n", " "
    )
    assert "No machine diverges at any point." in out
    assert (tmp_path / "out/sweep-cao-2019/grid.png").exists()
    assert "grid.png" in out
    assert f"--set reading={best['point']['reading']}" in out


def test_the_sample_steps_of_a_grid_are_those_of_each_point(here, tmp_path):
    of, grid = Request("cao-2019", ("pid",), ("frequency=50",)), "trials=2,5"
    found = outcomes.sweep(of, machines=2, grid=grid, folder=tmp_path)
    assert found.numbers["sample_steps"] == 2 * (2 + 5) * 20


def test_bounds_over_a_grid_have_a_map(here, tmp_path, monkeypatch):
    monkeypatch.setattr(sweeping, "SIGMA_STEPS", 4)
    grid = ("cfdl-mfailc.lam=0.5,2", "cfdl-mfailc.mu=1,3")
    axes = [word for axis in grid for word in ("--grid", axis)]
    sweep = ("sweep", "cao-2019", "--scheme", "cfdl-mfailc", "--set", "frequency=50", *axes)
    sweep = (*sweep, "--trials", 3, "--machines", 2, "--bounds")
    out = done(*sweep, "--json", "b.json")
    assert "cfdl-mfailc at all points: the bound of Cao 2019" in flat(out)
    numbers = json.loads((tmp_path / "b.json").read_text())
    best, last = (of["cfdl-mfailc"] for of in (numbers["grid"]["best"], numbers["schemes"]))
    assert best["error"] == last["by_trial"]["3"]["high"]
    one, whole = (of["bounds"]["cfdl-mfailc"] for of in (numbers, numbers["grid"]))
    assert one["premises"]["lam > b^2 / 4"] == {"held": 2, "share_broken": 0.0}
    assert whole["premises"]["lam > b^2 / 4"] == {"held": 8, "share_broken": 0.0}
    assert whole["bound"] == {"holds": 0, "fails": 0, "not claimed": 8}
    assert all(of["share_broken"] <= 1 for of in whole["premises"].values())
    folder = tmp_path / "out/sweep-cao-2019"
    assert (folder / "contraction.png").exists()
    nominal = jaxilc.open_dataset(folder / "nominal.zarr")
    assert nominal.sizes["sample"] == 1
    of = jaxilc.scenarios.load("cao-2019", frequency=50)
    law = dataclasses.replace(of.schemes["cfdl-mfailc"], lam=0.5)
    growth = frozen_growth(of.machine, law, of.task, steps=4).value
    np.testing.assert_allclose(nominal["sigma_max"].isel(scheme=0)[0], growth, rtol=1e-9)
    request = Request("cao-2019", ("cfdl-mfailc",), ("frequency=50",), trials=3)
    again = outcomes.sweep(request, machines=2, grid=grid, bounds=True, folder=folder, resume=True)
    assert again.numbers["sample_steps"] == 0
    assert again.numbers["grid"]["bounds"] == numbers["grid"]["bounds"]


@pytest.mark.parametrize("trials", [("--trials", 1), ("--grid", "trials=3,1")])
def test_bounds_need_a_second_trial(here, trials):
    sweep = ("sweep", "cao-2019", "--scheme", "cfdl-mfailc", "--bounds", "--machines", 2)
    said = refused(*sweep, *trials)
    assert "--trials 1 is outside its allowed range [2, inf) with --bounds" in said


def test_sweep_tells_the_bounds_beside_the_contraction(here, tmp_path):
    arguments = ["--scheme", "cfdl-mfailc", "--scheme", "ffdl-mfailc", "--set", "frequency=50"]
    sweep = ("sweep", "cao-2019", *arguments, "--trials", 3, "--machines", 4, "--report", "s.json")
    out = done(*sweep, "--bounds")
    assert "it was claimed on none of 4 machines" in flat(out)
    dataset = jaxilc.open_dataset(tmp_path / "out/sweep-cao-2019/dataset.zarr")
    bounds = json.loads((tmp_path / "s.json").read_text())["bounds"]
    compact, full = bounds["cfdl-mfailc"], bounds["ffdl-mfailc"]
    assert compact["bound"] == {"holds": 0, "fails": 0, "not claimed": 4}
    assert compact["premises"]["lam > b^2 / 4"] == {"held": 4, "share_broken": 0.0}
    assert compact["premises"]["y(k+1) depends on u(k) alone"]["held"] == 0
    d2 = dataset["d2"].sel(scheme="cfdl-mfailc")
    assert compact["d2"] == [float(d2.min()), float(d2.median()), float(d2.max())]
    assert compact["left_out"][0] > 0.99
    norm = dataset["contraction_norm"].sel(scheme="cfdl-mfailc").isel(trial=slice(1, None))
    assert compact["norm"][0] == pytest.approx(float(norm.median("trial").median()))
    assert compact["growing"] == float((norm > 1).mean())
    still = dataset.assign(contraction_norm=np.nan * dataset["contraction_norm"])
    one = jaxilc.scenarios.load("cao-2019").select(("cfdl-mfailc",))
    assert np.isnan(watched_numbers(one, still)["cfdl-mfailc"]["growing"]), "of no error at all"
    assert full["d2"] is None, "the paper proves nothing of its error"
    assert full["left_out"][2] < 0.01
    assert "watch" in refused(*sweep, "--resume"), "a store without bounds is another sweep"


@pytest.mark.parametrize(
    ("words", "message"),
    mistakes("""
run cao => scenario = 'cao' is unknown; did you mean cao-2019 or cao-2019-rig?
run cao-2019 --scheme ilc => scheme = 'ilc' is unknown; did you mean cfdl-mfailc or pfdl-mfailc \
or ffdl-mfailc? Known: pid, cfdl-mfailc, pfdl-mfailc, ffdl-mfailc, ilc-mfapc
run cao-2019 --trials 0 => --trials 0 is outside its allowed range [1, inf)
run cao-2019 --set lam=1 => 'lam' cannot be set; did you mean cfdl-mfailc
run cao-2019 --set 'machine.plant.poles[3]=1' => 'machine.plant.poles[3]' cannot be set
run cao-2019 --set pid.kp => --set 'pid.kp' is not PATH=VALUE
run cao-2019 --set pid.kp=big => pid.kp = 'big' is not a number
run cao-2019 --set ffdl-mfailc.L_u=1.5 => ffdl-mfailc.L_u = '1.5' is not a whole number
run cao-2019 --set cfdl-mfailc.lam=0 => lam = 0 is outside its allowed range (0, inf)
run cao-2019 --set cfdl-mfailc.reset=never => reset = 'never' is not one of 'book', 'sign', 'none'
run cao-2019 --set cfdl-mfailc.lead=5000 => lead = 5000 is outside its allowed range [0, 1999]
run cao-2019 --set plant=ideal => form = 'ideal' is not one of 'exact', 'printed', \
'dai_2014_printed'
run cao-2019 --set reference=square => reference = 'square' is not one of 'sinusoid', 'piston'
run cao-2019 --set frequency=fast => frequency = 'fast' is not a number
run cao-2019 --precision half => precision = 'half' is not one of 'float64', 'float32'
sweep cao-2019 --machines 0 => machines = 0 is outside its allowed range [1, inf)
sweep cao-2019 --spread 2 => spread = 2 is outside its allowed range (0, 1)
sweep cao-2019 --sampling grid => sampling = 'grid' is not one of monte-carlo
sweep cao-2019 --tolerance nan => tolerance = nan is outside its allowed range (0, inf)
sweep cao-2019 --keep z => keep = 'z' is not one of y, e, u
sweep cao-2019 --grid lam => --grid 'lam' is not PATH=VALUES
sweep cao-2019 --scheme pid --grid cfdl-mfailc.lam=1,2 => grid: 'cfdl-mfailc.lam' cannot be an axis
sweep cao-2019 --grid reading=stroke,stroke => --grid 'reading=stroke,stroke' has equal values
sweep cao-2019 --grid frequency=0.5,1 => a dataset needs one for all
run dai-2014 --set machine.plant=3 => 'machine.plant' cannot be set; did you mean plant.
run dai-2014 --params none.json => none.json: no such file or directory
run dai-2014 --report . => . cannot be written; allowed is a file in a folder that can
run dai-2014 --report a.json --report b.json => --report a.json is one of several .json; allowed \
is one
run dai-2014 --report a.txt => a.txt is neither .html, a page, nor .json
run dai-2014 --report file/x.html => file/x.html cannot be written
run dai-2014 --out file => file cannot be a folder for results
run dai-2014 --seed -1 => --seed -1 is outside its allowed range [0, 9e18]
run dai-2014 --seed 99999999999999999999999 => --seed 99999999999999999999999 is outside its \
allowed range [0, 9e18]
run milc-2024 --set dilc.learning.outputs=1e6 => dilc.learning.outputs = '1e6' is not a tuple (a \
whole number, ...)
sweep cao-2019 --set 'machine.plant.zero=(1,2,3)' => zero = [1. 2. 3.] has shape (3,); allowed is \
one number
run bare.toml => bare.toml has no scheme; needed is a table [schemes.NAME] at least
list file.toml => file.toml is no text in UTF-8: invalid start byte 0xff at byte 0
identify file => file is no text in UTF-8: invalid start byte 0xff at byte 0
certify cao-2019 --machines 0 => --machines 0 is outside its allowed range [1, inf)
certify cao-2019 --scheme cfdl-mfailc --trials 1 => --trials 1 is outside its allowed range [2, \
inf) of cfdl-mfailc
next --state s --dry-run --report n.html => --report n.html is a page, which `jaxilc trials` writes
next --state s --out n.csv --scenario milc-2024 => --scheme is missing; those that learn are \
dilc, milc
--quiet --verbose list => --quiet and --verbose exclude each other
"""),
)
def test_a_mistake_is_one_line_that_names_what_is_allowed(here, tmp_path, words, message):
    for name in ("file", "file.toml"):
        (tmp_path / name).write_bytes(b"\xff\xfe")
    (tmp_path / "bare.toml").write_text(PLANT)
    code, _, err = call(*words)
    assert code == 2
    assert message in err
    assert "Traceback" not in err
    assert not list(tmp_path.glob("out/*/*")), "nothing may be written"


def swept(line):
    """Start a process that sweeps a small plant, and waits before it writes each chunk."""
    # a shell lets what it starts in the background, such as these tests, ignore interrupts
    heeds = "import signal, sys, time; signal.signal(signal.SIGINT, signal.default_int_handler)"
    program = f"""{heeds}
from jaxilc.cli import main
from jaxilc.sweeps import host
from jaxilc.sweeps.store import Store
host.TRIALS_A_PASS, write = {host.TRIALS_A_PASS}, Store.write
Store.write = lambda *given: (time.sleep(0.5), write(*given))[1]
sys.argv = ["jaxilc", "sweep", "mine.toml", "--trials", "2", *{line!r}.split()]
main()
"""
    words = [sys.executable, "-c", program]
    return subprocess.Popen(words, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)


@pytest.mark.slow
def test_a_killed_sweep_resumes_bit_for_bit(here, tmp_path):
    """It is killed after its first chunk, and interrupted after another one.

    A mark that is being written has another name yet.
    """
    (tmp_path / "mine.toml").write_text(PLANT + LEARNER + known_to(0.2))
    killed = "--machines 3000 --out killed"  # 12 chunks
    done, before = tmp_path / "killed/dataset.zarr/chunk_done/c/0", 0
    for how, more in ((signal.SIGKILL, ""), (signal.SIGINT, " --resume")):
        process = swept(killed + more)
        while len(list(done.glob("[0-9]*"))) <= before and process.poll() is None:
            time.sleep(0.01)
        os.kill(process.pid, how)
        _, err = process.communicate()
        assert process.returncode == (-signal.SIGKILL if how is signal.SIGKILL else 130), err
        assert ("--resume goes on" in flat(err)) == (how is signal.SIGINT)
        finite = jaxilc.open_dataset(tmp_path / "killed/dataset.zarr")["finite"]
        assert not np.all(finite)
        assert np.any(finite)
        before = len(list(done.glob("[0-9]*")))
    for line in (f"{killed} --resume", "--machines 3000 --out whole"):
        code, out, err = call("sweep", "mine.toml", "--trials", 2, *line.split())
        assert (code, out.count("sample-steps")) == (0, 1), err
    of = (jaxilc.open_dataset(tmp_path / name / "dataset.zarr") for name in ("whole", "killed"))
    xr.testing.assert_identical(*of)


def test_the_law_that_looks_good_diverges_as_theory_knew_and_the_tuned_one_does_not(
    monkeypatch, tmp_path
):
    for name, value in {"MACHINES": 16, "STEPS": 15, "TRIALS": 40}.items():
        monkeypatch.setattr(demonstrating, name, value)
    found = demonstrating.demo(tmp_path)
    of = found.numbers
    assert of["claims"] == {"plain": "diverges", "tuned": "monotone"}
    assert of["turning"] == of["best_trial"]
    assert of["rms"][of["best_trial"] - 1] < 2e-3 * of["rms"][0] < of["rms"][-1]
    assert of["yield"] == {"plain": 0.0, "tuned": 1.0}
    assert of["worst"]["tuned"] < demonstrating.TOLERANCE
    assert "diverges" in found.verdict.said[1]
    assert found.verdict.following == "jaxilc init axis.toml"
    assert [*found.figures] == ["demo"]
    assert found.figures["demo"].draw() is not None


def test_reproduce_prints_every_published_number_with_its_verdict(here, tmp_path):
    out = done("reproduce", "dai-2014", "--report", "rows.json")
    assert "Of 4 independent printed numbers" in flat(out)
    asks = r"does not hold: dai-2014: MFAPC .* PID; asked of ours: [\d.]+ > [\d.]+ mm"
    assert re.search(asks, flat(out))
    assert "settled error [mm]" not in out.split("Of 4")[0].split("open: dai-2014")[0], "details"
    rows = json.loads((tmp_path / "rows.json").read_text())["rows"]
    assert {r["verdict"] for r in rows} <= {"met", "shape", "open"}
    assert all(r["reading"] and r["ratio"] == r["ours"] / r["value"] for r in rows)
    assert "scenario = 'dai' is unknown; did you mean dai-2014?" in refused("reproduce", "dai")


def test_certify_compares_theory_with_simulation(here, tmp_path):
    arguments = (
        "certify", "cao-2019", "--scheme", "cfdl-mfailc", "--scheme", "pid", "--machines", 3,
        "--trials", 4, "--report", "c.json", "--report", "page.html",
    )  # fmt: skip
    out = done(*arguments)
    page = (tmp_path / "page.html").read_text("utf-8")
    for part in ("jaxilc certify cao-2019", "data:image/png", "in the long run", "<td>3</td>"):
        assert part in page
    assert "constant sign of phi" in out
    numbers = json.loads((tmp_path / "c.json").read_text())
    assert list(numbers["schemes"]) == ["cfdl-mfailc"], "pid does not learn"
    row = numbers["schemes"]["cfdl-mfailc"]
    assert sum(row["claims"].values()) == sum(row["observed"].values()) == 3
    assert row["bound"] == {"holds": 0, "fails": 0, "not claimed": 3}
    assert row["contradicted"] == []
    assert "of the long run nothing is claimed" in flat(out)
    assert (tmp_path / "out/certify-cao-2019/cfdl-mfailc.png").exists()
    assert "none of pid learns" in refused("certify", "cao-2019", "--scheme", "pid")


def test_identify_reads_a_record_and_names_what_is_wrong_with_it(here, tmp_path, monkeypatch):
    u = jaxilc.references.m_sequence(8, hold=2)
    lag = jaxilc.plants.ProcessModel(gain=2.0, zeros=(), poles=(60.0,), frequencies=(), dampings=())
    machine = jaxilc.Machine(lag, sensor=jaxilc.Sensor(noise=1e-3))
    jaxilc.write_record("record.csv", jaxilc.excite(machine, u, 1e-3))
    (tmp_path / "found.toml").write_text("")
    law = StartingLaw(0.25, 3, 100.0, 3, 0.8, 0.85, 40.0)  # another test chooses one
    monkeypatch.setattr(identified_file, "starting_law", lambda *_, **__: law)
    asked = ("--poles", 1, "--pairs", 0, "--zeros", 0, "--out", "found.toml", "--force")
    out = done("identify", "record.csv", *asked, "--report", "found.json")
    assert "gamma_p = 0.25, lead = 3 and a cutoff of 100 Hz" in flat(out)
    assert read_scenario("found.toml").schemes["ilc"].scheme.lead == 3
    assert "95 % intervals" in out
    assert "Order 1 fits 9" in out
    assert "Next, a law that is tuned and judged: jaxilc design found.toml" in flat(out)
    (left,) = re.findall("from it leaves out the (.*) that the fit left", flat(out))
    assert float(left) == pytest.approx(1e-3, rel=0.2)
    found = json.loads((tmp_path / "found.json").read_text())
    assert found["poles[0]"]["low"] < 60.0 < found["poles[0]"]["high"]
    assert (tmp_path / "out/identify/validation.png").exists()
    told = refused("identify", "record.csv", "--out", "found.toml")
    assert "found.toml exists already; add --force to replace it" in told
    told = refused("identify", "record.csv", "--input", "voltage")
    assert "no column 'voltage'; present are t [s], u, y; --input (input) names another" in told


def test_identify_reads_a_frequency_response(here, tmp_path, monkeypatch):
    """A lag of 30 rad/s with 2.5 samples of delay, held over samples of 1 ms."""
    a, f = np.exp(-0.03), np.linspace(1.0, 200.0, 60)
    z = np.exp(2e-3j * np.pi * f)
    half = np.exp(-0.015)
    response = 2.0 * ((1 - half) / (z - a) + half * (1 - half) / (z - a) / z) / z**2
    std = 0.01 * np.abs(response)
    write_columns("frf.csv", "f [Hz],re,im,std", f, response.real, response.imag, std)
    law = StartingLaw(0.25, 3, 100.0, 3, 0.8, 0.85, 40.0)  # another test chooses one
    monkeypatch.setattr(identified_file, "starting_law", lambda *_, **__: law)
    asked = ("identify", "frf.csv", "--poles", 1, "--pairs", 0, "--zeros", 0)
    out = done(*asked, "--dt", 1e-3, "--out", "axis.toml")
    assert "Order 1 with a delay of 2.5 samples fits 100 % of the measured response" in out
    plant = read_scenario("axis.toml").machine.plant
    assert plant.delay == pytest.approx(2.5e-3, rel=1e-6)
    assert float(plant.poles[0]) == pytest.approx(30.0, rel=1e-6)
    assert (tmp_path / "out/identify/response.png").exists()
    out = done(*asked, "--dt", 1e-3, "--delay", 2)
    assert "Next, structures compared: jaxilc identify frf.csv --dt 0.001 --auto" in out
    for wrong, said in (
        (("--out", "b.toml"), "--out FILE.toml of a frequency response needs --dt"),
        (("--delay", 2), "--delay 2 counts samples of a response: give --dt, too"),
        (("--resample", 0.1), "--resample is for a record in time"),
        (("--delay", -1), "--delay -1 is outside its allowed range"),
    ):
        assert said in refused(*asked, *wrong)


def test_runs_of_different_settings_are_not_mixed(here, tmp_path, monkeypatch):
    """The same run is repeated, another one is refused or goes beside it, and may replace it."""
    monkeypatch.setattr(running, "_figures", lambda *_: {})  # figures have their own tests
    (tmp_path / "mine.toml").write_text(PLANT + LEARNER)
    run = ("--quiet", "run", "mine.toml", "--trials")
    for trials, more, code in ((2, (), 0), (2, (), 0), (3, (), 2), (3, ("--replace",), 0)):
        found = call(*run, trials, "--out", "o", *more)
        assert found[0] == code, found
        if code:
            assert "o holds a run of other settings (trials: 2 there, 3 here)" in found[2]
            assert "--replace" in found[2]
    for trials in (2, 3, 2):
        assert call(*run, trials)[0] == 0
    assert sorted(p.name for p in (tmp_path / "out").iterdir()) == ["run-mine", "run-mine-2"]


def examples():
    """Return every command with the examples of its help text."""
    for command in get_command(app).commands.values():
        found = re.findall(
            r"Example: jaxilc (.+?)(?:\n\n|\Z)",
            inspect.cleandoc(command.callback.__doc__),
            flags=re.DOTALL,
        )
        assert found, f"{command.name} has no example"
        yield from (
            pytest.param(command, shlex.split(example), id=command.name) for example in found
        )


def test_every_option_is_explained():
    for command in get_command(app).commands.values():
        for one in command.params:
            if one.name != "help":
                assert getattr(one, "help", None), f"{command.name}: {one.name} has no help"


@pytest.mark.thorough
@pytest.mark.parametrize(("command", "words"), [*examples()])
def test_the_example_of_a_command_is_one_of_it(command, words):
    """The options of each example exist, and their values are of the right type.

    Anything else would raise.
    """
    assert words[0] == command.name
    with command.make_context(command.name, words[1:]) as context:
        assert not context.args
        if "scenario" in context.params and isinstance(context.params["scenario"], str):
            schemes = jaxilc.scenarios.load(context.params["scenario"]).schemes
            assert set(np.atleast_1d(context.params.get("scheme") or [])) <= set(schemes)


# commands that count machines: those that know the old name `--samples`, and newer ones
OF_MACHINES = {"certify", "explore", "export", "pareto", "sweep", "tune"}
OF_MACHINES_NOW = {"design", "filter", "learn-law"}


@pytest.mark.parametrize("name", ["", *get_command(app).commands])
def test_a_help_page_fits_80_columns(name):
    words = [name] if name else []
    shown = CliRunner().invoke(app, [*words, "--help"], env={"COLUMNS": "80"})
    assert shown.exit_code == 0
    assert max(map(len, shown.stdout.splitlines())) <= 80
    assert "…" not in shown.stdout
    assert ("--machines" in shown.stdout) == (name in OF_MACHINES | OF_MACHINES_NOW)
    command = get_command(app).commands.get(name)
    helps = "".join([command.help, *(p.help for p in command.params)] if command else ())
    brackets = re.findall(r"\[[^\]]+\]", re.sub(r"[\\\s]", "", helps))
    together = re.sub(r"[│\s]", "", shown.stdout)
    assert [unit for unit in brackets if unit not in together] == [], "Rich has tags like [s]"
    assert "--samples" not in shown.stdout, "the old name is understood, but not advised"
    lines = [line.strip() for line in shown.stdout.partition("╭")[0].splitlines()]
    for line, after in itertools.pairwise(lines):
        assert not (line and after) or len(f" {line} {after.split()[0]}") >= 79, "it ends early"


def test_help_explains_what_a_campaign_sets():
    explained = CliRunner().invoke(app, ["next", "--help"], env={"COLUMNS": "80"}).stdout
    for name, (_, meaning) in OF_CAMPAIGN.items():
        assert f" {name}: {meaning}" in flat(explained)


def test_help_groups_every_command_by_what_one_wants():
    """Each command stands in one group, and `--help` shows the groups in the order of use."""
    groups = {n: c.rich_help_panel for n, c in get_command(app).commands.items()}
    assert groups["sweep"] == groups["run"] == groups["list"] == SIMULATE
    assert groups["tune"] == groups["pareto"] == groups["worst-case"] == DESIGN
    assert groups["learn-law"] == groups["design"] == DESIGN
    assert groups["certify"] == PROVE
    assert groups["next"] == groups["trials"] == MACHINE
    shown = CliRunner().invoke(app, ["--help"], env={"COLUMNS": "80"}).stdout
    places = [shown.index(f"─ {group} ─") for group in dict.fromkeys(groups.values())]
    assert places == sorted(places)
    assert len(places) == 5
    assert "─ Commands ─" not in shown


def test_what_commands_share_is_declared_once():
    """A shared option has the same help text in every command.

    The option that counts machines keeps its old name.
    """
    said, of_machines = {}, {}
    for name, command in get_command(app).commands.items():
        for option in (one for one in command.params if not getattr(one, "hidden", False)):
            said.setdefault(max(option.opts, key=len), set()).add(option.help)
            if "--machines" in option.opts:
                of_machines[name] = option.opts
    old = {name for name, names in of_machines.items() if names == ["--machines", "--samples"]}
    assert old == OF_MACHINES
    assert {*of_machines} - old == OF_MACHINES_NOW, "newer than the old name"
    shared = ("--set", "--params", "--seed", "--spread", "--report")
    for name in (*shared, "--resume"):
        assert len(said[name]) == 1, name


@pytest.mark.parametrize(
    "words",
    [("list",), ("list", "li-2020"), ("list", "cao-2019"), ("reproduce", "dai-2014")],
    ids=" ".join,
)
def test_a_table_fits_80_columns_and_nothing_is_cut(here, monkeypatch, words):
    monkeypatch.setattr(console.out, "width", 80)
    out = done(*words)
    *lines, following = out.splitlines()
    assert re.match("Next, .*: jaxilc ", following), "one line, to be copied"
    assert max(map(len, lines)) <= 80
    assert "…" not in out


def started(*words, **environment):
    """Run the console script as another process, without a terminal, and return its result."""
    return subprocess.run(
        [*PROGRAM, *words], capture_output=True, text=True, env=PLAIN | environment
    )


def test_a_pipe_is_as_wide_as_columns_tell():
    for told, width in (("", 160), ("70", 70), ("0", 160)):
        out = started("list", COLUMNS=told).stdout
        *lines, _ = out.splitlines()  # the last one is a command, to be copied
        assert max(map(len, lines)) <= width
        assert (max(map(len, lines)) > 70) == (width > 70)


def test_python_without_docstrings_is_told_what_it_lacks():
    for flag, said in (("-O", ""), ("-OO", f"warning: {WITHOUT_DOCSTRINGS}\n")):
        line = [sys.executable, flag, "-m", "jaxilc", "--version"]
        done = subprocess.run(line, capture_output=True, text=True)
        assert (done.returncode, done.stderr) == (0, said)


@pytest.mark.parametrize("closed", ["<&- 2>&-", "<&- >&- 2>&-"])
def test_a_closed_stream_is_one_that_nobody_reads(closed):
    line = shlex.join([*PROGRAM, "--version"])
    done = subprocess.run([f"{line} {closed}"], shell=True, capture_output=True, text=True)
    assert (done.returncode, done.stderr) == (0, "")
    assert bool(done.stdout) == (" >&-" not in closed)


@pytest.mark.parametrize("encoding", ["ascii", "cp1252", "latin-1", "utf-8"])
def test_a_sign_that_an_encoding_lacks_ends_no_command(encoding):
    """The signs of the encoding itself stay; the others are written in plain letters."""
    program = "from jaxilc.cli import console as c; c.say(TOLD); c.warn(TOLD); print(TOLD)"
    told, plain = "∞ −1 5 µm ± 2 ° 漢", "inf -1 5 um +- 2 deg ?"
    done = subprocess.run(
        [sys.executable, "-c", program.replace("TOLD", ascii(told))],
        capture_output=True, env=PLAIN | {"PYTHONIOENCODING": encoding},
    )  # fmt: skip
    expected = {"ascii": plain, "utf-8": told}.get(encoding, "inf -1 5 µm ± 2 ° ?")
    assert done.returncode == 0
    assert done.stdout.decode(encoding).splitlines() == [expected] * 2
    assert done.stderr.decode(encoding).splitlines() == [expected]


def test_the_files_of_a_result_are_there_if_nobody_reads_what_is_printed(monkeypatch, tmp_path):
    """A pipe to `head` ended a command of minutes before it had written anything."""
    found = outcomes.Outcome(
        command="tune", numbers={"a": 1.0}, verdict=outcomes.Verdict(("said",)), folder=tmp_path,
        files={"params.json": lambda path: path.write_text("{}")},
    )  # fmt: skip
    monkeypatch.setattr(outcomes.Outcome, "show", lambda *_, **__: sys.exit(1))
    report = tmp_path / "report.json"
    with pytest.raises(SystemExit):
        present.present(found, Pages([report]))
    assert (tmp_path / "params.json").exists()
    assert json.loads(report.read_text())["a"] == 1.0


@pytest.mark.thorough(but=["--version >/dev/full"])
@pytest.mark.skipif(not os.path.exists("/dev/full"), reason="no device of a full disk here")
@pytest.mark.parametrize("line", ["--version >/dev/full", "run none.toml 2>/dev/full"])
def test_a_full_disk_is_no_error_of_jaxilc(line):
    done = subprocess.run(
        [f"{shlex.join(PROGRAM)} {line}"], shell=True, capture_output=True, text=True
    )
    assert done.returncode == 2
    assert done.stderr in ("", "error: input or output: no space left on device\n")


def test_what_needs_no_jax_does_not_wait_for_it():
    program = """import contextlib, sys
from jaxilc.cli import main
for line in ("--help", "sweep --help", "--version", "list"):
    sys.argv = ["jaxilc", *line.split()]
    with contextlib.suppress(SystemExit):
        main()
    print(*(name in sys.modules for name in ("jax", "numpy")), file=sys.stderr)"""
    done = subprocess.run(
        [sys.executable, "-c", program], capture_output=True, text=True, env=PLAIN
    )
    assert (done.returncode, done.stderr.split()) == (0, ["False"] * 8)
    assert "130  stopped by Ctrl-C" in done.stdout


@pytest.mark.thorough
def test_a_shell_completes_scenarios_schemes_and_choices(tmp_path, monkeypatch):
    loaded = {name: jaxilc.scenarios.load(name) for name in jaxilc.scenarios.SCENARIOS}
    assert {
        name: (s.title, tuple(s.schemes), s.trials, s.task.N) for name, s in loaded.items()
    } == LISTED
    (tmp_path / "mine.toml").write_text(PLANT + LEARNER)
    for line, expected in (
        ("jaxilc run cao-", ["cao-2019", "cao-2019-rig"]),
        ("jaxilc tune cao-2019 --scheme c", ["cfdl-mfailc"]),
        (f"jaxilc certify {tmp_path / 'mine.toml'} --scheme i", ["ilc"]),
        ("jaxilc next --scenario milc-2024 --scheme m", ["milc"]),
        ("jaxilc certify cao-2019 --sampling so", ["sobol"]),
        ("jaxilc run elsewhere/", []),  # the shell completes the names of files
    ):
        environment = {
            "_JAXILC_COMPLETE": "complete_bash",
            "COMP_WORDS": line,
            "COMP_CWORD": str(len(line.split()) - 1),
        }
        monkeypatch.setattr(os, "environ", PLAIN | environment)
        assert call()[1].split() == expected
    assert "jaxilc" in started(_JAXILC_COMPLETE="source_bash").stdout


@pytest.mark.parametrize(("environment", "coloured"), [({}, True), ({"NO_COLOR": "1"}, False)])
def test_colours_are_for_a_terminal_that_wants_them(environment, coloured):
    pty = pytest.importorskip("pty", reason="Windows has no pseudo-terminals")
    ours, theirs = pty.openpty()
    subprocess.run(
        [*PROGRAM, "--help"],
        stdout=theirs,
        env=PLAIN | environment | {"TERM": "xterm-256color"},
        check=True,
    )
    os.close(theirs)
    text = b""
    with contextlib.suppress(OSError):  # raised at the end of the terminal's output
        while part := os.read(ours, 65536):
            text += part
    os.close(ours)
    assert b"Exit codes" in text
    assert bool(COLOUR.search(text.decode())) == coloured


@pytest.mark.thorough
def test_nothing_but_text_where_there_is_no_terminal():
    done = started("tune", "--help", TERM="xterm-256color")
    assert "--weights" in done.stdout
    assert "\x1b" not in done.stdout + done.stderr
    wrong = started("run", "cao", TERM="xterm-256color")
    assert wrong.returncode == 2
    assert wrong.stderr.count("\n") == 1
    assert "\x1b" not in wrong.stderr


def test_progress_is_shown_on_a_terminal_alone(monkeypatch):
    shown = {}
    for terminal, quiet in ((True, False), (True, True), (False, False)):
        text = io.StringIO()
        monkeypatch.setattr(console, "err", Console(file=text, force_terminal=terminal))
        monkeypatch.setattr(console.out, "quiet", quiet)
        with progress.progress_bar() as bar:
            bar.update(bar.add_task("trials", total=2, now="half"), completed=1)
        shown[terminal, quiet] = text.getvalue()
    assert "half" in shown[True, False]
    assert (shown[True, True], shown[False, False]) == ("", "")


def plain(text):
    """Return what a terminal shows of a text, without its escapes."""
    return Text.from_ansi(text.getvalue().replace("\r", "\n")).plain


@pytest.mark.parametrize("stored", [0, 131072])
def test_a_sweep_shows_the_median_until_now_on_one_line(monkeypatch, tmp_path, stored):
    """It has 80 columns. What comes afterwards is imported when the first results are stored."""
    errors = np.array([[9.0, 2e-3], [9.0, 3e-3], [9.0, 7e-3]])
    values = {"settled_error": errors, "finite": errors < np.inf, "diverged": errors > 8.0}

    def one_chunk(self, out, *, progress, results, **how):
        results("cfdl-mfailc", values)
        assert not imported
        if stored:
            progress("cfdl-mfailc", stored, 3)
        raise RuntimeError("enough")

    text, imported = io.StringIO(), []
    monkeypatch.setattr(progress, "importlib", SimpleNamespace(import_module=imported.append))
    monkeypatch.setattr(console, "err", Console(file=text, force_terminal=True, width=80))
    monkeypatch.setattr(Sweep, "run", one_chunk)
    request, run = Request("cao-2019", trials=2), partial(progress.run_sweep, cluster=None)
    with pytest.raises(RuntimeError, match="enough"):
        outcomes.sweep(request, machines=262144, folder=tmp_path / "new", run=run)
    lines = [line for line in plain(text).splitlines() if f" {stored}/262144" in line]
    shown = "^cfdl-mfailc .* median 3 µm +0:00:0"
    assert any(re.search(shown, line) for line in lines)
    assert all(re.search(shown, line) or not stored for line in lines)
    assert stored or not imported
    with progress.progress_bar(expected=0.1) as bar:
        bar.add_task("worst-case", total=12, now="the largest error of cfdl")
    assert plain(text).endswith("the largest error of cfdl 0:00:00 longer than before\n")


def test_a_text_stands_above_the_bar_in_a_terminal_and_in_the_output_elsewhere(monkeypatch):
    for terminal in (True, False):
        streams = {name: io.StringIO() for name in ("out", "err")}
        for name, text in streams.items():
            monkeypatch.setattr(console, name, Console(file=text, force_terminal=terminal))
        console.between("an answer")
        told = {name for name, text in streams.items() if "an answer" in text.getvalue()}
        assert told == {"err" if terminal else "out"}


def test_the_time_left_is_known_from_the_last_time(monkeypatch, tmp_path):
    """A command that took 40 s has about 40 s left when it begins again, whatever its files."""
    monkeypatch.setenv("JAXILC_CACHE", str(tmp_path / "cache"))
    key = progress.key_of(["run", "a.toml", "--out", "x", "--trials", "5", "--json=y"])
    assert key == progress.key_of(["run", "a.toml", "--trials", "5"])
    assert key != progress.key_of(["run", "a.toml", "--trials", "6"])
    assert progress.taken(key) is None
    progress.remember(key, 40.0)
    text = io.StringIO()
    monkeypatch.setattr(console, "err", Console(file=text, force_terminal=True, width=120))
    monkeypatch.setattr(console.out, "quiet", False)
    with progress.progress_bar(expected=progress.taken(key)) as bar:
        bar.add_task("run", total=None, now="starting")
    assert "about 40 s left" in text.getvalue()
    for how, said in (({"usual": 90.0}, "often 90 s"), ({"expected": 0.5}, "longer than before")):
        with progress.progress_bar(**how) as bar:
            bar.add_task("run", total=None, now="starting")
        assert said in text.getvalue()
    progress.durations_file().write_text("[")
    assert progress.taken(key) is None
    progress.remember(key, 2.0)
    assert progress.taken(key) == 2.0
    monkeypatch.setenv("JAXILC_CACHE", "off")
    progress.remember(key, 3.0)
    assert progress.taken(key) is None


@pytest.mark.thorough
def test_quiet_and_verbose(here, tmp_path):
    (tmp_path / "mine.toml").write_text(PLANT + LEARNER)
    run = ("run", "mine.toml", "--trials", 2, "--report", "run.json")
    assert call("--quiet", *run) == (0, "", "")
    assert json.loads((tmp_path / "run.json").read_text())["trials"] == 2
    code, out, err = call("--verbose", *run)
    assert code == 0
    assert "written: " in out
    told = json.loads((tmp_path / "run.json").read_text())
    assert flat(out).startswith(told["verdict"][0])
    assert out.splitlines()[-1] == f"Next, what theory claims: {told['next']}"
    assert told["next"] == "jaxilc certify mine.toml --trials 2"
    assert "devices: " in err
    assert re.search(r"\d s, of them .* for \d+ programs", err)
    assert "Traceback" in call("--verbose", "run", "cao")[2]
    assert "Traceback" not in call("run", "cao")[2]
