"""The benchmark's opponents compute what the package computes, and wrong numbers are refused."""

import json
import platform

import numpy as np
import pytest
import typer
from cases import ALGEBRA
from typer.testing import CliRunner

from jaxilc import bench
from jaxilc.bench import compiled_peers, computer, contests, timing
from jaxilc.cli import bench as command

OPPONENTS, NOTES = bench.opponents()


@pytest.fixture(scope="module", params=["cfdl", "ffdl"])
def small(request):
    """Return a setting and the package's metrics of 3 plants, each over 6 trials of 40 samples."""
    of = bench.setting(request.param, 3, 6, 40)
    return of, of.ours(lanes=2)()


@pytest.mark.parametrize("name", ["NumPy loop", "NumPy batch", "Numba parallel", "C limit"])
def test_every_opponent_has_our_numbers(small, name):
    if name not in OPPONENTS:
        pytest.skip("; ".join([*NOTES, "pip install 'jaxilc[bench]', and a C compiler named cc"]))
    of, ours = small
    theirs = OPPONENTS[name][0](of.problem)
    assert ours.shape == (3, 6, 4)
    np.testing.assert_allclose(theirs, ours, **ALGEBRA)
    assert np.all(np.diff(ours[..., 1], axis=1) != 0)  # the error changes from trial to trial
    assert len(np.unique(ours[:, -1, 1])) == 3  # the plants differ


def test_the_reset_is_the_same_for_all():
    """The estimator's reset gives the same numbers in every opponent.

    The start value has the wrong size, and the estimate changes its sign.
    """
    of = bench.setting("cfdl", 2, 12, 40)
    of = of._replace(scheme=type(of.scheme)(lam=0.01, mu=1e-4, phi0=-1e-3, reset="sign"))
    ours, problem = of.ours(lanes=1)(), of.problem
    for name, (peer, _) in OPPONENTS.items():
        np.testing.assert_allclose(peer(problem), ours, rtol=1e-8, err_msg=name)
    never = of._replace(scheme=type(of.scheme)(lam=0.01, mu=1e-4, phi0=-1e-3, reset="none")).ours(
        lanes=1
    )()
    assert np.max(np.abs(never - ours)) > 1e-6 * np.max(np.abs(ours))  # a reset took place


TARGETS = {"x86-64": ("SSE2", 2), "haswell": ("AVX2", 4), "skylake-avx512": ("AVX-512", 8)}


@pytest.mark.skipif(platform.machine() not in ("x86_64", "AMD64"), reason="targets of x86-64")
@pytest.mark.parametrize("target", TARGETS)
def test_the_lanes_of_c_follow_from_the_processor(target):
    """Vectors wider than a register were taken apart: the limit took ten times as long."""
    if "C limit" not in OPPONENTS:
        pytest.skip("; ".join(NOTES))
    found, here = (compiled_peers.target_of_c(of) for of in (target, "native"))
    assert (found.instructions, found.lanes) == TARGETS[target]
    widest_first = [*computer.INSTRUCTIONS.values()]
    if widest_first.index(found.instructions) < widest_first.index(here.instructions):
        pytest.skip(f"this processor has {here.instructions}, not {found.instructions}")
    for name in bench.SCHEMES:
        problem = bench.setting(name, 11, 6, 29).problem  # the last register is not full
        for program in (compiled_peers.c_program, compiled_peers.c_adjoint):
            np.testing.assert_allclose(program(1, target)(problem), program(1)(problem), **ALGEBRA)


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("model name\t: EPYC\nflags\t: sse2 avx avx2\n\nmodel name\t: last", ("EPYC", "AVX2")),
        ("BogoMIPS\t: 50.00\nFeatures\t: asimd", ("Neoverse", "aarch64")),
        (None, ("Neoverse", "aarch64")),
    ],
)
def test_the_processor_is_told(text, expected, tmp_path, monkeypatch):
    file = tmp_path / "cpuinfo"
    if text is not None:
        file.write_text(text)
    monkeypatch.setattr(computer, "CPUINFO", file)
    monkeypatch.setattr(computer.platform, "processor", lambda: "Neoverse")
    monkeypatch.setattr(computer.platform, "machine", lambda: "aarch64")
    found = computer.computer()
    assert (found["processor"], found["instructions"]) == expected
    assert computer.in_words(found | {"cores": 1}).startswith(", ".join([*expected, "1 core\n"]))


def entry(value, **changes):
    return timing.Entry(lambda: np.full((2, 3, 4), value), 2, 3, 10)._replace(**changes)


