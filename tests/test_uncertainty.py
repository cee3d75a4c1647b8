"""These tests check how uncertain machines are drawn: statistics, prefixes, corners and errors."""

import subprocess
import sys

import jax
import numpy as np
import pytest

from jaxilc import Actuator, LogUniform, Machine, Normal, Sweep, Task, Tuning, Uniform
from jaxilc.plants import StateSpace, voice_coil
from jaxilc.schemes import PIDType
from jaxilc.uncertainty import Population, draw, drawn_machine, with_spread

MACHINE = Machine(voice_coil(), actuator=Actuator(limit=10.0))
GAIN, SLOW = "plant.gain", "plant.poles[2]"
UNCERTAINTY = {
    GAIN: Uniform(0.9, 1.1, relative=True),
    SLOW: Normal(6.4, 0.2),
    "actuator.limit": LogUniform(5.0, 20.0),
}
PLANT = Machine(StateSpace([[0.9]], [[0.1]], [[1.0]], dt=1e-3))
OF_B = {"plant.B": Uniform(0.9, 1.1, relative=True)}


@pytest.mark.parametrize("sampling", ["monte-carlo", "latin-hypercube", "sobol"])
def test_draws_have_the_distribution_asked_for(sampling):
    S = 4097
    drawn = draw(MACHINE, UNCERTAINTY, S, seed=3, sampling=sampling)
    gain, slow, limit = (drawn[name][1:] for name in UNCERTAINTY)
    six_errors = 6 / np.sqrt(S - 1)
    assert gain.min() >= 0.9
    assert gain.max() <= 1.1
    assert abs(gain.mean() - 1.0) < six_errors * 0.2 / np.sqrt(12)
    assert abs(slow.mean() - 6.4) < six_errors * 0.2
    assert abs(slow.std() / 0.2 - 1.0) < six_errors
    assert abs(np.log(limit).mean() - np.log(10.0)) < six_errors * np.log(4.0) / np.sqrt(12)


def test_latin_hypercube_puts_one_draw_in_each_layer():
    gain = draw(MACHINE, {GAIN: Uniform(0.0, 1.0, relative=True)}, 33, sampling="latin-hypercube")[
        GAIN
    ][1:]
    assert sorted(np.floor(gain * 32).astype(int)) == list(range(32))


@pytest.mark.parametrize("sampling", ["monte-carlo", "sobol"])
def test_a_longer_draw_starts_with_the_shorter_one(sampling):
    short, long = (draw(MACHINE, UNCERTAINTY, S, seed=5, sampling=sampling) for S in (100, 1000))
    for name in UNCERTAINTY:
        np.testing.assert_array_equal(long[name][:100], short[name])


@pytest.mark.parametrize("double", [False, True])
def test_each_seed_has_noise_of_its_own(double):
    with jax.enable_x64(double):
        seeds = (5, 2**31, 2**32 + 5, 2**33 + 5, 8 * 10**18)
        keys = [Population(MACHINE, seed=seed).key_of(1) for seed in seeds]
        assert len({tuple(jax.random.key_data(key).tolist()) for key in keys}) == len(seeds)


def test_corners_are_all_combinations_of_the_ends():
    drawn = draw(
        MACHINE,
        {GAIN: Uniform(0.9, 1.1, relative=True), SLOW: Uniform(5.0, 7.0)},
        1,
        sampling="corners",
    )
    points = set(zip(drawn[GAIN][1:], drawn[SLOW][1:], strict=True))
    assert points == {(0.9, 5.0), (0.9, 7.0), (1.1, 5.0), (1.1, 7.0)}
    assert draw(MACHINE, {}, 1, sampling="corners") == {}


def test_the_numbers_land_in_the_machine_also_under_vmap():
    drawn = draw(MACHINE, UNCERTAINTY, 5)
    batch = jax.vmap(lambda values: drawn_machine(MACHINE, UNCERTAINTY, values))(drawn)
    np.testing.assert_allclose(batch.plant.gain, 7437.7769 * drawn[GAIN], rtol=1e-15)
    np.testing.assert_allclose(batch.plant.poles[:, 2], drawn[SLOW], rtol=1e-15)
    np.testing.assert_allclose(batch.plant.poles[:, 0], 474.0)
    np.testing.assert_allclose(batch.actuator.limit, drawn["actuator.limit"])


