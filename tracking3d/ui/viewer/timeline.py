"""The timeline: status, keyframes and one quantity over time, as a clickable image.

Viser's plots do not report where they are clicked, so the plot is HTML of our own. A click writes the frame's number
into the field next to the slider, as a person would; everything else follows from that.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from itertools import groupby, pairwise

from tracking3d.results import drawing
from tracking3d.results.drawing import Colour
from tracking3d.results.records import FrameRecord
from tracking3d.ui.viewer.followed_run import FollowedRun

SLIDER = "frame"
"""The label of the slider that a click sets."""
RUN_COLOURS: tuple[Colour, ...] = (
    (0, 150, 200),
    (200, 80, 160),
    (110, 150, 30),
    (150, 100, 220),
    (220, 120, 30),
)
PLAIN_QUANTITIES = ("confidence", "IoU with the initial mask", "seconds")
_COLUMNS = 600  # of a curve; more frames than that are drawn by the lowest and highest of each column
_STRIP, _PLOT = 10, 90
_PRESENT = "--present-frame"


def quantities(runs: Sequence[FollowedRun]) -> list[str]:
    """What can be plotted of these runs."""
    terms = {
        term for run in runs for record in run.frames.values() for term in record.losses | record.diagnostics
    }
    return [*PLAIN_QUANTITIES, *sorted(terms)]


def draw_timeline(runs: Sequence[FollowedRun], quantity: str, first: int, last: int) -> str:
    """The plot as HTML, without the line of the present frame; see `cursor`.

    Args:
        runs: The runs, in the order of their colours.
        quantity: One of `quantities`.
        first: Index of the first frame.
        last: Index of the last one.
    """
    span = max(last - first, 1)
    strips = [_strip(run, number, first, span) for number, run in enumerate(runs)]
    top = _STRIP * len(runs) + 4
    curves = [_values(run, quantity) for run in runs]
    known = [value for curve in curves for _, value in curve]
    low, high = (min(known), max(known)) if known else (0.0, 1.0)
    if quantity in PLAIN_QUANTITIES[:2]:
        low, high = 0.0, 1.0
    high = high if high > low else low + 1.0
    lines = [
        _curve(curve, first, span, low, high, top, RUN_COLOURS[number % len(RUN_COLOURS)])
        for number, curve in enumerate(curves)
    ]
    height = top + _PLOT
    drawn = (
        f'<svg viewBox="0 0 1000 {height}" preserveAspectRatio="none" style="width:100%;height:{height}px;'
        f'display:block;cursor:crosshair">{"".join(strips)}'
        f'<rect x="0" y="{top}" width="1000" height="{_PLOT}" fill="currentColor" opacity="0.05"/>'
        f"{''.join(lines)}</svg>"
        f'<div style="position:absolute;left:3px;top:{top}px;opacity:.6">{high:.3g}</div>'
        f'<div style="position:absolute;left:3px;bottom:1px;opacity:.6">{low:.3g}</div>'
    )
    return _clickable(drawn, first, last)


def cursor(frame: int, first: int, last: int) -> str:
    """Where the line of the present frame is: a few bytes, so that the plot is not sent again for every frame."""
    share = (frame - first) / max(last - first, 1)
    return f"<style>:root{{{_PRESENT}:{100 * share:.3f}%}}</style>"


def colour_of(number: int, runs: int) -> Colour | None:
    """The colour of a run's curve; None if there is but one run to tell apart."""
    return RUN_COLOURS[number % len(RUN_COLOURS)] if runs > 1 else None


def jump(frame: str) -> str:
    """JavaScript that goes to a frame, for an attribute in double quotes; ``frame`` is an expression of it."""
    return (
        f"var f=Math.round({frame});"
        f"var l=[...document.querySelectorAll('label')].find(l=>l.textContent.trim()==='{SLIDER}');"
        "var i=document.getElementById(l.htmlFor).parentElement.querySelector('input:not([type=hidden])');"
        "Object.getOwnPropertyDescriptor(HTMLInputElement.prototype,'value').set.call(i,f);"
        "i.dispatchEvent(new Event('input',{bubbles:true}))"
    )


def _clickable(drawn: str, first: int, last: int) -> str:
    """The plot, ready to be clicked, with a line where `cursor` says."""
    going = jump(f"{first}+(event.clientX-this.getBoundingClientRect().left)/this.clientWidth*{last - first}")
    return (
        f'<div class="timeline" onclick="{going}" style="position:relative;font-size:10px;line-height:12px;'
        f'margin:2px 12px">{drawn}'
        f'<div style="position:absolute;top:0;bottom:0;width:2px;margin-left:-1px;left:var({_PRESENT},0%);'
        f'background:currentColor;opacity:.7;pointer-events:none"></div></div>'
    )


def _strip(run: FollowedRun, number: int, first: int, span: int) -> str:
    """The status of every frame as runs of colour, the keyframes as marks on it."""
    top, step, records = number * _STRIP, 1000 / span, list(run.frames.values())
    place = f'y="{top}" height="{_STRIP - 2}"'
    groups = [list(alike) for _, alike in groupby(records, key=lambda record: record.status)]
    begins = [alike[0].index for alike in groups] + [record.index + 1 for record in records[-1:]]
    parts = [
        f'<rect x="{(begin - first - 0.5) * step:.1f}" width="{max((end - begin) * step, 1.5):.1f}" {place} '
        f'fill="{hexadecimal(drawing.STATUS[alike[0].status])}"/>'
        for alike, (begin, end) in zip(groups, pairwise(begins), strict=True)
    ]
    keyframes = [record.index for record in records if record.keyframe]
    parts += [
        f'<rect x="{(index - first) * step - 1:.1f}" width="2" {place} fill="#222"/>'
        for index in keyframes[:: max(len(keyframes) // _COLUMNS, 1)]
    ]
    return "".join(parts)


def _values(run: FollowedRun, quantity: str) -> list[tuple[int, float]]:
    def of(record: FrameRecord) -> float | None:
        if quantity == PLAIN_QUANTITIES[0]:
            return record.confidence
        if quantity == PLAIN_QUANTITIES[1]:
            return record.iou_initial
        return (
            record.seconds
            if quantity == PLAIN_QUANTITIES[2]
            else (record.losses | record.diagnostics).get(quantity)
        )

    values = [(index, of(record)) for index, record in run.frames.items()]
    return [(index, value) for index, value in values if value is not None and math.isfinite(value)]


def _curve(
    values: list[tuple[int, float]], first: int, span: int, low: float, high: float, top: int, colour: Colour
) -> str:
    bundle = max(len(values) // _COLUMNS, 1)
    kept: list[tuple[int, float]] = []
    for start in range(0, len(values), bundle):
        column = values[start : start + bundle]
        kept += sorted({min(column, key=lambda one: one[1]), max(column, key=lambda one: one[1])})
    points = " ".join(
        f"{(index - first) / span * 1000:.1f},{top + _PLOT * (1 - (value - low) / (high - low)):.1f}"
        for index, value in kept
    )
    return (
        f'<polyline points="{points}" fill="none" stroke="{hexadecimal(colour)}" stroke-width="1.5" '
        f'vector-effect="non-scaling-stroke"/>'
    )


def hexadecimal(colour: Colour) -> str:
    """``#rrggbb``."""
    return "#{:02x}{:02x}{:02x}".format(*colour)
