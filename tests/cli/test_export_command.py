"""`jaxilc export`: the files of a law, the proof that they belong together, and refusals."""

from pathlib import Path

import pytest
from cases import follows, lag, p_type
from command import call, done, flat, mistakes, refused

from jaxilc.export.certificate import WRITTEN
from jaxilc.storage.sealed import read_json

AXIS = f"""{lag(60.0, 0.002)}{follows(5.0, 0.1)}{p_type(0.5)}[schemes.pid]
class = "PID"
kp = 1.0
"""

pytestmark = pytest.mark.usefixtures("compiled_once")


@pytest.fixture(autouse=True)
def axis(here):
    """Work in a folder with a plant file."""
    (here / "axis.toml").write_text(AXIS)


@pytest.mark.parametrize(
    ("words", "message"),
    mistakes("""
axis.toml => --limit None is no largest input
axis.toml --limit -1 => --limit -1.0 is no largest input
axis.toml --limit nan => --limit nan is no largest input
axis.toml --limit inf => --limit inf is no largest input
axis.toml --limit 1e39 --number float => --limit 1e+39 is no largest input
axis.toml --limit 1 --format ada => --format ada is not known
axis.toml --limit 1 --number half => --number half is not known
axis.toml --limit 1 --scheme pid => export takes one scheme that learns
 => export needs a scenario or a plant file
axis.toml --limit 1 --state s => a scenario and --state exclude each other
--limit 1 --state s --scheme ilc => --scheme is for a scenario only
--check nowhere => nowhere/certificate.json: no such file
axis.toml --check law => axis.toml and --check exclude each other
--check law --limit 1 => --limit is for a law to write only
"""),
)
def test_a_mistake_is_one_line_and_nothing_is_written(tmp_path, words, message):
    assert message in refused("export", *words)
    assert not (tmp_path / "law").exists()


LOOP = 'class = "WithFeedback"\nlearning = { class = "PIDType" }\n'
LOOP += 'feedback = { class = "PID", kp = 0.5, ki = 9.0 }'


@pytest.mark.parametrize(
    ("option", "law", "message"),
    [
        ("dropped = 0.05", "PIDType", "dropped = 0.05, and the code learns"),
        ("shortest = 0.5", "PIDType", "shortest = 0.5, and the code learns"),
        ("carried = 1.0", "WithFeedback", "carried makes its feedback"),
    ],
)
def test_a_law_is_not_certified_on_trials_that_its_code_refuses(tmp_path, option, law, message):
    """The code begins at rest, too, and the certificate was of another law."""
    varied = AXIS.replace("[task]", f"[machine.variation]\n{option}\n[task]")
    loop = varied.replace('class = "PIDType"\ngamma_p = 0.5', LOOP)
    (tmp_path / "varied.toml").write_text(varied if law == "PIDType" else loop)
    said = refused("export", "varied.toml", "--limit", "9", "--scheme", "ilc")
    assert f"machine.variation.{message}" in said


@pytest.mark.parametrize(
    ("kind", "files"), [("hal", {"law.comp", "law.c", "law.h", "law_test.c"}), ("st", {"law.st"})]
)
def test_other_languages_carry_the_certificate_too(tmp_path, kind, files):
    given = ("export", "axis.toml", "--limit", "9", "--machines", "1", "--format", kind)
    folder = tmp_path / "a law"
    folder.mkdir()
    other = folder / {"hal": "law.st", "st": "law.c"}[kind]
    other.write_text("of an export before")
    code, out, err = call(*given, "--out", "a law")
    assert code == 0, err
    assert f"{other.name} is of another export" in flat(err)
    assert out.endswith("jaxilc export --check 'a law'\n")
    assert f"{other.name} is of another export" in refused("export", "--check", "a law")
    other.unlink()
    assert call("export", "--check", "a law")[0] == 0
    assert {path.name for path in folder.iterdir()} == files | {"certificate.json"}
    assert files <= WRITTEN, "or the files of another export would pass for its own"
    certificate = read_json(folder / "certificate.json")
    digest = certificate["certificate"]
    assert certificate["claims"]["monotone"] + certificate["claims"]["converges"] == 1
    assert 0 < certificate["margin"] < 1
    path = folder / {"hal": "law.comp", "st": "law.st"}[kind]
    text = path.read_text()
    assert digest in text
    path.write_text(text.replace(digest, "f" * 64))
    assert "of another law" in refused("export", "--check", "a law")
    assert call(*given, "--number", "float")[0] == 2
    path.unlink()
    path.mkdir()
    assert f"{path.name} is a folder" in refused(*given, "--out", "a law")


@pytest.mark.thorough
def test_nothing_is_claimed_of_a_law_that_needs_more_than_its_limit():
    """Such a law does not learn from the trials that it cannot play, whatever theory says."""
    out = done("export", "axis.toml", "--limit", "0.2", "--machines", "1", "--out", "l")
    assert "ilc, not claimed on 1: actuator.limit is met in trial 2." in flat(out)


@pytest.mark.thorough
def test_trials_that_the_guard_refuses_are_told_beside_what_is_claimed():
    """The estimate of the law rises from a start far too low: it learns fast only without guard."""
    law = 'class = "CFDLMFAILC"\nlam = 0.01\nrho = 0.6\neta = 0.5\nmu = 0.5\nphi0 = 0.001'
    Path("axis.toml").write_text(f"{AXIS}[schemes.adaptive]\n{law}\n")
    out = done("export", "axis.toml", "--scheme", "adaptive", "--limit", "1e3", "--machines", "1",
               "--out", "l")  # fmt: skip
    said = "The guard refuses 19 of 20 trials of the nominal machine, trial 2 as the first"
    assert said in flat(out)
    assert said in flat(done("export", "--check", "l"))
    assert read_json(Path("l/certificate.json"))["refused_trials"] == [*range(2, 21)]
