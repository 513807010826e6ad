"""Writing a run folder during the run, so that a kill loses at most the frames since the last saved state.

A frame's masks are renamed into place before its line is appended to ``frames.jsonl``: the line says that the
frame is there. The writer holds a lock on ``frames.jsonl``, which the system drops with the process.
"""

from __future__ import annotations

import json
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path
from types import TracebackType
from typing import Any, Literal, Self

import numpy as np
from numpy.typing import NDArray

from tracking3d.errors import OutputError
from tracking3d.estimation.estimate import FrameEstimate, ObjectModel
from tracking3d.frames import Frame, MaskEstimate, SkippedFrame
from tracking3d.geometry.camera import Camera
from tracking3d.results import description, layout
from tracking3d.results.files import (
    expect_visible_masks,
    first_problem,
    read_mask,
    repeat_masks,
    try_lock,
    write_image,
    write_mask,
    write_probability,
    write_reserved,
    write_visible_masks,
    writing,
)
from tracking3d.results.mesh_export import export_mesh
from tracking3d.results.notes import notes_of_run
from tracking3d.results.overwrite import check_output_folder, clear_run_folder
from tracking3d.results.pictures import Pictures
from tracking3d.results.records import FrameRecord, jsonable, latest
from tracking3d.results.refinement_writer import RefinementWriter, clear_refinement
from tracking3d.results.run_reader import RunReader, read_records
from tracking3d.runtime.concurrency import RegularWork
from tracking3d.runtime.memory import release_free_memory

FinalState = Literal["finished", "interrupted", "failed"]
SKIPS_EVERY = 1.0
"""Seconds between two writes of ``run.json`` for skipped frames; the last ones are written at the end."""
SHEET_EVERY, SHEET_SHARE = 5.0, 0.01
"""Seconds between two writes of the contact sheet while the run goes on, and the most of the time that they take."""
RESERVE = 2048  # bytes that ``run.json`` has to spare for saying, on a full disk, how the run ended
_STAYS = {"created", "refinement", "split", "tracker_choice"}  # of a run that is continued
DEFAULT_FPS = 10.0
"""Frame rate of the overlay video if the source has none, such as a folder of images."""


