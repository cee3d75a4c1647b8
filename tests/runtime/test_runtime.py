"""These tests check how JAX is started."""

import contextlib
import json
import os
import subprocess
import sys

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxilc
from jaxilc import Machine, Task, learn
from jaxilc.plants import StateSpace
from jaxilc.runtime import start
from jaxilc.schemes import PIDType


def python(program, *arguments, **environment):
    kept = {name: value for name, value in os.environ.items() if name not in ("XLA_FLAGS", "NPROC")}
    return subprocess.run(
        [sys.executable, "-c", program, *arguments], env=kept | environment, capture_output=True,
        text=True, timeout=60, check=True,
    )  # fmt: skip


FLAGS = """
import json, os, sys, warnings
import jaxilc.runtime.start as start, jaxilc.runtime.xla_options as options
jaxlib = options.jaxlib
def flags(given="", platforms=None, plugins=True, version=jaxlib.__version__, **texts):
    os.environ["XLA_FLAGS"] = given
    start.jax.config.update("jax_platforms", platforms)
    start.entry_points = lambda group: [group] * plugins
    known = {name: getattr(options, name) for name in texts} | {"version": jaxlib.__version__}
    vars(options).update(texts)
    jaxlib.__version__ = version
    with warnings.catch_warnings(record=True) as said:
        start.setup(devices=3)
    jaxlib.__version__ = known.pop("version")
    vars(options).update(known)
    return os.environ["XLA_FLAGS"], [str(one.message) for one in said]
of_environment = start.jax.config.jax_platforms
found = {name: flags(**case) for name, case in json.loads(sys.argv[1]).items()}
os.environ["XLA_FLAGS"] = found["wide"][0]
start.jax.config.update("jax_platforms", "cpu")
begun = [start.jax.device_count(), start.jax.numpy.ones(2).dtype.name]
print(json.dumps([found, begun, of_environment]))
"""
KEPT_AS_IT_IS = "--xla_backend_extra_options=xla_cpu_small_while_loop_byte_threshold=7"
CPU = {"platforms": "cpu"}
LATER = CPU | {"version": "91.1.0"}
OF_LATER = {
    "later": LATER, "later, fewer": LATER | {"LOADS_SHARED": ",-no-such-option=1"},
    "later, none": LATER | {"WHOLE_LOOPS": "--xla_no_such_option=1"},
}  # fmt: skip
CASES = {
    "accelerated": {}, "without plugins": {"plugins": False}, "wide": CPU,
    "asked": CPU | {"given": "--xla_cpu_prefer_vector_width=128"}, "kept": {"given": KEPT_AS_IT_IS},
}  # fmt: skip


@contextlib.contextmanager
def setup_for(double):
    jaxilc.setup(precision="float64" if double else "float32", devices=jax.device_count())
    yield
    jaxilc.setup(devices=jax.device_count())


def flags_after_setup(cases):
    """Return XLA_FLAGS after `setup` in each case and the case's warnings.

    One process that has not started JAX finds them all. It then computes with the options of
    "wide", on the devices and in the precision of `setup`: an option that XLA does not know ends
    the process.
    """
    found, begun, of_environment = json.loads(
        python(FLAGS, json.dumps(cases), JAX_PLATFORMS="cpu").stdout
    )
    assert begun == [3, "float64"]
    assert of_environment == "cpu", "JAX_PLATFORMS is where the setting comes from"
    return found


@pytest.fixture(scope="module")
def flags():
    return flags_after_setup(CASES)


@pytest.mark.thorough
def test_options_that_an_accelerator_would_read_are_left_out_where_there_is_one(flags):
    assert "unroll" not in flags["accelerated"][0]
    assert "unroll" in flags["wide"][0]
    assert "unroll" in flags["without plugins"][0]


@pytest.mark.thorough
def test_wide_registers_are_asked_for_where_nobody_else_did(flags):
    assert "prefer_vector_width=512" in flags["wide"][0]
    asked = flags["asked"][0]
    assert (asked.count("prefer_vector_width"), "=128" in asked) == (1, True)


