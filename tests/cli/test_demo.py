"""`jaxilc demo` tells a story that its own numbers bear out."""

import pytest

from jaxilc.outcomes import demonstrating


@pytest.mark.usefixtures("compiled_once")
def test_the_law_that_looks_good_diverges_as_theory_knew_and_the_tuned_one_does_not(
    monkeypatch, tmp_path
):
    for name, value in {"MACHINES": 16, "STEPS": 15, "TRIALS": 40}.items():
        monkeypatch.setattr(demonstrating, name, value)
    found = demonstrating.demo(tmp_path)
    of = found.numbers
    assert of["claims"] == {"plain": "diverges", "tuned": "monotone"}
    assert of["turning"] == of["best_trial"]
    assert of["rms"][of["best_trial"] - 1] < 2e-3 * of["rms"][0] < of["rms"][-1]
    assert of["yield"] == {"plain": 0.0, "tuned": 1.0}
    assert of["worst"]["tuned"] < demonstrating.TOLERANCE
    assert "diverges" in found.verdict.said[1]
    assert found.verdict.following == "jaxilc init axis.toml"
    assert [*found.figures] == ["demo"]
    assert found.figures["demo"].draw() is not None
