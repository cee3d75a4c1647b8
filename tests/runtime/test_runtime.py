"""These tests check how JAX is started."""

import os
import subprocess
import sys

import pytest

import jaxilc


def python(program, **environment):
    kept = {name: value for name, value in os.environ.items() if name not in ("XLA_FLAGS", "NPROC")}
    return subprocess.run(
        [sys.executable, "-c", program],
        env=kept | environment,
        capture_output=True,
        text=True,
        timeout=60,
        check=True,
    )


def test_setup_takes_cores_precision_and_whole_loops_and_leaves_flags_alone():
    program = (
        "import jaxilc, jax, os; jaxilc.setup(devices=3); "
        "print(jax.device_count(), jax.config.jax_enable_x64, os.environ['XLA_FLAGS'])"
    )
    count, double, flags = python(program).stdout.split(maxsplit=2)
    assert (count, double) == ("3", "True")
    assert "xla_cpu_small_while_loop_byte_threshold" in flags
    kept = "--xla_backend_extra_options=xla_cpu_small_while_loop_byte_threshold=7"
    assert python(program, XLA_FLAGS=kept).stdout.split(maxsplit=2)[2].strip() == kept


def test_options_that_an_accelerator_would_read_are_left_out_where_there_is_one():
    program = (
        "import jaxilc.runtime.start as r, os; r.entry_points = lambda group: [group]; "
        "r.setup(); print(os.environ['XLA_FLAGS'])"
    )
    assert "unroll" not in python(program).stdout
    assert "unroll" in python(program, JAX_PLATFORMS="cpu").stdout
    assert "unroll" in python(program.replace("[group]", "[]")).stdout


def test_wide_registers_are_asked_for_where_the_option_is_known_and_nobody_else_did():
    program = (
        "import jaxilc.runtime.start as r, os; {} r.setup(); "
        "print(os.environ['XLA_FLAGS'], r.jax.numpy.ones(2) + 1)"
    )
    cpu = {"JAX_PLATFORMS": "cpu"}
    assert "prefer_vector_width=512" in python(program.format(""), **cpu).stdout
    assert (
        "prefer_vector_width"
        not in python(program.format("r.jaxlib.__version__ = '9.1.0';"), **cpu).stdout
    )
    asked = python(program.format(""), **cpu, XLA_FLAGS="--xla_cpu_prefer_vector_width=128").stdout
    assert (asked.count("prefer_vector_width"), "=128" in asked) == (1, True)


def test_importing_flips_nothing():
    program = (
        "import jaxilc, jax, os; jaxilc.scenarios.load('cao-2019'); "
        "print(jax.config.jax_enable_x64, 'XLA_FLAGS' in os.environ)"
    )
    assert python(program).stdout.split() == ["False", "False"]


def test_setup_too_late_says_so():
    program = "import jax; jax.numpy.ones(1) + 1; import jaxilc; jaxilc.setup(devices=3)"
    assert "came after JAX had started" in python(program).stderr


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


def test_programs_are_found_again_by_the_next_start(tmp_path):
    first, again = (
        python(KEPT, XDG_CACHE_HOME=str(tmp_path), JAXILC_CACHE="").stdout.split() for _ in range(2)
    )
    assert first[0].startswith(str(tmp_path / "jaxilc"))
    assert (first[1:], again[1:]) == (["0", "4.0", "False"], ["0", "4.0", "True"])


def test_keeping_programs_can_be_switched_off_and_sent_elsewhere(tmp_path):
    home, other, unwritable = str(tmp_path / "home"), str(tmp_path / "other"), tmp_path / "file"
    unwritable.write_text("")
    assert python(KEPT, XDG_CACHE_HOME=home, JAXILC_CACHE="off").stdout.split()[0] == "None"
    assert python(KEPT, XDG_CACHE_HOME=str(unwritable), JAXILC_CACHE="").stdout.split()[0] == "None"
    assert not (tmp_path / "home").exists()
    assert python(KEPT, XDG_CACHE_HOME=home, JAXILC_CACHE=other).stdout.split()[0] == other
    assert python(KEPT, JAX_COMPILATION_CACHE_DIR=other, JAXILC_CACHE="").stdout.split()[0] == other
    assert list((tmp_path / "other").iterdir())


def test_batched_linear_algebra_on_every_device_does_not_deadlock():
    """Batched linear algebra on every device does not deadlock.

    With one thread per core in XLA's pool, this stopped within a hundred calls.
    """
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