@pytest.mark.thorough
def test_a_later_version_is_given_the_options_that_it_knows():
    """An option that XLA or LLVM does not know ends a process, which is another one here."""
    flags = flags_after_setup({"wide": CPU, **OF_LATER})
    assert flags["later"] == flags["wide"]
    fewer, said = flags["later, fewer"]
    assert fewer == "--xla_backend_extra_options=xla_cpu_small_while_loop_byte_threshold=1000000000"
    assert [text.partition(";")[0] for text in said] == [
        "jaxlib 91.1.0 does not know all options that jaxilc gives to XLA"
    ]
    assert flags["later, none"] == ["", said]


def test_options_that_are_given_are_not_changed(flags):
    assert "xla_cpu_small_while_loop_byte_threshold" in flags["without plugins"][0]
    assert flags["kept"] == [KEPT_AS_IT_IS, []]


def test_an_accelerator_multiplies_matrices_in_the_precision_that_was_chosen(monkeypatch):
    monkeypatch.setattr(start, "_accelerated", lambda: True)
    of = jax.ShapeDtypeStruct((2, 2), "float32")
    try:
        for before, after in ((None, "HIGHEST"), ("high", "HIGH")):
            jax.config.update("jax_default_matmul_precision", before)
            jaxilc.setup(precision="float32", devices=jax.device_count())
            assert f"[{after}, {after}]" in jax.jit(lambda x: x @ x).lower(of).as_text()
    finally:
        jax.config.update("jax_default_matmul_precision", None)
        jaxilc.setup(devices=jax.device_count())


def test_the_version_of_jax_whose_loops_are_slow_is_reported(monkeypatch):
    monkeypatch.setattr("jax.__version__", "0.11.1")
    with pytest.warns(RuntimeWarning, match=r"^JAX 0\.11\.1 takes time quadratic"):
        jaxilc.setup(devices=jax.device_count())


@pytest.mark.thorough
def test_importing_flips_nothing_and_setup_too_late_says_so():
    program = (
        "import jaxilc, jax, os; from jaxilc.outcomes import Request; "
        "Request('cao-2019').scenario(); "
        "print(jax.config.jax_enable_x64, 'XLA_FLAGS' in os.environ); "
        "jax.numpy.ones(1) + 1; jaxilc.setup(devices=3); Request('cao-2019').scenario()"
    )
    found = python(program)
    assert found.stdout.split() == ["False", "False"]
    assert found.stderr.count("setup() was not called: JAX computes in float32") == 1
    assert "came after JAX had started" in found.stderr


@pytest.mark.thorough
def test_setup_too_late_for_loops_says_so_even_where_the_devices_are_given():
    program = (
        "import jax; jax.numpy.ones(1) + 1; import jaxilc; jaxilc.setup(); "
        "print(jax.device_count())"
    )
    given = "--xla_force_host_platform_device_count=2"
    found = python(program, XLA_FLAGS=given)
    assert found.stdout.split() == ["2"]
    assert "loops run several times slower" in found.stderr
    twice = "import jaxilc, jax; jaxilc.setup(); jax.numpy.ones(1) + 1; jaxilc.setup()"
    assert python(twice, XLA_FLAGS=given).stderr == ""


@pytest.mark.parametrize("change", [setup_for, jax.enable_x64])
def test_programs_get_arrays_in_the_precision_at_hand_whatever_others_hold(change):
    """JAX kept what it had made of an array, and gave it to programs of the other precision."""
    law, machine = PIDType(gamma_p=0.5), Machine(StateSpace([[0.9]], [[0.1]], [[1.0]], dt=1e-3))
    task, holding = Task(np.sin(np.arange(9.0)), dt=1e-3), []
    closed = jax.jit(lambda gain: learn(machine, law, task, 2).rms * gain)
    for double in (True, False) * 2:
        with change(double):
            holding.append([jax.make_jaxpr(lambda gain: gain * task.reference)(1.0)])
            holding.append(jax.tree.map(jnp.asarray, (machine, task)))
            for found in (closed(1.0), learn(machine, law, task, 2).rms):
                assert found.dtype == (np.float64 if double else np.float32)


