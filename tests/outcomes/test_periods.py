"""What `certify` tells of repetitive control, against theory and a run."""

import numpy as np
import pytest
from cases import first_order, follows, known_to, p_type

from jaxilc import learn, theory
from jaxilc.outcomes import certify
from jaxilc.outcomes.request import Request

TURNING = """
trials = 1
[plant]
kind = "transfer_function"
num = [4000.0]
den = [1.0, 80.0, 4000.0]
[task]
dt = 0.001
reference = { function = "sinusoid", amplitude = 1.0, frequency = 10.0, duration = 2.0 }
[schemes.turning]
class = "WithFeedback"
feedback = { class = "PID", kp = 0.5 }
[schemes.turning.learning]
class = "RepetitiveControl"
period = 0.1
law = { class = "LearningFilter", L = [0.1, 0.3, 0.1], keep = [0.1, 0.8, 0.1], lead = 12 }
[schemes.alone]
class = "PID"
kp = 0.5
""" + known_to(0.1)


@pytest.mark.thorough
def test_repetitive_control_is_certified_from_period_to_period(tmp_path):
    """In numbers as theory has them, in sentences, and so it runs."""
    (file := tmp_path / "turning.toml").write_text(TURNING)
    request = Request(str(file))
    found = certify(request, machines=3)
    told, chosen = found.numbers["periods"]["turning"], request.scenario()
    scheme = chosen.schemes["turning"]
    one = theory.repetitive_condition(chosen.machine, scheme, chosen.task)
    wrong = theory.repetitive_condition(chosen.machine, scheme, chosen.task, wrong=0.01)
    assert told["condition"] >= one.test.condition.value
    assert (told["left"], told["left_if_wrong"]) == (one.left[0], wrong.left[0])
    assert found.numbers["schemes"] == {}
    assert set(found.numbers["periods"]) == {"turning"}
    said = " ".join(found.verdict.said)
    assert (
        "turning converges from period to period of 0.1 s on all 3 machines: |Q (1 - L T)|" in said
    )
    assert f"grows up to {told['grows']:.3g} times" in said
    e = np.abs(learn(chosen.machine, scheme, chosen.task, trials=1).final.e[:, 0])
    assert e[-100:].max() < 0.01 * e[:100].max()


def test_a_number_of_machines_that_cannot_differ_is_told(tmp_path):
    """Nothing was said where the file has no uncertainty; one machine was certified."""
    file = tmp_path / "axis.toml"
    file.write_text(f"trials = 2\n{first_order()}{follows(50.0, 0.02)}{p_type(5.0)}")
    request = Request(str(file))
    (told,) = {*certify(request, machines=10**9).lines} - {*certify(request).lines}
    assert told.startswith("machines = 1000000000 has no effect: without an uncertainty the nom")
    assert certify(request, machines=1).lines == certify(request).lines


def test_a_law_that_is_too_strong_is_not_certified_and_no_scheme_at_all_is_refused(tmp_path):
    file = tmp_path / "turning.toml"
    file.write_text(TURNING.replace("[0.1, 0.3, 0.1]", "[0.1, 3.0, 0.1]"))
    said = certify(Request(str(file), ("turning",)), machines=1).verdict.said
    assert said[0].startswith("turning is not certified from period to period of 0.1 s: |Q (1 - L")
    tracked = TURNING.replace(
        "period = 0.1", 'period = 0.1\ntracking = { class = "PeriodTracking", fastest = 1e-6 }'
    )
    file.write_text(tracked)
    said = certify(Request(str(file), ("turning",)), machines=1).verdict.said
    assert said[0].startswith("turning stays bounded whatever is tracked, and once that is const")
    assert "0.1 s, which is tracked and changes by 1.00e-06 s/s at most, on the nominal" in said[0]
    with pytest.raises(ValueError, match="none of alone learns; there is nothing to certify"):
        certify(Request(str(file), ("alone",)), machines=1)


def test_functions_of_a_period_are_certified_by_its_map(tmp_path):
    before, _, after = TURNING.partition('class = "RepetitiveControl"')
    waves = f"""{before}class = "RepetitiveBasis"
gain = GAIN
lead = 0.012
functions = {{ class = "Harmonics", pitch = 0.1, orders = [1, 2] }}
[schemes.alone]{after.partition("[schemes.alone]")[2]}"""
    (file := tmp_path / "waves.toml").write_text(waves.replace("GAIN", "0.002"))
    found = certify(Request(str(file)), machines=3)
    assert found.verdict.said[0].startswith(
        "turning converges from period to period of 0.1 s on all 3 machines: the largest eigenvalue"
    )
    assert found.verdict.said[0].endswith("Of what its functions hold nothing is left.")
    chosen = Request(str(file)).scenario()
    e = np.abs(learn(chosen.machine, chosen.schemes["turning"], chosen.task, trials=1).final.e)
    rate = (e[-100:].max() / e[-1100:-1000].max()) ** 0.1
    assert rate < found.numbers["periods"]["turning"]["map"]
    file.write_text(waves.replace("GAIN", "0.2"))
    said = certify(Request(str(file), ("turning",)), machines=1).verdict.said
    assert said[0].startswith("turning is not certified from period to period of 0.1 s: the large")
    file.write_text(waves.replace("GAIN", "0.002").replace("pitch = 0.1", "pitch = 0.0999734"))
    said = certify(Request(str(file)), machines=1).verdict.said  # as a tuning leaves a period
    assert (
        "turning is not certified from period to period: basis_condition: the period is" in said[0]
    )
