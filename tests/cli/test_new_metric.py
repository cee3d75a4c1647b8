"""A metric that is added as `known_metrics` says works everywhere: a line, and a field.

Both are written into the source of that module in another process, which then runs the commands.
"""

import json
import subprocess
import sys

import pytest
from cases import first_order, follows, known_to, p_type

from jaxilc import figures

ADD = '''
import importlib.util, shlex, shutil, sys
name = "jaxilc.learning.known_metrics"
spec = importlib.util.find_spec(name)
source = spec.loader.get_source(name)
LINES = """
    Metric("peak_input", _PER_INPUT, "input", "largest input", tuned=True,
           gathered=Gathering("u", "largest")),
    Metric("late_rms", _PER_OUTPUT, "output", "rms error in the settled window", tuned=True,
           gathered=Gathering("e", "root mean square", settled=True)),
"""
FIELDS = """
    peak_input: Array
    late_rms: Array
"""
for before, lines in (('    Metric("best_trial"', LINES[1:]), ("    finite: Array", FIELDS[1:])):
    assert source.count(before) == 1
    source = source.replace(before, lines + before)
module = importlib.util.module_from_spec(spec)
sys.modules[name] = module
exec(compile(source, spec.origin, "exec"), vars(module))

from jaxilc import load_scenario
from jaxilc import figures
from jaxilc.cli import main
from jaxilc.figures.explorer import Exploration

figures.save = lambda _, path, **__: shutil.copy("pixel.png", path)  # drawn, but not painted
for line in sys.argv[1].split("\\n"):
    sys.argv = ["jaxilc", *shlex.split(line)]
    try:
        main()
    except SystemExit as stop:
        print(f"{line}: {stop.code or 0}")
moved = Exploration(load_scenario("peak_input.toml"), machines=2).outcome({})
print("moved", moved.errors.shape)
'''
PLANT = f"""trials = 4
{first_order()}unit = "mm"
input_unit = "V"
settle = [0.01, 0.03]
{follows(50.0, 0.03)}{p_type(2.0)}{known_to(0.1)}"""
FEW = "--weights gamma_p --machines 3 --held-out 2 --unseen 2 --steps 1"
LINES = f"""run peak_input.toml --metric late_rms --json late.json
run late_rms.toml --metric peak_input --json peak.json
sweep late_rms.toml --metric peak_input --tolerance 1 --machines 3 --report sweep.html
tune peak_input.toml --scheme ilc {FEW} --objective final+every-trial@late_rms
worst-case peak_input.toml --scheme ilc --starts 1 --steps 1
certify peak_input.toml --machines 2
next --state c --scenario peak_input.toml --scheme ilc --out n.csv
next --state c --measured m.csv --out n2.csv
trials --state c"""


@pytest.mark.thorough
def test_a_new_metric_works_everywhere(tmp_path, unpainted):
    for metric in ("peak_input", "late_rms"):
        (tmp_path / f"{metric}.toml").write_text(f'judged_by = "{metric}"\n{PLANT}')
    figures.save(None, tmp_path / "pixel.png")
    rows = "".join(f"{k / 1000},0.0,0.0\n" for k in range(31))
    (tmp_path / "m.csv").write_text(f"t [s],y [mm],u [V]\n{rows}")
    done = subprocess.run(
        [sys.executable, "-W", "error", "-c", ADD, LINES],  # a figure without numbers warns
        cwd=tmp_path,
        capture_output=True,
        text=True,
    )
    codes = [line for line in LINES.split("\n") if f"{line}: 0\n" not in done.stdout]
    assert (done.returncode, codes) == (0, []), done.stdout + done.stderr
    assert "moved (2, 4)" in done.stdout
    late, peak = (json.loads((tmp_path / f"{name}.json").read_text()) for name in ("late", "peak"))
    assert late["schemes"]["ilc"].keys() >= {"late_rms", "peak_input", "effort"}
    assert "late_rms of" not in done.stdout
    assert "late rms of" in late["verdict"][0]
    assert " mm" in late["verdict"][0]
    u = peak["schemes"]["ilc"]["peak_input"]
    assert u["1"] == 0 < u["2"] < u["4"]
    assert f"peak input of {u['4']:.3g} V, after 0 V in trial 1" in peak["verdict"][0]
    assert "leaves an rms error of at most 0 mm" in done.stdout.replace("\n", " ")
