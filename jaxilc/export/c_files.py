"""The files of a law in C99: `law.h`, `law.c`, and `law_test.c`, a test with its vectors.

And a law as a component of LinuxCNC's HAL, which holds them: a `.comp` file that `halcompile
--install` takes. Its pins are measured outputs in, inputs of the plant out, and a bit that begins a
trial. The thread that calls it must have the sample time of the law; else it does nothing, and says
so by its code. Source: LinuxCNC 2.9, HAL Component Generator.
"""

from __future__ import annotations

import math
import re
from collections.abc import Mapping, Sequence

import numpy as np

from ..native.operations import TOGETHER, elementwise
from ..native.program import Program, Step
from ..signals.task import Task
from . import guard
from .c import REAL, Code, field_name, number, plain, table
from .law import Law, said_of_scheme
from .printer import wrapped

WRONG_THREAD = -1  # the code of a component of HAL in a thread of another period
HEADS = {
    "begin": "void law_begin(law *l)",
    "sample": "void law_sample(law *l, int k, const law_real y[LAW_OUTPUTS], "
              "law_real u[LAW_INPUTS])",
    "end": "int law_end(law *l, const law_real y[LAW_OUTPUTS])",
}  # fmt: skip
MEANING = {
    "begin": "Before the first sample of each trial.",
    "sample": "At sample k = 0 ... LAW_SAMPLES - 1: from the measured output y to the input u.",
    "end": "After the trial, with its last output: learns from it and returns a code of law_code.",
}
# arithmetic that C does not have as it is meant here
OWN = """
/* The larger and the smaller number; NaN if one is NaN. */
static inline law_real law_max(law_real a, law_real b) { return a != a || a > b ? a : b; }
static inline law_real law_min(law_real a, law_real b) { return a != a || a < b ? a : b; }

/* A place of a part within an array, whose last possible one is given. */
static inline int law_place(int64_t place, int last)
{
    return place < 0 ? 0 : place > last ? last : (int) place;
}

/* The whole part of a number, held within the range of the integer; 0 for NaN. */
static inline int32_t law_to_int32_t(law_real x)
{
    return x >= (law_real) INT32_MAX ? INT32_MAX : x <= (law_real) INT32_MIN ? INT32_MIN
           : x == x ? (int32_t) x : 0;
}
static inline int64_t law_to_int64_t(law_real x)
{
    return x >= (law_real) INT64_MAX ? INT64_MAX : x <= (law_real) INT64_MIN ? INT64_MIN
           : x == x ? (int64_t) x : 0;
}
static inline uint32_t law_to_uint32_t(law_real x)
{
    return x >= (law_real) UINT32_MAX ? UINT32_MAX : x > 0 ? (uint32_t) x : 0;
}
"""


def files_of(law: Law, about: Sequence[str], digest: str, trials: Sequence[np.ndarray], *,
             single: bool = False, code: Code | None = None) -> dict[str, str]:  # fmt: skip
    """The texts of the files by their names.

    trials: outputs (N+1, n_y) of the trials of the test program
    single: whether numbers are `float` in place of `double`
    code: of the law, where it is known already
    """
    code = code or Code(law.fields, law.functions, single=single)
    said = comment_of([*about, f"certificate {digest}"])
    return {
        "law.h": said + _header(law, code, digest),
        "law.c": said + _source(law, code, digest),
        "law_test.c": said + _test(law, trials, code.single),
    }


def comment_of(lines: Sequence[str]) -> str:
    short = (f" * {line}\n".replace(" \n", "\n") for line in wrapped(map(plain, lines)))
    return "/*\n" + "".join(short) + " */\n"


def cost(program: Program) -> int:
    """The operations on numbers that a program carries out at most."""
    return sum(map(_cost, program.steps))


def _cost(step: Step) -> int:
    of, size = step.params, math.prod(step.outs[0].shape)
    if step.name == "scan":
        return int(of["length"]) * cost(of["body"])
    if step.name == "while":
        return int(of["bound"]) * (cost(of["body"]) + cost(of["condition"]))
    if step.name == "dot_general":
        return 2 * size * math.prod(step.ins[0].shape[i] for i in of["dimension_numbers"][0][0])
    if step.name in TOGETHER:
        return math.prod(step.ins[0].shape)
    return size if elementwise(step.name) else 0


