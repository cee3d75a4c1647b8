"""What is not of a machine, or not of this trial, is refused: seen on a drive in plain NumPy."""

import shlex
from itertools import product

import campaigns_with_faults as faults
import numpy as np
import pytest
import scipy.signal
from rigs_of_many_kinds import RIGS, cylinder
from two_mass_rig import DT, Rig, read_schedule, stroke

from jaxilc.hardware import Rules, checks
from jaxilc.signals import Task

R = stroke()
U = R[:-1, None]
LAST = Rig().play(U[:, 0], 1)[:, None]


def said(findings):
    return [f"{f.kind}: {f.text}" for f in findings]


def test_a_channel_that_stands_still_is_seen_and_one_that_rests_is_not():
    dead = np.zeros_like(LAST)
    (found,) = said(checks.frozen("y", dead, LAST, U, ()))
    assert found.startswith("refusal: y is constant up to 0")
    assert found.endswith("--set campaign.accept=frozen accepts it")
    halfway = faults.frozen(LAST[:, 0])[:, None]
    (found,) = said(checks.frozen("y", halfway, LAST, U, ("frozen",)))
    assert found.startswith("warning: y stands still from sample 120 to 600")
    for good in (LAST, Rig(coulomb=100.0).play(U[:, 0], 2)[:, None]):
        assert checks.frozen("y", good, LAST, U, ()) == []
    # An experiment moves the machine by a hundredth, or by less than two counts of the encoder.
    assert checks.frozen("y", 0.015 * LAST, LAST, U, (), share=0.01) == []
    (found,) = said(checks.frozen("y", dead, LAST, U, (), share=0.1))
    assert f"where a range of {0.1 * np.ptp(LAST):.3g} was expected" in found
    assert checks.frozen("y", dead, LAST.round(), U, (), share=1.9 / np.ptp(LAST)) == []
    # An axis is held at rest, where one count came and went; a command of two values is no count.
    count = 1e-3 * (np.arange(len(LAST)) == 20)[:, None]
    assert checks.frozen("y", 0 * count, count, U, ()) == []
    assert len(checks.frozen("u", 0 * U, np.sign(U), np.sign(U), ())) == 1
    # The first trial of a law that has learned nothing plays nothing, and nothing moves.
    assert checks.frozen("y", dead, R[:, None], 0 * U, (), still=checks.DEAD) == []


def test_of_a_trial_that_ended_early_only_what_was_measured_stands_still():
    share = LAST[:, 0] / LAST.max()
    k = np.argmax(share > 0.9) + 1  # it ended while the machine moved
    assert checks.frozen("y", LAST[:k], LAST, U, ()) == []
    (found,) = said(checks.frozen("y", 0 * LAST[:k], LAST, U, ()))
    assert found.startswith("refusal: y is constant up to 0")
    rest = np.argmax(share > 0.1)  # it ended before the machine had to move
    assert checks.frozen("y", 0 * LAST[:rest], LAST, U, ()) == []


def test_an_output_that_is_a_command_is_its_column_and_not_a_perfect_trial():
    """It was looked for until the first trial that was learned from, and in the reference only."""
    r, noise = R[:, None], 1e-3 * np.random.default_rng(0).normal(size=(len(R), 1))
    commands, learned = {"the reference": r, "the input": r[:-1] + noise[:-1]}, LAST
    for y, last in ((r, None), (r.round(4), None), (np.float32(r), learned)):
        (found,) = said(checks.as_the_command(y, last, commands, ()))
        assert found.startswith("refusal: y is the reference to the last digit; suspected is the c")
    (found,) = said(checks.as_the_command(r + noise, learned, commands, ()))
    assert found.startswith("refusal: y is the input to the last digit")
    rest = np.argmax(R > 0)  # a trial that ended there says nothing
    for y in (r[:rest], LAST, r + 1e-2 * noise, LAST[:200]):
        assert checks.as_the_command(y, None, {"the reference": r}, ()) == []
    assert checks.as_the_command(0 * r, None, {"r": 0 * r}, ()) == [], "an axis is held at rest"
    counts = {"the reference": r.round(2)}  # an encoder of 10 µm, and an axis that has learned
    assert checks.as_the_command(r.round(2), (r + 10 * noise).round(2), counts, ()) == []
    assert len(checks.as_the_command(r.round(2), LAST.round(2), counts, ())) == 1


