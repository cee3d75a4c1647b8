"""Machine code for the processor at hand, from the text of a program, and how XLA calls it.

The text of a program ends with a handler: the function that XLA calls with the buffers of operands
and results (`jaxlib/include/xla/ffi/api/c_api.h`). It runs the groups of machines on threads of its
own, each of which takes the next group that no other has taken.
"""

from __future__ import annotations

import ctypes
import hashlib
import sys
import threading
from collections.abc import Sequence
from contextlib import suppress
from functools import cache
from importlib import metadata
from pathlib import Path
from types import ModuleType

import jax

from ..runtime.jax_internals import seal
from ..runtime.start import cores
from ..storage.files import atomically
from .llvm import ALIGNED, Lines, aligned
from .program import Unknown

WIDEST = {"avx512f": 64, "avx": 32, "neon": 16}  # bytes of a register, by a feature
# Places of fields in bytes in the structures of XLA's interface, versions 0.3 to 0.5.
EXTENSION, API, OPERANDS, RESULTS = 8, 16, 72, 112  # of the frame of a call
METADATA, MAJOR, MINOR, TRAITS = 24, 24, 28, 32  # of its extension, which asks for the version
MINOR_OF_API = 36
DATA, SIZES = 24, 40  # of a buffer
# bytes for a group from which on a result, or the room for work, is given huge pages; the advice
LARGE, PAGE, HUGE = 2**16, 2**12, 14
AGREED = b"agrees with XLA"
_targets: dict[str, Code] = {}
_lock = threading.Lock()

PART = """
; next group, next thread, groups, given, out, work, and the cores that may be used
%task = type {{ i64, i64, i64, ptr, ptr, ptr, [16 x i64] }}
declare i32 @pthread_create(ptr, ptr, ptr, ptr)
declare i32 @pthread_join(i64, ptr)
declare i32 @madvise(ptr, i64, i32)

define ptr @part(ptr %pointer) {{
entry:
  %task = load %task, ptr %pointer
  %threads = getelementptr i64, ptr %pointer, i64 1
  %thread = atomicrmw add ptr %threads, i64 1 monotonic
  %groups = extractvalue %task %task, 2
  %given = extractvalue %task %task, 3
  %out = extractvalue %task %task, 4
  %room = extractvalue %task %task, 5
  %at = mul i64 %thread, {work}
  %work = getelementptr i8, ptr %room, i64 %at
  br label %next
next:
  %group = atomicrmw add ptr %pointer, i64 1 monotonic
  %more = icmp slt i64 %group, %groups
  br i1 %more, label %run, label %end
run:
  %after = add i64 %group, 1
  call void @run(i64 %group, i64 %after, ptr %given, ptr %out, ptr %work, i64 0, i64 {trials})
  br label %next
end:
  ret ptr null
}}

{apart}

define ptr @handler(ptr %frame) {{
  %task = alloca %task
  %last = alloca i32
  %given = alloca ptr, i64 {operands}
  %out = alloca ptr, i64 {results}
{begun}
  %fewer = icmp slt i64 %groups, %cores
  %wanted = select i1 %fewer, i64 %groups, i64 %cores
  %ids = alloca i64, i64 %cores
  br label %create
create:
  %i = phi i64 [1, %begin], [%i1, %created]
  %all = icmp sge i64 %i, %wanted
  br i1 %all, label %own, label %one
one:
  %id = getelementptr i64, ptr %ids, i64 %i
  %failed = call i32 {create}
  %ready = icmp eq i32 %failed, 0
  br i1 %ready, label %created, label %own
created:
  %i1 = add i64 %i, 1
  br label %create
own:
  %none = call ptr @part(ptr %task)
  br label %join
join:
  %j = phi i64 [1, %own], [%j1, %joined]
  %done = icmp sge i64 %j, %i
  br i1 %done, label %end, label %joined
joined:
  %its = getelementptr i64, ptr %ids, i64 %j
  %thread = load i64, ptr %its
  %ended = call i32 @pthread_join(i64 %thread, ptr null)
  %j1 = add i64 %j, 1
  br label %join
end:
  ret ptr null
}}
"""

