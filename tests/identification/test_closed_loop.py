"""A loop that was closed is seen, and the reference gives a fit without bias."""

import numpy as np
import pytest
import scipy.signal
from command import write_columns

from jaxilc import outcomes
from jaxilc.identification import Record, identify
from jaxilc.identification.estimation import feedback_seen, of_reference, with_noise
from jaxilc.plants import ProcessModel

DT, N, POLE, GAIN = 0.01, 2000, 8.0, 2.0
STRUCTURE = {"poles": 1, "pairs": 0, "zeros": 0}


def played(seed, feedback, slow=0.97, other=np.inf):
    """Return reference, input and output of a lag, or two, with noise and P control, by NumPy."""
    rng, kept, second = np.random.default_rng(seed), np.exp(-POLE * DT), np.exp(-other * DT)
    r = np.repeat(rng.choice([-1.0, 1.0], N // 20 + 1), 20)[: N + 1]
    v = scipy.signal.lfilter([0.05], [1, -slow], rng.standard_normal(N + 1))
    x, z, u, y = 0.0, 0.0, np.zeros(N + 1), np.zeros(N + 1)
    for k in range(N + 1):
        y[k] = x + v[k]
        u[k] = feedback * (r[k] - y[k]) if feedback else r[k]
        z = second * z + (1 - second) * u[k]
        x = kept * x + GAIN * (1 - kept) * z
    return r, u, y


@pytest.mark.thorough
def test_a_closed_loop_is_seen_and_an_open_one_is_not():
    for seed in range(4):
        for feedback in (0.0, 3.0):
            _, u, y = played(seed, feedback)
            record = Record(u[:-1], y, DT)
            wrong = ProcessModel(0.7 * GAIN, [], [1.5 * POLE], [], [])  # no model is the plant
            found = identify(record, wrong, free=["gain"])
            assert feedback_seen(record, y[:, None] - found.simulated) == bool(feedback)


def test_a_model_of_the_noise_and_the_reference_give_a_fit_without_bias():
    inside, off = [], []
    for seed in range(8):
        r, u, y = played(seed, 3.0)
        record = Record(u[:-1, None], y[:, None], DT)
        staged = identify(of_reference(record, r[:-1]), ProcessModel(GAIN, [], [POLE], [], []))
        direct = identify(record, ProcessModel(GAIN, [], [POLE], [], []))
        found = with_noise(record, direct)
        for name, true in (("gain", GAIN), ("poles[0]", POLE)):
            inside.append(found.parameters[name].low < true < found.parameters[name].high)
        off.append([float(one.plant.gain) / GAIN - 1 for one in (direct, found, staged)])
        assert found.white
        assert not direct.white
        left = record.y - found.simulated  # of the record as it is, with its bias
        assert abs(np.mean(left)) < 1e-9 * np.std(y)
        freedom = found.samples - len(found.parameters)
        std = np.linalg.norm(left[: found.samples]) / np.sqrt(freedom)
        assert found.residual_std == pytest.approx(std, rel=1e-9)
        assert found.fit[0] == pytest.approx(direct.fit[0], abs=5.0)
    assert np.mean(inside) > 0.8
    biased, *unbiased = np.mean(off, axis=0) / (np.std(off, axis=0) / np.sqrt(len(off)))
    assert abs(biased) > 6
    assert np.max(np.abs(unbiased)) < 3


def test_the_noise_of_a_record_cut_out_of_a_motion_is_modelled_without_its_unknown_past():
    """From a past of zeros the first rows had errors as large as the offset, here of 50."""
    for seed in range(2):
        _, u, y = played(seed, 3.0)
        record = Record(u[37:-1, None] + 50 / GAIN, y[37:, None] + 50, DT)
        direct = identify(record, ProcessModel(GAIN, [], [POLE], [], []))
        found = with_noise(record, direct)
        assert not found.from_rest
        assert found.white
        assert found.samples == direct.samples
        assert found.residual_std < 1.2 * direct.residual_std
        assert float(found.plant.gain) == pytest.approx(GAIN, rel=0.1)


def test_what_a_plant_misses_is_not_taken_for_its_noise():
    """What is left by plant and noise is white here, but the past of the input still tells it."""
    for seed in range(3):
        _, u, y = played(seed, 2.0, 0.9, other=6.0)
        record = Record(u[:-1, None], y[:, None], DT)
        found = with_noise(record, identify(record, ProcessModel(GAIN, [], [4.0], [], [])))
        assert found.whiteness > 0.8
        assert not found.white


@pytest.mark.parametrize(
    ("slow", "modelled", "with_r", "without"),
    [
        (0.3, True, "an autoregression of its noise", "an autoregression of its noise"),
        (0.0, True, "adds no bias, since it is white", "adds no bias, since it is white"),
        (0.97, True, "an autoregression of its noise", "the reference as a column r"),
        (0.97, False, "fitted from its reference", "the reference as a column r"),
    ],
)
def test_the_command_uses_the_reference_of_a_file_and_asks_for_it(
    slow, modelled, with_r, without, tmp_path, monkeypatch
):
    if not modelled:  # as where no autoregression is its noise
        monkeypatch.setattr(outcomes.identifying, "with_noise", lambda record, found: found)
    signals = played(0, 3.0, slow)
    for columns, expected in (("truy", with_r), ("tuy", without)):
        file = tmp_path / f"{columns}.csv"
        write_columns(file, ",".join(columns), np.arange(N + 1) * DT, *signals[-len(columns) + 1 :])
        found = outcomes.identify(file, reading={"structure": STRUCTURE})
        assert expected in " ".join(found.verdict.said)
        inside = found.numbers["gain"]["low"] < GAIN < found.numbers["gain"]["high"]
        assert inside or "column r, too" in " ".join(found.verdict.said)


@pytest.mark.thorough
def test_an_output_that_answers_within_its_sample_is_no_closed_loop(tmp_path):
    """Rows of measured files may hold the output after the input of the same row has acted."""
    rng, kept = np.random.default_rng(0), np.exp(-POLE * DT)
    u = np.repeat(rng.standard_normal(N // 4 + 1), 4)
    y = scipy.signal.lfilter([GAIN * (1 - kept)], [1, -kept], u)
    y, said = (y + 0.01 * rng.standard_normal(len(y)))[: N + 1], []
    for first in (0, 1):
        file = tmp_path / "a.csv"
        write_columns(file, "t,u,y", np.arange(N + 1) * DT, u[first : first + N + 1], y)
        found = outcomes.identify(file, reading={"structure": STRUCTURE})
        said.append(" ".join(found.verdict.said))
    assert "write the outputs one row later" in said[0]
    assert "A loop" not in said[0]
    assert "loop" not in said[1]


@pytest.mark.thorough
@pytest.mark.parametrize("seed", range(3))
def test_what_is_not_linear_is_no_closed_loop(seed):
    """Of a stiffness that hardens, a little of the residual predicts a periodic input, too."""
    rng = np.random.default_rng(seed)
    lines = np.zeros(N // 2 + 1, complex)
    lines[1 : N // 5] = np.exp(2j * np.pi * rng.random(N // 5 - 1))
    u = np.fft.irfft(lines) * N / 20
    x, v, y = 0.0, 0.0, np.zeros(N)
    for k in range(N):
        y[k] = x
        v += DT * (400.0 * (u[k] - x - 2.0 * x**3) - 3.0 * v)
        x += DT * v
    record = Record(u[:-1], y, DT)
    found = identify(record, poles=0, pairs=1, zeros=1)
    assert float(found.fit[0]) < 97.0
    assert not feedback_seen(record, y[:, None] - found.simulated)


def test_an_input_fixed_beforehand_is_no_closed_loop_however_its_plant_is_missed():
    """Of a lag with Coulomb friction and a multisine a loop was told, in 4 of 4 records."""
    t = np.arange(3000) * 1e-3
    for seed in range(2):
        rng = np.random.default_rng(seed)
        for lines, highest in ((40, 200.0), (100, 450.0)):
            phases = 2 * np.pi * np.outer(t, np.linspace(highest / lines, highest, lines))
            of_lines = np.cos(phases + rng.uniform(0, 6.28, lines)).sum(axis=1)
            u, v, y = of_lines / lines**0.5, 0.0, np.zeros(len(t))
            for k in range(len(t)):
                y[k] = v
                v += 0.03 * (u[k] - v - 0.05 * np.tanh(v / 1e-2))
            y += 2e-3 * np.std(y) * rng.standard_normal(len(t))
            linear = scipy.signal.lfilter([0, 0.03], [1, -0.97], u)
            e = y - linear * (linear @ y) / (linear @ linear)
            assert not feedback_seen(Record(u[:-1], y, 1e-3), e[:, None], late=1), (lines, seed)


def test_a_reference_that_rests_excites_nothing():
    with pytest.raises(ValueError, match="the reference does not move"):
        of_reference(Record(np.ones(50), np.ones(51), DT), np.zeros(50))
