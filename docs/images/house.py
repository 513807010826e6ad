"""Makes two pictures for CONTRIBUTING.md: rooms by floor, and which imports which.

The first shows the rooms of the package, the second those of its online solver. Both are drawn from the tables and the
imports that tests/test_architecture.py checks. Only the longest path between two rooms is drawn: a room has no line to
`errors` if it imports another room that imports `errors`.

$ python docs/images/house.py
"""

from __future__ import annotations

import importlib.util
from collections.abc import Iterator
from pathlib import Path
from types import ModuleType

ROOT = Path(__file__).resolve().parents[2]
PICTURE = Path(__file__).with_suffix(".svg")
ONLINE_PICTURE = Path(__file__).with_name("house_online.svg")

WIDTH, ONLINE_WIDTH = 1180, 620
MARGIN, GAP = 16, 14
ROOM_HEIGHT, FLOOR_GAP, PADDING = 30, 46, 11
LETTER = 7.4
ACROSS = 9
"""Rooms side by side; a floor with more has two rows, as even as can be."""
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


def online_imports(rules: ModuleType) -> dict[str, set[str]]:
    """For each room of the online solver, the other rooms of it that it imports."""
    used: dict[str, set[str]] = {room: set() for room in set().union(*rules.ONLINE_FLOORS)}
    for _, own, other in rules.online_imports():
        used[own].add(other)
    return used


def longest_paths(used: dict[str, set[str]]) -> list[tuple[str, str]]:
    """Pairs of a room and one that it imports, without those that another of its imports leads to."""
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
    """The rooms of the package as SVG."""
    rules = architecture()
    title = "The rooms of tracking3d by floor: lines lead down to what a room imports"
    return draw(rules.FLOORS, longest_paths(imports(rules)), WIDTH, title)


def online_picture() -> str:
    """The rooms of the online solver as SVG."""
    rules = architecture()
    title = "The rooms of the online solver: lines lead down to what a room imports"
    used = online_imports(rules)
    return draw(levels(used), longest_paths(used), ONLINE_WIDTH, title)


def levels(used: dict[str, set[str]]) -> list[set[str]]:
    """Rooms by the length of the longest path of imports below them, from the ground: each as low as it can be."""
    heights: dict[str, int] = {}

    def height(room: str) -> int:
        if room not in heights:
            heights[room] = 1 + max(map(height, used[room]), default=-1)
        return heights[room]

    return [{room for room in used if height(room) == at} for at in range(1 + max(map(height, used)))]


def draw(floors: list[set[str]], paths: list[tuple[str, str]], width: int, title: str) -> str:
    """SVG of rooms by floor, from the ground, with lines from rooms to those that they import."""
    places: dict[str, tuple[float, float, float]] = {}
    drawn: list[str] = []
    y, last = float(MARGIN), -1
    for height, rooms in rows(floors):
        if height != last and last >= 0:
            y += FLOOR_GAP - GAP
        if height != last:
            drawn.append(f'<text class="floor" x="{MARGIN}" y="{y + 20:g}">{height + 1}</text>')
        last = height
        widths = [len(room) * LETTER + 2 * PADDING for room in rooms]
        free = width - 2 * MARGIN - 30 - sum(widths)
        gap = free / (len(rooms) + 1)
        x = MARGIN + 30 + gap
        for room, wide in zip(rooms, widths, strict=True):
            places[room] = (x, y, wide)
            drawn.append(
                f'<rect x="{x:.1f}" y="{y:g}" width="{wide:.1f}" height="{ROOM_HEIGHT}" '
                f'fill="{COLOURS[height % len(COLOURS)]}"/>'
                f'<text x="{x + wide / 2:.1f}" y="{y + 20:g}">{room}</text>'
            )
            x += wide + gap
        y += ROOM_HEIGHT + GAP
    lines = [line(places[room], places[other]) for room, other in paths]
    head = (
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {width} {y:g}" width="{width}" height="{y:g}">'
    )
    return "\n".join(
        [head, f"<title>{title}</title>", f"<style>{STYLE}</style>", *lines, *drawn, "</svg>", ""]
    )


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
    ONLINE_PICTURE.write_text(online_picture(), encoding="utf-8")
