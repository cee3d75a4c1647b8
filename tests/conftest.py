"""JAX is started here, before any test module touches it."""

import os

# Compiling dominates these tests. Without the optimiser of LLVM and the newer code generator it
# takes half the time. `XLA_FLAGS= pytest` runs what ships.
FLAGS = "--xla_backend_optimization_level=0 --xla_cpu_use_fusion_emitters=false"
os.environ.setdefault("XLA_FLAGS", FLAGS)
os.environ.setdefault("JAXILC_CACHE", "off")  # the command line keeps programs in a user's folder

import jaxilc.runtime  # noqa: E402

jaxilc.runtime.setup()

import jax  # noqa: E402
import pytest  # noqa: E402
from cases import PLANTS, task_for  # noqa: E402
from jax.experimental.compilation_cache import compilation_cache  # noqa: E402

from jaxilc.learning import Machine  # noqa: E402


def pytest_addoption(parser):
    parser.addini("quick", "files and tests that `make check` runs", type="linelist")


def pytest_collection_modifyitems(config, items):
    """Mark what `quick` in pyproject.toml lists, so that `-m quick` runs it."""
    entries = config.getini("quick")
    listed = {entry for entry in entries if not entry.startswith("not ")}
    left_out = {entry.removeprefix("not ") for entry in entries} - listed
    for item in items:
        test = item.nodeid.partition("[")[0]
        if {test, test.partition("::")[0]} & listed and test not in left_out:
            item.add_marker(pytest.mark.quick)


@pytest.fixture(scope="module", autouse=True)
def _forget_compiled_programs():
    """What a module compiled is of no use to the next one; all of it together takes gigabytes."""
    yield
    jax.clear_caches()


@pytest.fixture(scope="module")
def compiled_once(tmp_path_factory):
    """For modules whose commands and problems would each compile the same programs again."""
    settings = {
        "jax_compilation_cache_dir": str(tmp_path_factory.mktemp("programs")),
        "jax_persistent_cache_min_compile_time_secs": 0.0,
    }
    before = {name: getattr(jax.config, name) for name in settings}
    for name, value in settings.items():
        jax.config.update(name, value)
    compilation_cache.reset_cache()
    yield
    for name, value in before.items():
        jax.config.update(name, value)
    compilation_cache.reset_cache()


@pytest.fixture(scope="session")
def task():
    """One input, one output, 60 samples of 1 ms."""
    return task_for(PLANTS["voice_coil_printed"], N=60)


@pytest.fixture(scope="session")
def machine():
    """The printed voice coil, without noise."""
    return Machine(PLANTS["voice_coil_printed"])