def test_outputs_in_another_order_and_a_shifted_input_are_told():
    """Both were learned from; the shift was told as one of the machine's feedback or limit."""
    y = np.hstack([LAST, 0.5 * LAST[::-1]])
    r = y + 0.01 * np.random.default_rng(0).normal(size=y.shape)
    (found,) = said(checks.exchanged(y[:, ::-1], r, ()))
    follows = "y{} follows the reference of y{}".format
    assert found.startswith(f"refusal: {follows(0, 1)}, {follows(1, 0)}; suspected")
    three = np.column_stack([r, r[:, 0] * r[:, 1]])
    (found,) = said(checks.exchanged(three[:, [1, 2, 0]], three, ()))
    assert f"{follows(1, 2)}, {follows(2, 0)}" in found
    for good in (y, 0 * y, y[:, [0, 0]], y[:200]):
        assert checks.exchanged(good, r, ()) == []
    task = Task(R, dt=DT, input_unit="V")
    for late in (-2, 3):
        (found,) = said(checks.as_commanded(np.roll(U, late), U, None, task))
        assert found.endswith(f"; it is that one shifted by {abs(late)} samples")
    (found,) = said(checks.as_commanded(0.9 * U, U, None, task))
    assert "shifted" not in found


def test_lost_counts_and_another_unit_are_steps_that_no_motion_makes():
    y = LAST.copy()
    assert checks.jumped(y, R[:, None], None, (), "mm") == []
    y[300:] -= 2.0
    (found,) = said(checks.jumped(y, R[:, None], LAST, (), "mm"))
    assert "y jumps by 2 mm at sample 300" in found
    (found,) = said(checks.jumped(1000 * LAST, R[:, None], LAST, (), "mm"))
    assert "wrong unit" in found
    rough = LAST + np.random.default_rng(0).normal(0, 0.1, LAST.shape)
    assert checks.jumped(rough, R[:, None], None, (), "mm") == []
    (found,) = said(checks.jumped(1000 * LAST, R[:, None], LAST, (), ""))
    assert "  " not in found, "a task without a unit"


@pytest.mark.parametrize("coupling", [0.5, -0.02])
@pytest.mark.parametrize("count", [0.0, 1e-3])
def test_an_axis_at_rest_that_another_one_moves_does_not_jump(coupling, count):
    """Its steps were compared with its own reference and last trial alone, which both rest."""
    rng = np.random.default_rng(0)
    r = np.stack([R, 0 * R], axis=1)
    noise = 1e-3 * rng.standard_normal((2, *r.shape))
    last, y = noise[0], noise[1] + LAST * [1, coupling]
    if count:
        last, y = (count * np.round(x / count) for x in (last, y))
    assert checks.jumped(y, r, last, (), "mm") == []
    for axis in (0, 1):
        slipped, spiked, dropped, inches = (y.copy() for _ in range(4))
        slipped[300:, axis] -= 1.0
        spiked[300, axis] += 1.0
        dropped[300:310, axis] = 5.0
        inches[:, axis] = 1000 * LAST[:, 0]
        for wrong in (slipped, spiked, dropped, inches):
            (found,) = said(checks.jumped(wrong, r, last, (), "mm"))
            assert found.startswith(f"refusal: y{axis} jumps by")


def test_inches_of_a_small_motion_are_no_coupling_of_a_large_one():
    """They were taken for a motion that another axis makes."""
    r = np.stack([R, 0.03 * R], axis=1)
    last = LAST * [1, 0.03]
    assert checks.jumped(last, r, last, (), "mm") == []
    (found,) = said(checks.jumped(last * [1, 25.4], r, last, (), "mm"))
    assert found.startswith("refusal: y1 jumps by")


@pytest.mark.parametrize("seed", range(5))
def test_noise_of_one_encoder_is_no_motion_that_lasts(seed):
    """It was taken for one up to five times the largest step of the other axis."""
    rng = np.random.default_rng(seed)
    r = np.stack([R, 0 * R], axis=1)
    last, y, noisy, burst = LAST * [1, 0] + 1e-3 * rng.standard_normal((4, *r.shape))
    step = np.max(np.abs(np.diff(LAST, axis=0)))
    noisy[:, 1] += 0.6 * step * rng.standard_normal(len(R))
    burst[300:303, 1] += [step, -step, step]
    assert checks.jumped(y, r, last, (), "mm") == []
    for wrong in (noisy, burst):
        (found,) = said(checks.jumped(wrong, r, last, (), "mm"))
        assert found.startswith("refusal: y1 jumps by")


