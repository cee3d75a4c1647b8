"""This file starts JAX before any test module uses it."""

import base64
import gc
import itertools
import logging
import os
import re
import threading
from hashlib import sha256
from pathlib import Path

from instructions import limited

ISA = limited()  # before NumPy is loaded
os.environ.pop("COLUMNS", None)  # which a pipe follows
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # its threads would wait for one another
os.environ.setdefault("JAXILC_CACHE", "off")  # it would write to the user's folder

from jaxilc.runtime.xla_options import known  # noqa: E402

# Most of the time of these tests is compilation. Without LLVM's optimiser it takes half as long,
# and a tenth less in one piece for all cores. `XLA_FLAGS= pytest` tests the programs as users get
# them.
QUICK = "--xla_backend_optimization_level=0"
FLAGS = known(QUICK + " --xla_cpu_parallel_codegen_split_count=1", QUICK)
QUICKLY_COMPILED = bool(FLAGS) and FLAGS in os.environ.setdefault("XLA_FLAGS", FLAGS)
os.environ["XLA_FLAGS"] = os.environ.get("XLA_FLAGS", "") + ISA

gc.set_threshold(200_000, 20, 100)  # tracing makes many objects, few of them in circles

import jaxilc.runtime  # noqa: E402

jaxilc.runtime.setup()

import jax  # noqa: E402
import pytest  # noqa: E402
import typer.main  # noqa: E402
from cases import PLANTS, task_for  # noqa: E402
from jax._src import compiler  # noqa: E402
from jax._src.interpreters import mlir  # noqa: E402
from jax.experimental.compilation_cache import compilation_cache  # noqa: E402
from turns import drawn  # noqa: E402

from jaxilc import figures  # noqa: E402
from jaxilc.learning import Machine  # noqa: E402
from jaxilc.storage import files  # noqa: E402
from jaxilc.sweeps import host  # noqa: E402
from jaxilc.tuning import Tuning  # noqa: E402

if QUICKLY_COMPILED:  # a pass of two trials takes twice as long to compile
    host.TRIALS_A_PASS = 1


jax.config.update("jax_traceback_in_locations_limit", 1)  # each operation would keep ten lines

_make_context, _contexts = getattr(mlir, "make_ir_context", None), {}


def context_of_module():
    """Return the same MLIR context for all programs of a module and a thread.

    A context takes 8 ms to make, a tenth of the time of these tests, and JAX makes one for each of
    17,000 programs. A program that is made within another one has its own.
    """
    thread = threading.get_ident()
    if mlir.ir.Context.current is not None:
        return _make_context()
    return _contexts.get(thread) or _contexts.setdefault(thread, _make_context())


if _make_context is not None:
    mlir.make_ir_context = context_of_module

_compile, _small, _of_module = getattr(compiler, "backend_compile_and_load", None), {}, {}
CALLED = re.compile(r"custom_call @\"?(\w+)")
SMALL = 40  # operations of a program that stands for a line of NumPy's kind
STATELESS = ("lapack_", "blas_", "ducc_fft", "Sharding")  # of what is called outside of a program


def is_small(program):
    """Return whether a program has few operations, so that all modules may keep it."""
    blocks = (block for function in program.body for part in function.regions for block in part)
    operations = (operation for block in blocks for operation in block)
    return len([*itertools.islice(operations, SMALL + 1)]) <= SMALL


def compile_once(backend, program, *how, **named):
    """Compile a program once in a module, and a small one once: JAX knows a function by itself.

    So a test would compile anew what the one before it did with a function of the same text.

    how: devices, options and callbacks; where a version of JAX has others, nothing is kept
    """
    if named or len(how) != 3 or how[2]:
        return _compile(backend, program, *how, **named)
    text = str(program)
    if not all(called.startswith(STATELESS) for called in CALLED.findall(text)):
        return _compile(backend, program, *how)
    key = sha256(text.encode()).digest(), str(how[0]), how[1].SerializeAsString()
    kept = _small if is_small(program) else _of_module
    if key not in kept:
        kept[key] = _compile(backend, program, *how)
    return kept[key]


if _compile is not None:
    compiler.backend_compile_and_load = compile_once

_make, _made = typer.main.get_command, {}


