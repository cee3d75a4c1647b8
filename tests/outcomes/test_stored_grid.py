"""The folder of a grid, given for `--params`, is its best point, or is refused in words."""

import shutil

import numpy as np
import pytest
from gain_case import Killed

from jaxilc import Machine, Sweep, Task, outcomes
from jaxilc.outcomes import Request
from jaxilc.plants import StateSpace
from jaxilc.scenarios import Scenario
from jaxilc.schemes import PIDType
from jaxilc.sweeps import best_points, open_dataset, point_of
from jaxilc.tuning import Tuned

pytestmark = pytest.mark.usefixtures("compiled_once")

NAME = "ffdl-mfailc"
SHORT = ["frequency=50"]  # 20 samples a trial
PHI0 = [(0.5, 0.0, -0.06, 0.0), (0.25, 0.125, -0.03, 0.01)]


def asked(folder, *, scheme=NAME, trials=None, settings=(), scenario="cao-2019"):
    return Request(scenario, (scheme,), (*SHORT, *settings), folder, trials).scenario()


def stored(folder, grid, settings=()):
    """Store a sweep as the command does, and return its folder."""
    of = asked(None, trials=3, settings=settings)
    Sweep(
        of.machine, of.schemes, of.task, of.trials, uncertainty=of.uncertainty, machines=2,
        quantities=of.functions, grid=grid,
    ).run(folder / "dataset.zarr")  # fmt: skip
    return folder


def test_settings_are_also_values_by_path():
    law = f"{NAME}.phi0"
    values = {"frequency": 50, f"{NAME}.lam": np.float64(0.1) / 3, law: np.array(PHI0[1][:3])}
    values |= {f"{NAME}.L_y": 1, f"{NAME}.reset": "sign", "plant.gain": 7e3}
    texts = ("frequency=50", f"{NAME}.lam={0.1 / 3!r}", f"{law}=0.25,0.125,-0.03")
    texts += (f"{NAME}.L_y=1", f"{NAME}.reset=sign", "plant.gain=7000.0")
    assert Request("cao-2019", set=values).set == texts
    chosen = Request("cao-2019", (NAME,), texts).scenario()
    found = chosen.schemes[NAME]
    assert (float(found.lam), tuple(found.phi0), found.L_y) == (0.1 / 3, PHI0[1][:3], 1)
    assert (found.reset, float(chosen.machine.plant.gain), chosen.task.N) == ("sign", 7e3, 20)


@pytest.fixture(scope="module")
def grid(tmp_path_factory):
    gain = float(asked(None).machine.plant.gain)
    other = asked(None, settings=["reading=amplitude"])
    readings = {"stroke": asked(None, settings=["reading=stroke"]), "amplitude": other}
    # A static value is a program of its own: one of each axis, which is not the scenario's own.
    return stored(
        tmp_path_factory.mktemp("grid"),
        {f"{NAME}.lam": [0.3, 1 / 3], f"{NAME}.phi0": PHI0, f"{NAME}.reset": ["none"],
         "plant.gain": [gain / 3, gain], "trials": [2], "reading": readings},
    )  # fmt: skip


@pytest.mark.thorough
def test_the_scenario_is_that_of_the_best_point(grid):
    dataset = open_dataset(grid / "dataset.zarr")
    found, of = asked(grid), asked(None)
    limit = of.tolerance / of.shown(of.judged_by)[0]
    best = best_points(dataset, limit, metric=of.judged_by)[0].point
    law = found.schemes[NAME]
    assert (float(law.lam), law.reset) == (best[f"{NAME}.lam"], best[f"{NAME}.reset"])
    assert " ".join(f"{x:g}" for x in np.asarray(law.phi0)) == best[f"{NAME}.phi0"]
    assert float(found.machine.plant.gain) == best["machine.plant.gain"]
    assert (found.trials, found.options["reading"]) == (best["trials"], best["reading"])


def test_a_point_of_shared_axes_and_of_arrays_is_whole(tmp_path):
    lam, mu, phi0 = [0.3, 1 / 3], [0.5, 2 / 3], [(1 / 3, 0, -0.06, 0), (0.25, 0.125, -1 / 30, 0.01)]
    shared = {f"{NAME}.lam/{NAME}.mu": [lam, mu], f"{NAME}.phi0": phi0}
    dataset = open_dataset(stored(tmp_path, shared) / "dataset.zarr")
    for i, label in enumerate(dataset[f"{NAME}.phi0"].values):
        point = point_of(dataset, {f"{NAME}.lam": lam[i], f"{NAME}.phi0": label})
        law = asked(None).with_values(point).schemes[NAME]
        assert (float(law.lam), float(law.mu)) == (lam[i], mu[i])
        assert np.asarray(law.phi0).tolist() == list(phi0[i])


