"""In what an error repeats: `potential` on records whose errors are made one way or another."""

import numpy as np
import pytest

from jaxilc.outcomes import potential

t = 1e-3 * np.arange(3001)
BACK_AND_FORTH = 60 * np.sin(np.pi * t / 2.1) ** 2 + 4 * t  # [mm], at many speeds
STEADY = 20 * t
BUMP = np.exp(-(((t - 0.7) / 0.1) ** 2)) - np.exp(-(((t - 2.3) / 0.25) ** 2))
BY_PLACE = np.sin(2 * np.pi * BACK_AND_FORTH / 7.3) + 0.4 * np.cos(4 * np.pi * BACK_AND_FORTH / 7.3)


@pytest.mark.parametrize(
    ("position", "of_trial", "said", "period"),
    [
        (
            BACK_AND_FORTH,
            np.sin(2 * np.pi * t / 0.23),
            "repeats in a period, so Rep",
            ("time", 0.23),
        ),
        (BACK_AND_FORTH, BY_PLACE, "in the position, so a map of Pos", ("position", 7.3)),
        (BACK_AND_FORTH, BUMP, "repeats from trial to trial only", None),
        (BACK_AND_FORTH, 3 * t, "repeats from trial to trial only", None),
        (STEADY, np.sin(2 * np.pi * STEADY / 5), "at one speed the two are one", ("time", 0.25)),
    ],
)
def test_what_the_error_repeats_in_is_told_with_the_law(tmp_path, position, of_trial, said, period):
    rng, files = np.random.default_rng(0), []
    for j in range(4):
        e = of_trial + 0.1 * rng.normal(size=len(t))
        np.savez(file := tmp_path / f"trial-{j}.npz", t=t, e=e, r=position)
        files.append(file)
    found = potential(files, unit="mm")
    line = found.lines[-1]
    assert said in line
    if period:
        name, size = period
        assert found.numbers["within"][name]["period"] == pytest.approx(size, rel=0.02)
