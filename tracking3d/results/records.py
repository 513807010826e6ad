"""One frame as a line of ``frames.jsonl``, and back."""

from __future__ import annotations

import json
import math
from collections.abc import Iterable, Mapping
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Annotated, Any, Self

import numpy as np
from numpy.typing import NDArray
from pydantic import BeforeValidator, Field, PlainValidator, TypeAdapter, ValidationError

from tracking3d.estimation.estimate import FrameEstimate, MaskSource, Status
from tracking3d.frames import SkippedFrame, mask_iou_or_none
from tracking3d.geometry.alignment import nearest_rigid
from tracking3d.geometry.camera import Camera
from tracking3d.runtime.stage_times import StageTimes


def _number(value: Any) -> Any:
    return math.nan if value is None else value


def _pose(value: Any) -> NDArray[np.float64]:
    try:
        return np.array(value, dtype=np.float64).reshape(4, 4)
    except TypeError as error:
        raise ValueError("it is no matrix") from error


def _stages(value: Any) -> StageTimes | None:
    return None if value is None else read_stages(value)


_Count = Annotated[int, Field(ge=0, le=2**53)]  # up to what every reader of JSON knows exactly
_Number = Annotated[float, BeforeValidator(_number)]
_Numbers = dict[str, _Number]


@dataclass(frozen=True, eq=False)
class FrameRecord:
    """The record of one frame in the run folder, without its masks."""

    index: _Count  # the frame's index in the source
    time: float | None  # seconds since the start of the video, if known
    name: str  # what messages call the frame
    # (4, 4) float64 from object to camera; NaN if the estimate was not a number
    T_cam_obj: Annotated[NDArray[np.float64], PlainValidator(_pose)]
    status: Status  # the estimator's judgement
    reason: str  # why, in words
    confidence: _Number  # in [0, 1]
    # each loss term at the estimate, unweighted, by name; NaN if it was not a number
    losses: _Numbers
    iterations: _Count  # optimizer iterations spent
    keyframe: bool  # whether the frame became a keyframe
    seconds: _Number  # wall time spent on the frame, all stages together; of a revision 0, see `latest`
    iou_initial: float | None  # IoU of the estimate and the initial mask; None without an initial mask
    area: _Count  # pixels of the estimated mask
    revision: bool = False  # whether this replaces an earlier estimate
    failure: str = ""  # which plug-in failed at this frame, and why; empty if none did
    hypothesis: str = ""  # the pose hypothesis that won, in a word or two; empty if there was only one
    refined: bool = False  # whether this is the estimate of the final refinement, not the causal one
    # the same time stage by stage; None in revisions
    stages: Annotated[StageTimes | None, PlainValidator(_stages)] = None
    mask_source: MaskSource | None = None  # where the estimated mask comes from; None if unknown
    # fx, fy, cx, cy of the camera that the pose is of; None if it is the run's
    camera: tuple[float, float, float, float] | None = None
    # the other numbers behind status and confidence, by name; NaN if it was not a number
    diagnostics: _Numbers = field(default_factory=dict)
    # unit vector in object coordinates about which the rotation is not known; None if all of it is
    free_axis: tuple[float, float, float] | None = None

    @classmethod
    def of(
        cls,
        estimate: FrameEstimate,
        name: str = "",
        initial_mask: NDArray[np.bool_] | None = None,
        revision: bool = False,
    ) -> Self:
        """The record of ``estimate``, whose initial mask was ``initial_mask``."""
        return cls(
            index=estimate.index,
            time=estimate.time,
            name=name,
            T_cam_obj=np.asarray(estimate.T_cam_obj, dtype=np.float64),
            status=Status(estimate.status),
            reason=estimate.reason,
            confidence=float(estimate.confidence),
            losses={term: float(value) for term, value in estimate.losses.items()},
            iterations=int(estimate.iterations),
            keyframe=bool(estimate.keyframe),
            seconds=float(estimate.seconds),
            iou_initial=mask_iou_or_none(estimate.mask, initial_mask),
            area=int(np.count_nonzero(estimate.mask)),
            revision=revision,
            failure=estimate.failure,
            hypothesis=estimate.hypothesis,
            refined=bool(estimate.refined),
            stages=estimate.stages,
            mask_source=estimate.mask_source,
            camera=None if (c := estimate.camera) is None else (c.fx, c.fy, c.cx, c.cy),
            diagnostics={name: float(value) for name, value in estimate.diagnostics.items()},
            free_axis=None if (a := estimate.free_axis) is None else (float(a[0]), float(a[1]), float(a[2])),
        )

    def through(self, camera: Camera) -> Camera:
        """The camera that the pose is of; ``camera`` is the run's."""
        if self.camera is None:
            return camera
        fx, fy, cx, cy = self.camera
        return replace(camera, fx=fx, fy=fy, cx=cx, cy=cy)

    def and_wrote(self, seconds: float) -> Self:
        """The record, with the time that writing masks and pictures took."""
        stages = None if self.stages is None else self.stages + StageTimes(write=seconds)
        return replace(self, stages=stages, seconds=self.seconds + seconds)

    def repeated(self, by: SkippedFrame) -> Self:
        """The record of a frame that shows the same picture again."""
        stages = None if self.stages is None else StageTimes()
        return replace(
            self, index=by.index, time=by.time, name=by.name, keyframe=False, iterations=0, seconds=0.0, stages=stages,
            hypothesis=f"that of frame {self.index}",
        )  # fmt: skip

    @property
    def has_pose(self) -> bool:
        """Whether the pose is known; else it is NaN."""
        return bool(np.isfinite(self.T_cam_obj).all())

    @classmethod
    def from_line(cls, line: bytes, file: Path) -> FrameRecord:
        """Read one line of a file, with the nearest rotation if what it has is so only nearly.

        Raises:
            ValueError: If it is not a whole and valid record, or its pose is not rigid.
        """
        record = cls.from_json(line)
        if not record.has_pose:
            return record
        if (T_cam_obj := nearest_rigid(record.T_cam_obj, file)) is None:
            raise ValueError(f"the pose of frame {record.index} is not a rotation and a translation")
        return replace(record, T_cam_obj=T_cam_obj)

    @classmethod
    def from_json(cls, line: str | bytes) -> FrameRecord:
        """Read one line.

        Raises:
            ValueError: If it is not a whole and valid record.
        """
        try:
            return _LINE.validate_json(line, strict=True)
        except ValidationError as error:
            fault = error.errors(include_url=False)[0]
            if "surrogate" in fault["msg"]:  # of a path that is not UTF-8; pydantic reads no such JSON
                return _LINE.validate_python(json.loads(line))
            name = ".".join(map(str, fault["loc"]))
            if not name:
                raise ValueError(f"not a frame record: {fault['msg']}") from error
            what = "missing" if fault["type"] == "missing" else f"{fault['input']!r:.40}"
            raise ValueError(f"{name} is {what}") from error

    def to_json(self) -> str:
        """The record as one line of valid JSON; what is not a number is null."""
        return json.dumps(jsonable(vars(self)), allow_nan=False)


