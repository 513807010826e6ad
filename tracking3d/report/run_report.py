"""``report.html``: the report of a run in one file."""

from __future__ import annotations

import base64
import math
from contextlib import suppress
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from tracking3d.errors import InputError, Tracking3dError
from tracking3d.estimation.estimate import ObjectModel, Status
from tracking3d.report import figures
from tracking3d.report.curves import Curve, curve, stretches
from tracking3d.report.doubts import doubts_of, next_steps, outcome_of
from tracking3d.report.frame_pictures import FramePictures, frame_pictures, jpeg_of
from tracking3d.report.model_data import middle_of, model_data, read_model
from tracking3d.report.probability_layer import probability_layers
from tracking3d.report.rendering import render_page
from tracking3d.report.settings import settings_of
from tracking3d.report.turntable import write_turntable
from tracking3d.results import layout
from tracking3d.results.doubtful_frames import DoubtfulRange, doubtful_ranges
from tracking3d.results.files import write_atomic, writing
from tracking3d.results.mesh_view import render_view, side_shown
from tracking3d.results.notes import unseen_share
from tracking3d.results.records import FrameRecord
from tracking3d.results.run_reader import RunReader
from tracking3d.runtime.progress import report_progress

_MOST_LISTED = 30
"""Ranges of uncertain and lost frames that are named; the plots show all."""
_STILL = 480  # pixels a side
_FASTEST = 30.0  # pictures a second
_OBJECT_FOLDER = "object_"
_DAMAGED = (KeyError, TypeError, ValueError, AttributeError, RecursionError)


def write_report(folder: Path, turntable: bool = True) -> Path:
    """Write the report of a run, and the turntable movie of its model next to it.

    Args:
        folder: A run folder: of a run that has ended in any way, or still goes on.
        turntable: Whether to write the turntable movie.

    Returns:
        The report's file.

    Raises:
        InputError: If it is no run folder, or damaged.
        OutputError: If the report cannot be written; the run is left as it is.
    """
    report_progress("report")
    run = RunReader(folder)
    try:
        model, no_model = _model_of(run)
        front = _front(run, model)
        page = _page(run, model, front, no_model)
    except _DAMAGED as error:
        raise InputError(
            f"{folder / layout.RUN} is damaged ({type(error).__name__}: {error}); restore it."
        ) from error
    path = folder / layout.REPORT
    write_atomic(path, page)
    if model is not None and turntable:
        with writing(folder / layout.TURNTABLE):
            write_turntable(folder / layout.TURNTABLE, model, front)
    return path


def write_turntable_of(folder: Path) -> None:
    """Write the turntable movie of a run's model alone; see `write_report`."""
    run = RunReader(folder)
    model, _ = _model_of(run)
    if model is not None:
        with writing(folder / layout.TURNTABLE):
            write_turntable(folder / layout.TURNTABLE, model, _front(run, model))


def _model_of(run: RunReader) -> tuple[ObjectModel | None, str]:
    """The model; or why there is none, in a sentence."""
    try:
        return read_model(run.mesh_folder), ""
    except Tracking3dError as error:
        return None, str(error)


