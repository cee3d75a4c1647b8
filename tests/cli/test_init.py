"""`jaxilc init` writes a plant file that loads as it is, and with every choice in its comments."""

import json
import re

import jax
import numpy as np
import pytest
import scipy.signal
from command import call, flat, refused, write_columns
from typer.main import get_command

from jaxilc.cli import app
from jaxilc.learning import learn
from jaxilc.learning.playback import schedules
from jaxilc.pytree import replaced
from jaxilc.scenarios.from_file import read_scenario

PLANTS = {  # other plants that the comments speak of, with what the file's plant has
    "zeros_poles_gain": "zeros = []\npoles = [[-40.0, 49.0], [-40.0, -49.0]]\ngain = 4001.0",
    "state_space": "A = [[-40.0]]\nB = [[40.0]]\nC = [[1.0]]",
    "VoiceCoil": "",
}
S = np.clip(np.arange(401) / 200, 0, 1)
MOVE = 5 * (10 * S**3 - 15 * S**4 + 6 * S**5)  # a set-point


pytestmark = pytest.mark.usefixtures("here")


def test_a_set_point_is_corrected_from_the_error_of_the_drive_on(tmp_path):
    assert call("init", "plain.toml")[0] == 0
    code, _, err = call("init", "--set-point", "drive.toml")
    assert (code, err) == (0, "")
    errors = {}
    for name in ("plain", "drive"):
        file = tmp_path / f"{name}.toml"
        made = read_scenario(file)
        found = learn(made.machine, made.schemes["ilc"], made.task, 12).metrics.rms
        errors[name] = np.asarray(found)[:, 0]
        chosen = re.sub(r"^#(?=[a-z\[])", "", file.read_text(encoding="utf-8"), flags=re.M)
        (tmp_path / "chosen.toml").write_text(chosen)
        assert [*read_scenario(tmp_path / "chosen.toml").schemes] == ["ilc", "norm-optimal"]
    made = read_scenario(tmp_path / "drive.toml")
    law = made.schemes["ilc"]
    (u,) = schedules(law, law.initial_memory(made.task), made.task).values()
    r = np.asarray(made.task.reference)
    assert np.max(np.abs(u - (r[1:] + r[:-1]) / 2)) < 0.025  # r through the filter, of 50 Hz
    drive = scipy.signal.tf2ss([4000.0], [1.0, 80.0, 4000.0])
    A, B, C, *_ = scipy.signal.cont2discrete(drive, made.task.dt)
    x, of_drive = np.zeros((2, 1)), []
    for k, held in enumerate(u[:, 0]):
        x = A @ x + B * held
        of_drive.append((C @ x).item() - r[k + 1, 0])
    np.testing.assert_allclose(errors["drive"][0], np.sqrt(np.mean(np.square(of_drive))), rtol=1e-9)
    assert errors["plain"][0] > 3 * errors["drive"][0] > 50 * errors["drive"][-1]
    assert made.task.input_unit == "mm"


def recorded(folder, w=30.16, dt=0.005):
    """Write the move of a drive that SciPy simulates; return its position.

    w: square root of its stiffness per mass [rad/s];  dt: sample time [s]
    """
    drive = scipy.signal.tf2ss([w * w], [1.0, 1.2 * w, w * w])
    A, B, C, *_ = scipy.signal.cont2discrete(drive, dt)
    x, y = np.zeros((2, 1)), [0.0]
    for held in MOVE[:-1]:
        x = A @ x + B * held
        y.append((C @ x).item())
    rows = [
        f"{1e3 * dt * k:g};{a:.9g};{b:.9g}".replace(".", ",")
        for k, (a, b) in enumerate(zip(MOVE, y, strict=True))
    ]
    (folder / "move.csv").write_text("time [ms];set [mm];pos_act [mm]\n" + "\n".join(rows))
    return np.array(y)


