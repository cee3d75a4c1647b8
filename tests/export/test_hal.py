"""A law as a component of LinuxCNC's HAL."""

import dataclasses
import re
import shutil
import subprocess

import numpy as np
import pytest
from cases import case

from jaxilc.export import law_of
from jaxilc.export.c_files import files_of, hal_component


@pytest.fixture(scope="module", params=["cfdl_book", "norm_optimal"])
def text(request):
    _, scheme, task = case(request.param)
    files = files_of(law_of(scheme, task, 100.0), ["A law."], "0" * 64, [task.reference])
    return hal_component(task, files, "A law.")


def test_what_is_told_stays_on_one_line_between_its_quotes():
    _, _, task = case("cfdl_book")
    task = dataclasses.replace(task, unit='"', input_unit="V\\\n")
    lines = hal_component(task, {"law.h": "", "law.c": ""}, 'A "law"\nof two\tlines.').splitlines()
    assert lines[0] == """component law "A 'law' of two lines.";"""
    told = [re.search(r' "((?:\\.|[^\\"])*)";$', one)[1] for one in lines if one[:4] == "pin "]
    assert told[:2] == ["measured output [']", "input of the plant [V/]"]


@pytest.mark.thorough
def test_the_pins_are_those_of_the_task_and_no_name_of_the_law(text):
    head, _, code = text.partition(";;")
    pins = re.findall(r"pin (?:in|out) \w+ ([\w-]+)(?:-#\[(\d+)\])?", head)
    names = [name.rstrip("-#").replace("-", "_") for name, _ in pins]
    assert names == ["measured", "command", "begin_trial", "running", "trials", "last_code"]
    own = re.sub(r"/\*.*?\*/", "", code.partition("static law the_law;")[0], flags=re.S)
    assert not set(names) & set(re.findall(r"\w+", own))  # pins are macros there


def test_halcompile_takes_it(text, tmp_path):
    if shutil.which("halcompile") is None:
        pytest.skip("needs halcompile: apt install linuxcnc-uspace-dev")
    (tmp_path / "law.comp").write_text(text)
    subprocess.run(["halcompile", "--preprocess", "law.comp"], cwd=tmp_path, check=True)
    assert "rtapi_app_main" in (tmp_path / "law.c").read_text()


# What halcompile makes of pins: macros of what is seen through pointers.
STUB = """#include <stdbool.h>
#include <stdio.h>
static struct { double measured, command; bool begin_trial, running; int trials, last_code; } pins;
#define measured (0 + pins.measured)
#define command pins.command
#define begin_trial (0 + pins.begin_trial)
#define running pins.running
#define trials pins.trials
#define last_code pins.last_code
#define fperiod (period * 1e-9)
#define FUNCTION(name) static void called(long period)
"""
SESSION = """
#undef measured
#undef begin_trial
int main(void)
{
    long period;
    int begin;
    while (scanf("%ld %d %lf", &period, &begin, &pins.measured) == 3) {
        pins.begin_trial = begin;
        called(period);
        printf("%a %d %d %d\\n", command, running, trials, last_code);
    }
    return 0;
}
"""


@pytest.mark.skipif(shutil.which("cc") is None, reason="there is no C compiler")
def test_a_thread_plays_trial_after_trial(tmp_path):
    """With rests of any length between trials, and calls of another period, which do nothing."""
    _, scheme, task = case("cfdl_book")
    law = law_of(scheme, task, 100.0)
    code = hal_component(task, files_of(law, [], "0" * 64, [task.reference]), "").partition(";;")[2]
    code = code.replace("rtapi_math.h", "math.h")
    (tmp_path / "law.c").write_text(STUB + code + SESSION)
    made = ["cc", "-std=c99", "-ffp-contract=off", "-o", "law", "law.c", "-lm"]
    subprocess.run(made, cwd=tmp_path, check=True)
    rng, played, period = np.random.default_rng(0), law.played(), round(1e9 * task.dt)
    rows, wanted, k, u, trials, told = [], [], None, 0.0, 0, 0
    for _ in range(5 * task.N):
        begin, right = rng.random() < 0.2, rng.random() < 0.98
        y = 1e-3 * rng.standard_normal(1) + (0.0 if k is None else task.reference[k])
        if not right:
            told = -1
        elif k is None and begin:
            played.call("begin")
            k = 0
        if right and k == task.N:
            told, trials = int(played.call("end", y=y)["code"]), trials + 1
            k, u = None, 0.0
        elif right and k is not None:
            u, k = float(played.call("sample", k=np.int32(k), y=y)["u"][0]), k + 1
        rows.append(f"{period if right else 2 * period} {begin:d} {float(y[0]).hex()}")
        wanted.append((u, k is not None, trials, told))
    found = subprocess.run(["./law"], cwd=tmp_path, input="\n".join(rows), capture_output=True,
                           text=True, check=True).stdout.splitlines()  # fmt: skip
    found = [(float.fromhex(one[0]), *map(int, one[1:])) for one in map(str.split, found)]
    assert found == wanted
    assert trials >= 3