# On Linux, each further thread begins on the next core that this process may use, and may be moved
# later. Else it often waits on the core of the thread that creates it while another core has no
# work, and is moved there only after milliseconds, in which a group of machines could be done.
# `last` is the core of the thread before, or -1 where the system does not tell the cores.
APART = """
declare i32 @sched_getcpu()
declare i32 @sched_getaffinity(i32, i64, ptr)
declare i32 @sched_setaffinity(i32, i64, ptr)
declare i32 @pthread_attr_init(ptr)
declare i32 @pthread_attr_setaffinity_np(ptr, i64, ptr)
declare i32 @pthread_attr_destroy(ptr)

define ptr @moved(ptr %pointer) {
  %every = getelementptr i64, ptr %pointer, i64 6
  %free = call i32 @sched_setaffinity(i32 0, i64 128, ptr %every)
  %end = call ptr @part(ptr %pointer)
  ret ptr null
}

define i32 @create(ptr %id, ptr %pointer, ptr %last) {
entry:
  %attributes = alloca [16 x i64]
  %own = alloca [16 x i64]
  store [16 x i64] zeroinitializer, ptr %own
  %every = getelementptr i64, ptr %pointer, i64 6
  %before = load i32, ptr %last
  %told = icmp sge i32 %before, 0
  br i1 %told, label %choose, label %plain
choose:
  %core = phi i32 [ %before, %entry ], [ %next, %choose ]
  %after = add i32 %core, 1
  %next = and i32 %after, 1023
  %number = zext i32 %next to i64
  %at = lshr i64 %number, 6
  %word = getelementptr i64, ptr %every, i64 %at
  %allowed = load i64, ptr %word
  %place = and i64 %number, 63
  %bit = shl i64 1, %place
  %both = and i64 %allowed, %bit
  %none = icmp eq i64 %both, 0
  br i1 %none, label %choose, label %found
found:
  store i32 %next, ptr %last
  %its = getelementptr i64, ptr %own, i64 %at
  store i64 %bit, ptr %its
  %begun = call i32 @pthread_attr_init(ptr %attributes)
  %set = call i32 @pthread_attr_setaffinity_np(ptr %attributes, i64 128, ptr %own)
  %refused = call i32 @pthread_create(ptr %id, ptr %attributes, ptr @moved, ptr %pointer)
  %destroyed = call i32 @pthread_attr_destroy(ptr %attributes)
  %created = icmp eq i32 %refused, 0
  br i1 %created, label %end, label %plain
plain:
  %failed = call i32 @pthread_create(ptr %id, ptr null, ptr @part, ptr %pointer)
  ret i32 %failed
end:
  ret i32 0
}
"""