def test_a_recorded_move_gives_the_file_of_a_set_point(tmp_path):
    """One command leads from the record to trials, of which the first has the drive's own error.

    It is that up to 6 %, which the filter leaves out of the reference; the stroke is 20 times it.
    """
    y = recorded(tmp_path)
    columns = ("--time", "time", "--input", "set", "--output", "pos_act")
    way = ("init", "--set-point", "--record", "move.csv", *columns, "plants/drive.toml")
    code, out, err = call(*way)
    assert (code, err) == (0, "")
    assert "runs as it is; put your own uncertainty" in flat(out)
    assert "is assumed" not in out
    made = read_scenario(tmp_path / "plants" / "drive.toml")
    assert (made.task.dt, made.task.unit, made.task.input_unit) == (0.005, "mm", "mm")
    np.testing.assert_allclose(np.asarray(made.task.reference)[:, 0], MOVE, atol=1e-8)
    errors = np.asarray(learn(made.machine, made.schemes["ilc"], made.task, 8).metrics.rms)[:, 0]
    np.testing.assert_allclose(errors[0], np.sqrt(np.mean((MOVE - y)[1:] ** 2)), rtol=0.1)
    assert errors[-1] < 0.02 * errors[0]
    move = (tmp_path / "move.csv").read_text()
    (tmp_path / "um.csv").write_text(move.replace("act [mm]", "act [um]"))
    for wrong, said in (
        (("init", "--record", "move.csv", "b.toml"), "--record is for --set-point"),
        (("init", "--set-point", "--input", "set", "b.toml"), "--input set names a column of"),
        (("init", "--set-point", "--record", "move.csv", "b.toml"), "has no column 'u'; present"),
        (("init", "--set-point", "--record", "gone.csv", "b.toml"), "gone.csv"),
        (
            ("init", "--set-point", "--record", "um.csv", *columns, "b.toml"),
            "um.csv: set is in 'mm' and pos_act in 'um'; allowed is one unit for both",
        ),
    ):
        assert said in refused(*wrong)
        assert not (tmp_path / "b.toml").exists()
    write_columns("far.csv", "t,u,y", 0.005 * np.arange(401), MOVE + 100, y + 100)
    said = refused("init", "--set-point", "--record", "far.csv", "b.toml")
    assert "far.csv: u begins at 100, where the move must begin at 0" in said
    assert not (tmp_path / "b.toml").exists()


@pytest.mark.parametrize(
    ("hertz", "dt", "heading", "unit"),
    [(2, 0.01, "Zeit [ms];set;pos_act", "mm"), (60, 0.005, "time [ms];set [um];pos_act", "um")],
)
def test_the_law_of_a_recorded_drive_is_one_that_learns_on_it(tmp_path, hertz, dt, heading, unit):
    """That of the file without a record has a cutoff at Nyquist here, or makes the error grow."""
    recorded(tmp_path, 2 * np.pi * hertz, dt)
    move = tmp_path / "move.csv"
    _, rows = move.read_text(encoding="utf-8").split("\n", 1)
    move.write_text(f"{heading}\n{rows}", encoding="utf-8")
    columns = ("--time", heading.split()[0], "--input", "set", "--output", "pos_act")
    code, out, err = call("init", "--set-point", "--record", "move.csv", *columns, "a.toml")
    assert (code, err) == (0, "")
    assert f"move.csv gives no unit of pos_act; {unit} is assumed" in flat(out)
    made = read_scenario(tmp_path / "a.toml")
    learning = made.schemes["ilc"].scheme.scheme
    assert f"gamma_p = {float(learning.gamma_p):g}, lead = {learning.lead} and" in " ".join(
        out.split()
    )

    def errors(gain):
        machine = replaced(made.machine, {"plant.gain": gain})
        return learn(machine, made.schemes["ilc"], made.task, 15).metrics.rms[:, 0]

    gain = float(made.machine.plant.gain)
    low, fitted, high = np.asarray(jax.vmap(errors)(gain * np.array([0.9, 1.0, 1.1])))
    assert fitted[-1] < 0.002 * fitted[0]
    assert max(low[-1] / low[0], high[-1] / high[0]) < 0.05
    grid = re.search(r'^#"ilc.scheme.scheme.lead" = (.*)$', (tmp_path / "a.toml").read_text(), re.M)
    assert json.loads(grid[1])[-1] == learning.lead