def test_wrong_numbers_are_refused():
    with pytest.raises(ArithmeticError, match="other differs from jaxilc by 0\\.01"):
        timing.in_turns({"other": entry(1.01), timing.OURS: entry(1.0)}, repeats=1)
    with pytest.raises(ArithmeticError, match="other differs from jaxilc by nan"):
        timing.in_turns({"other": entry(np.nan), timing.OURS: entry(1.0)}, repeats=1)


def test_other_numbers_in_blocks_are_refused(monkeypatch):
    right = contests.InBlocks.response
    monkeypatch.setattr(
        contests.InBlocks, "response", lambda plant, u, dt: (1 + 2e-9) * right(plant, u, dt)
    )
    with pytest.raises(
        ArithmeticError,
        match="jaxilc in blocks differs from jaxilc by 2e-09 of the largest output; "
        "allowed is 1e-09",
    ):
        bench.compare_long(100, repeats=1)


def test_a_row_says_what_was_measured():
    rows = timing.in_turns({"other": entry(1.0, built=7.0), timing.OURS: entry(1.0)}, repeats=3)
    assert len(rows["other"].seconds) == len(rows["other"].cpu_seconds) == 3
    assert rows["other"].compile_seconds >= 7.0
    slow = rows["other"]._replace(seconds=(3e-6, 1e-6, 8e-6), steps=100)
    ours = rows[timing.OURS]._replace(seconds=(1e-6, 1e-6, 1e-6), steps=50)
    assert (slow.best, slow.median) == pytest.approx((10.0, 30.0))  # [ns]
    np.testing.assert_allclose(slow.ratios(ours), [1.5, 0.5, 4.0])
    assert json.dumps(timing.as_json({"other": slow, timing.OURS: ours}))


def test_memory_of_a_call_is_seen():
    peak = timing._Peak()
    if peak.before is None:
        pytest.skip("only Linux keeps a peak of memory")
    touched = np.ones(8_000_000)
    assert peak.bytes() >= 0.9 * touched.nbytes


def test_the_cost_of_a_size_is_a_line():
    found = timing.cost([1, 2, 4], [0.7, 1.2, 2.2])
    assert (found.start, found.slope, found.residual) == pytest.approx((0.2, 0.5, 0.0), abs=1e-12)
    # The line misses the three times by 0.5, -1 and 0.5, and the largest time is 4.
    assert timing.cost([1, 2, 3], [1.0, 1.0, 4.0]).residual == pytest.approx(0.25)


def test_the_command(tmp_path):
    app, file = typer.Typer(), tmp_path / "bench.json"
    command.register(app)
    small = [
        "--plants",
        "2",
        "--trials",
        "4",
        "--samples",
        "24",
        "--long",
        "200",
        "--schemes",
        "cfdl",
        "--repeats",
        "1",
    ]
    result = CliRunner().invoke(app, [*small, "--json", str(file)])
    assert result.exit_code == 0, result.output
    found = json.loads(file.read_text())
    assert set(found["rows"]) == {"cfdl/2", "cfdl gradient/2", "plant/2", "long/200"}
    ways = {timing.OURS, "1 weight forward", "5 weights forward", "5 weights reverse"}
    assert ways <= set(found["rows"]["cfdl gradient/2"])
    assert {"python-control", "SciPy lfilter", timing.OURS} == set(found["rows"]["plant/2"])
    assert {"SciPy lfilter", contests.BLOCKS, timing.OURS} == set(found["rows"]["long/200"])
    for told in (computer.in_words(found["machine"]), *found["notes"]):
        assert told in result.output
    assert any(
        note.startswith("C: " if "C limit" in OPPONENTS else "C l") for note in found["notes"]
    )
    assert set(found["cost"]["cfdl"]) == {"plants", "trials", "samples"}


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--plants", "1,x"], "--plants '1,x' is not whole numbers"),
        (["--plants", "0"], "--plants '0' is not whole numbers"),
        (["--schemes", "pid"], "--schemes 'pid' is not one of cfdl, ffdl, noilc, ilc-asmc"),
        (["--trials", "0"], "trials = 0 is outside"),
        (["--samples", "3"], "samples = 3 is outside"),
        (["--long", "3"], "--long 3 is not 0 or a whole number from 4 on"),
        (["--repeats", "0"], "repeats = 0 is outside"),
    ],
)
def test_bad_input_is_named(arguments, message):
    app = typer.Typer()
    command.register(app)
    result = CliRunner().invoke(
        app, ["--plants", "1", "--schemes", "cfdl", "--trials", "2", "--samples", "8", *arguments]
    )
    assert isinstance(result.exception, ValueError)
    assert message in str(result.exception)
