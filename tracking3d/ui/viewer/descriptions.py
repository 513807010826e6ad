"""Descriptions as HTML: a frame's estimate, the uncertain and lost frames, the run as a whole.

All of it is text of files, and escaped.
"""

from __future__ import annotations

import html
from collections.abc import Sequence
from typing import Any

from tracking3d.estimation.estimate import FREE_ROTATION, Status
from tracking3d.results import drawing
from tracking3d.results.drawing import Colour
from tracking3d.results.records import FrameRecord
from tracking3d.ui.sentences import DoubtfulRange, doubtful_ranges
from tracking3d.ui.viewer.followed_run import FollowedRun
from tracking3d.ui.viewer.timeline import hexadecimal, jump

LONGEST_LIST = 200
"""Maximum entries in the list of uncertain and lost frames; the rest is only counted."""


def list_doubtful_frames(runs: Sequence[FollowedRun]) -> str:
    """The uncertain and lost frames of all runs with their reasons; a click goes to a frame."""
    rows = [(run, doubtful) for run in runs for doubtful in doubtful_ranges(list(run.frames.values()))]
    items = "".join(_row(run, doubtful, len(runs) > 1) for run, doubtful in rows[:LONGEST_LIST])
    if not rows:
        items = "<p>No frame is uncertain or lost.</p>"
    elif len(rows) > LONGEST_LIST:
        items += f"<p>… and {len(rows) - LONGEST_LIST} more.</p>"
    return f'<div style="font-size:12px;line-height:1.35;max-height:40vh;overflow-y:auto;margin:4px 12px">{items}</div>'


def describe_frame(run: FollowedRun, record: FrameRecord | None, colour: Colour | None = None) -> str:
    """One run's estimate of a frame in a line of HTML, after the colour of its curve."""
    name = html.escape(run.name)
    if colour is not None:
        name = f'<span style="color:{hexadecimal(colour)}">▬</span> {name}'
    if record is None:
        return f"<div><b>{name}</b> has no estimate for this frame</div>"
    figures = f"confidence {record.confidence:.2f}"
    if record.iou_initial is not None:
        figures += f", IoU with the initial mask {record.iou_initial:.2f}"
    details = [figures, *(["keyframe"] if record.keyframe else []), *(["refined"] if record.refined else [])]
    free = FREE_ROTATION if record.free_axis else ""
    why = [html.escape(text) for text in (record.reason, record.failure, free) if text]
    return (
        f"<div><b>{name}</b> {_badge(record.status)} {', '.join(details)}"
        f"{'<br>' if why else ''}{'; '.join(why)}</div>"
    )


def about(run: FollowedRun) -> str:
    """A run's state, source, tracker and notes."""
    description: dict[str, Any] = run.description
    tracker = description.get("config", {}).get("tracker")
    seconds = description.get("timings", {}).get("seconds_total")
    rows = {
        "state": run.reader.state_in_words,
        "source": description.get("source"),
        "frames": len(run.frames),
        "mask tracker": tracker.get("name") if isinstance(tracker, dict) else None,
        "lens": run.camera.origin,
        "seconds": round(seconds) if isinstance(seconds, int | float) else None,
    }
    cells = "".join(
        f"<tr><td style='opacity:.6;padding-right:8px;vertical-align:top'>{name}</td>"
        f"<td style='overflow-wrap:anywhere'>{html.escape(str(value))}</td></tr>"
        for name, value in rows.items()
        if value not in (None, "")
    )
    notes = "".join(f"<p>{html.escape(str(note))}</p>" for note in description.get("notes", []))
    return (
        f'<div style="font-size:12px;line-height:1.35;margin:4px 12px"><b>{html.escape(run.name)}</b>'
        f"<table>{cells}</table>{notes}</div>"
    )


def _badge(status: Status) -> str:
    red, green, blue = drawing.STATUS[status]
    return (
        f'<span style="background:rgb({red},{green},{blue});color:#111;border-radius:3px;padding:0 5px">'
        f"{status.value}</span>"
    )


def _row(run: FollowedRun, doubtful: DoubtfulRange, named: bool) -> str:
    name = f"{html.escape(run.name)}, " if named else ""
    going = jump(str(doubtful.first))
    return (
        f'<div class="streak" role="button" tabindex="0" onclick="{going}" '
        f'onkeydown="if(event.key===\'Enter\')this.click()" style="cursor:pointer;padding:3px 0">'
        f"{_badge(doubtful.status)} {name}<b>{doubtful.frames}</b>: "
        f"{html.escape(doubtful.reason) or 'no reason given'}</div>"
    )
