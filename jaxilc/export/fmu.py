"""A law, or a plant, as an FMU 2.0 or 3.0 for co-simulation: its C around the functions of FMI.

An FMU is a zip file of a description in XML, the sources, and a library for the processor at hand
if a C compiler is found. One communication step is one sample time, or several.

Source: Functional Mock-up Interface Specification, versions 2.0.4 and 3.0.1, Modelica Association.
"""

from __future__ import annotations

import io
import os
import platform
import shutil
import subprocess
import tempfile
import zipfile
from collections.abc import Mapping, Sequence
from importlib import resources
from pathlib import Path
from typing import NamedTuple
from xml.etree import ElementTree

import numpy as np

from ..signals.task import Task
from ..storage.sealed import checksum
from .c import number


class Kind(NamedTuple):
    """A kind of variables, by its name in FMI 2.0.

    begin: where their references begin
    in_three: its name in FMI 3.0
    type, member: of the array that holds them in the struct of a block
    """

    begin: int
    in_three: str
    type: str
    member: str


KINDS = {
    "Real": Kind(0, "Float64", "double", "real"),
    "Integer": Kind(1000, "Int32", "int32_t", "whole"),
    "Boolean": Kind(2000, "Boolean", "bool", "truth"),
}
TIME = 3000
SI = {  # units as products of base units, with their factor
    "m": ({"m": 1}, 1.0), "mm": ({"m": 1}, 1e-3), "um": ({"m": 1}, 1e-6), "µm": ({"m": 1}, 1e-6),
    "nm": ({"m": 1}, 1e-9), "s": ({"s": 1}, 1.0), "A": ({"A": 1}, 1.0), "rad": ({"rad": 1}, 1.0),
    "N": ({"kg": 1, "m": 1, "s": -2}, 1.0), "N m": ({"kg": 1, "m": 2, "s": -2}, 1.0),
    "V": ({"kg": 1, "m": 2, "s": -3, "A": -1}, 1.0), "m/s": ({"m": 1, "s": -1}, 1.0),
}  # fmt: skip
FLAGS = ("-std=c99", "-O2", "-ffp-contract=off", "-fPIC", "-shared", "-fvisibility=hidden")


class Variable(NamedTuple):
    """A variable of an FMU.

    kind: Real, Integer or Boolean
    input: whether it is set from outside
    """

    name: str
    kind: str
    input: bool
    about: str
    unit: str = ""
    start: float = 0.0


class Block(NamedTuple):
    """What an FMU holds.

    name: law or plant
    about: one sentence
    variables: in the order of their references within their kind, inputs first
    files: the texts of its C files by their names; `block.c` has block_start, block_begin, for the
        begin of a communication step, and block_step, for a sample
    """

    name: str
    about: str
    task: Task
    variables: Sequence[Variable]
    files: Mapping[str, str]


def law_block(task: Task, files: Mapping[str, str], about: str) -> Block:
    """The block of a law: y and `start` in, u and what the law tells out.

    files: the texts of `law.h` and `law.c`
    """
    variables = [
        *_channels("y", task.outputs, True, "measured output", task.unit),
        *_channels("u", task.inputs, False, "input of the plant; 0 between trials",
                   task.input_unit),
        Variable("trial", "Integer", False, "trials that have ended"),
        Variable("code", "Integer", False, "what the last trial ended with; 0: learned, see law.h"),
        Variable("start", "Boolean", True, "a trial begins where none is running"),
        Variable("running", "Boolean", False, "a trial is running"),
    ]  # fmt: skip
    body = """
void block_start(block *b)
{
    memset(b, 0, sizeof *b);
    law_start(&b->inner);
}

void block_begin(block *b) { (void) b; }

/* A trial takes LAW_SAMPLES steps, and one more, with whose output the law learns. */
void block_step(block *b)
{
    double *y = b->real, *u = b->real + LAW_OUTPUTS;
    bool *running = &b->truth[1];
    if (!*running && b->truth[0]) {
        law_begin(&b->inner);
        b->k = 0;
        *running = true;
    } else if (!*running) {
        return;
    }
    if (b->k < LAW_SAMPLES) {
        law_sample(&b->inner, b->k++, y, u);
        return;
    }
    b->whole[1] = law_end(&b->inner, y);
    b->whole[0] += 1;
    *running = false;
    for (int i = 0; i < LAW_INPUTS; ++i) {
        u[i] = 0.0;
    }
}
"""
    sources = {name: text for name, text in files.items() if name in ("law.h", "law.c")}
    return Block("law", about, task, variables, {**sources, "block.c": _HEAD + body})


