"""FMUs of a law and of a plant, called as a simulator calls them."""

import ctypes as c
import dataclasses
import io
import shutil
import zipfile
from xml.etree import ElementTree

import numpy as np
import pytest
from cases import PLANTS, case, task_for
from jax import lax
from jax import numpy as jnp

from jaxilc.export import law_of, program_of
from jaxilc.export.c_files import files_of
from jaxilc.export.certificate import WRITTEN
from jaxilc.export.fmu import law_block, packed, plant_block
from jaxilc.export.formats import FORMATS, Asked
from jaxilc.export.law import Field, Function
from jaxilc.export.plant import Model, files_of_plant, model_of
from jaxilc.learning import Disturbance, Machine, learn
from jaxilc.native.program import Unknown
from jaxilc.plants import StateSpace
from jaxilc.plants.along_motion import motion
from jaxilc.signals import Task

compiled = pytest.mark.skipif(shutil.which("cc") is None, reason="needs a C compiler, as `cc`")
VALUES = {"Real": c.c_double, "Float64": c.c_double, "Integer": c.c_int, "Int32": c.c_int32}


class Instance:
    """An FMU of either version, loaded and instantiated; variables by their names."""

    def __init__(self, content, folder):
        with zipfile.ZipFile(io.BytesIO(content)) as fmu:
            fmu.extractall(folder)
        self.root = ElementTree.parse(folder / "modelDescription.xml").getroot()
        self.version = int(self.root.get("fmiVersion")[0])
        (library,) = [p for p in (folder / "binaries").rglob("*") if p.is_file()]
        self.library = c.CDLL(str(library))
        self.places = {}
        for one in self.root.find("ModelVariables"):
            kind = one[0].tag if self.version == 2 else one.tag
            self.places[one.get("name")] = kind, int(one.get("valueReference"))
        self.token = self.root.get("guid") or self.root.get("instantiationToken")
        self.it = self.instantiate(self.token)

    def instantiate(self, token):
        name, text = b"one", token.encode()
        if self.version == 2:
            make = self.library.fmi2Instantiate
            make.restype = c.c_void_p
            return c.c_void_p(make(name, 1, text, None, None, 0, 0))
        make = self.library.fmi3InstantiateCoSimulation
        make.restype = c.c_void_p
        flags = [c.c_bool(False)] * 4
        return c.c_void_p(make(name, text, None, *flags, None, c.c_size_t(0), None, None, None))

    def type_of(self, kind):
        boolean = c.c_int if self.version == 2 else c.c_bool
        return VALUES.get(kind, boolean)

    def call(self, name, *given):
        return getattr(self.library, f"fmi{self.version}{name}")(self.it, *given)

    def access(self, verb, name, value=0):
        kind, place = self.places.get(name, ("Real" if self.version == 2 else "Float64", 77))
        held = self.type_of(kind)(value)
        counts = [c.c_size_t(1)] if self.version == 3 else []
        status = self.call(f"{verb}{kind}", c.byref(c.c_uint(place)), c.c_size_t(1),
                           c.byref(held), *counts)  # fmt: skip
        return status, held.value

    def get(self, name):
        status, value = self.access("Get", name)
        assert status == 0
        return value

    def set(self, name, value):
        assert self.access("Set", name, value)[0] == 0

    def step(self, size):
        flags = [c.byref(c.c_bool()) for _ in range(3)] if self.version == 3 else []
        last = [c.byref(c.c_double())] if self.version == 3 else []
        back = c.c_int(1) if self.version == 2 else c.c_bool(True)
        return self.call("DoStep", c.c_double(0.0), c.c_double(size), back, *flags, *last)


def block_of(model):
    files = files_of_plant(model, ["A plant."])
    return plant_block(model.task, files, "A plant.", model.first)


@pytest.fixture(scope="module")
def exported():
    machine, scheme, task = case("norm_optimal")
    law = law_of(scheme, task, 100.0)
    rng = np.random.default_rng(0)
    y = np.asarray(task.reference) + 0.01 * rng.standard_normal(task.reference.shape)
    model = model_of(machine, task)
    files = files_of(law, ["A law."], "0" * 64, [y])
    return law, y, law_block(task, files, "A law."), block_of(model), model