KEPT = """
import jaxilc, jax; jaxilc.setup()
from jaxilc.runtime.start import keep_programs
hits = []
def listen(name, **_):
    if name.endswith("cache_hits"):
        hits.append(name)
jax.monitoring.register_event_listener(listen)
folder = keep_programs()
print(folder, len(hits), end=" ")
print(float(jax.jit(lambda x: x @ x + 1.0)(jax.numpy.ones(3))), len(hits) > 0)
"""


@pytest.mark.thorough
def test_programs_are_found_again_by_the_next_start(tmp_path):
    first, again = (
        python(KEPT, XDG_CACHE_HOME=str(tmp_path), JAXILC_CACHE="").stdout.split() for _ in range(2)
    )
    assert first[0].startswith(str(tmp_path / "jaxilc"))
    assert (first[1:], again[1:]) == (["0", "4.0", "False"], ["0", "4.0", "True"])


EXCHANGED = """
import jaxilc, jax; jaxilc.setup()
from jaxilc.runtime.start import keep_programs
folder = keep_programs()
ones = jax.numpy.ones(3)
print(float(jax.jit(lambda x: x @ x + 1.0)(ones)), float(jax.jit(lambda x: x @ x + 2.0)(ones)))
"""


@pytest.mark.thorough
def test_programs_that_were_damaged_or_exchanged_are_compiled_again(tmp_path):
    def run():
        found = python(EXCHANGED, JAXILC_CACHE=str(tmp_path))
        return found.stdout.split(), found.stderr

    assert run()[0] == ["4.0", "5.0"]
    kept = {file: file.read_bytes() for file in tmp_path.glob("jit__lambda*-cache")}
    (one, content), (other, others) = kept.items()
    one.write_bytes(others)
    other.write_bytes(content)
    assert run() == (["4.0", "5.0"], "")
    one.write_bytes(content[:-7])
    other.write_bytes(b"")
    assert run() == (["4.0", "5.0"], "")
    assert all(len(file.read_bytes()) == len(was) for file, was in kept.items())


ELSEWHERE = """
import jaxilc, jax, os, sys; jaxilc.setup()
from jaxilc.runtime.start import keep_programs
home, other, unwritable = sys.argv[1:]
for cache, folder in ((home, "off"), (unwritable, ""), (home, other)):
    os.environ |= {"XDG_CACHE_HOME": cache, "JAXILC_CACHE": folder}
    print(keep_programs())
jax.jit(lambda x: x @ x + 1.0)(jax.numpy.ones(3))
"""


@pytest.mark.thorough
def test_keeping_programs_can_be_switched_off_and_sent_elsewhere(tmp_path):
    home, other, given = (tmp_path / name for name in ("home", "other", "given"))
    unwritable = tmp_path / "file"
    unwritable.write_text("")
    said = python(ELSEWHERE, *map(str, (home, other, unwritable))).stdout.split()
    assert said == ["None", "None", str(other)]
    assert not home.exists()
    told = python(KEPT, JAX_COMPILATION_CACHE_DIR=str(given), JAXILC_CACHE="").stdout.split()
    assert told[0] == str(given)
    assert list(other.iterdir())
    assert list(given.iterdir())


@pytest.mark.thorough
def test_batched_linear_algebra_on_every_device_does_not_deadlock():
    """With one thread per core in XLA's pool, this stopped within a hundred calls."""
    program = """
import jaxilc; jaxilc.setup(devices=2)
import jax, numpy as np
run = jaxilc.tiled(lambda common, one: jax.numpy.linalg.qr(one)[0])
batch = np.random.default_rng(0).normal(size=(256, 3000, 4))
for _ in range(120):
    run(0.0, batch).block_until_ready()
"""
    python(program)


@pytest.mark.parametrize(
    ("kwargs", "message"),
    [({"precision": "half"}, "precision = 'half'"), ({"devices": 0}, "devices = 0 is outside")],
)
def test_bad_input_is_named(kwargs, message):
    with pytest.raises(ValueError, match=message):
        jaxilc.setup(**kwargs)


def test_every_public_name_is_there():
    for name in jaxilc.__all__:
        assert getattr(jaxilc, name) is not None
    with pytest.raises(AttributeError, match="No jaxilc attribute nothing"):
        jaxilc.nothing
