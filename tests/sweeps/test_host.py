"""A host computes the next chunks while one is used, no further ahead, and hides no error."""

import dataclasses

import jax.numpy as jnp
import pytest
from sweep_case import PLAN

from jaxilc.runtime import capacity
from jaxilc.sweeps.host import Host

CHUNKS = dataclasses.replace(PLAN, machines=24).plan.chunks()[:6]


@pytest.fixture
def host(monkeypatch):
    """Return a host that notes which chunks it starts; the values of chunk k are all k."""
    made = Host(PLAN.plan)
    made.noted = []

    def started(chunk):
        made.noted.append(f"start {chunk.number}")
        return {"rms": jnp.full(PLAN.chunk, float(chunk.number))}

    monkeypatch.setattr(made, "_started", started)
    return made


class Full(list):
    """A list that takes no note of a chunk that is used."""

    def append(self, note):
        if note.startswith("use"):
            raise OSError("disk full")
        super().append(note)


def used(host, chunks=CHUNKS):
    with host.computing(chunks, 0) as computed:
        for chunk, values in computed:
            assert (values["rms"] == chunk.number).all()
            host.noted.append(f"use {chunk.number}")
    return ", ".join(host.noted)


def test_the_next_chunks_are_computed_while_one_is_used(host):
    start = "start 0, start 1, start 2, start 3"
    assert used(host) == f"{start}, use 0, start 4, use 1, start 5, use 2, use 3, use 4, use 5"


def test_a_first_chunk_is_computed_once_and_not_at_all_where_it_does_not_fit(host, monkeypatch):
    monkeypatch.setattr(host, "bytes_of", lambda name, size: 600)
    monkeypatch.setattr(host, "room", lambda stored: (700 - stored, ""))
    assert host.first(CHUNKS[0], 200) == {}
    assert (host.first(CHUNKS[0], 100)["rms"] == 0).all()
    assert host.noted == ["start 0"]
    assert used(host, CHUNKS[:3]) == "start 0, start 1, start 2, use 0, use 1, use 2"


def test_a_first_chunk_leaves_as_much_room_as_before_it_was_computed(host, monkeypatch):
    free = 1000
    monkeypatch.setattr(capacity, "host_bytes", lambda: free)
    monkeypatch.setattr(host, "bytes_of", lambda name, size: 600)
    room = host.room(200)
    free -= host.first(CHUNKS[0], 200)["rms"].nbytes
    assert host.room(200) == room == (800, "")


@pytest.mark.parametrize(
    ("room", "order"),
    [
        (1000, "start 0, use 0, start 1, use 1, start 2, use 2"),
        (1200, "start 0, start 1, use 0, start 2, use 1, use 2"),
        (None, "start 0, start 1, start 2, use 0, use 1, use 2"),
    ],
)
def test_no_more_chunks_are_started_than_the_memory_holds(host, monkeypatch, room, order):
    monkeypatch.setattr(host, "_needed", 600)
    monkeypatch.setattr(host, "room", lambda stored: (room, ""))
    assert used(host, CHUNKS[:3]) == order


def test_an_error_comes_at_its_chunk_and_ends_the_computing(host, monkeypatch):
    finished = host._finished

    def fails(chunk, found, begun):
        if chunk.number == 1:
            raise MemoryError("chunk 1")
        return finished(chunk, found, begun)

    monkeypatch.setattr(host, "_finished", fails)
    with pytest.raises(MemoryError, match="chunk 1"):
        used(host)
    assert host.noted == ["start 0", "start 1", "start 2", "start 3", "use 0", "start 4"]
    monkeypatch.setattr(host, "_finished", finished)
    host.noted = Full()
    with pytest.raises(OSError, match="disk full"):
        used(host)
    assert host.noted == ["start 0", "start 1", "start 2", "start 3"]


def test_sweeps_of_one_shape_share_a_program():
    program = PLAN.host()._run("learning")
    other = {"schemes": {"another": PLAN.schemes["learning"]}, "machines": 5, "seed": 8}
    spread = {"uncertainty": {name: of.spread(0.1) for name, of in PLAN.uncertainty.items()}}
    own = {"quantities": {"none": lambda trial: 0.0}}
    assert dataclasses.replace(PLAN, **other).host()._run("another") is program
    for change in (spread, own, {"trials": 3}, {"keep": ()}):
        assert dataclasses.replace(PLAN, **change).host()._run("learning") is not program