@pytest.mark.parametrize(
    ("changed", "expected"),
    [
        ({"gain": 0.7}, "a gain that changed by -30%"),
        ({"delay": 9}, "a delay that is +7.98 ms (+8 samples) longer"),
        ({"coulomb": 40.0}, "friction (or play) that grew"),
        ({"coulomb": 150.0, "viscous": 0.1}, "friction (or play) that grew"),
        ({"force": 6.0}, "a limit of force or speed: the first acceleration reaches 6"),
        ({"resonance": 18.0, "damping": 0.02}, "a resonance at 15 Hz"),
        ({"position_gain": 40.0}, "a lag that is +"),
    ],
)
def test_what_changed_is_named(changed, expected):
    y = Rig(**changed).play(U[:, 0], 2)[:, None]
    found = checks.what_changed(y, LAST, DT)
    assert found.text.startswith(expected)
    assert found.then
    inches = checks.what_changed(LAST / 25.4, LAST)
    assert inches.text == "another unit: y is 0.03937 times that of the last trial"
    turned = checks.what_changed(-LAST, LAST)
    assert turned.text == "another sign: y is -1 times that of the last trial"
    assert checks.what_changed(LAST[:5], 2 * LAST[:5]) == checks.Change()


@pytest.mark.parametrize("pressure", [0.1, 0.06, 0.04])
def test_a_limit_of_speed_is_no_friction(pressure):
    """The flow of a hydraulic cylinder at a low pressure was called friction."""
    before, now = (cylinder(stroke()[:-1], 1, p)[:, None] for p in (1.0, pressure))
    found = checks.what_changed(now, before, DT)
    assert found.cause == "limit"
    assert "a limit of speed" in found.text


def test_an_input_that_is_not_the_one_to_play_is_refused():
    (found,) = said(checks.misplayed(0.5 * U, U, {1: 0 * U, 3: 0.5 * U}, ()))
    assert "it is that of trial 3" in found
    noisy = U + np.random.default_rng(0).normal(0, 0.1, U.shape)
    assert checks.misplayed(noisy, U, {}, ()) == []


def test_rules_name_what_is_accepted():
    with pytest.raises(ValueError, match="accept = 'all' is none of frozen, sign, jump"):
        Rules(accept=("all",)).checked()


@pytest.mark.parametrize("seed", range(3))
def test_no_drive_in_order_is_taken_for_one_of_the_other_sign(seed):
    """All ten drives, in trials that play nothing, a part of the motion, and all of it."""
    lag = np.exp(-50 * DT)
    for j, (rig, share) in enumerate(product(RIGS, (0.0, 0.01, 0.7, 1.0))):
        u = share * R[:-1]
        y = rig(u, 100 * seed + j)[:, None]
        nominal = np.append(0.0, scipy.signal.lfilter([1 - lag], [1, -lag], u))[:, None]
        assert checks.of_other_sign(y, nominal, R[:, None], (), "mm") == []
        told = checks.of_other_sign(-y, nominal, R[:, None], (), "mm")
        assert len(told) == (share > checks.MOVES)
        for accept, kind in ((("frozen",), "refusal"), (("sign",), "warning")):
            told = checks.of_other_sign(-y, nominal, R[:, None], accept, "mm")
            assert {of.kind for of in told} <= {kind}
    noise = np.random.default_rng(seed).standard_normal((1000, len(R), 2))
    assert not any(checks.of_other_sign(y, noise[0], noise[1], (), "mm") for y in noise)


@pytest.mark.parametrize("wrong", [1, -1])
def test_the_sign_of_a_load_or_of_a_coupling_between_axes_is_not_judged(wrong):
    """Both were refused: a machine at rest under a load, and an axis beside one that moves."""
    both = np.stack([R, 0 * R], axis=1)
    load = wrong * np.full(both.shape, 0.02)
    assert checks.of_other_sign(load, np.full(both.shape, 0.02), both, (), "mm") == []
    beside = np.stack([R, 0.002 * R], axis=1)
    assert checks.of_other_sign(beside * [1, wrong], beside, both, (), "mm") == []


def test_a_first_trial_of_the_other_sign_is_refused(tmp_path):
    """It was learned from: three trials on, the input was twice the stroke."""
    schedule, file = tmp_path / "next.csv", tmp_path / "1.csv"
    assert faults.begun(tmp_path, None, tmp_path / "x", schedule)[0] == 0
    learn = ("next", "--state", tmp_path / "x", "--measured", file, "--out", schedule)
    u = read_schedule(schedule)
    y = Rig().play(u, 1)
    faults.write_trial(file, R, -y, u)
    code, told = faults.call(*learn)
    assert code == 3
    assert "suspected is the sign of the column, or of the plant's gain in the file; --set" in told
    faults.write_trial(file, R, y, u)
    assert faults.call(*learn)[0] == 0