@compiled
@pytest.mark.parametrize("version", [2, 3])
def test_a_law_plays_in_an_fmu_what_it_plays_here(exported, version, tmp_path):
    law, y, block, *_ = exported
    fmu, dt = Instance(packed(block, version=version), tmp_path), law.task.dt
    names = {"y": [f"y[{i + 1}]" for i in range(2)], "u": [f"u[{i + 1}]" for i in range(2)]}
    played = law.played()
    fmu.set("start", True)
    for trial in range(2):
        wanted, code = played.trial(y)
        for k, row in enumerate(y):
            for name, value in zip(names["y"], row, strict=True):
                fmu.set(name, value)
            if k == 3:  # a state is kept, spoiled and brought back
                size = c.c_size_t()
                state, again = c.c_void_p(), c.c_void_p()
                get, put, free = ("GetFMUstate", "SetFMUstate", "FreeFMUstate")
                if version == 3:
                    get, put, free = (x.replace("state", "State") for x in (get, put, free))
                assert fmu.call(get, c.byref(state)) == 0
                text = "FMUstate" if version == 2 else "FMUState"
                assert fmu.call(f"Serialized{text}Size", state, c.byref(size)) == 0
                kept = c.create_string_buffer(size.value)
                assert fmu.call(f"Serialize{text}", state, kept, size) == 0
                fmu.step(dt)
                made = "DeSerialize" if version == 2 else "Deserialize"
                assert fmu.call(f"{made}{text}", kept, size, c.byref(again)) == 0
                assert fmu.call(put, again) == 0
                for one in (state, again):
                    assert fmu.call(free, c.byref(one)) == 0
            assert fmu.step(dt) == 0
            if k < len(wanted):
                assert [fmu.get(name) for name in names["u"]] == list(wanted[k])
        assert (fmu.get("trial"), fmu.get("code"), fmu.get("running")) == (trial + 1, code, False)
    assert fmu.step(0.4 * dt) != 0
    assert fmu.access("Set", "u[1]", 1.0)[0] != 0  # which is no input
    assert fmu.access("Get", "nobody")[0] != 0
    assert not fmu.instantiate("{0}").value
    assert fmu.call("Reset") == 0
    assert fmu.get("trial") == 0
    fmu.call("FreeInstance")


@pytest.mark.thorough
@compiled
@pytest.mark.parametrize("version", [2, 3])
def test_a_step_of_several_samples_begins_from_rest_once(version, tmp_path):
    plant, x = StateSpace([[0.5]], [[0.5]], [[1.0]], dt=1e-3), 0.0
    model = model_of(Machine(plant), Task(np.zeros(4), dt=1e-3))
    fmu = Instance(packed(block_of(model), version=version), tmp_path)
    fmu.set("u", 3.0)
    assert fmu.step(1e-3) == 0
    fmu.set("rest", True)
    fmu.set("u", 1.0)
    for _ in range(3):
        x = 0.5 * x + 0.5
    for _ in range(2):
        fmu.set("u", 1.0)
        assert fmu.step(3e-3) == 0
        fmu.set("u", 9.0)
        assert fmu.get("y") == x
    of = [one for one in fmu.root.find("ModelStructure").iter() if not len(one)]
    assert [one.get("dependencies") for one in of] == ["", ""]  # so a loop with a law is none


def test_a_plant_that_varies_over_a_trial_steps_by_its_own_matrices():
    plant = PLANTS["time_varying"]
    u = np.random.default_rng(2).standard_normal((plant.N, 1))
    found = model_of(Machine(plant), task_for(plant, plant.N)).response(u)
    x, wanted = np.zeros(2), [np.zeros(1)]
    for A, B, C, row in zip(plant.A, plant.B, plant.C, u, strict=True):
        x = A @ x + B @ row
        wanted.append(C @ x)
    np.testing.assert_allclose(found, wanted, rtol=1e-10, atol=1e-12)


@pytest.mark.thorough
def test_a_plant_reads_its_friction_from_a_table():
    plant, u = PLANTS["ball_screw_real"], np.random.default_rng(3).standard_normal((8, 1))
    task = task_for(plant, 8)
    model, y = model_of(Machine(plant), task), motion(plant, u, task.dt)
    assert {*files_of_plant(model, [])} == {"plant.h", "plant.c"}
    np.testing.assert_allclose(model.response(u), y, rtol=1e-10, atol=1e-14)


def three_passes(x):
    return lax.scan(lambda x, _: (x[::-1], None), x, length=3)[0]


