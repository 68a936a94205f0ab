"""The rules of the workflow, laid out from left to right."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

BOX_WIDTH, BOX_HEIGHT, COLUMN, ROW = 112, 36, 158, 54  # pixels
MARGIN = 4


@dataclass(frozen=True)
class Node:
    """A rule: its place is its box's upper left corner."""

    rule: str
    note: str
    x: int
    y: int


@dataclass(frozen=True)
class Graph:
    """What there is to draw."""

    nodes: list[Node]
    curves: list[str]  # SVG paths from the rule that makes a file to one that reads it
    width: int
    height: int


def graph(target: str, needs: Mapping[str, Sequence[str]], notes: Mapping[str, str]) -> Graph:
    """Lay out `target` and all before it by what each rule `needs`, which stands left of it.

    What a rule needs of rules that it needs in turn is not drawn: the way there is.
    """
    needs = {rule: needs[rule] for rule in needs if rule in {target} | _all_before(target, needs)}
    columns = {rule: _depth(rule, needs) for rule in needs}
    last = max(columns.values())
    for rule in needs:  # what needs nothing, beside what is made at the same time
        readers = [columns[other] for other in needs if rule in needs[other]]
        if readers and not needs[rule]:
            columns[rule] = min(readers) - 1
    rows = [[rule for rule in needs if columns[rule] == column] for column in range(last + 1)]
    tallest = max(map(len, rows))
    places = {
        rule: (MARGIN + column * COLUMN, MARGIN + (tallest - len(row)) * ROW // 2 + place * ROW)
        for column, row in enumerate(rows)
        for place, rule in enumerate(row)
    }
    nodes = [Node(rule, notes.get(rule, ""), *place) for rule, place in places.items()]
    curves = [
        _curve(places[maker], places[rule])
        for rule, makers in needs.items()
        for maker in makers
        if not any(maker in _all_before(other, needs) for other in makers)
    ]
    return Graph(
        nodes,
        curves,
        last * COLUMN + BOX_WIDTH + 2 * MARGIN,
        (tallest - 1) * ROW + BOX_HEIGHT + 2 * MARGIN,
    )


def _depth(rule: str, needs: Mapping[str, Sequence[str]]) -> int:
    """How many steps come before."""
    return max((_depth(maker, needs) + 1 for maker in needs[rule]), default=0)


def _all_before(rule: str, needs: Mapping[str, Sequence[str]]) -> set[str]:
    """What a rule needs, directly or not."""
    return set(needs[rule]).union(*(_all_before(maker, needs) for maker in needs[rule]))


def _curve(start: tuple[int, int], end: tuple[int, int]) -> str:
    x0, y0 = start[0] + BOX_WIDTH, start[1] + BOX_HEIGHT // 2
    x1, y1 = end[0], end[1] + BOX_HEIGHT // 2
    middle = (x0 + x1) // 2
    return f"M{x0},{y0} C{middle},{y0} {middle},{y1} {x1},{y1}"