def callable_by_xla(
    text: str, operands: int, results: Sequence[int | None], work: int, trials: int
) -> str:
    """The text of a program, whose function `run` it calls, with its handler.

    operands: number of operands, each a buffer
    results: the bytes of each result for a group; None for one that nobody reads
    work: bytes that a group needs
    trials: number of trials

    Further buffers of results are those that are read, with the groups as their first axis, and the
    room for the work of all threads, see `room`.
    """
    begun = Lines("x")
    add, do, place, field = begun.add, begun.do, begun.place, begun.field

    def up(pointer: str, size: int) -> str:
        """The next place behind a pointer that is a multiple of a size."""
        number = add(f"ptrtoint ptr {pointer} to i64")
        number = add(f"and i64 {add(f'add i64 {number}, {size - 1}')}, -{size}")
        return add(f"inttoptr i64 {number} to ptr")

    def huge(data: str, size: str, of_group: int) -> None:
        """Advise huge pages for a buffer, which is not in the RAM yet."""
        if of_group < LARGE or sys.platform != "linux":
            return
        first = up(data, PAGE)
        add(f"call i32 @madvise(ptr {first}, i64 {add(f'sub i64 {size}, {PAGE}')}, i32 {HUGE})")

    extension = field("%frame", EXTENSION)
    asked = add(f"icmp ne ptr {extension}, null")
    do(f"br i1 {asked}, label %version, label %begin\nversion:")
    metadata, minor = field(extension, METADATA), field(field("%frame", API), MINOR_OF_API, "i32")
    for value, offset in (("0", MAJOR), (minor, MINOR), ("0", TRAITS)):
        do(f"store i32 {value}, ptr {place(metadata, offset)}")
    do("ret ptr null")
    do("begin:")
    given, found = field("%frame", OPERANDS), field("%frame", RESULTS)
    number = 0
    for i in range(operands):
        do(f"store ptr {field(field(given, 8 * i), DATA)}, ptr {place('%given', 8 * i)}")
    groups = field(field(field(found, 0), SIZES), 0, "i64")
    for i, size in enumerate(results):
        data = "null" if size is None else field(field(found, 8 * number), DATA)
        do(f"store ptr {data}, ptr {place('%out', 8 * i)}")
        number += size is not None
        if size is not None:
            huge(data, add(f"mul i64 {groups}, {size}"), size)
    buffer = field(found, 8 * number)
    room = up(field(buffer, DATA), ALIGNED)
    threads = field(field(buffer, SIZES), 0, "i64")
    huge(room, add(f"mul i64 {threads}, {aligned(work)}"), work)
    linux = sys.platform == "linux"
    task = ("i64 0", "i64 0", f"i64 {groups}", "ptr %given", "ptr %out", f"ptr {room}")
    for i, value in enumerate(task):
        do(f"store {value}, ptr {place('%task', 8 * i)}")
    if linux:
        every = place("%task", 8 * len(task))
        do(f"store [16 x i64] zeroinitializer, ptr {every}")
        failed = add(f"call i32 @sched_getaffinity(i32 0, i64 128, ptr {every})")
        known, core = add(f"icmp eq i32 {failed}, 0"), add("call i32 @sched_getcpu()")
        do(f"store i32 {add(f'select i1 {known}, i32 {core}, i32 -1')}, ptr %last")
    do(f"%groups = add i64 {groups}, 0")
    do(f"%cores = add i64 {threads}, 0")
    return text + PART.format(
        operands=max(operands, 1), results=max(len(results), 1), work=aligned(work), trials=trials,
        create="@create(ptr %id, ptr %task, ptr %last)" if linux else
            "@pthread_create(ptr %id, ptr null, ptr @part, ptr %task)",
        apart=APART if linux else "", begun="\n".join(begun.lines),
    )  # fmt: skip


def room(work: int) -> tuple[int, int]:
    """The shape of the room for the work of all threads, in bytes."""
    return cores(), aligned(work) + ALIGNED


def target(text: str) -> str:
    """The name under which XLA calls the program of a text, which is compiled if it was not yet.

    The name follows from the text, since XLA keeps programs with the names of what they call on
    disk. A program stays for the life of the process.
    """
    name = f"jaxilc_{key_of(text)}"
    if name not in _targets:
        code = Code(text)
        with _lock:
            if name not in _targets:
                code.register(name)
    return name


@cache
def _llvm() -> ModuleType:
    """The module of llvmlite, ready for this processor; raises Unknown without it."""
    try:
        import llvmlite.binding as llvm
    except ImportError as error:
        raise Unknown("llvmlite is not installed: pip install jaxilc[native]") from error
    llvm.initialize_native_target()
    llvm.initialize_native_asmprinter()
    return llvm


@cache
def width() -> int:
    """The bytes of a register of this processor."""
    known = _llvm().get_host_cpu_features()
    return next((size for name, size in WIDEST.items() if known.get(name)), 16)


