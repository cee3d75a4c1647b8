"""The command line: what it prints and writes, what it refuses, and a sweep killed with SIGKILL."""

import json
import os
import signal
import subprocess
import sys
import time

import numpy as np
import pytest
import xarray as xr
from typer.testing import CliRunner

import jaxilc
from jaxilc.cli import app, main


@pytest.fixture
def jaxilc_command(monkeypatch, capsys, tmp_path):
    """Runs the command in this process: exit code, standard output, standard error."""
    monkeypatch.chdir(tmp_path)

    def call(*arguments):
        monkeypatch.setattr(sys, "argv", ["jaxilc", *map(str, arguments)])
        code = 0
        try:
            main()
        except SystemExit as stop:
            code = stop.code or 0
        return code, *capsys.readouterr()

    return call


def test_list_names_scenarios_and_all_that_can_be_set(jaxilc_command):
    code, out, _ = jaxilc_command("list")
    assert code == 0
    assert "cao-2019" in out
    code, out, _ = jaxilc_command("list", "cao-2019")
    assert code == 0
    for path in ("machine.plant.poles", "ffdl-mfailc.phi0", "pid.form", "reference"):
        assert path in out


def test_run_prints_ours_beside_the_published_and_writes_everything(jaxilc_command, tmp_path):
    code, out, _ = jaxilc_command("run", "cao-2019", "--trials", 20, "--scheme", "cfdl-mfailc", "--out", "here", "--json", "here/run.json")
    assert code == 0
    assert "16.2 (18)" in out
    numbers = json.loads((tmp_path / "here/run.json").read_text())
    of_scheme = numbers["schemes"]["cfdl-mfailc"]
    dataset = xr.open_zarr(tmp_path / "here/dataset.zarr", consolidated=False, chunks=None)
    np.testing.assert_allclose(of_scheme["settled_error"]["20"], 1e3 * dataset["settled_error"].sel(scheme="cfdl-mfailc", trial=20)[0])
    by_hand = np.abs(dataset["e"].sel(scheme="cfdl-mfailc", trial=20).values[1000:]).max()
    np.testing.assert_allclose(of_scheme["settled_error"]["20"], 1e3 * by_hand)
    assert [p["ours"] is None for p in of_scheme["published"] if p["trial"] == 30] == [True]
    for name in ("error-by-trial.png", "tracking-cfdl-mfailc.png"):
        assert (tmp_path / "here" / name).stat().st_size > 10_000


def test_settings_reach_leaves_statics_and_options_together(jaxilc_command, tmp_path):
    settings = ("plant=printed", "ffdl-mfailc.L_y=1", "ffdl-mfailc.phi0=0.5,-0.06,0", "ffdl-mfailc.reset=sign", "machine.plant.b[0]=0.002")
    flags = [part for s in settings for part in ("--set", s)]
    code, _, _ = jaxilc_command("run", "cao-2019", "--scheme", "ffdl-mfailc", "--trials", 3, "--json", "a.json", *flags)
    assert code == 0
    s = jaxilc.scenarios.load("cao-2019", plant="printed")
    s = s.with_values({"ffdl-mfailc.L_y": 1, "ffdl-mfailc.phi0": (0.5, -0.06, 0), "ffdl-mfailc.reset": "sign", "machine.plant.b[0]": 0.002})
    ours = jaxilc.learn(s.machine, s.schemes["ffdl-mfailc"], s.task, 3).rms[-1, 0]
    printed = json.loads((tmp_path / "a.json").read_text())["schemes"]["ffdl-mfailc"]["rms"]["3"]
    np.testing.assert_allclose(printed, 1e3 * ours, rtol=1e-12)


