"""The comparison page of several runs, in one file."""

from __future__ import annotations

import base64
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import ArrayLike

from tracking3d.results.files import read_mask, write_atomic
from tracking3d.results.overlay import OverlaySize
from tracking3d.results.redrawing import overlay_frames
from tracking3d.runtime.stage_times import STAGES
from tracking3d.ui.report.curves import Curve, curve, stretches
from tracking3d.ui.report.differences import RunComparison, run_figures
from tracking3d.ui.report.frame_pictures import jpeg_of
from tracking3d.ui.report.rendering import render_page

_MARGIN = 0.4  # of the longer side of what the masks cover, around it


def write_comparison(comparison: RunComparison, path: Path) -> None:
    """Write the page.

    Args:
        comparison: What differs.
        path: The HTML file.

    Raises:
        OutputError: If it cannot be written.
    """
    first = comparison.runs[0]
    figures = [run_figures(run) for run in comparison.runs]
    page = render_page(
        "comparison.html",
        title=" and ".join(comparison.names)
        if len(comparison.names) == 2
        else f"{len(comparison.names)} runs",
        names=comparison.names,
        facts=[("Source", str(first.description.get("source", ""))), ("Reference run", comparison.names[0])],
        notes=comparison.notes,
        settings=comparison.settings,
        pairs=_pairs(comparison),
        summaries=[(one.name, one.summary) for one in comparison.differences],
        plots=_plots(comparison),
        strips=_strips(comparison),
        first_label=f"frame {_frames(comparison)[0]}",
        last_label=f"frame {_frames(comparison)[-1]}",
        figures=figures,
        stages=STAGES,
        frames=_pictures(comparison),
    )
    write_atomic(path, page)


def _pairs(comparison: RunComparison) -> list[tuple[str, list[dict[str, str] | None]]]:
    """The row of every run in the table of pairs, if there are more than two runs."""
    if len(comparison.runs) < 3:
        return []
    rows = []
    for row, name in enumerate(comparison.names):
        cells: list[dict[str, str] | None] = []
        for column in range(len(comparison.names)):
            iou, turn = comparison.iou_between[row, column], comparison.rotation_between[row, column]
            cell = {
                "iou": f"{iou:.3f}" if np.isfinite(iou) else "–",
                "rotation": f"{turn:.1f}°" if np.isfinite(turn) else "–",
            }
            cells.append(None if row == column else cell)
        rows.append((name, cells))
    return rows


def _frames(comparison: RunComparison) -> list[int]:
    """Every frame with an estimate of any run: what the plots go over."""
    return sorted({record.index for run in comparison.runs for record in run.frames})


def _plots(comparison: RunComparison) -> list[list[Curve]]:
    """One plot a figure, with a curve for every run but the first, on one scale."""
    place = {index: number for number, index in enumerate(_frames(comparison))}

    def spread(indices: ArrayLike, values: ArrayLike) -> Any:
        over = np.full(len(place), np.nan)
        over[[place[index] for index in np.asarray(indices).tolist()]] = values
        return over

    plots = []
    for title, attribute, unit, upwards in (
        ("Overlap of masks (IoU)", "iou", "", False),
        ("Difference in rotation", "rotation", "°", True),
        ("Difference in translation (% of the distance)", "translation", " %", True),
    ):
        drawn = [(one.name, spread(one.indices, getattr(one, attribute))) for one in comparison.differences]
        known = np.concatenate([values[np.isfinite(values)] for _, values in drawn])
        if not len(known):
            continue
        limits = (0.0, max(float(known.max()), 0.01)) if upwards else (min(float(known.min()), 0.99), 1.0)
        curves = [curve(f"{title} of {name}", values, unit, limits) for name, values in drawn]
        plots.append([replace(one, title=title) for one in curves if one is not None])
    return plots


def _strips(comparison: RunComparison) -> list[dict[str, Any]]:
    """The statuses of every run."""
    frames, strips = _frames(comparison), []
    for name, run in zip(comparison.names, comparison.runs, strict=True):
        status = {record.index: record.status.value for record in run.frames}
        statuses = [status.get(index, "no estimate") for index in frames]
        counts = ", ".join(f"{statuses.count(kind)} {kind}" for kind in dict.fromkeys(statuses))
        strips.append({"name": name, "stretches": stretches(statuses), "summary": counts})
    return strips


def _pictures(comparison: RunComparison) -> list[dict[str, Any]]:
    """For each frame that differs most, the overlays of all runs around the object, and in what they differ."""
    size = OverlaySize.of(comparison.runs[0].camera)
    shown: list[dict[str, Any]] = [
        {"index": index, "pictures": [], "differs": _differs(comparison, index)} for index in comparison.worst
    ]
    for name, run in zip(comparison.names, comparison.runs, strict=True):
        positions = {record.index: number for number, record in enumerate(run.frames)}
        wanted = [positions[index] for index in comparison.worst if index in positions]
        drawn = dict(zip(wanted, overlay_frames(run, wanted), strict=False))
        for frame in shown:
            image = drawn.get(positions.get(frame["index"], -1))
            rows, columns = _around(comparison, frame["index"], size)
            picture = "" if image is None else base64.b64encode(jpeg_of(image[rows, columns])).decode("ascii")
            record = run.frames[positions[frame["index"]]] if frame["index"] in positions else None
            status = "no estimate" if record is None else record.status.value
            frame["pictures"].append({"name": name, "picture": picture, "status": status})
    return shown


def _around(comparison: RunComparison, index: int, size: OverlaySize) -> tuple[slice, slice]:
    """Rows and columns of the overlay around the masks of all runs; all of it if there is none."""
    masks = [mask for run in comparison.runs if (mask := read_mask(run.mask_path(index))) is not None]
    boxes = [cv2.boundingRect(mask.astype(np.uint8)) for mask in masks if mask.any()]
    if not boxes:
        return slice(0, size.picture), slice(0, size.width)
    edges = np.array([(x, y, x + width, y + height) for x, y, width, height in boxes])
    (left, top), (right, bottom) = edges[:, :2].min(0).tolist(), edges[:, 2:].max(0).tolist()
    margin = _MARGIN * max(right - left, bottom - top)
    rows = np.clip(size.scale * np.array([top - margin, bottom + margin]), 0, size.picture).astype(int)
    columns = np.clip(size.scale * np.array([left - margin, right + margin]), 0, size.width).astype(int)
    return slice(*rows), slice(*columns)


def _differs(comparison: RunComparison, index: int) -> str:
    sentences = []
    for one in comparison.differences:
        for place in np.flatnonzero(one.indices == index):
            parts = [
                f"{name} {value[place]:.{digits}f}{unit}"
                for name, value, unit, digits in (
                    ("IoU", one.iou, "", 3),
                    ("rotation", one.rotation, "°", 1),
                    ("translation", one.translation, " %", 1),
                )
                if np.isfinite(value[place])
            ]
            sentences.append(f"{one.name}: {', '.join(parts) or 'nothing to compare'}")
    return "; ".join(sentences)