def until_the_third(x):
    return lax.while_loop(lambda of: of[1] < 3, lambda of: (of[0][::-1], of[1] + 1), (x, 0))[0]


def summed_by_columns(x):
    return x - jnp.sum(jnp.square(x.reshape(4, 10) / 7), axis=(1, 0))


@compiled
@pytest.mark.parametrize("turned", [three_passes, until_the_third, summed_by_columns])
def test_a_loop_may_turn_the_array_that_it_carries(turned, tmp_path):
    """Its passes read all of the array before they write to it; sums are row by row."""
    task = Task(np.zeros(4), dt=1e-3)

    def step(x, u):
        x = turned(x + u)
        return x, {"y": x[:1]}

    fields = {"x": Field(np.arange(40.0), "")}
    made = Function("step", program_of(step, fields["x"].first, np.ones(1)), ("x", "u"), ("x", "y"))
    model = Model(task, fields, made, np.zeros(1))
    fmu = Instance(packed(block_of(model), version=2), tmp_path)
    for answer in model.response(np.ones((2, 1)))[1:]:
        fmu.set("u", 1.0)
        assert fmu.step(task.dt) == 0
        assert fmu.get("y") == answer


@pytest.mark.thorough
@compiled
@pytest.mark.parametrize("version", [2, 3])
def test_law_and_plant_learn_together_what_they_learn_here(exported, version, tmp_path):
    *_, block, plant, model = exported
    machine, scheme, task = case("norm_optimal")
    one = Instance(packed(block, version=version), tmp_path / "law")
    other = Instance(packed(plant, version=5 - version), tmp_path / "plant")
    one.set("start", True)
    rms = []
    for _ in range(4):
        y, other_rest = model.first, True
        error = []
        for k in range(task.N + 1):
            for i, value in enumerate(y):
                one.set(f"y[{i + 1}]", value)
            assert one.step(task.dt) == 0
            if k < task.N:
                other.set("rest", other_rest)
                other_rest = False
                for i in (1, 2):
                    other.set(f"u[{i}]", one.get(f"u[{i}]"))
                assert other.step(task.dt) == 0
                y = np.array([other.get(f"y[{i}]") for i in (1, 2)])
                error.append(task.reference[k + 1] - y)
        rms.append(np.sqrt(np.mean(np.square(error), axis=0)))
    history = learn(machine, scheme, task, 4)
    np.testing.assert_allclose(rms, history.rms, rtol=1e-9)
    assert rms[-1].max() < rms[0].max()


@pytest.mark.parametrize("version", [2, 3])
def test_an_fmu_is_what_the_standard_asks_for(exported, version, tmp_path):
    fmpy = pytest.importorskip("fmpy.validation", reason="pip install fmpy")
    for one in exported[2:4]:
        path = tmp_path / f"{one.name}.fmu"
        path.write_bytes(packed(one, version=version, compiler="no-such-compiler"))
        assert fmpy.validate_fmu(str(path)) == []


def test_an_fmu_without_a_compiler_holds_the_sources_and_no_library(exported):
    block = exported[2]
    found = packed(block, version=2, compiler="no-such-compiler")
    assert found == packed(block, version=2, compiler="no-such-compiler")
    with zipfile.ZipFile(io.BytesIO(found)) as fmu:
        names = fmu.namelist()
    assert "sources/law.c" in names
    assert not any(name.startswith("binaries") for name in names)


def test_single_precision_is_refused_by_name(exported):
    law, y, *_ = exported
    asked = Asked(law, None, ["A law."], "0" * 64, [y], single=True)
    for name in ("fmu", "hal", "st"):
        with pytest.raises(Unknown, match="`--number float` in a"):
            FORMATS[name].make(asked)


def test_a_plant_that_has_no_fmu_is_told(exported, monkeypatch):
    monkeypatch.setenv("CC", "no-such-compiler")
    law, y, *_ = exported
    disturbance = Disturbance(input=np.zeros((12, 2)))
    machine = dataclasses.replace(case("norm_optimal")[0], disturbance=disturbance)
    made = FORMATS["fmu"].make(Asked(law, machine, ["A law."], "0" * 64, [y], single=False))
    assert not [name for name in made.files if name.startswith("plant")]
    assert {*made.files} <= WRITTEN
    said = "the disturbance of the machine cannot be a part of one"
    assert made.warnings == (f"The plant has no FMU: {said}.",)