def test_sweep_prints_the_yield_and_resumes(jaxilc_command, tmp_path):
    sweep = ("sweep", "cao-2019", "--scheme", "cfdl-mfailc", "--trials", 3, "--samples", 8, "--spread", 0.2, "--json", "sweep.json")
    code, out, _ = jaxilc_command(*sweep, "--tolerance", 640)
    assert code == 0
    assert "8 machines" in out
    numbers = json.loads((tmp_path / "sweep.json").read_text())
    dataset = jaxilc.open_dataset(tmp_path / "out/sweep-cao-2019/dataset.zarr")
    errors = 1e3 * dataset["settled_error"].sel(scheme="cfdl-mfailc", trial=3)
    assert numbers["schemes"]["cfdl-mfailc"]["yield"] == float((errors <= 640).mean())
    assert 0 < numbers["schemes"]["cfdl-mfailc"]["yield"] < 1
    assert float(abs(dataset["plant.gain"] - 1).max()) > 0.1
    code, _, err = jaxilc_command(*sweep)
    assert code == 2
    assert "--resume" in err
    assert jaxilc_command(*sweep, "--resume")[0] == 0


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("run", "cao"), "scenario = 'cao' is not one of cao-2019"),
        (("run", "cao-2019", "--scheme", "ilc"), "scheme = 'ilc' is not one of pid, cfdl-mfailc, pfdl-mfailc, ffdl-mfailc, ilc-mfapc"),
        (("run", "cao-2019", "--trials", "0"), "--trials 0 is outside its allowed range [1, inf)"),
        (("run", "cao-2019", "--set", "lam=1"), "'lam' cannot be set; known: machine.plant.gain"),
        (("run", "cao-2019", "--set", "pid.kq=1"), "'pid.kq' cannot be set; known: "),
        (("run", "cao-2019", "--set", "machine.plant.poles[3]=1"), "'machine.plant.poles[3]' cannot be set"),
        (("run", "cao-2019", "--set", "pid.kp"), "--set 'pid.kp' is not PATH=VALUE"),
        (("run", "cao-2019", "--set", "pid.kp=big"), "pid.kp = 'big' is not a number"),
        (("run", "cao-2019", "--set", "ffdl-mfailc.L_u=1.5"), "ffdl-mfailc.L_u = '1.5' is not a whole number"),
        (("run", "cao-2019", "--set", "cfdl-mfailc.lam=0"), "lam = 0 is outside its allowed range (0, inf)"),
        (("run", "cao-2019", "--set", "cfdl-mfailc.eta=1.5"), "eta = 1.5 is outside its allowed range (0, 1]"),
        (("run", "cao-2019", "--set", "cfdl-mfailc.reset=never"), "reset = 'never' is not one of 'book', 'sign', 'none'"),
        (("run", "cao-2019", "--set", "cfdl-mfailc.lead=5000"), "lead = 5000 is outside its allowed range [0, 1999]"),
        (("run", "cao-2019", "--set", "plant=ideal"), "form = 'ideal' is not one of 'exact', 'printed', 'dai_2014_printed'"),
        (("run", "cao-2019", "--set", "reference=square"), "reference = 'square' is not one of 'sinusoid', 'piston'"),
        (("run", "cao-2019", "--set", "frequency=fast"), "frequency = 'fast' is not a number"),
        (("run", "cao-2019", "--precision", "half"), "precision = 'half' is not one of 'float64', 'float32'"),
        (("sweep", "cao-2019", "--samples", "0"), "samples = 0 is outside its allowed range [1, inf)"),
        (("sweep", "cao-2019", "--spread", "2"), "spread = 2 is outside its allowed range (0, 1)"),
        (("sweep", "cao-2019", "--sampling", "grid"), "sampling = 'grid' is not one of monte-carlo"),
        (("sweep", "cao-2019", "--tolerance", "-1"), "--tolerance -1 is outside its allowed range (0, inf)"),
        (("sweep", "cao-2019", "--keep", "z"), "keep = 'z' is not one of y, e, u"),
    ],
)
def test_a_mistake_is_one_line_that_names_what_is_allowed(jaxilc_command, tmp_path, arguments, message):
    code, _, err = jaxilc_command(*arguments)
    assert code == 2
    assert message in err
    assert "Traceback" not in err
    assert not list(tmp_path.glob("out/*/*")), "nothing may be written"


def command(store, *more):
    program = "from jaxilc.cli import main; main()"
    schemes = [part for name in ("pid", "cfdl-mfailc", "pfdl-mfailc") for part in ("--scheme", name)]
    return [sys.executable, "-c", program, "sweep", "cao-2019", "--trials", "3", "--samples", "40", *schemes, "--out", str(store), *more]


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    """The store of an uninterrupted sweep."""
    store = tmp_path_factory.mktemp("sweep") / "whole"
    subprocess.run(command(store), check=True, capture_output=True)
    return store