@pytest.mark.parametrize("sampling", ["monte-carlo", "latin-hypercube", "sobol", "corners"])
def test_a_population_draws_its_machines_and_gives_them_one_by_one_and_together(sampling):
    given = Population(MACHINE, UNCERTAINTY, count=6, seed=3, sampling=sampling)
    drawn = draw(MACHINE, UNCERTAINTY, 6, seed=3, sampling=sampling)
    assert given.size == len(drawn[GAIN]) == (9 if sampling == "corners" else 6)
    assert [drawn[name][0] for name in UNCERTAINTY] == [1.0, 6.404, 10.0], "the nominal numbers"
    numbers, values = given.batch(1)
    assert numbers.tolist() == list(range(1, given.size))
    for name, of in drawn.items():
        np.testing.assert_array_equal(given.drawn[name], of)
        np.testing.assert_array_equal(values[name], of[1:])
    one = given.machine_of(2)
    for none in (-1, given.size, 1.5, None):
        with pytest.raises(ValueError, match=f"machine_of: number = {none} is"):
            given.machine_of(none)
    jax.tree.map(np.testing.assert_array_equal, one, jax.tree.map(lambda x: x[2], given.machines))
    same, key = given.one_of(jax.tree.map(lambda x: x[1], given.batch(1)))
    jax.tree.map(np.testing.assert_array_equal, same, one)
    assert key == jax.random.fold_in(jax.random.key(3), 2)
    other = given.others(4, 6)
    assert other.sampling == ("sobol" if sampling == "corners" else sampling)
    assert not set(other.drawn[GAIN][1:]) & set(drawn[GAIN][1:])


def test_a_population_keeps_what_it_has_and_takes_what_is_given_besides():
    given = Population(MACHINE, UNCERTAINTY, count=6)
    assert Population.of(given) is given
    other = Population.of(given, {}, seed=2)
    assert (other.uncertainty, other.count, other.seed) == ({}, 6, 2)
    with pytest.raises(ValueError, match=r"Population: count = 0 is outside its allowed range"):
        Population(MACHINE, count=0)
    with pytest.raises(ValueError, match=r"plant.mass.*Known: plant.gain"):
        Population(MACHINE, {"plant.mass": Uniform(1, 2)})


def test_what_is_given_by_place_beside_a_population_comes_before_its_own():
    given = Population(PLANT, OF_B, count=6, seed=2, sampling="sobol")
    task, law = Task(np.ones(9), dt=1e-3), PIDType(gamma_p=1.0)
    sweep = Sweep(given, {"law": law}, task, 3, {}, 4)
    assert (sweep.uncertainty, sweep.machines, sweep.seed, sweep.sampling) == ({}, 4, 2, "sobol")
    tuning = Tuning(given, law, task, 3, ["gamma_p"], OF_B)
    assert (tuning.uncertainty, tuning.machines, tuning.seed) == (OF_B, 6, 2)


def test_spread_widens_the_relative_ones_only():
    wide = with_spread(UNCERTAINTY, 0.3)
    assert wide[GAIN].corners() == (0.7, 1.3)
    assert wide[SLOW] == UNCERTAINTY[SLOW]