def _header(law: Law, code: Code, digest: str) -> str:
    task = law.task
    codes = "".join(f"    LAW_{name} = {i}, /* {said} */\n" for i, (name, said) in enumerate(
        zip(guard.CODES, guard.MEANINGS, strict=True)))  # fmt: skip
    limits = ", ".join(number(x, float, code.single) for x in law.limit)
    begun = "".join(f"/* {MEANING[name]} */\n{head};\n\n" for name, head in HEADS.items())
    return f"""#ifndef LAW_H
#define LAW_H

#include <stdbool.h>
#include <stdint.h>

typedef {"float" if code.single else "double"} law_real;

#define LAW_SAMPLES {task.N} /* inputs of a trial; it has one output more */
#define LAW_INPUTS {task.inputs} /* [{plain(task.input_unit) or "1"}] */
#define LAW_OUTPUTS {task.outputs} /* [{plain(task.unit) or "1"}] */
#define LAW_SAMPLE_TIME {number(task.dt, float, code.single)} /* [s] */
#define LAW_LIMIT {{ {limits} }} /* largest |u| [{plain(task.input_unit) or "1"}] */
#define LAW_CERTIFICATE "{digest}"

/* What law_end tells. After a refusal the input of the last good trial is played again. */
enum law_code {{
{codes}}};

/* All that the law keeps. memory: what was learned; schedule: what is played in this trial; good:
 * both of the last trial that was not refused, and the trials they were learned from; within and
 * record: of this trial; seen: what the guard remembers; work: room for intermediate results. */
typedef struct {{
{code.members}
}} law;

/* Once, before the first trial. */
void law_start(law *l);

{begun}#endif
"""


def _source(law: Law, code: Code, digest: str) -> str:
    parts = ['#include "law.h"\n\n#include <math.h>\n']
    parts.append(f"#define LAW_F(name) {'name##f' if code.single else 'name'}\n")
    parts.append(f'const char law_certificate[] = "{digest}";\n{OWN}')
    for name, text in said_of_scheme(law.scheme, law.task):
        parts.append(comment_of([name, *map(str.rstrip, text.split("\n"))]))
    parts.append(code.start.under("void law_start(law *l)"))
    programs = {function.name: function.program for function in law.functions}
    for name, body in code.functions.items():
        about = [MEANING[name], f"At most {cost(programs[name])} operations on numbers."]
        unused = [
            f"    (void) {x};"
            for x in ("k", "y", "l")
            if x in _words(HEADS[name]) and x not in _words("\n".join(body.lines))
        ]
        parts.append(comment_of(about) + body.under(HEADS[name], unused))
    return "\n" + "\n".join(parts)


def _words(text: str) -> set[str]:
    return set(re.findall(r"\w+", text))


# The test program
# --------------------------------------------------------------------------------------------------


def _test(law: Law, trials: Sequence[np.ndarray], single: bool) -> str:
    """A program that plays trials and compares every input, every code and what is then known."""
    played = law.played(np.float32 if single else np.float64)
    found = [played.trial(y) for y in trials]
    outputs = np.concatenate([np.ravel(y) for y in trials])
    inputs = np.concatenate([u.ravel() for u, _ in found])
    checked, tables = [], []
    for i, name in enumerate(law.fields):
        if not name.startswith(("memory", "schedule", "seen")):
            continue
        values, member = np.ravel(played.known[name]), field_name(name)
        if values.dtype.kind != "f" or not values.size:
            continue
        tables += table(REAL, f"known_{i}", _numbers(values, single))
        at = f"&l.{member}" if values.size == 1 else f"l.{member}"
        checked.append(f'    wrong += compared("{member}", {at}, known_{i}, {values.size});')
    codes = ", ".join(str(code) for _, code in found)
    lines = [
        *table(REAL, "outputs", _numbers(outputs, single)),
        *table(REAL, "inputs", _numbers(inputs, single)),
        *tables,
        f"static const int codes[TRIALS] = {{ {codes} }};",
    ]
    return f"""#include "law.h"

#include <math.h>
#include <stdio.h>

#define TRIALS {len(found)}

{chr(10).join(lines)}

/* Numbers are equal to the last bit, or both are not numbers. */
static int compared(const char *name, const law_real *found, const law_real *wanted, int count)
{{
    int wrong = 0;
    double most = 0.0;
    for (int i = 0; i < count; ++i) {{
        if (found[i] != wanted[i] && !(found[i] != found[i] && wanted[i] != wanted[i])) {{
            const double off = fabs((double) found[i] - (double) wanted[i]);
            most = off > most ? off : most;
            ++wrong;
        }}
    }}
    if (wrong) {{
        printf("%s: %d of %d numbers differ, by up to %g\\n", name, wrong, count, most);
    }}
    return wrong;
}}

int main(void)
{{
    static law l;
    static law_real played[TRIALS * LAW_SAMPLES * LAW_INPUTS];
    int wrong = 0;
    law_start(&l);
    for (int j = 0; j < TRIALS; ++j) {{
        const law_real *y = outputs + j * (LAW_SAMPLES + 1) * LAW_OUTPUTS;
        law_real *u = played + j * LAW_SAMPLES * LAW_INPUTS;
        law_begin(&l);
        for (int k = 0; k < LAW_SAMPLES; ++k) {{
            law_sample(&l, k, y + k * LAW_OUTPUTS, u + k * LAW_INPUTS);
        }}
        const int code = law_end(&l, y + LAW_SAMPLES * LAW_OUTPUTS);
        if (code != codes[j]) {{
            printf("trial %d ends with code %d in place of %d\\n", j + 1, code, codes[j]);
            ++wrong;
        }}
    }}
    wrong += compared("u", played, inputs, TRIALS * LAW_SAMPLES * LAW_INPUTS);
{chr(10).join(checked)}
    printf(wrong ? "law: %d numbers differ\\n" : "law: all numbers are equal\\n", wrong);
    return wrong != 0;
}}
"""