def _page(run: RunReader, model: ObjectModel | None, front: NDArray[np.float64], no_model: str) -> bytes:
    records = run.frames
    pictures = frame_pictures(run)
    likely = probability_layers(run, pictures.positions)
    doubtful = doubtful_ranges(records)
    counts = figures.status_counts(records)
    shares, refinement_time = figures.stage_shares(run), run.refinement_stages is not None
    in_parent = run.folder.resolve().name.startswith(_OBJECT_FOLDER)
    return render_page(
        "report.html",
        ("model_viewer.js", "report.js"),
        title=_title(run.folder),
        index=in_parent and (run.folder / ".." / layout.INDEX).is_file(),
        counts=counts,
        facts=_facts(run),
        outcome=outcome_of(run),
        steps=next_steps(run, model),
        files=_files(run.folder),
        doubts=doubts_of(run),
        count=len(records),
        pictures=pictures if pictures.jpegs else None,
        probabilities=sum(layer is not None for layer in likely),
        first_picture=_text(pictures.jpegs[0]) if pictures.jpegs else "",
        model=model is not None,
        no_model=no_model,
        still="" if model is None else _text(jpeg_of(render_view(model, front, _STILL))),
        seen="" if model is None else f"{100 * (1 - unseen_share(model)):.0f} %",
        stretches=stretches([record.status.value for record in records]),
        status_summary=", ".join(f"{number} {status}" for status, number in counts.items()),
        curves=_curves(records, model),
        first_label=_label(records[0]) if records else "",
        last_label=_label(records[-1]) if records else "",
        doubtful=_most_telling(doubtful),
        more_doubtful=max(len(doubtful) - _MOST_LISTED, 0),
        sheet=_sheet(run.folder / layout.CONTACT_SHEET),
        stages=shares,
        refinement_time=refinement_time,
        time_in_words=_time_in_words(run),
        command=run.description.get("command") or "",
        settings=settings_of(run.config),
        machine=_machine(run),
        conventions=list((run.description.get("conventions") or {}).items()),
        data=_data(run, model, pictures, likely, doubtful),
    )


def _data(
    run: RunReader,
    model: ObjectModel | None,
    pictures: FramePictures,
    likely: tuple[bytes | None, ...],
    doubtful: list[DoubtfulRange],
) -> dict[str, Any]:
    """What the page's script needs, as short as it goes: a run may have a hundred thousand frames."""
    records = run.frames
    reasons = {reason: number for number, reason in enumerate(dict.fromkeys(one.reason for one in records))}
    fps = run.description.get("fps")
    timed = bool(records) and all(record.time is not None for record in records)
    return {
        "indices": [record.index for record in records],
        "statuses": "".join(record.status.value[0] for record in records),
        "confidences": [_round(record.confidence) for record in records],
        "times": [_round(record.time) for record in records] if timed else None,
        "keyframes": [number for number, record in enumerate(records) if record.keyframe],
        "reasons": list(reasons),
        "reason": [reasons[record.reason] for record in records],
        "doubts": [part.position for part in doubtful],
        "pictured": pictures.positions,
        "pictures": [_text(jpeg) for jpeg in pictures.jpegs],
        "probabilities": [None if layer is None else _text(layer) for layer in likely],
        "speed": min(fps, _FASTEST) if isinstance(fps, int | float) and fps > 0 else 10,
        "model": None if model is None else model_data(model),
        "rotations": [] if model is None else _rotations(records, middle_of(model), pictures),
    }


def _rotations(
    records: list[FrameRecord], middle: NDArray[np.float64], pictures: FramePictures
) -> list[list[float] | None]:
    """For every picture the side of the model that it shows; None if unknown."""
    shown = [records[position] for position in pictures.positions] or records[:1]
    found = [
        None if record.status is Status.LOST else side_shown(record.T_cam_obj, middle) for record in shown
    ]
    return [None if rotation is None else rotation.ravel().round(4).tolist() for rotation in found]


def _front(run: RunReader, model: ObjectModel | None) -> NDArray[np.float64]:
    """``(3, 3)`` rotation that shows the model as the first frame with a pose did, tracked ones before others."""
    if model is not None:
        for statuses in ((Status.TRACKED,), (Status.UNCERTAIN,)):
            for record in run.frames:
                rotation = side_shown(record.T_cam_obj, middle_of(model))
                if record.status in statuses and rotation is not None:
                    return rotation
    return np.eye(3)


def _curves(records: list[FrameRecord], model: ObjectModel | None) -> list[Curve]:
    poses = figures.reliable_poses(records)
    middle = np.zeros(3) if model is None else middle_of(model)
    ious = [_own_overlap(record) for record in records]
    drawn = [
        curve("Confidence", [record.confidence for record in records], "", (0.0, 1.0)),
        curve("Rotation from the first frame", figures.turns(poses), "°", digits=1),
        curve("Distance relative to the first frame", figures.distances(poses, middle), "", digits=3),
        curve("IoU of the mask with the mask tracker's", ious, "", digits=3),
    ]
    return [one for one in drawn if one is not None]


