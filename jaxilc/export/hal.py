"""A law as a component of LinuxCNC's HAL: a `.comp` file that `halcompile --install` takes.

Its pins are measured outputs in, inputs of the plant out, and a bit that begins a trial. The thread
that calls it must have the sample time of the law; else it does nothing, and says so by its code.

Source: LinuxCNC 2.9, HAL Component Generator.
"""

from __future__ import annotations

from collections.abc import Mapping

from ..signals.task import Task

WRONG_THREAD = -1  # the code of a thread of another period


def component(task: Task, files: Mapping[str, str], about: str) -> str:
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
    unit = {name: f" [{text}]" if text else "" for name, text in
            (("y", task.unit), ("u", task.input_unit))}  # fmt: skip
    about = " ".join(about.replace('"', "'").split())
    return f'''component law "{about}";
description """
A law that learns from trial to trial. It begins a trial when begin-trial is true and none is
running, reads measured and sets command at each of its {task.N} samples, and learns at the sample
after them. Between trials command is 0. It takes a thread of {task.dt:g} s; in another it does
nothing, and last-code is {WRONG_THREAD}. The codes are those of law_code below.
""";
pin in float measured{number[0]} "measured output{unit["y"]}";
pin out float command{number[1]} "input of the plant{unit["u"]}";
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
