"""The benchmark of accelerators plans its rows within its time, and one row stops no other."""

import types

import accelerator
import accelerator_programs as programs
import accelerator_rows as rows
import contests
import numpy as np
import pytest
from accelerator_rows import ACCELERATOR, CPU, FAILED, MEASURED, UNMEASURED, Row

from jaxilc.runtime import capacity, lanes

SIZES = pytest.mark.parametrize("sizes", [ACCELERATOR, CPU])
DONE = {
    "status": MEASURED, "bytes": 4096 * 1e5, "compile_seconds": 3.0, "seconds": 1.0,
    "seconds_a_pass": 2e-5, "ns_a_step": 5.0, "share_of_bandwidth": 0.01, "off_by": 0.0,
}  # fmt: skip


def done(*fields, **changes):
    return Row(*fields)._asdict() | DONE | changes


@SIZES
def test_every_size_has_its_row_and_the_most_important_come_first(sizes):
    plan = rows.planned(sizes)
    assert len(plan) == len(set(plan))
    assert (plan[0].what, plan[0].precision) == ("forward", "float64")
    for what in ("forward", "gradient"):
        of = [row for row in plan if row.what == what]
        assert {row.lanes for row in of} == {None, *sizes.lanes}
        assert {row.machines for row in of if row.lanes is None} == {*sizes.machines}
        assert {row.unroll for row in of} == {*sizes.unroll}
        assert {row.precision for row in of} == {"float64", "float32"}
    assert plan.index(Row("forward", sizes.machines[-1], sizes.trials)) < len(plan) / 3
    assert {row.machines for row in rows.planned(sizes, 3) if row.lanes} == {
        3 * n for n in sizes.lanes
    }


def test_lanes_grow_by_steps_from_what_was_measured():
    plan, known = rows.planned(ACCELERATOR), {}
    for row in plan:
        if row.lanes is not None and row.unroll == 1:
            before = known.setdefault((row.what, row.precision), [2**10])
            assert row.lanes <= 4 * max(before)
            before.append(row.lanes)


def test_a_cost_follows_from_the_most_similar_row():
    small, large = done("forward", 4096, 8, 4096), done("forward", 2**16, 8, 2**16)
    other = done("gradient", 4096, 8, 4096, status="out of memory: 1 B")
    row = Row("forward", 2**18, 8, 2**18, 4)
    near = rows.nearest(row, [small, large, other])
    assert near is large
    passes = 8 * 2000
    assert rows.predicted(row, 2**18, passes, near) == pytest.approx(
        4 * 3.0 + 2 * passes * 2e-5 * 2**2
    )
    fewer = row._replace(lanes=4096, unroll=1)
    assert rows.predicted(fewer, 4096, passes, large) == pytest.approx(3.0 + 2 * passes * 2e-5)
    first = row._replace(what="gradient", unroll=1)
    assert rows.predicted(first, 2**16, passes, large) == pytest.approx(
        4 * 3.0 + 2 * passes * 2e-5 * rows.FIRST_GRADIENT
    )
    assert rows.predicted(row, 2**18, passes, rows.nearest(row, [other])) == 0.0


@pytest.fixture
def session(monkeypatch):
    """Return a session of 100 s that has measured a row, where nothing is compiled or run."""
    monkeypatch.setattr(accelerator, "use", lambda *_: None)
    monkeypatch.setattr(accelerator, "fitting", lambda *_: 4096)
    monkeypatch.setattr(lanes, "LANES", {})
    monkeypatch.setattr(capacity, "device_memory", lambda: 10**11)
    found = {
        "checks": [{"held": True}],
        "rows": [done("forward", 4096, 8, 4096)],
        "copy_gb_a_second": 1.0,
    }
    return types.SimpleNamespace(left=lambda: 100.0, found=found, firsts={})


def test_a_row_that_takes_too_long_is_named_as_not_run(session):
    row = Row("gradient", 10**6, 80)
    found = accelerator.result(row, ACCELERATOR, session)
    assert found == row._asdict() | {"status": found["status"]}
    assert found["status"].startswith("not run: ")
    assert found["status"].endswith(" s predicted, 100 s left")


