"""Writing a run folder while the run goes on, so that a kill loses at most the current frame.

A frame's masks are renamed into place before its line is appended to ``frames.jsonl``: the line says that the
frame is there. The writer holds a lock on ``frames.jsonl``, which the system drops with the process.
"""

from __future__ import annotations

import json
import time
from collections.abc import Callable, Mapping
from functools import partial
from pathlib import Path
from types import TracebackType
from typing import Any, Literal, Self

import numpy as np

from tracking3d.errors import InputError, OutputError
from tracking3d.estimation.estimate import FrameEstimate, ObjectModel
from tracking3d.frames import Frame, SkippedFrame
from tracking3d.geometry.camera import Camera
from tracking3d.results import description, layout
from tracking3d.results.contact_sheet import CROPS, Thumbnails, draw_contact_sheet
from tracking3d.results.files import read_mask, write_atomic, write_image, write_mask, writing
from tracking3d.results.lock import try_lock
from tracking3d.results.mesh_export import export_mesh
from tracking3d.results.overlay import ObjectAxes, OverlaySize, draw_overlay
from tracking3d.results.records import FrameRecord, jsonable, latest
from tracking3d.results.run_reader import RunReader, read_records
from tracking3d.video.writer import VideoWriter

FinalState = Literal["finished", "interrupted", "failed"]
DEFAULT_FPS = 10.0
"""Speed of the overlay video where the source has none, such as a folder of images."""