@pytest.mark.slow
@pytest.mark.parametrize("how", [signal.SIGKILL, signal.SIGINT])
def test_a_killed_sweep_resumes_bit_for_bit(tmp_path, whole, how):
    killed = tmp_path / "killed"
    process = subprocess.Popen(command(killed), stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    first_chunk = killed / "dataset.zarr" / "chunk_done" / "c" / "0" / "0"
    while not first_chunk.exists() and process.poll() is None:
        time.sleep(0.01)
    os.kill(process.pid, how)
    _, err = process.communicate()
    assert process.returncode == (-signal.SIGKILL if how is signal.SIGKILL else 130)
    if how is signal.SIGINT:
        assert "--resume goes on" in err
    assert not np.all(jaxilc.open_dataset(killed / "dataset.zarr")["finite"])
    again = subprocess.run(command(killed, "--resume"), check=True, capture_output=True, text=True)
    assert "sample-steps" in again.stdout
    xr.testing.assert_identical(*(jaxilc.open_dataset(d / "dataset.zarr") for d in (whole, killed)))


def test_reproduce_prints_every_published_number_with_its_verdict(jaxilc_command, tmp_path):
    code, out, _ = jaxilc_command("reproduce", "dai-2014", "--json", "rows.json")
    assert code == 0
    assert "4 published numbers" in out
    rows = json.loads((tmp_path / "rows.json").read_text())
    assert {r["verdict"] for r in rows} <= {"met", "shape", "open"}
    assert all(r["reading"] and r["ratio"] == r["ours"] / r["value"] for r in rows)
    code, _, err = jaxilc_command("reproduce", "dai")
    assert code == 2
    assert "scenario = 'dai' is not one of cao-2019" in err


def test_certify_compares_theory_with_simulation(jaxilc_command, tmp_path):
    arguments = ("certify", "cao-2019", "--scheme", "cfdl-mfailc", "--scheme", "pid", "--samples", 3, "--trials", 4, "--json", "c.json")
    code, out, _ = jaxilc_command(*arguments)
    assert code == 0
    assert "constant sign of phi" in out
    numbers = json.loads((tmp_path / "c.json").read_text())
    assert list(numbers["schemes"]) == ["cfdl-mfailc"], "pid does not learn"
    row = numbers["schemes"]["cfdl-mfailc"]
    assert sum(row["verdicts"].values()) == 3
    assert row["bound"] == {"holds": 0, "fails": 0, "not claimed": 3}
    assert row["certified_yet_grew"] == []
    assert (tmp_path / "out/certify-cao-2019/cfdl-mfailc.png").exists()
    code, _, err = jaxilc_command("certify", "cao-2019", "--scheme", "pid")
    assert code == 2
    assert "none of pid learns" in err


def test_identify_reads_a_record_and_names_what_is_wrong_with_it(jaxilc_command, tmp_path):
    u = jaxilc.references.m_sequence(8, hold=2)
    lag = jaxilc.plants.ProcessModel(gain=2.0, zeros=(), poles=(60.0,), frequencies=(), dampings=())
    machine = jaxilc.Machine(lag, sensor=jaxilc.Sensor(noise=1e-3))
    jaxilc.write_record("record.csv", jaxilc.excite(machine, u, 1e-3))
    code, out, _ = jaxilc_command("identify", "record.csv", "--poles", 1, "--pairs", 0, "--zeros", 0, "--json", "found.json")
    assert code == 0
    assert "95 % intervals" in out
    found = json.loads((tmp_path / "found.json").read_text())
    assert found["poles[0]"]["low"] < 60.0 < found["poles[0]"]["high"]
    assert (tmp_path / "out/identify/validation.png").exists()
    code, _, err = jaxilc_command("identify", "record.csv", "--input", "voltage")
    assert code == 2
    assert "no column 'voltage'; present are t, u, y" in err


def test_a_run_leaves_a_report(tmp_path):
    """One page with the table, every figure embedded, and how it was asked for."""
    page = tmp_path / "page.html"
    result = CliRunner().invoke(app, ["run", "dai-2014", "--scheme", "pid", "--out", str(tmp_path / "run"), "--report", str(page)])
    assert result.exit_code == 0, result.output
    text = page.read_text(encoding="utf-8")
    assert text.count("data:image/") == len(list((tmp_path / "run").glob("*.png")))
    assert "settled error [mm]" in text