class RunWriter:
    """Writes one run folder.

    As a context manager it ends a run that was not finished as interrupted or failed.

    Args:
        folder: The run folder; made with its parents.
        header: The facts of the run before its first frame.
        overwrite: Replace a run that is there. Only files a run writes are removed, only from a run folder.
        resume: Continue the run that is there, of which so much is saved. What is behind that in ``frames.jsonl``
            stays until something is written in its place.

    Raises:
        OutputError: If the folder is in use, holds a run already, or cannot be written.
    """

    def __init__(
        self,
        folder: Path,
        header: description.RunHeader,
        *,
        overwrite: bool = False,
        resume: WrittenSoFar | None = None,
    ) -> None:
        self.folder = Path(folder)
        self._camera, self._fps = header.camera, header.fps or DEFAULT_FPS
        self._passes: dict[str, float] = {}
        self._pass, self._pass_began = "tracking", time.monotonic()
        self._drawing, self._over = 0.0, False
        self._pictures = Pictures(self.folder / layout.OVERLAY, self._camera, self._fps)
        self._sheet = RegularWork(partial(self._write_contact_sheet, None), SHEET_EVERY, SHEET_SHARE)
        self._refinement: RefinementWriter | None = None
        self._probabilities = bool(header.config.get("runtime", {}).get("probabilities"))
        self._description = description.description_at_start(header)
        self._kept: dict[int, FrameRecord] = {}
        self._repeats: list[SkippedFrame] = []
        if resume is None:
            check_output_folder(self.folder, overwrite)
        with writing(self.folder):
            self.folder.mkdir(parents=True, exist_ok=True)
            if resume is None and (self.folder / layout.FRAMES).is_symlink():
                (self.folder / layout.FRAMES).unlink()
        self._lines = FrameLines(self.folder)
        try:
            if resume is None:
                clear_run_folder(self.folder, overwrite)
            with writing(self.folder):
                if resume is None:
                    self._lines.begin()
                for inner in (layout.MASKS, layout.INITIAL_MASKS):
                    (self.folder / inner).mkdir(exist_ok=True)
            if resume is not None:
                self._continue(resume)
            self._write_description()
        except BaseException:
            self._lines.discard()
            raise

    @property
    def seconds(self) -> float:
        """Wall time of the run so far, pauses left out."""
        return sum(self.passes.values())

    @property
    def passes(self) -> dict[str, float]:
        """The same by pass; `tracking` is the first."""
        return self._passes | {self._pass: time.monotonic() - self._pass_began}

    def begin_pass(self, name: str) -> None:
        """From here on time belongs to the pass ``name``."""
        self._passes, self._pass, self._pass_began = self.passes, name, time.monotonic()
        release_free_memory()

    @property
    def lines(self) -> int:
        """Bytes of ``frames.jsonl`` that are written."""
        return self._lines.size

    def kept_record(self, index: int) -> FrameRecord | None:
        """The estimate that a frame had before the run was stopped; None if it had none."""
        return self._kept.get(index)

    def draw_again(self, frame: Frame) -> FrameRecord | None:
        """Draw a frame that was estimated before the run was stopped; None if it has no estimate."""
        record = self._kept.get(frame.index)
        if record is not None:
            initial = read_mask(layout.initial_mask_path(self.folder, frame.index))
            mask = read_mask(layout.mask_path(self.folder, frame.index))
            self._pictures.add_kept(frame, record, mask, initial)
        return record

    def begin_drawing_again(self) -> None:
        """All frames are estimated: from here on `draw_again` draws them, in the order in which they come.

        Raises:
            OutputError: If the video that was drawn so far cannot be finished.
        """
        self._pictures.close()
        self._pictures = Pictures(self.folder / layout.OVERLAY, self._camera, self._fps)
        self._kept = {record.index: record for record in latest(read_records(self.folder / layout.FRAMES))}

    def write(self, estimate: FrameEstimate, frame: Frame) -> FrameRecord:
        """Keep the estimate for one frame, and those it revises.

        Overlay and contact sheet show each frame's first estimate; a final refinement redraws them.

        Returns:
            The record of ``estimate``.

        Raises:
            OutputError: If it cannot be written; what was written before stays whole.
        """
        started = time.perf_counter() - self._drawing  # of the image before, drawn when its line was safe
        for revised in estimate.revised:
            self.record(revised, "", revision=True)
        record = self.record(estimate, frame.name, revision=False, started=started)
        self.use_camera(estimate.camera or self._camera)
        drawn = time.perf_counter()
        self._pictures.add(frame, estimate, record)
        self._drawing = time.perf_counter() - drawn
        self._sheet.do_if_due()
        return record

    def skip(self, skipped: SkippedFrame) -> None:
        """Record a frame that could not be decoded or was dropped; an `OutputError` says that it cannot be.

        One that repeats the picture before gets the estimates of that one at the end.
        """
        if skipped.repeats is not None:
            self._repeats.append(skipped)
            return
        self._description["skipped"].append({"index": skipped.index, "reason": skipped.reason})
        # A camera drops many frames a second, and the file is written whole.
        if time.monotonic() - self._described >= SKIPS_EVERY:
            self._write_description()

    def skip_refinement(self, reason: str) -> None:
        """Record that there is no final refinement though one was asked for, and why."""
        self._description["refinement"] = description.refinement("skipped", reason)
        self._write_description()

    def begin_refinement(
        self, model: ObjectModel | None, kept: int = 0, seconds: float = 0.0
    ) -> RefinementWriter:
        """All frames have their causal estimates; whatever comes now, the folder holds them whole.

        Args:
            model: The object as it is now; its mesh is written. None if that was done before the run was stopped.
            kept: Bytes of refined estimates that were saved before.
            seconds: Wall time that they took.

        Raises:
            OutputError: If something cannot be written.
        """
        self._pictures.close()
        if model is not None:
            export_mesh(self.folder, model)
        else:
            with writing(self.folder):
                self._lines.truncate()
        causal = latest(read_records(self.folder / layout.FRAMES), refined=False)
        self._refinement = RefinementWriter(self.folder, self._camera, self._fps, causal, kept, seconds)
        if model is None and (before := (self._description["refinement"] or {}).get("start")):
            self._refinement.start = description.StartOfModel(**before)
        self._description["refinement"] = self._refinement.describe("running")
        self._write_description()
        return self._refinement

    def refine_camera(self, camera: Camera) -> None:
        """From here on estimates are those of ``camera``; ``run.json`` names it when the refinement has ended."""
        assert self._refinement is not None
        self._camera = self._refinement.pictures.camera = camera
        self._description["refinement"] = self._refinement.describe("running")
        self._write_description()

    def use_camera(self, camera: Camera) -> None:
        """From here on causal estimates are those of ``camera``."""
        if camera != self._camera:
            self._camera = self._pictures.camera = camera
            self._description["camera"] = asdict(camera)
            self._write_description()

    def end_refinement(self, passed_over: Mapping[str, int]) -> None:
        """Replace the causal estimates by the refined ones; the causal ones go to ``causal/``.

        Args:
            passed_over: How many frames each pass has left as they were, by its name.

        Raises:
            OutputError: If it cannot be done.
        """
        assert self._refinement is not None
        self._refinement.passed_over = dict(passed_over)
        self._refinement.take_over(self._lines.append)
        self._description["refinement"] = self._refinement.describe("finished")
        self._description["camera"] = asdict(self._camera)
        self._pictures, self._refinement = self._refinement.pictures, None

    def finish(self, model: ObjectModel | None, state: FinalState, error: str | None = None) -> None:
        """Write the final files and the final state, and release the folder.

        All files that can be written are, even if others fail. A second call does nothing.

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
            problem = self._write_final_files(model, state, error)
            if problem:
                state, error = "failed", str(problem)
            ended = {"state": state, "error": error, "finished": description.now()}
            self._description |= ended
            try:
                self._write_description()
            except OutputError as full:
                problem = problem or full
                ended |= {"state": "failed", "error": error or str(full)}
                self._description = {**self._written, **ended}
                self._write_description()
            if state == "finished":
                clear_refinement(self.folder)
        except KeyboardInterrupt:
            if self._description["state"] == "running":
                self._description |= {"state": "interrupted", "finished": description.now()}
                self._write_description()
            raise
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

    def _continue(self, so_far: WrittenSoFar) -> None:
        """Continue the run that is there."""
        earlier = RunReader(self.folder).description
        self._lines.go_on(so_far.lines)
        known = latest(read_records(self.folder / layout.FRAMES, so_far.lines), refined=False)
        self._kept = {record.index: record for record in known}
        self._passes["earlier"] = so_far.seconds
        self._description |= {key: earlier[key] for key in _STAYS & earlier.keys()}
        again = {"at": description.now(), "frames": len(known)}
        self._description["resumed"] = [*earlier.get("resumed", ()), again]
        self._repeats = [one for one in so_far.skipped if one.repeats is not None]
        left_out = [one for one in so_far.skipped if one.repeats is None]
        self._description["skipped"] = [{"index": one.index, "reason": one.reason} for one in left_out]

    def record(
        self, estimate: FrameEstimate, name: str, revision: bool, started: float | None = None
    ) -> FrameRecord:
        """Write an estimate without drawing it; ``revision`` if its frame has one already."""
        initial_path = layout.initial_mask_path(self.folder, estimate.index)
        initial = estimate.initial_mask
        if revision and initial_path.is_file():  # a better estimate has the same initial mask
            initial = read_mask(initial_path)
        elif initial is not None:
            write_initial_mask(self.folder, estimate.index, initial, estimate.occluder)
        record = FrameRecord.of(estimate, name, initial, revision)
        write_mask(layout.mask_path(self.folder, estimate.index), estimate.mask)
        if self._probabilities:
            write_probability(self.folder, estimate.index, estimate.probability)
        if started is not None:
            record = record.and_wrote(time.perf_counter() - started)
        self._lines.append([record])
        return record

    def _write_description(self) -> None:
        self._described = time.monotonic()
        text = json.dumps(jsonable(self._description), indent=2, allow_nan=False)
        write_reserved(self.folder / layout.RUN, text.encode() + b"\n", RESERVE)
        self._written = dict(self._description)

    def _give_up_refinement(self, state: FinalState, error: str | None) -> None:
        """Handle a refinement that did not finish."""
        if self._refinement is not None:
            self._refinement.give_up(keep=layout.has_state(self.folder))
            self._description["refinement"] = self._refinement.describe(state, error or "")

    def _write_final_files(
        self, model: ObjectModel | None, state: FinalState, error: str | None
    ) -> Exception | None:
        """Write all files that can be written; the first problem with any of them."""
        steps: list[Callable[[], None]] = [
            self._pictures.close,
            partial(self._give_up_refinement, state, error),
            self._write_repeats,
            partial(self._finish, model),
            partial(write_visible_masks, self.folder),
        ]
        if model is not None:
            steps.insert(2, partial(export_mesh, self.folder, model))
        if state == "finished":
            mesh, pictures = model is not None, self._pictures.any
            steps.append(partial(check_complete, self.folder, mesh=mesh, pictures=pictures))
        return first_problem(*steps)

    def _write_repeats(self) -> None:
        """Give frames that repeat the picture before the estimates of that one, causal and refined, and its masks."""
        if not self._repeats:
            return
        with writing(self.folder / layout.FRAMES):
            self._lines.truncate()
        records = list(read_records(self.folder / layout.FRAMES))
        causal = {one.index: one for one in latest(records, refined=False)}
        refined = {one.index: one for one in latest(records) if one.refined}
        again = [one for one in self._repeats if one.repeats in causal]
        for one in again:
            repeat_masks(self.folder, one.repeats, one.index)
        self._lines.append(
            [
                known[one.repeats].repeated(one)
                for known in (causal, refined)
                for one in again
                if one.repeats in known
            ]
        )

    def _finish(self, model: ObjectModel | None) -> None:
        records = list(read_records(self.folder / layout.FRAMES))
        figures = self._summarize(records)
        self._description |= figures | {"notes": notes_of_run(self._description, model, latest(records))}
        self._write_contact_sheet(model, records)

    def _write_contact_sheet(
        self, model: ObjectModel | None, records: list[FrameRecord] | None = None
    ) -> None:
        """Write the contact sheet of the frames so far; None leaves the model out, or reads the records."""
        records = list(read_records(self.folder / layout.FRAMES)) if records is None else records
        replaced = {record.index for record in latest(records) if record.revision and not record.refined}
        figures = self._summarize(records)
        sheet = self._pictures.contact_sheet(model, figures | self._description, replaced)
        if sheet is not None:
            write_image(self.folder / layout.CONTACT_SHEET, sheet)

    def _summarize(self, records: list[FrameRecord]) -> dict[str, Any]:
        """Counts and times of the run so far."""
        skipped = len(self._description["skipped"])
        return description.summary(latest(records), skipped, self.passes, latest(records, refined=False))


PICTURES = (layout.OVERLAY, layout.CONTACT_SHEET)
_SHOWN = (layout.RUN, layout.FRAMES, *PICTURES, *layout.MESH_FILES)


def missing_files(folder: Path, names: Iterable[str]) -> list[str]:
    """Those of some files in a folder that are not there, or empty."""
    return [name for name in names if not _is_there(folder / name)]


def check_complete(folder: Path, *, mesh: bool, pictures: bool) -> None:
    """Make sure that a run that ends as finished has its files.

    Args:
        folder: The run folder.
        mesh: Whether it has a mesh.
        pictures: Whether a frame was drawn.

    Raises:
        OutputError: If one is missing.
    """
    names = [*(layout.MESH_FILES if mesh else ()), *(PICTURES if pictures else ())]
    if missing := missing_files(folder, names):
        verb = "is" if len(missing) == 1 else "are"
        raise OutputError(
            f"{', '.join(missing)} {verb} missing in {folder}, so that the run is not finished; resume it."
        )


def lacks_report(folder: Path) -> bool:
    """Whether a run has no report, or no turntable though it has a model."""
    model = (folder / layout.FEATURES).is_file()
    return bool(missing_files(folder, (layout.REPORT, *([layout.TURNTABLE] if model else []))))


def times_written(folder: Path) -> tuple[int, ...]:
    """When the files were written that a report shows; if one of them changes, the report is out of date."""
    paths = [folder / name for name in _SHOWN]
    return tuple(path.stat().st_mtime_ns if path.is_file() else 0 for path in paths)


def _is_there(path: Path) -> bool:
    return path.is_file() and path.stat().st_size > 0


# The mask tracker's masks in a run folder, ``initial_masks/``, and what it says is in front of the object.
#
# One PNG a frame: 255 the object, 64 an occluder, 0 the rest.


def write_initial_mask(
    folder: Path, index: int, mask: NDArray[np.bool_], occluder: NDArray[np.bool_] | None
) -> None:
    """Write what a mask tracker gave for frame ``index``.

    Args:
        folder: The run folder.
        index: Index of the frame.
        mask: ``(H, W)``.
        occluder: ``(H, W)`` what is in front of the object; None if nothing is known.

    Raises:
        OutputError: If it cannot be written.
    """
    if occluder is not None and occluder.any():
        expect_visible_masks(folder)
    write_mask(layout.initial_mask_path(folder, index), mask, occluder)


def is_initial_mask(folder: Path, frame: Frame, estimate: MaskEstimate) -> bool:
    """Whether a mask tracker's estimate for a frame is the one that the run folder holds."""
    kept, given = read_mask(layout.initial_mask_path(folder, frame.index)), estimate.binary
    if kept is None or given is None:
        return all(mask is None or not mask.any() for mask in (kept, given))
    return np.array_equal(kept, given)