@pytest.mark.parametrize(
    ("error", "status"),
    [
        (RuntimeError("RESOURCE_EXHAUSTED: Out of memory allocating\n1 B"), "out of memory: Run"),
        (MemoryError(), "out of memory: MemoryError"),
        (
            ValueError("tiled: one machine takes 9 GB of memory, where 1 GB are available"),
            "out of memory: ",
        ),
        (RuntimeError("launch failed"), "failed: RuntimeError: launch failed"),
    ],
)
def test_a_row_that_fails_is_recorded(session, monkeypatch, error, status):
    def raises(*_):
        raise error

    monkeypatch.setattr(accelerator, "timed", raises)
    found = accelerator.result(Row("forward", 4096, 8, 4096), ACCELERATOR, session)
    assert found["status"].startswith(status)
    assert "\n" not in found["status"]
    session.found["rows"].append(found)
    assert rows.failed(session.found) == status.startswith(FAILED)


def test_rows_of_a_kind_must_have_the_same_results(session, monkeypatch):
    values = np.random.default_rng(0).normal(size=(16, 8, 4))
    plan = [Row("forward", 4096, 8, 4096, unroll) for unroll in (1, 2, 4, 8)]
    for row, factor, status in zip(
        plan, (1.0, 1 + 1e-12, 1 + 1e-6, np.nan), (MEASURED, MEASURED, FAILED, FAILED), strict=True
    ):
        given = dict(DONE), factor * values
        monkeypatch.setattr(accelerator, "timed", lambda *_, given=given: given)
        assert accelerator.result(row, ACCELERATOR, session)["status"].startswith(status)


def test_the_table_fits_80_columns_and_says_what_was_not_measured():
    check = {"check": "gradient float64", "against": "CPU backend", "allowed": 1e-6}
    sized = {"seconds": 123.4, "ns_a_step": 1234.5, "share_of_bandwidth": 12.3, "bytes": 1.5e11}
    timed = [
        done("gradient", 10**6, 80, 2**18, unroll, ns_a_step=9.0 / unroll, compile_seconds=99.9)
        for unroll in (1, 2, 16)
    ]
    found = {
        "accelerator": False,
        "device": "2 x cpu",
        "checks": [check | {"off_by": 3e-9, "held": True}, check | {"off_by": None, "held": False}],
        "copy_gb_a_second": 4812.3456,
        "pass_us": 8.123456,
        "usual_unroll": 1,
        "cpu_cores": 2,
        "cpu_seconds_1024": 2.22,
        "rows": [
            *timed,
            timed[0] | sized | {"machines": 10**5},
            Row("gradient", 10**6, 80, 2**18)._asdict()
            | {"status": "out of memory: " + 40 * "word "},
            Row("gradient", 10**6, 80)._asdict() | {"status": "not run: 9 s predicted, 1 s left"},
        ],
    }
    text = rows.table(found)
    assert max(map(len, text.splitlines())) <= 80
    assert text.startswith(UNMEASURED)
    assert "gradient float64, 1000000 x 80: not run: 9 s predicted, 1 s left" in text
    assert "16 samples in a pass are fastest, 16 times as fast as 1" in text
    assert "WRONG gradient float64" in text
    assert rows.failed(found)
    assert len({len(line) for line in map(rows.in_words, timed)}) == 1  # columns are aligned
    empty = {"checks": [], "rows": []}
    assert rows.table(empty) == "The numbers were not checked."
    assert rows.failed(empty)


@pytest.mark.thorough
@pytest.mark.parametrize("what", ["forward", "gradient"])
def test_a_row_runs_the_machines_of_make_bench(what):
    """A signature that changed in the package once broke every row, and no other test saw it."""
    found, values = programs.timed(Row(what, 5, 3), 40, 2, 1, 1e9)
    assert found["status"] == MEASURED
    np.testing.assert_allclose(values, programs.results(what, 3, 40, 5), rtol=1e-12)
    if what == "forward":
        np.testing.assert_allclose(values, contests.setting("cfdl", 5, 3, 40).ours()(), rtol=1e-12)