@pytest.mark.thorough
def test_a_point_of_matrices_has_their_shape_and_their_digits():
    plant = StateSpace([[0.5, 0.1], [0.0, 0.4]], [[1.0], [0.0]], [[1.0, 0.0]], dt=1e-3)
    B = "plant.B"
    task, grid = Task(np.ones(5), dt=1e-3), {B: [[[1.0], [0.0]], [[1.23456789], [0.0]]]}
    s = Scenario("two", "two", Machine(plant), task, {"p": PIDType(gamma_p=0.1)}, 2, {})
    dataset = Sweep(s.machine, s.schemes, task, 2, {}, machines=1, grid=grid).run()
    for label, value in zip(dataset[f"machine.{B}"].values, grid[B], strict=True):
        found = s.with_values(point_of(dataset, {f"machine.{B}": label}))
        assert np.asarray(found.machine.plant.B).tolist() == value


@pytest.mark.thorough
def test_what_is_set_goes_on_top(grid):
    settings = [f"{NAME}.lam=7", "plant.gain=-3", "reading=stroke", f"{NAME}.mu=2"]
    found = asked(grid, settings=settings, trials=9)
    law = found.schemes[NAME]
    assert (float(law.lam), float(law.mu), found.trials) == (7.0, 2.0, 9)
    assert (float(found.machine.plant.gain), found.options["reading"]) == (-3.0, "stroke")


def test_tuning_starts_at_the_best_point(tmp_path):
    def halved(search, *_, **__):
        """A tuning that takes half of the weight; the search itself has its own tests."""
        problem, one = search.__self__, np.ones((1, 1))
        values = {"lam": 0.5 * problem.start["lam"]}
        return Tuned(
            values, problem.scheme_of(values), problem.start, one, one, 0 * one, {"lam": one}, one,
            1.0, 0.5, 1, {}, "steps",
        )  # fmt: skip

    folder = stored(tmp_path / "grid", {f"{NAME}.lam": [0.5, 2.0], "plant.gain": [-4e3, 7e3]})
    best, request = asked(folder), Request("cao-2019", (NAME,), (*SHORT,), folder, 3)
    found = outcomes.tune(request, weights="lam", machines=2, held_out=2, unseen=2, run=halved)
    assert found.numbers["weights"]["lam"]["given"] == float(best.schemes[NAME].lam)
    gain = f"machine.plant.gain={float(best.machine.plant.gain)}"
    assert gain in found.verdict.following  # it is not in the parameter file


def test_what_is_no_grid_of_this_scenario_is_refused(tmp_path):
    plain = stored(tmp_path / "plain", {})
    with pytest.raises(ValueError, match="plain has no grid; a sweep with --grid has one"):
        asked(plain)
    with pytest.raises(ValueError, match="neither a parameter file nor the folder of a sweep"):
        asked(tmp_path)
    settle = stored(tmp_path / "settle", {"task.settle": [(0.001, 0.01)]})
    with pytest.raises(ValueError, match=r"settle has the schemes ffdl-mfailc, and none of pid"):
        asked(settle, scheme="pid")
    with pytest.raises(ValueError, match=r"of another scenario, or of other settings; it differs"):
        Request("cao-2019", (NAME,), params=settle).scenario()
    with pytest.raises(ValueError, match="and none of p-type"):
        Request("li-2020", ("p-type",), params=settle).scenario()
    with pytest.raises(ValueError, match=r"the axis task.settle is not one that --set can set"):
        asked(settle)
    lost = stored(tmp_path / "lost", {f"{NAME}.lam": [0.5, 2.0]}, settings=["plant.gain=-1e9"])
    with pytest.raises(ValueError, match=r"it differs in machine.plant.gain: -1000000000.0 there"):
        asked(lost)
    with pytest.raises(ValueError, match="more than 5 % of the machines diverge at every point"):
        asked(lost, settings=["plant.gain=-1e9"])  # which explains the difference


def test_what_an_axis_replaced_is_no_difference(tmp_path):
    """A grid with another value beneath an axis was one of other settings."""
    other = [f"{NAME}.lam=0.7", f"{NAME}.rho=0.3"]
    grid = stored(tmp_path, {f"{NAME}.lam": [0.3, 0.5]}, other)
    found = asked(grid, settings=other[1:]).schemes[NAME]
    assert (float(found.lam) in (0.3, 0.5), float(found.rho)) == (True, 0.3)
    with pytest.raises(ValueError, match=rf"it differs in schemes.{NAME}.rho: 0.3 there"):
        asked(grid)


def test_what_is_killed_or_damaged_is_refused_until_it_is_resumed(tmp_path):
    def kill(name, done, fresh):
        raise Killed

    of, folder = asked(None, trials=2), tmp_path / "killed"
    sweep = Sweep(
        of.machine, of.schemes, of.task, 2, uncertainty={}, machines=1, chunk=1,
        quantities=of.functions, grid={f"{NAME}.lam": [0.5, 1.0, 2.0]},
    )  # fmt: skip
    with pytest.raises(Killed):
        sweep.run(folder / "dataset.zarr", progress=kill)
    with pytest.raises(ValueError, match=r"is not complete: 2 of 3 runs are missing; the same"):
        asked(folder)
    sweep.run(folder / "dataset.zarr", resume=True)
    assert float(asked(folder).schemes[NAME].lam) in (0.5, 1.0, 2.0)
    shutil.rmtree(folder / "dataset.zarr" / "finite")
    with pytest.raises(ValueError, match="is damaged"):
        asked(folder)