def test_a_sign_is_not_judged_of_a_trial_within_its_band(tmp_path):
    """A coupling of a half between two axes, of the other sign, leaves the error that it has."""
    plant, schedule, file = (tmp_path / name for name in ("axes.toml", "next.csv", "1.csv"))
    r = np.stack([R, 0 * R], axis=1)
    rows = (f"{k * DT},{x},0" for k, x in enumerate(R))
    (tmp_path / "r.csv").write_text("\n".join(["t,x,y", *rows]))
    plant.write_text(f"""
        [plant]
        kind = "state_space"
        A = [[0.7, 0.0], [0.0, 0.7]]
        B = [[0.3, 0.0], [0.15, 0.3]]
        C = [[1.0, 0.0], [0.0, 1.0]]
        dt = {DT}
        [machine.sensor]
        noise = 0.001
        [task]
        dt = {DT}
        inputs = 2
        unit = "mm"
        reference = [{{csv = "r.csv", column = "x"}}, {{csv = "r.csv", column = "y"}}]
        [schemes.law]
        class = "PIDType"
        gamma_p = 0.5
    """)
    state = ("next", "--state", tmp_path / "x", "--out", schedule)
    assert faults.call(*state, "--scenario", plant)[0] == 0
    rng = np.random.default_rng(1)
    for _ in range(2):
        table = np.loadtxt(schedule, delimiter=",", skiprows=1)[:, -2:]
        y = scipy.signal.lfilter([0, 0.3], [1, -0.7], table @ [[1, -0.5], [0, 1]], axis=0)
        y += 0.001 * rng.standard_normal(y.shape)
        columns = np.column_stack([np.arange(len(R)) * DT, r, y, table])
        head = "t [s],r0 [mm],r1 [mm],y0 [mm],y1 [mm],u0,u1"
        np.savetxt(file, columns, delimiter=",", header=head, comments="")
        code, told = faults.call(*state, "--measured", file)
        assert code == 0, told


def test_a_dead_encoder_is_refused_without_a_file_and_the_campaign_goes_on(tmp_path, monkeypatch):
    monkeypatch.setattr(faults, "TRIALS", 4)
    monkeypatch.setattr(faults, "FAULTY", 3)
    good = faults.campaign(tmp_path, "none")
    assert good["trial 6"] == "played on: "
    found = faults.campaign(tmp_path, "dead encoder")  # asserts that no file is written
    for part in (
        "y is constant up to 0",
        "the next u would reach",
        "Nothing was learned or written; back to the input of trial 2",
    ):
        assert part in found["trial 6"]
    assert found["trial 6"].startswith("refused")
    assert found["largest"] < 1.01 * good["largest"]
    assert found["largest"] > 0.9 * good["largest"]


def test_each_suspicion_can_be_accepted_by_name(tmp_path):
    np.savetxt(
        tmp_path / "reference.csv", np.column_stack([np.arange(len(R)) * DT, R]), delimiter=",",
        header="t,r", comments="",
    )  # fmt: skip
    (tmp_path / "axis.toml").write_text(faults.PLANT)
    state, out = tmp_path / "x", tmp_path / "next.csv"
    start = ("next", "--state", state, "--set", "campaign.predict=false", "--out", out)
    assert faults.call(*start, "--scenario", tmp_path / "axis.toml")[0] == 0
    for j in (1, 2):
        u = read_schedule(out)
        y = Rig().play(u, 1) if j == 1 else 1e-4 * (np.arange(len(R)) % 7 == 0)  # as at rest
        faults.write_trial(tmp_path / f"{j}.csv", R, y, u)
        arguments = (*start, "--measured", tmp_path / f"{j}.csv")
        if j == 2:
            code, told = faults.call(*arguments)
            assert code == 3
            assert "accept=frozen" in told
            *back, beside = shlex.split(told.split("back to the input of trial 1 ")[1])[3:]
            assert beside == str(tmp_path / "best.csv")
            assert faults.call(*back, beside)[0] == 0, "it is typed as it stands"
            np.testing.assert_array_equal(read_schedule(beside), 0.0)
            assert faults.call(*start, "--measured", tmp_path / "1.csv")[0] == 0
            arguments += ("--set", "campaign.accept=frozen,input,growth")
        assert faults.call(*arguments)[0] == 0