def plant_block(task: Task, files: Mapping[str, str], about: str, first: np.ndarray) -> Block:
    """The block of a plant: u and `rest` in, y out.

    files: the texts of `plant.h` and `plant.c`
    first: (n_y,) output at rest [unit of y]
    """
    variables = [
        *_channels("u", task.inputs, True, "input, held until the next sample", task.input_unit),
        *_channels("y", task.outputs, False, "output", task.unit, first),
        Variable("rest", "Boolean", True, "the step begins from rest, as a trial does"),
    ]
    body = """
void block_start(block *b)
{
    memset(b, 0, sizeof *b);
    plant_start(&b->inner, b->real + PLANT_INPUTS);
}

void block_begin(block *b)
{
    if (b->truth[0]) {
        plant_start(&b->inner, b->real + PLANT_INPUTS);
    }
}

void block_step(block *b) { plant_step(&b->inner, b->real, b->real + PLANT_INPUTS); }
"""
    return Block("plant", about, task, variables, {**files, "block.c": _HEAD + body})


_HEAD = '#include "block.h"\n\n#include <string.h>\n'


def packed(block: Block, *, version: int, compiler: str | None = None) -> bytes:
    """The bytes of an FMU.

    version: 2 or 3, of FMI
    compiler: command of a C compiler; None: that of the variable CC, else cc. Where there is none,
        the FMU holds the sources alone
    Raises RuntimeError if the compiler refuses the sources.
    """
    token = checksum(repr(sorted(block.files.items())).encode())
    token = "{" + "-".join(token[a:b] for a, b in ((0, 8), (8, 12), (12, 16), (16, 20), (20, 32)))
    token += "}"
    sources = {**block.files, "block.h": _block_h(block, token)}
    for name in ("state.h", f"fmi{version}.c"):
        sources[name] = resources.files("jaxilc.export").joinpath("fmi", name).read_text()
    entries: dict[str, bytes] = {
        "modelDescription.xml": _xml(_description(block, token, sources, version)),
        **{f"sources/{name}": text.encode() for name, text in sources.items()},
    }
    if version == 3:
        entries["sources/buildDescription.xml"] = _xml(_build(block, sources))
    library = _compiled(block.name, sources, compiler)
    if library is not None:
        entries[f"binaries/{_place(version)}/{block.name}{_suffix()}"] = library
    file = io.BytesIO()
    with zipfile.ZipFile(file, "w", zipfile.ZIP_DEFLATED) as into:
        for name, data in entries.items():  # the same files give the same bytes on any day
            into.writestr(zipfile.ZipInfo(name, (1980, 1, 1, 0, 0, 0)), data, zipfile.ZIP_DEFLATED)
    return file.getvalue()


def _channels(name: str, count: int, inside: bool, about: str, unit: str,
              first: np.ndarray | None = None) -> list[Variable]:  # fmt: skip
    names = [name] if count == 1 else [f"{name}[{i + 1}]" for i in range(count)]
    starts = [0.0] * count if first is None else first
    return [Variable(one, "Real", inside, about, unit, float(x))
            for one, x in zip(names, starts, strict=True)]  # fmt: skip


def _block_h(block: Block, token: str) -> str:
    sizes, members = [], []
    for name, kind in KINDS.items():
        inputs = [v.input for v in block.variables if v.kind == name]
        macro = f"#define BLOCK_{kind.member.upper()}"
        sizes += [f"{macro}S {len(inputs)}u", f"{macro}_INPUTS {sum(inputs)}u",
                  f"{macro} {kind.begin}u"]  # fmt: skip
        members.append(f"    {kind.type} {kind.member}[{max(1, len(inputs))}];")
    newline = "\n"
    return f"""/* The variables of the block around a {block.name}, inputs first, and its step. */
#ifndef BLOCK_H
#define BLOCK_H

#include "{block.name}.h"

#include <math.h>

#define BLOCK_NAME "{block.name}"
#define BLOCK_TOKEN "{token}"
#define BLOCK_SAMPLE_TIME {number(block.task.dt, float, False)}
#define BLOCK_WRONG_STEP "a step must be {block.task.dt:g} s long, or a multiple of it"
{newline.join(sizes)}
#define BLOCK_TIME {TIME}u

#if defined _WIN32
#define BLOCK_EXPORT __declspec(dllexport)
#elif defined __GNUC__
#define BLOCK_EXPORT __attribute__((visibility("default")))
#else
#define BLOCK_EXPORT
#endif

typedef struct {{
    {block.name} inner;
    int k;
    double time; /* told by FMI 3.0 */
{newline.join(members)}
}} block;

void block_start(block *b);
void block_begin(block *b);
void block_step(block *b);

/* Whether a value reference is one of a number of them. */
static inline bool block_has(unsigned at, unsigned first, unsigned count)
{{
    return at >= first && at - first < count;
}}

/* The steps of one sample time within a communication step; false where it is no multiple. */
static inline bool block_steps(block *b, double step)
{{
    const double samples = rint(step / BLOCK_SAMPLE_TIME);
    if (!(samples >= 1.0 && samples < 1e9)
        || fabs(step - samples * BLOCK_SAMPLE_TIME) > 1e-6 * BLOCK_SAMPLE_TIME) {{
        return false;
    }}
    block_begin(b);
    for (int i = 0; i < (int) samples; ++i) {{
        block_step(b);
    }}
    return true;
}}

#endif
"""


def _reference(block: Block, variable: Variable) -> int:
    alike = [v for v in block.variables if v.kind == variable.kind]
    return KINDS[variable.kind].begin + alike.index(variable)