def test_the_law_of_a_record_stays_where_the_record_shows_the_drive(tmp_path):
    """A smooth move leaves a resonance of 14 Hz unseen; the law of the fit alone diverges on it."""
    dt, w, v = 0.005, 8 * np.pi, 28 * np.pi
    slow, fast = np.array([1, 1.2 * w, w * w]), np.array([1, 0.06 * v, v * v])
    top = np.polyadd(0.7 * w * w * fast, 0.3 * v * v * slow)
    b, a, _ = scipy.signal.cont2discrete((top, np.polymul(slow, fast)), dt)
    y = scipy.signal.lfilter(b[0], a, MOVE) + 1e-4 * np.random.default_rng(0).normal(size=401)
    write_columns("move.csv", "t [s],u [mm],y [mm]", dt * np.arange(401), MOVE, y)
    code, out, err = call("init", "--set-point", "--record", "move.csv", "a.toml")
    assert (code, err) == (0, "")
    for said in ("The residual is not white", "is not significant", "jaxilc filter T.csv --gain"):
        assert said in flat(out)
        assert said in (tmp_path / "a.toml").read_text(encoding="utf-8") or "filter" in said
    made = read_scenario(tmp_path / "a.toml")
    law = made.schemes["ilc"].scheme
    z = np.exp(2j * np.pi * dt * np.linspace(0.01, 99.6, 5000))
    ratio = np.tan(np.angle(z) / 2) / np.tan(np.pi * dt * float(law.filter.cutoff))
    T = np.polyval(b[0], z) / np.polyval(a, z)
    kept = 1 - float(law.scheme.gamma_p) * z ** (1 + law.scheme.lead) * T
    assert np.max(np.abs(kept) / (1 + ratio**4)) < 0.7
    known = made.uncertainty["plant.gain"]
    assert known.low <= 0.9 * float(made.machine.plant.gain)


def test_the_file_runs_as_it_is_and_with_every_choice(tmp_path):
    code, out, err = call("init")
    assert (code, err) == (0, "")
    assert out.endswith("jaxilc run axis.toml\n")
    made = read_scenario(tmp_path / "axis.toml")
    assert [*made.schemes] == ["ilc"]
    assert made.tolerance is None

    text = (tmp_path / "axis.toml").read_text(encoding="utf-8")
    assert len(re.findall(r"^#[a-z\[]", text, re.M)) > 12
    chosen = tmp_path / "chosen.toml"
    chosen.write_text(re.sub(r"^#(?=[a-z\[])", "", text, flags=re.M))
    made = read_scenario(chosen)
    assert [*made.schemes] == ["ilc", "norm-optimal"]
    assert (made.tolerance, made.trials, made.title) == (0.02, 20, "my axis")
    assert made.machine.actuator.limit == 10.0
    assert made.machine.sensor.noise == 1e-5
    assert made.machine.disturbance.input_noise == 1e-5


def test_the_comments_name_commands_that_exist_and_a_path_that_can_be_planned(tmp_path):
    assert call("init")[0] == 0
    text = (tmp_path / "axis.toml").read_text(encoding="utf-8")
    named = set(re.findall(r"jaxilc ([a-z-]+)", text))
    assert {"run", "design", "sweep", "certify", "list", "identify"} <= named
    assert named <= set(get_command(app).commands)
    head, plant, rest = re.split(r"^(\[plant\]\n(?:.+\n)+)", text, flags=re.M)
    plant = '[plant]\nkind = "TwoAxes"\n' + plant.replace("[plant]", "[plant.axis]")
    path = re.search(r"^#   (reference = \{ path .*)$", text, re.M)[1]
    rest = re.sub(r"^reference = .*$", path, rest, flags=re.M)
    (tmp_path / "two.toml").write_text(head + plant + rest[: rest.index("[schemes.ilc]")])
    made = read_scenario(tmp_path / "two.toml")
    assert (made.task.names, made.judged_by) == (("x", "y"), "contour_max")


@pytest.mark.parametrize("kind", PLANTS)
def test_the_plants_of_the_comments_fit_the_rest_of_the_file(kind, tmp_path):
    assert call("init")[0] == 0
    text = (tmp_path / "axis.toml").read_text(encoding="utf-8")
    assert kind in text
    text = re.sub(r"^(num|den) = .*\n", "", text, flags=re.M).replace(
        'kind = "transfer_function"', f'kind = "{kind}"\n{PLANTS[kind]}'
    )
    own = tmp_path / "own.toml"
    own.write_text(text[: text.index("[uncertainty")])
    assert read_scenario(own).machine.plant.n_y == 1


def test_a_file_that_exists_is_kept_without_force(tmp_path):
    kept = tmp_path / "mine.toml"
    kept.write_text("# mine")
    assert "mine.toml exists already; add --force to replace it" in refused("init", "mine.toml")
    assert kept.read_text() == "# mine"
    code, _, err = call("init", "--force", "mine.toml")
    assert (code, err) == (0, "")
    assert "[plant]" in kept.read_text()
    assert "mine.json is not a name that ends with .toml" in refused("init", "mine.json")
    code, _, err = call("init", "new/[b] one.toml")
    assert (code, err) == (0, "")
    assert (tmp_path / "new/[b] one.toml").exists()