BAD_NAMES = [
    ({"plant.mass": Uniform(1, 2)}, "plant.mass.*Known: plant.gain, plant.zero"),
    ({"sensor.noise": Uniform(1, 2)}, "sensor.noise.*known"),
    ({"actuator.rate": Uniform(1, 2)}, "actuator.rate = None is not a float leaf"),
    ({"plant.poles": Uniform(1, 2)}, r"plant.poles has shape \(3,\).*plant.poles\[0\]"),
    ({SLOW: Uniform(-1.0, 7.0)}, r"poles\[2\] was drawn between -.* allowed is \(0, inf\)"),
    ({GAIN: 0.1}, "plant.gain = 0.1 is no distribution; allowed are Uniform, Normal and LogUnif"),
    ({GAIN: Uniform}, "plant.gain = <class 'jaxilc.uncertainty.Uniform'> is no distribution"),
    ({3: Uniform(1, 2)}, "uncertainty: 3 is not a parameter name such as gain"),
    # the draw of the element would be lost, or that of the array would not reach it
    (
        {SLOW: Uniform(5.0, 7.0), "plant.poles": Uniform(0.9, 1.1, relative=True)},
        r"plant.poles\[2\] is drawn by plant.poles already; allowed is each number once",
    ),
    ({SLOW: Uniform(5.0, 6.0), "plant.poles[02]": Uniform(8.0, 9.0)}, r"poles\[02\] is drawn by"),
    ([GAIN], r"uncertainty = \['plant.gain'\] is a list; allowed are names with distributions"),
]
RANGE = r"outside its allowed range"
BAD_OPTIONS = [
    ({"sampling": "halton"}, "sampling = 'halton' is not one of monte-carlo"),
    ({"machines": 0}, rf"machines = 0 is {RANGE} \[1, inf\)"),
    ({"machines": 2.5}, rf"machines = 2.5 is {RANGE} \[1, inf\) of whole numbers"),
    ({"machines": None}, "machines = None is not a number"),
    ({"seed": 2**70}, rf"seed = 1.18059e\+21 is {RANGE} \[0, 9e\+18\] of whole numbers"),
    ({"seed": -1}, f"seed = -1 is {RANGE}"),
]


@pytest.mark.parametrize(
    ("given", "message"), [*(({"uncertainty": u}, m) for u, m in BAD_NAMES), *BAD_OPTIONS]
)
def test_bad_input_is_named(given, message):
    with pytest.raises(ValueError, match=message):
        draw(MACHINE, **({"uncertainty": UNCERTAINTY, "machines": 50} | given))


def test_an_element_of_a_matrix_is_named_by_both_places():
    with pytest.raises(ValueError, match=r"A has shape \(1, 1\); .* say A\[0\]\[0\]"):
        Population(PLANT.plant, {"A": Uniform(0.8, 0.95)})
    Population(PLANT.plant, {"A[0][0]": Uniform(0.8, 0.95)})


def test_a_grid_that_has_no_names_is_refused():
    """A count in its place would otherwise leave a population of 1024 machines."""
    with pytest.raises(ValueError, match="grid = 5 is a int; allowed are values by name"):
        Population(MACHINE, UNCERTAINTY, 5)


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: Uniform(2, 1), "Uniform: low = 2 must lie below high = 1"),
        (lambda: Normal(0, 0), r"Normal: std = 0 is outside its allowed range \(0, inf\)"),
        (lambda: LogUniform(0, 1), "LogUniform: low = 0 and high = 1"),
        (
            lambda: Normal(np.nan, 1.0),
            r"Normal: mean = nan is outside its allowed range \(-inf, inf\)",
        ),
        (lambda: Normal(0.0, np.inf), r"Normal: std = inf is outside its allowed range \(0, inf\)"),
        (lambda: Uniform(-np.inf, 1.0), "Uniform: low = -inf is outside"),
        (lambda: Uniform("0", 1.0), "Uniform: low = '0' is not a number"),
        (lambda: Uniform(0.0, 1.0, relative=2), "Uniform: relative = 2 is not one of True, False"),
        (lambda: Uniform(-1.5e308, 1.5e308), "reaches beyond the largest float"),
        (lambda: LogUniform(1e-300, 1e300), "reaches beyond the largest float"),
        (lambda: with_spread(UNCERTAINTY, None), "spread = None is not a number"),
        (
            lambda: with_spread(UNCERTAINTY, 1.5),
            r"spread = 1.5 is outside its allowed range \(0, 1\)",
        ),
    ],
)
def test_bad_distributions_are_named(make, message):
    with pytest.raises(ValueError, match=message):
        make()


def test_what_takes_long_to_import_is_imported_where_it_is_used():
    """scipy.stats takes more than a second, and only some ways of drawing need it."""
    program = (
        "import sys, jaxilc.uncertainty; from jaxilc.sweeps import Sweep, summarise;"
        " print([name for name in ('scipy.stats', 'scipy.special') if name in sys.modules])"
    )
    said = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True)
    assert said.stdout == "[]\n", said.stderr
