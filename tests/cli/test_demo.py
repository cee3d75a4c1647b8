"""`jaxilc demo` tells a story that its own numbers bear out."""

import json

from command import call

from jaxilc.outcomes import demonstrating


def test_the_law_that_looks_good_diverges_as_theory_knew_and_the_tuned_one_does_not(
    monkeypatch, tmp_path
):
    monkeypatch.chdir(tmp_path)
    for name, value in {"MACHINES": 16, "STEPS": 15, "TRIALS": 40}.items():
        monkeypatch.setattr(demonstrating, name, value)
    code, said, _ = call("demo", "--report", "demo.json")
    assert code == 0
    of = json.loads((tmp_path / "demo.json").read_text())
    assert of["claims"] == {"plain": "diverges", "tuned": "monotone"}
    assert of["turning"] == of["best_trial"]
    assert of["rms"][of["best_trial"] - 1] < 2e-3 * of["rms"][0] < of["rms"][-1]
    assert of["yield"] == {"plain": 0.0, "tuned": 1.0}
    assert of["worst"]["tuned"] < demonstrating.TOLERANCE
    assert "diverges" in of["verdict"][1]
    assert "jaxilc init axis.toml" in said
    assert (tmp_path / "out" / "demo" / "demo.png").stat().st_size > 10_000