class RunWriter:
    """Writes one run folder.

    As a context manager it ends a run that was not finished as interrupted or failed.

    Args:
        folder: The run folder; made with its parents.
        config: The configuration as used.
        camera: The camera of the full frame.
        source: What was tracked, in words.
        seed: Seed of everything random.
        renderer: What renders, and why.
        fps: Frames per second of the source, where known.
        command: The command line, where there was one.
        overwrite: Replace a run that is there. Only files a run writes are removed, only from a run folder.

    Raises:
        OutputError: If the folder is in use, holds a run already, or cannot be written.
    """

    def __init__(
        self,
        folder: Path,
        *,
        config: dict[str, Any],
        camera: Camera,
        source: str,
        seed: int,
        fps: float | None,
        command: str | None,
        selection: str | None = None,
        renderer: Mapping[str, str | int] | None = None,
        overwrite: bool = False,
    ) -> None:
        self.folder = Path(folder)
        self._camera = camera
        self._fps = fps or DEFAULT_FPS
        self._started = time.monotonic()
        self._first: FrameEstimate | None = None
        self._axes: ObjectAxes | None = None
        self._thumbnails = Thumbnails()
        self._video: VideoWriter | None = None
        self._over = False
        self._description = description.description_at_start(
            config=config,
            camera=camera,
            source=source,
            seed=seed,
            fps=fps,
            command=command,
            selection=selection,
            renderer=renderer,
        )
        frames = self.folder / layout.FRAMES
        with writing(self.folder):
            self.folder.mkdir(parents=True, exist_ok=True)
            new = not frames.exists()
            self._lines = frames.open("ab", buffering=0)
        try:
            if not try_lock(self._lines.fileno()):
                raise OutputError(
                    f"{self.folder} is in use by another run; wait for it or choose another --out."
                )
            _make_room(self.folder, overwrite)
            with writing(self.folder):
                self._lines.truncate(0)
                for inner in (layout.MASKS, layout.INITIAL_MASKS):
                    (self.folder / inner).mkdir(exist_ok=True)
            self._write_description()
        except BaseException:
            self._lines.close()
            if new:
                frames.unlink()
            raise

    def write(self, estimate: FrameEstimate, frame: Frame) -> FrameRecord:
        """Keep the answer for one frame, and those it revises.

        Overlay and contact sheet show each frame's first answer: they are drawn while its image is there.

        Returns:
            What was recorded of ``estimate``.

        Raises:
            OutputError: If it cannot be written; what was written before stays whole.
        """
        for revised in estimate.revised:
            self._record(revised, "", revision=True)
        record = self._record(estimate, frame.name, revision=False)
        if self._first is None:
            self._first = estimate
        if self._axes is None:
            self._axes = ObjectAxes.of(estimate, self._camera)
        size = OverlaySize.of(self._camera)
        overlay = draw_overlay(frame, estimate, record, self._camera, self._axes)
        self._thumbnails.add(overlay[: size.picture], size.scale, estimate)
        if self._video is None:
            self._video = VideoWriter(self.folder / layout.OVERLAY, self._fps, (size.height, size.width))
        self._video.write(overlay)
        return record

    def skip(self, skipped: SkippedFrame) -> None:
        """Record a frame that could not be decoded."""
        self._description["skipped"].append({"index": skipped.index, "reason": skipped.reason})
        self._write_description()

    def finish(self, model: ObjectModel | None, state: FinalState, error: str | None = None) -> None:
        """Write what is made at the end and the final state, and let go of the folder.

        Everything that can be written is, whatever fails beside it. A second call does nothing.

        Args:
            model: The object, or None if there is none.
            state: How the run ended.
            error: Why, if it failed.

        Raises:
            OutputError: If something could not be written; the state is then ``failed``.
        """
        if self._over:
            return
        self._over = True
        try:
            problem = _first_problem(
                self._close_video, partial(self._export, model), partial(self._finish, model)
            )
            if problem:
                state, error = "failed", str(problem)
            self._description |= {"state": state, "error": error, "finished": description.now()}
            self._write_description()
        finally:
            self._lines.close()
        if problem:
            raise problem

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if not self._over:
            ended: FinalState = "failed" if isinstance(error, Exception) else "interrupted"
            self.finish(None, ended, str(error) if isinstance(error, Exception) else None)

    def _record(self, estimate: FrameEstimate, name: str, revision: bool) -> FrameRecord:
        initial_path = layout.initial_mask_path(self.folder, estimate.index)
        initial = estimate.initial_mask
        if initial is not None:
            write_mask(initial_path, initial)
        elif revision:
            initial = read_mask(initial_path)
        record = FrameRecord.of(estimate, name, initial, revision)
        write_mask(layout.mask_path(self.folder, estimate.index), estimate.mask)
        self._append(record.to_json().encode() + b"\n")
        return record

    def _append(self, line: bytes) -> None:
        """Append a whole line or nothing."""
        with writing(self.folder / layout.FRAMES):
            end = self._lines.seek(0, 2)
            try:
                written = 0
                while written < len(line):
                    written += self._lines.write(line[written:])
            except OSError:
                self._lines.truncate(end)
                raise

    def _write_description(self) -> None:
        text = json.dumps(jsonable(self._description), indent=2, allow_nan=False)
        write_atomic(self.folder / layout.RUN, text.encode() + b"\n")

    def _close_video(self) -> None:
        if self._video is not None:
            self._video.close()

    def _export(self, model: ObjectModel | None) -> None:
        if model is not None:
            export_mesh(self.folder, model)

    def _finish(self, model: ObjectModel | None) -> None:
        records = latest(read_records(self.folder / layout.FRAMES))
        seconds = time.monotonic() - self._started
        figures = description.summary(records, len(self._description["skipped"]), seconds)
        self._description |= figures
        if self._first is not None:
            rotation = np.asarray(self._first.T_cam_obj, dtype=np.float64)[:3, :3]
            sheet = draw_contact_sheet(self._thumbnails.spread(CROPS), model, rotation, figures)
            write_image(self.folder / layout.CONTACT_SHEET, sheet)


def _first_problem(*steps: Callable[[], None]) -> Exception | None:
    """Take every step; give the first error any of them raised."""
    problem: Exception | None = None
    for step in steps:
        try:
            step()
        except Exception as error:
            problem = problem or error
    return problem


def _make_room(folder: Path, overwrite: bool) -> None:
    """Remove an earlier run from the folder, or refuse to.

    Raises:
        OutputError: If there is one and ``overwrite`` is not set, or if files there are not a run's.
    """
    there = [path for path in layout.run_files(folder) if path.name != layout.FRAMES or path.stat().st_size]
    if not there:
        return
    try:
        earlier = RunReader(folder)
    except InputError as error:
        raise OutputError(
            f"{folder} is not a readable run folder but holds {there[0].relative_to(folder)}, "
            "which a run would replace; choose another --out."
        ) from error
    if earlier.frames and not overwrite:
        raise OutputError(f"{folder} already holds a run; choose another --out or pass --overwrite.")
    with writing(folder):
        for path in there:
            # These two are replaced in place, so that a kill in between leaves a run folder.
            if path.name not in (layout.RUN, layout.FRAMES):
                path.unlink()