def _xml(root: ElementTree.Element) -> bytes:
    ElementTree.indent(root)
    return ElementTree.tostring(root, encoding="UTF-8", xml_declaration=True)


def _description(block: Block, token: str, sources: Mapping[str, str],
                 version: int) -> ElementTree.Element:  # fmt: skip
    two, task = version == 2, block.task
    add = ElementTree.SubElement
    root = ElementTree.Element("fmiModelDescription", {
        "fmiVersion": f"{version}.0", "modelName": block.name,
        "guid" if two else "instantiationToken": token, "description": block.about,
        "generationTool": "jaxilc", "variableNamingConvention": "structured"})  # fmt: skip
    state = "FMUstate" if two else "FMUState"
    kind = {"modelIdentifier": block.name, "canHandleVariableCommunicationStepSize": "true",
            f"canGetAndSet{state}": "true", f"canSerialize{state}": "true"}  # fmt: skip
    simulated = add(root, "CoSimulation", kind)
    if two:
        files = add(simulated, "SourceFiles")
        for name in _compiled_files(sources):
            add(files, "File", {"name": name})
    else:
        simulated.set("fixedInternalStepSize", repr(float(task.dt)))
    units = sorted({v.unit for v in block.variables if v.unit} | (set() if two else {"s"}))
    if units:
        into = add(root, "UnitDefinitions")
        for unit in units:
            one = add(into, "Unit", {"name": unit})
            if unit in SI:
                powers, factor = SI[unit]
                base = {name: str(power) for name, power in powers.items()}
                add(one, "BaseUnit", base | ({} if factor == 1 else {"factor": repr(factor)}))
    add(root, "DefaultExperiment", {"startTime": "0", "stopTime": repr(float(task.dt * task.N)),
                                    "stepSize": repr(float(task.dt))})  # fmt: skip
    listed, structure = add(root, "ModelVariables"), ElementTree.Element("ModelStructure")
    for v in block.variables:
        there = {"name": v.name, "valueReference": str(_reference(block, v)),
                 "description": v.about, "causality": "input" if v.input else "output"}  # fmt: skip
        there["variability"] = "discrete"
        start = {"start": {"Real": repr(v.start), "Integer": "0", "Boolean": "false"}[v.kind]}
        own = ({"unit": v.unit} if v.unit else {}) | (start if v.input else {})
        if two:
            add(add(listed, "ScalarVariable", there), v.kind, own)
        else:
            add(listed, KINDS[v.kind].in_three, there | own)
    if not two:
        clock = {"name": "time", "valueReference": str(TIME), "unit": "s"}
        add(listed, "Float64", clock | {"causality": "independent", "variability": "continuous"})
    places = [(i, v) for i, v in enumerate(block.variables, 1) if not v.input]
    root.append(structure)
    for name in ("Output", "InitialUnknown"):  # which no input changes before the next step
        into, tag = (add(structure, f"{name}s"), "Unknown") if two else (structure, name)
        for i, v in places:
            place = {"index": str(i)} if two else {"valueReference": str(_reference(block, v))}
            add(into, tag, place | {"dependencies": ""})
    return root


def _build(block: Block, sources: Mapping[str, str]) -> ElementTree.Element:
    root = ElementTree.Element("fmiBuildDescription", {"fmiVersion": "3.0"})
    one = ElementTree.SubElement(root, "BuildConfiguration", {"modelIdentifier": block.name})
    files = ElementTree.SubElement(one, "SourceFileSet", {"language": "C99"})
    for name in _compiled_files(sources):
        ElementTree.SubElement(files, "SourceFile", {"name": name})
    return root


def _compiled_files(sources: Mapping[str, str]) -> list[str]:
    return [name for name in sources if name.endswith(".c")]


def _place(version: int) -> str:
    """The folder of the library for this processor and system."""
    machine, system = platform.machine().lower(), platform.system().lower()
    if version == 3:
        machine = {"amd64": "x86_64", "arm64": "aarch64"}.get(machine, machine)
        return f"{machine}-{system}"
    return {"windows": "win", "linux": "linux", "darwin": "darwin"}.get(system, system) + "64"


def _suffix() -> str:
    return {"Windows": ".dll", "Darwin": ".dylib"}.get(platform.system(), ".so")


def _compiled(name: str, sources: Mapping[str, str], compiler: str | None) -> bytes | None:
    command = compiler or os.environ.get("CC") or "cc"
    if shutil.which(command) is None:
        return None
    with tempfile.TemporaryDirectory() as folder:
        for file, text in sources.items():
            Path(folder, file).write_text(text)
        library = f"{name}{_suffix()}"
        line = [command, *FLAGS, "-o", library, *_compiled_files(sources), "-lm"]
        done = subprocess.run(line, cwd=folder, capture_output=True, text=True, check=False)
        if done.returncode:
            raise RuntimeError(f"{command} refused the sources of the FMU:\n{done.stderr[-2000:]}")
        return Path(folder, library).read_bytes()