class Code:
    """The machine code of a text."""

    def __init__(self, text: str):
        llvm = _llvm()
        machine = llvm.Target.from_default_triple().create_target_machine(
            cpu=llvm.get_host_cpu_name(),
            features=llvm.get_host_cpu_features().flatten(),
            opt=3,
            jit=True,
        )
        try:
            module = llvm.parse_assembly(text)
        except RuntimeError as error:
            raise Unknown(f"LLVM refuses the program: {error}".replace("\n", " ")) from error
        module.triple, module.data_layout = machine.triple, str(machine.target_data)
        module.verify()
        key = key_of(text)
        known = _kept(key)
        if known is None:
            options = llvm.create_pipeline_tuning_options(speed_level=2)
            options.loop_vectorization = options.slp_vectorization = False
            builder = llvm.create_pass_builder(machine, options)
            builder.getModulePassManager().run(module, builder)
        for function in module.functions:
            if function.is_declaration and not function.name.startswith("llvm."):
                llvm.add_symbol(function.name, address_of(function.name))
        self._engine = llvm.create_mcjit_compiler(module, machine)
        self._engine.set_object_cache(lambda _, compiled: _keep(key, compiled), lambda _: known)
        self._engine.finalize_object()

    def register(self, name: str) -> None:
        """Let XLA call it under a name that has no other."""
        kind = ctypes.CFUNCTYPE(ctypes.c_void_p, ctypes.c_void_p)
        handler = jax.ffi.pycapsule(kind(self._engine.get_function_address("handler")))
        jax.ffi.register_ffi_target(name, handler, platform="cpu", api_version=1)
        _targets[name] = self


def _place(key: str) -> Path | None:
    """The file of a key, beside the programs that JAX keeps; None where it keeps none."""
    folder = _folder()
    return Path(folder) / f"native-{key}" if folder else None


def key_of(*texts: str) -> str:
    """What the machine code of texts depends on, in short."""
    processor = _llvm().get_host_cpu_name(), _llvm().get_host_cpu_features().flatten()
    versions = (metadata.version(name) for name in ("llvmlite", "jaxlib"))
    of = "\0".join((*versions, *processor, *texts))
    return hashlib.sha256(of.encode()).hexdigest()


@cache
def of_compiler() -> str:
    """The text of this compiler, in short."""
    files = sorted(Path(__file__).parent.glob("*.py"))
    return hashlib.sha256(b"".join(of.read_bytes() for of in files)).hexdigest()


def agreed(key: str) -> bool:
    """Whether a process noted that the program of this key agrees with XLA."""
    return _kept(key) == AGREED


def agree(key: str) -> None:
    """Note that the program of this key agrees with XLA, where JAX keeps its programs on disk."""
    _keep(key, AGREED)


def _folder() -> str | None:
    """The folder in which JAX keeps its programs."""
    kept = jax.config.jax_enable_compilation_cache
    return jax.config.jax_compilation_cache_dir if kept else None


def _kept(key: str) -> bytes | None:
    """What is kept under a key; None where nothing is, or not what was written under its name.

    Machine code that was damaged, or exchanged for another, would do anything.
    """
    place = _place(key)
    if place is None:
        return None
    try:
        found = place.read_bytes()
    except OSError:
        return None
    return found[32:] if found[:32] == seal(place.name, found[32:]) else None


def _keep(key: str, compiled: bytes) -> None:
    """Write machine code at once or not at all."""
    place = _place(key)
    with suppress(OSError):
        if place is not None:
            atomically(place, lambda file: file.write(seal(place.name, compiled) + compiled))


def in_vectors(lanes: int, size: int, name: str, operands: int) -> str | None:
    """The name of a function of the C library for a vector of numbers; None where it has none.

    size: bytes of a number
    """
    registers = {64: ("e", "avx512f"), 32: ("d", "avx2"), 16: ("b", "sse2")}
    letter, feature = registers.get(lanes * size, ("", ""))
    if not _llvm().get_host_cpu_features().get(feature):
        return None
    found = f"_ZGV{letter}N{lanes}{'v' * operands}_{name}"
    try:
        address_of(found)
    except Unknown:
        return None
    return found


def address_of(name: str) -> int:
    """The address of a function of the C library; raises Unknown where there is none."""
    for library in (None, "libm.so.6", "libmvec.so.1"):
        try:
            found = getattr(ctypes.CDLL(library), name)
        except (OSError, AttributeError, TypeError):
            continue
        return ctypes.cast(found, ctypes.c_void_p).value or 0
    raise Unknown(f"{name}, which is not in the C library")