@dataclass(frozen=True)
class WrittenSoFar:
    """What a stopped run has written."""

    lines: int = 0  # bytes of frames.jsonl that are of finished frames
    seconds: float = 0.0  # wall time of the run until then
    skipped: tuple[SkippedFrame, ...] = ()  # frames that were not taken


class FrameLines:
    """Appends records to ``frames.jsonl``, and holds a lock on it that the system drops with the process.

    Args:
        folder: The run folder; it exists.

    Raises:
        OutputError: If another run writes there, or the file cannot be opened.
    """

    def __init__(self, folder: Path) -> None:
        self._path = folder / layout.FRAMES
        self._kept: int | None = None
        with writing(folder):
            self._new = not self._path.exists()
            self._file = self._path.open("ab", buffering=0)
        if not try_lock(self._file.fileno()):
            self._file.close()
            raise OutputError(
                f"{folder} is in use by another run; wait for it or choose another {layout.OUT}."
            )

    @property
    def size(self) -> int:
        """Bytes of finished frames."""
        return self._file.seek(0, 2) if self._kept is None else self._kept

    def begin(self) -> None:
        """Begin with none."""
        self._file.truncate(0)

    def go_on(self, kept: int) -> None:
        """Continue behind ``kept`` bytes; later lines stay until others are written in their place.

        Raises:
            OutputError: If the file is shorter.
        """
        if self._file.seek(0, 2) < kept:
            raise OutputError(f"{self._path} is shorter than it was; run it again with {layout.OVERWRITE}.")
        self._kept = kept

    def append(self, records: Sequence[FrameRecord]) -> None:
        """Append the lines of all records, or none of them.

        Raises:
            OutputError: If they cannot be written.
        """
        lines = b"".join(record.to_json().encode() + b"\n" for record in records)
        with writing(self._path):
            self.truncate()
            end = self._file.seek(0, 2)
            try:
                written = 0
                while written < len(lines):
                    written += self._file.write(lines[written:])
            except OSError:
                self._file.truncate(end)
                raise

    def truncate(self) -> None:
        """Cut off the lines that a stopped run wrote after its last finished frame."""
        if self._kept is not None:
            self._file.truncate(self._kept)
            self._kept = None

    def close(self) -> None:
        """Close the file."""
        self._file.close()

    def discard(self) -> None:
        """Close the file, and remove it if it was made here."""
        self.close()
        if self._new:
            self._path.unlink()
