"""The recipe for conda, the history of speed and the paper say what the project says."""

import json
import re
import tomllib
from pathlib import Path

from jaxilc import __version__

ROOT = Path(__file__).parents[1]
RENAMED = {"matplotlib": "matplotlib-base"}  # by conda-forge: the part without Qt


def text_of(file: str) -> str:
    """Return the text of a file of the repository."""
    return (ROOT / file).read_text(encoding="utf-8")


def test_the_recipe_has_the_dependencies_of_the_project():
    project = tomllib.loads(text_of("pyproject.toml"))["project"]
    recipe = text_of(".ci/conda/recipe.yaml")
    needed = re.search(r"\n  run:\n((?:    - .*\n)+)", recipe)
    asked = [re.split(r"(?=[><=!])", one, maxsplit=1) for one in project["dependencies"]]
    wanted = {f"{RENAMED.get(name, name)} {bounds}" for name, bounds in asked}
    wanted |= {f"python {project['requires-python']}"}
    assert {*re.findall(r"- (.*)", needed[1])} == wanted
    assert f'version: "{__version__}"' in recipe
    assert all(f"{name} = {to}" in recipe for name, to in project["scripts"].items())


def test_the_oldest_scipy_that_is_allowed_draws_as_it_is_asked_to():
    """Its quasi-random sequences take `rng` from 1.15 on; 1.14 ended in a TypeError."""
    wanted = tomllib.loads(text_of("pyproject.toml"))["project"]["dependencies"]
    (oldest,) = (one.removeprefix("scipy>=") for one in wanted if one.startswith("scipy>="))
    assert "qmc.Sobol(dimensions, rng=" in text_of("jaxilc/uncertainty.py")
    assert tuple(map(int, oldest.split("."))) >= (1, 15)


def test_the_history_times_what_is_there():
    settings = json.loads(text_of(".ci/history/asv.conf.json"))
    folder = ROOT / ".ci/history" / settings["benchmark_dir"]
    timed = re.findall(r"def (time_\w+)", (folder / "main_figures.py").read_text(encoding="utf-8"))
    assert {"time_sweep", "time_gradient", "time_certify", "time_help"} <= {*timed}
    assert (ROOT / ".ci/history" / settings["repo"]).resolve() == ROOT


def test_the_paper_counts_as_the_project_does():
    """The numbers of the paper are those of the start page, which test_promises.py computes."""
    paper, start = (" ".join(text_of(f).split()) for f in (".github/paper.md", "README.md"))
    for of_start, of_paper in (
        (r"(\d+) independent printed numbers", "{} independent numbers"),
        (r"Of (\d+) comparisons with what papers", "of {} comparisons with their conclusions"),
        (r"(\d+) numbers of other software agree", "on {} of their printed numbers"),
    ):
        assert of_paper.format(re.search(of_start, start)[1]) in paper
    assert all(f"`{command}`" in paper for command in ("jaxilc reproduce", "jaxilc"))