def _own_overlap(record: FrameRecord) -> float:
    """IoU of the estimated and the initial mask; NaN if the initial mask was kept unchanged."""
    handed_back = record.mask_source is not None and not record.mask_source.is_own
    return math.nan if record.iou_initial is None or handed_back else record.iou_initial


def _most_telling(doubtful: list[DoubtfulRange]) -> list[DoubtfulRange]:
    """The longest ranges, lost ones first, in order of time."""
    chosen = sorted(doubtful, key=lambda part: (part.status != Status.LOST, -part.count))[:_MOST_LISTED]
    return sorted(chosen, key=lambda part: part.position)


def _facts(run: RunReader) -> list[tuple[str, str]]:
    about, camera = run.description, run.camera
    names = [(run.config.get(key) or {}).get("name", "") for key in ("tracker", "features", "solver")]
    facts = [
        ("Source", about.get("source", "")),
        ("Frames", f"{len(run.frames)} of {camera.width} x {camera.height} pixels"),
        ("Masks from", names[0]),
        ("Features", names[1]),
        ("Solver", names[2]),
        ("State", run.state_in_words),
        ("Time", _time_per_frame(run)),
        ("Corrected frames", ", ".join(f"frame {index}" for index in figures.corrected_frames(run))),
        ("Started", str(about.get("created", "")).replace("T", " ").replace("+00:00", " UTC")),
    ]
    return [(name, str(value)) for name, value in facts if value]


def _files(folder: Path) -> list[str]:
    names = [name for what, names in layout.OUTPUTS.items() if what != "report" for name in names]
    return [name for name in names if (folder / name).exists()]


def _machine(run: RunReader) -> list[tuple[str, str]]:
    camera, renderer = run.camera, run.description.get("renderer") or {}
    rows = {
        "focal lengths": f"{camera.fx:.2f}, {camera.fy:.2f} pixels",
        "principal point": f"{camera.cx:.2f}, {camera.cy:.2f}",
        "lens": camera.origin,
        "renderer": f"{renderer.get('backend', '')} ({renderer.get('reason', '')})" if renderer else "",
        "seed": run.description.get("seed"),
        "peak memory": _megabytes(run.description.get("peak_memory_mb")),
        **(run.description.get("versions") or {}),
    }
    return [(name, str(value)) for name, value in rows.items() if value not in (None, "")]


def _time_in_words(run: RunReader) -> str:
    total = (run.description.get("timings") or {}).get("seconds_total")
    took = [f"{total:.1f} seconds in total" if isinstance(total, int | float) else ""]
    words = ", ".join(filter(None, [*took, _time_per_frame(run)]))
    return f"{words}; one-time work, such as compiling code and building the mesh, belongs to no stage."


def _time_per_frame(run: RunReader) -> str:
    causal, refined = figures.stage_times(run)
    return (
        "" if causal is None else f"{(causal.whole + refined.whole) / len(run.frames):.2f} seconds per frame"
    )


def _megabytes(value: Any) -> str:
    return f"{value:.0f} MB" if isinstance(value, int | float) else ""


def _sheet(path: Path) -> str:
    """The contact sheet as JPEG; empty if there is no readable one."""
    image = None
    with suppress(OSError, cv2.error):
        image = cv2.imdecode(np.fromfile(path, np.uint8), cv2.IMREAD_COLOR)
    return "" if image is None else _text(jpeg_of(np.asarray(image[..., ::-1], dtype=np.uint8), 82))


def _title(folder: Path) -> str:
    path = folder.resolve()
    return f"{path.parent.name}/{path.name}" if path.name.startswith(_OBJECT_FOLDER) else path.name


def _label(record: FrameRecord) -> str:
    time = f", {record.time:.2f} s" if record.time is not None else ""
    return f"frame {record.index}{time}"


def _round(value: float | None) -> float | None:
    return None if value is None or not math.isfinite(value) else round(value, 2)


def _text(data: bytes) -> str:
    return base64.b64encode(data).decode("ascii")