def get_command(program):
    """Make the commands of a program once: for each line that is run, typer makes all of them."""
    key = program, *program.registered_commands
    return _made[key] if key in _made else _made.setdefault(key, _make(program))


typer.main.get_command = get_command

PIXEL = (
    "iVBORw0KGgoAAAANSUhEUgAAAAEAAAABCAQAAAC1HAwCAAAAC0lEQVR42mNkYAAAAAYAAjCB0C8AAAAASUVORK5CYII="
)
LISTS = ("quick", "shipped")  # of pyproject.toml, and the markers of what they list


def pytest_addoption(parser):
    for name in LISTS:
        parser.addini(name, f"files and tests that `-m {name}` runs", type="linelist")


def pytest_ignore_collect(collection_path, config):
    """Leave out files that have nothing of a list that `-m` names: loading all takes 10 s."""
    name = config.option.markexpr.partition(" and ")[0]
    if name in LISTS and collection_path.suffix == ".py":
        file = collection_path.relative_to(config.rootpath).as_posix()
        return True if not any(e.startswith(file) for e in config.getini(name)) else None


def pytest_collection_modifyitems(config, items):
    """Mark the tests that a list names: by file, test, or file and case, `tests/a.py[case]`."""
    for name in LISTS:
        entries = config.getini(name)
        listed = {entry for entry in entries if not entry.startswith("not ")}
        left_out = {entry.removeprefix("not ") for entry in entries} - listed
        for item in items:
            test, bracket, case = item.nodeid.partition("[")
            file = test.partition("::")[0]
            if {test, file, file + bracket + case} & listed and test not in left_out:
                item.add_marker(name)
    if any("::" in argument for argument in config.args):
        return
    cases = {}  # of `thorough` tests
    for item in items:
        if item.get_closest_marker("thorough"):
            of_case = getattr(item, "callspec", None)
            cases.setdefault(item.function, {})[of_case and of_case.id] = item
    spared = set()
    for function, of in cases.items():
        always = {*next(iter(of.values())).get_closest_marker("thorough").kwargs.get("but", ())}
        assert always <= {*of}, f"{function.__name__} has no cases {always - {*of}}"
        spared |= {one for case, one in of.items() if case not in always and not drawn(one.nodeid)}
    config.hook.pytest_deselected(items=[*spared])
    items[:] = [item for item in items if item not in spared]


@pytest.fixture(scope="module", autouse=True)
def _forget_compiled_programs():
    """Forget the compiled programs after each module.

    The next module cannot use them, and all of them together take gigabytes.
    """
    yield
    jax.clear_caches()
    _contexts.clear()
    _of_module.clear()


@pytest.fixture(scope="module")
def compiled_once(tmp_path_factory):
    """Keep compiled programs on disk within a module.

    The commands and problems of such a module would each compile the same programs again.
    """
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


@pytest.fixture
def quickly_and_quietly(monkeypatch, caplog):
    """Wait for no disk, since only a power failure loses written data; show errors alone."""
    monkeypatch.setattr(files.os, "fsync", lambda _: None)
    caplog.set_level(logging.ERROR, "jaxilc")


@pytest.fixture(scope="module")
def tuned_by_one_program():
    """Compile equal tunings of a module once, which are begun anew, resumed, or asked for again."""
    make, known = Tuning._programs.func, {}

    def found(self):
        key = repr(self.configuration())
        return known[key] if key in known else known.setdefault(key, make(self))

    with pytest.MonkeyPatch.context() as patched:
        patched.setattr(Tuning, "_programs", property(found))
        yield


@pytest.fixture
def here(tmp_path, monkeypatch):
    """Work in a folder of the test's own, and return it."""
    monkeypatch.chdir(tmp_path)
    return tmp_path


@pytest.fixture
def unpainted(monkeypatch):
    """Save figures as a picture of one pixel: they are drawn, but to paint them takes a second."""

    def save(_, path, **__):
        path = Path(path)
        path.write_bytes(base64.b64decode(PIXEL))
        return path

    monkeypatch.setattr(figures, "save", save)


@pytest.fixture(scope="session")
def task():
    """Return a task with one input, one output and 60 samples of 1 ms."""
    return task_for(PLANTS["voice_coil_printed"], N=60)


@pytest.fixture(scope="session")
def machine():
    """Return the voice coil with the printed coefficients, without noise."""
    return Machine(PLANTS["voice_coil_printed"])