_LINE = TypeAdapter(FrameRecord)


def latest(records: Iterable[FrameRecord], refined: bool = True) -> list[FrameRecord]:
    """The estimate for every frame: the last record of each index, sorted by index.

    Args:
        records: In the order in which they were written.
        refined: Take the estimates of the final refinement if there are any, else the causal ones everywhere.
    """
    estimates: dict[int, FrameRecord] = {}
    for record in records:
        if record.refined and not refined:
            continue
        before = estimates.get(record.index)
        # A revision is made long after the frame was seen and no longer knows its name.
        if before and record.revision and not record.refined:
            # What a revision took is counted in the frame that led to it.
            record = replace(record, seconds=before.seconds, stages=before.stages)
        estimates[record.index] = replace(record, name=before.name) if before and not record.name else record
    return [estimates[index] for index in sorted(estimates)]


def jsonable(value: Any) -> Any:
    """``value`` in JSON's own types: arrays as lists, paths as text, what is not a finite number as None."""
    if isinstance(value, StageTimes):
        return jsonable(asdict(value))
    if isinstance(value, Mapping):
        return {str(key): jsonable(item) for key, item in value.items()}
    if isinstance(value, np.ndarray | np.generic):
        return jsonable(value.tolist())
    if isinstance(value, list | tuple):
        return [jsonable(item) for item in value]
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    return str(value) if isinstance(value, Path) else value


def read_stages(value: Any) -> StageTimes:
    """Stage times from JSON; NaN if a time is null.

    Raises:
        ValueError: If it is none.
    """
    try:
        return StageTimes(**{stage: float(_number(seconds)) for stage, seconds in value.items()})
    except (TypeError, AttributeError) as error:
        raise ValueError(f"{value!r:.40} are not stage times") from error
