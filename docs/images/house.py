"""Makes the picture of CONTRIBUTING.md: the rooms of the package by floor, and who imports whom.

It is drawn from the table and the imports that tests/test_architecture.py checks. Of two ways to a room only the longer
one is drawn: who imports a room that imports `errors` too has no line to `errors` of his own.

$ python docs/images/house.py
"""

from __future__ import annotations

import importlib.util
from collections.abc import Iterator
from pathlib import Path
from types import ModuleType

ROOT = Path(__file__).resolve().parents[2]
PICTURE = Path(__file__).with_suffix(".svg")

WIDTH, MARGIN, GAP = 1180, 16, 14
ROOM_HEIGHT, FLOOR_GAP, PADDING = 30, 46, 11
LETTER = 7.4
ACROSS = 9
"""Rooms beside each other; a floor with more has two rows, as even as can be."""
COLOURS = ("#2b7a78", "#3a6ea5", "#6a4c93", "#b5651d", "#8a6d1f", "#a23b72", "#5b6f2a", "#444f5a")

STYLE = """
  text { font: 13px ui-monospace, Menlo, Consolas, monospace; fill: #fff; text-anchor: middle }
  .floor { fill: #808a94; font-size: 12px; text-anchor: start }
  path { fill: none; stroke: #808a94; stroke-opacity: .5; stroke-width: 1.2 }
  rect { rx: 6 }
"""


def architecture() -> ModuleType:
    """The test that knows the floors."""
    path = ROOT / "tests/test_architecture.py"
    specification = importlib.util.spec_from_file_location("architecture", path)
    assert specification is not None and specification.loader is not None
    module = importlib.util.module_from_spec(specification)
    specification.loader.exec_module(module)
    return module


def imports(rules: ModuleType) -> dict[str, set[str]]:
    """For each room, the other rooms that it imports."""
    rooms = set().union(*rules.FLOORS)
    used: dict[str, set[str]] = {room: set() for room in rooms}
    for path in rules.modules():
        names = {name.split(".")[1] for name in rules.imported_modules(path) if "." in name}
        own = rules.room_of(path)
        used[own] |= names & rooms - {own}
    return used


def longest_ways(used: dict[str, set[str]]) -> list[tuple[str, str]]:
    """Who imports whom, without those that are reached by way of another room."""
    reached: dict[str, set[str]] = {}

    def below(room: str) -> set[str]:
        if room not in reached:
            reached[room] = set().union(*({other} | below(other) for other in used[room]))
        return reached[room]

    return sorted(
        (room, other)
        for room, others in used.items()
        for other in others
        if not any(other in below(between) for between in others - {other})
    )


def rows(floors: list[set[str]]) -> Iterator[tuple[int, list[str]]]:
    """The rows of rooms from above, each with the number of its floor."""
    for height in range(len(floors) - 1, -1, -1):
        rooms = sorted(floors[height])
        count = -(-len(rooms) // ACROSS)
        size = -(-len(rooms) // count)
        for start in range(0, len(rooms), size):
            yield height, rooms[start : start + size]


def picture() -> str:
    """The house as SVG."""
    rules = architecture()
    places: dict[str, tuple[float, float, float]] = {}
    drawn: list[str] = []
    y, last = float(MARGIN), -1
    for height, rooms in rows(rules.FLOORS):
        if height != last and last >= 0:
            y += FLOOR_GAP - GAP
        if height != last:
            drawn.append(f'<text class="floor" x="{MARGIN}" y="{y + 20:g}">{height + 1}</text>')
        last = height
        widths = [len(room) * LETTER + 2 * PADDING for room in rooms]
        free = WIDTH - 2 * MARGIN - 30 - sum(widths)
        gap = free / (len(rooms) + 1)
        x = MARGIN + 30 + gap
        for room, width in zip(rooms, widths, strict=True):
            places[room] = (x, y, width)
            drawn.append(
                f'<rect x="{x:.1f}" y="{y:g}" width="{width:.1f}" height="{ROOM_HEIGHT}" '
                f'fill="{COLOURS[height % len(COLOURS)]}"/>'
                f'<text x="{x + width / 2:.1f}" y="{y + 20:g}">{room}</text>'
            )
            x += width + gap
        y += ROOM_HEIGHT + GAP
    lines = [line(places[room], places[other]) for room, other in longest_ways(imports(rules))]
    head = (
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {WIDTH} {y:g}" width="{WIDTH}" height="{y:g}">'
    )
    title = "<title>The rooms of tracking3d by floor: lines lead down to what a room imports</title>"
    return "\n".join([head, title, f"<style>{STYLE}</style>", *lines, *drawn, "</svg>", ""])


def line(start: tuple[float, float, float], end: tuple[float, float, float]) -> str:
    """From the bottom of one room to the top of another; between neighbours of one floor, from below around."""
    x, y = start[0] + start[2] / 2, start[1] + ROOM_HEIGHT
    to_x, to_y = end[0] + end[2] / 2, end[1]
    if to_y <= start[1]:
        to_y += ROOM_HEIGHT
        bend = y + 16
        return f'<path d="M{x:.1f} {y:g}C{x:.1f} {bend:g} {to_x:.1f} {max(bend, to_y + 16):g} {to_x:.1f} {to_y:g}"/>'
    middle = (y + to_y) / 2
    return f'<path d="M{x:.1f} {y:g}C{x:.1f} {middle:g} {to_x:.1f} {middle:g} {to_x:.1f} {to_y:g}"/>'


if __name__ == "__main__":
    PICTURE.write_text(picture(), encoding="utf-8")
