"""``report.html``: the report of a run in one file."""

from __future__ import annotations

import base64
import io
import math
from collections.abc import Sequence
from contextlib import suppress
from functools import partial
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import trimesh
from numpy.typing import NDArray
from PIL import Image as Pillow
from scipy.spatial.transform import Rotation

from tracking3d.errors import InputError, Tracking3dError
from tracking3d.estimation.estimate import ObjectModel, Status
from tracking3d.rendering.backend import share_threads
from tracking3d.results import layout
from tracking3d.results.contact_sheet import look_of, render_view, side_shown
from tracking3d.results.files import write_atomic, writing
from tracking3d.results.layout import partial_path
from tracking3d.results.mesh_export import load_model, split_mesh
from tracking3d.results.notes import unseen_share
from tracking3d.results.records import FrameRecord
from tracking3d.results.run_reader import RunReader
from tracking3d.runtime.concurrency import start_in_thread
from tracking3d.runtime.progress import report_each, report_progress
from tracking3d.ui.report import figures
from tracking3d.ui.report.curves import Curve, curve, stretches
from tracking3d.ui.report.differences import settings_of
from tracking3d.ui.report.frame_pictures import FramePictures, frame_pictures, jpeg_of
from tracking3d.ui.report.rendering import render_page
from tracking3d.ui.sentences import DoubtfulRange, doubtful_ranges, doubts_of, next_steps, outcome_of
from tracking3d.video.writer import VideoWriter

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
        shown = model if turntable else None
        with share_threads(1):
            movie = start_in_thread(partial(_write_movie, folder, shown, front), cv2.getNumThreads())
            page = _page(run, model, front, no_model)
            path = folder / layout.REPORT
            write_atomic(path, page)
            movie()
    except _DAMAGED as error:
        raise InputError(
            f"{folder / layout.RUN} is damaged ({type(error).__name__}: {error}); restore it."
        ) from error
    return path


def write_turntable_of(folder: Path) -> None:
    """Write the turntable movie of a run's model alone; see `write_report`."""
    run = RunReader(folder)
    model, _ = _model_of(run)
    _write_movie(folder, model, _front(run, model))


def _write_movie(folder: Path, model: ObjectModel | None, front: NDArray[np.float64]) -> None:
    if model is not None:
        with writing(folder / layout.TURNTABLE):
            write_turntable(folder / layout.TURNTABLE, model, front)


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


# The model of a run for the page's viewer: plain arrays and a texture image.
#
# The picture has two halves: above the colours, below how much of each texel was ever seen. The viewer paints what was
# never seen in a pale colour of the page instead of a guess. As an alpha channel it would not do: browsers forget the
# colour of what is transparent. If it would be large as PNG, it is WebP, in which the eye sees no difference.

MOST_TEXTURE = 1_500_000
"""Bytes of the picture; as text in the page it takes a third more."""
_LARGE = 300_000  # bytes of a PNG that is not worth losing anything for
_QUALITIES = (90, 75, 55, 30, 10)
MOST_FACES = 200_000
"""Faces of a model that is put into a page."""


def read_model(folder: Path) -> ObjectModel:
    """The model of a run, if it is one that can be drawn.

    Raises:
        InputError: If there is none, it cannot be read, or its arrays do not fit each other.
    """
    model = load_model(folder)
    fault = _fault(model)
    if fault:
        raise InputError(
            f"The model {folder / layout.FEATURES} {fault}; track again into another {layout.OUT}."
        )
    return model


def middle_of(model: ObjectModel) -> NDArray[np.float64]:
    """``(3,)`` the middle of the model's box, in object coordinates."""
    middle: NDArray[np.float64] = (model.vertices.min(0) + model.vertices.max(0)) / 2
    return middle


def model_data(model: ObjectModel) -> dict[str, Any]:
    """What the viewer draws: the mesh, centred and of radius 1, in object axes (y down), as base64 of float32.

    Texture coordinates have their origin in the upper left of the picture's upper half.
    """
    plain = trimesh.visual.material.SimpleMaterial()
    mesh = split_mesh(model, plain)
    centred = mesh.vertices - middle_of(model)
    radius = max(float(np.linalg.norm(centred, axis=1).max()), 1e-12)
    assert isinstance(mesh.visual, trimesh.visual.TextureVisuals)
    uv = np.asarray(mesh.visual.uv) * (1, -1) + (0, 1)
    seen = np.repeat(255 * (model.texture_weight > 0)[..., None].astype(np.uint8), 3, axis=2)
    picture = np.concatenate([model.texture, seen])[..., ::-1]
    return {
        "positions": _floats(centred / radius),
        "normals": _floats(mesh.vertex_normals),
        "coordinates": _floats(uv),
        "faces": _base64(np.asarray(mesh.faces, dtype="<u4").tobytes()),
        "texture": _picture(picture),
    }


def _picture(picture: NDArray[np.uint8]) -> str:
    """``(H, W, 3)`` BGR as the address of a picture within the page."""
    plain = cv2.imencode(".png", picture)[1].tobytes()
    if len(plain) <= _LARGE:
        return f"data:image/png;base64,{_base64(plain)}"
    for quality in _QUALITIES:
        made = cv2.imencode(".webp", picture, [cv2.IMWRITE_WEBP_QUALITY, quality])[1].tobytes()
        if len(made) <= MOST_TEXTURE:
            break
    return f"data:image/webp;base64,{_base64(made)}"