def _numbers(values: np.ndarray, single: bool) -> list[str]:
    return [number(x, float, single) for x in values]


# A component of LinuxCNC's HAL, which holds them
# --------------------------------------------------------------------------------------------------


def hal_component(task: Task, files: Mapping[str, str], about: str) -> str:
    """The text of `law.comp`.

    files: the texts of `law.h` and `law.c`
    about: what the law is, in one sentence, which is put on one line
    LinuxCNC loads only components with a licence that is compatible with its own; the component is
    yours, and the file says "GPL", which you may change to another such licence.
    """
    many = task.outputs > 1, task.inputs > 1
    number = [f"-#[{n}]" if more else "" for n, more in zip((task.outputs, task.inputs), many,
                                                            strict=True)]  # fmt: skip
    at = ["(i)" if more else "" for more in many]
    inlined = files["law.h"] + files["law.c"].replace('#include "law.h"\n', "")
    inlined = inlined.replace("#include <math.h>", "#include <rtapi_math.h>")
    about, *units = (" ".join(text.replace('"', "'").replace("\\", "/").split())
                     for text in (about, task.unit, task.input_unit))  # fmt: skip
    of_y, of_u = (f" [{unit}]" if unit else "" for unit in units)
    return f'''component law "{about}";
description """
A law that learns from trial to trial. It begins a trial when begin-trial is true and none is
running, reads measured and sets command at each of its {task.N} samples, and learns at the sample
after them. Between trials command is 0. It takes a thread of {task.dt:g} s; in another it does
nothing, and last-code is {WRONG_THREAD}. The codes are those of law_code below.
""";
pin in float measured{number[0]} "measured output{of_y}";
pin out float command{number[1]} "input of the plant{of_u}";
pin in bit begin_trial "a trial begins where none is running";
pin out bit running "a trial is running";
pin out s32 trials "trials that have ended";
pin out s32 last_code "what the last trial ended with; 0: learned";
option singleton yes;
function _ fp "one sample of the law";
license "GPL"; // of your component: one that LinuxCNC loads
;;

{inlined}
static law the_law;
static int sample = -1; /* -1: not started */

FUNCTION(_)
{{
    law_real y[LAW_OUTPUTS], u[LAW_INPUTS] = {{ 0 }};
    int i;
    if (fabs(fperiod - LAW_SAMPLE_TIME) > 1e-3 * LAW_SAMPLE_TIME) {{
        last_code = {WRONG_THREAD};
        return;
    }}
    if (sample < 0) {{
        law_start(&the_law);
        last_code = 0;
        sample = 0;
    }}
    if (!running && begin_trial) {{
        law_begin(&the_law);
        sample = 0;
        running = 1;
    }}
    if (!running) {{
        return;
    }}
    for (i = 0; i < LAW_OUTPUTS; ++i) {{
        y[i] = measured{at[0]};
    }}
    if (sample < LAW_SAMPLES) {{
        law_sample(&the_law, sample++, y, u);
    }} else {{
        last_code = law_end(&the_law, y);
        trials += 1;
        running = 0;
    }}
    for (i = 0; i < LAW_INPUTS; ++i) {{
        command{at[1]} = u[i];
    }}
}}
'''
