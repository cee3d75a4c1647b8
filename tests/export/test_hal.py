"""A law as a component of LinuxCNC's HAL."""

import re
import shutil
import subprocess

import pytest
from cases import case

from jaxilc.export import law_of
from jaxilc.export.c_files import files_of
from jaxilc.export.hal import component


@pytest.fixture(scope="module", params=["cfdl_book", "norm_optimal"])
def text(request):
    _, scheme, task = case(request.param)
    files = files_of(law_of(scheme, task, 100.0), ["A law."], "0" * 64, [task.reference])
    return component(task, files, "A law.")


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