def _floats(values: NDArray[np.float64]) -> str:
    return _base64(np.ascontiguousarray(values, dtype="<f4").tobytes())


def _base64(data: bytes) -> str:
    return base64.b64encode(data).decode("ascii")


def _fault(model: ObjectModel) -> str:
    """Why the arrays are no model, or nothing."""
    count = len(model.vertices)
    shapes = (
        model.vertices.shape == (count, 3)
        and model.faces.ndim == 2
        and model.faces.shape[1] == 3
        and model.face_uvs.shape == (*model.faces.shape, 2)
        and model.texture_weight.shape == model.texture.shape[:2]
    )
    if not shapes or not np.issubdtype(model.faces.dtype, np.integer):
        return "has arrays of inconsistent sizes"
    if not 0 < len(model.faces) <= MOST_FACES:
        return f"has {len(model.faces)} faces"
    if not 0 <= model.faces.min() <= model.faces.max() < count:
        return "has faces with missing vertices"
    if not (np.isfinite(model.vertices).all() and np.isfinite(model.face_uvs).all()):
        return "has vertices with invalid coordinates"
    return ""


# Object probabilities as overlays for a page: small images of sixteen colours.
#
# Blue is hardly, yellow is surely the object, as in the viewer; what is below a thirtieth is transparent.

BUDGET = 1_200_000
"""Bytes of all layers of a page; as text in the page they take a third more."""
WIDEST = 320
"""Pixels across a layer; the page stretches it over the picture."""
_STEPS = 16
_FAINTEST, _STRONGEST = 40, 150  # of 255; what is hardly the object's is hardly covered


def probability_layers(
    run: RunReader, positions: Sequence[int], budget: int = BUDGET
) -> tuple[bytes | None, ...]:
    """A layer as PNG for each of some estimates; None for one without a probability, nothing if none has one.

    Args:
        run: The run.
        positions: Positions in ``run.frames``.
        budget: Bytes of all layers together; they get smaller until they fit.
    """
    width = min(WIDEST, run.camera.width)
    shown = [_grey(run.probability(run.frames[position].index), width) for position in positions]
    if all(one is None for one in shown):
        return ()
    layers = list(map(_encode, shown))
    while sum(len(layer) for layer in layers if layer) > budget and width > 16:
        width = width * 3 // 4
        layers = [_encode(None if one is None else _shrunk(one, width)) for one in shown]
    return tuple(layers)


def _grey(probability: NDArray[np.float32] | None, width: int) -> NDArray[np.uint8] | None:
    """0 to 255: a long run has hundreds of them at a time."""
    if probability is None:
        return None
    return _shrunk(np.rint(255 * probability).clip(0, 255).astype(np.uint8), width)


def _shrunk(grey: NDArray[np.uint8], width: int) -> NDArray[np.uint8]:
    height, before = grey.shape
    shape = (width, max(round(width * height / before), 1))
    return cv2.resize(grey, shape, interpolation=cv2.INTER_AREA).astype(np.uint8)


def _encode(grey: NDArray[np.uint8] | None) -> bytes | None:
    if grey is None:
        return None
    image = Pillow.fromarray(np.rint(grey / 255 * (_STEPS - 1)).astype(np.uint8))
    image.putpalette(_palette())
    written = io.BytesIO()
    transparency = bytes([0, *np.linspace(_FAINTEST, _STRONGEST, _STEPS - 1).astype(np.uint8)])
    image.save(written, "PNG", bits=4, transparency=transparency, optimize=True)
    return written.getvalue()


def _palette() -> list[int]:
    """Viridis, as the viewer has it."""
    greys = np.rint(np.linspace(0, 255, _STEPS)).astype(np.uint8)[None]
    return [int(value) for value in cv2.applyColorMap(greys, cv2.COLORMAP_VIRIDIS)[0, :, ::-1].ravel()]


VIEWS = 48
FPS = 12.0
SIDE = 320
PITCH = 20.0
"""Degrees by which the views look down on the object."""


def write_turntable(path: Path, model: ObjectModel, rotation: NDArray[np.float64]) -> None:
    """Write one turn of the model about the vertical of a view; what was never seen is pale.

    Args:
        path: The MP4 file; it is there when it is whole.
        model: The object.
        rotation: ``(3, 3)`` object to camera of the first view.

    Raises:
        OutputError: If it cannot be written.
    """
    unfinished, look = partial_path(path), look_of(model, SIDE)
    try:
        with VideoWriter(unfinished, FPS, (SIDE, SIDE)) as video:
            for yaw in report_each("turntable", np.arange(VIEWS) * 360.0 / VIEWS):
                turned = Rotation.from_euler("yx", [yaw, PITCH], degrees=True).as_matrix() @ rotation
                video.write(render_view(model, turned, SIDE, look))
        unfinished.replace(path)
    finally:
        unfinished.unlink(missing_ok=True)
