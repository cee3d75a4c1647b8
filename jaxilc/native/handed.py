"""What each sample of a loop hands on to the next one, which would compute it again.

A law that reads the increments du[k] and du[k-1] asks for the same number twice: du[k-1] is what
the sample before has computed as du[k]. So the nodes of a sample are compared with those of the
sample before, and what both compute is carried in a cell.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import NamedTuple

from .operations import Node
from .places import At, Cell
from .rows import Segment, Trials


class Handed(NamedTuple):
    """A number that each sample of a loop hands on to the next one, which would compute it again.

    cell: in which it is handed on
    node: what a sample would compute
    ahead: what the sample before computes, which is the same
    """

    cell: Node
    node: Node
    ahead: Node


def handed_on(of: Trials, segment: Segment, wanted: Sequence[Node], d: int) -> list[Handed]:
    """What the samples of a segment hand on.

    What is only read is read again, since that takes no longer, and products are computed again,
    since they are a part of a sum that is rounded once.

    wanted: the nodes that the segment needs
    d: 1 if it runs forward, -1 if backward
    """
    n, new = of.n, {cell.what: x for cell, x in segment.cells}
    moved: dict[Node, Node | None] = {}  # each node, as the sample before calls it
    for node in _in_turn(wanted):
        if not node.varies:
            moved[node] = node
        elif isinstance(node.what, At):
            first = node.what.first + d * node.what.sign
            moved[node] = n.known(node, (), node.what._replace(first=first))
        elif isinstance(node.what, Cell):
            moved[node] = new.get(node.what)
        else:
            args = [x for x in map(moved.get, node.args) if x is not None]
            whole = len(args) == len(node.args) > 0
            moved[node] = n.known(node, args, node.what) if whole else None
    found: dict[Node, Handed] = {}
    todo, seen = list(wanted), set[Node]()
    while todo:
        node = todo.pop()
        if node in seen:
            continue
        seen.add(node)
        ahead = moved[node]
        again = not node.args or (node.name == "mul" and node.dtype.kind == "f")
        if node.varies and not again and ahead is not None and ahead in moved:
            cell = of.new_cells((1,), node.dtype, loop=0).item()
            found[node] = Handed(cell, node, ahead)
            todo.append(ahead)
        else:
            todo += node.args
    return [*found.values()]


def _in_turn(nodes: Iterable[Node]) -> list[Node]:
    """Nodes and all that they are computed from, operands first."""
    found: dict[Node, None] = {}
    todo = list(nodes)
    while todo:
        node = todo[-1]
        missing = [x for x in node.args if x not in found]
        if missing and node not in found:
            todo += missing
        else:
            found[todo.pop()] = None
    return [*found]
