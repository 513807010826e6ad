"""Small changes of a sequence's input that should hardly change its estimates."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Literal, TypeVar

import numpy as np
from pydantic import BaseModel, ConfigDict, Field

from tracking3d.errors import InputError
from tracking3d.frames import Box
from tracking3d.geometry.camera import Camera
from tracking3d.trackers.crops import box_of
from tracking3d_bench.datasets.truth import PointTruth, Truth

_NEAR = 3  # most frames between the first one and the one that its box is taken from

_Known = TypeVar("_Known")


class InputChange(BaseModel):
    """What is changed.

    Attributes:
        lens: Whether a tracker is given the lens: as the data set says, ``given`` or ``withheld``.
        focal_scale: Factor of the given focal length.
        box_shift: Pixels by which the first box is moved to the right and down.
        box_growth: Share by which the first box is wider and higher, about its centre.
        first_frame: The frame that is the first one.
        grey_noise: Seed of one grey level of noise on the frames; None for none.
    """

    model_config = ConfigDict(frozen=True, extra="forbid")

    lens: Literal["usual", "given", "withheld"] = "usual"
    focal_scale: float = Field(1.0, gt=0)
    box_shift: tuple[float, float] = (0.0, 0.0)
    box_growth: float = Field(0.0, gt=-1)
    first_frame: int = Field(0, ge=0)
    grey_noise: int | None = None

    def reason_against(self, truth: Truth, masks: str) -> str:
        """Why the change means nothing for a sequence; empty if it can be made.

        Args:
            truth: The sequence as it is.
            masks: Where the initial masks come from, as in `tracking3d_bench.benchmark.variant.Variant`.
        """
        told = truth.camera is not None and truth.camera_told
        if self.lens == "given" and truth.camera is None:
            return "its lens is unknown"
        if self.lens == "given" and self.focal_scale == 1 and told and truth.given_camera is None:
            return "its lens is given anyway"
        if self.lens == "withheld" and not told:
            return "its lens is not given anyway"
        if (self.box_growth or self.box_shift != (0.0, 0.0)) and (masks != "tracker" or truth.box is None):
            return "it does not start from a box"
        if self.first_frame and self.first_frame + 1 >= len(truth.frames):
            return "it has too few frames"
        if self.first_frame and masks == "tracker" and _first_box(truth, self.first_frame) is None:
            return "the object's box there is unknown"
        return ""

    def apply(self, truth: Truth) -> Truth:
        """The sequence with the change, except for the noise, which is added when frames are read.

        Raises:
            InputError: If the first frame is beyond the end.
        """
        if self.first_frame:
            truth = _start_at(truth, self.first_frame)
        if self.lens == "withheld":
            truth = replace(truth, camera_told=False)
        if self.lens == "given" and truth.camera is not None:
            truth = replace(truth, camera_told=True, given_camera=_scale(truth.camera, self.focal_scale))
        if truth.box is not None and (self.box_growth or self.box_shift != (0.0, 0.0)):
            truth = replace(truth, box=self._change_box(truth.box))
        return truth

    def _change_box(self, box: Box) -> Box:
        x, y, width, height = box
        wider, higher = self.box_growth * width, self.box_growth * height
        right, down = self.box_shift
        return x + right - wider / 2, y + down - higher / 2, width + wider, height + higher


def _scale(camera: Camera, factor: float) -> Camera:
    return replace(camera, fx=camera.fx * factor, fy=camera.fy * factor)


def _start_at(truth: Truth, first: int) -> Truth:
    """The sequence without the frames before ``first``."""
    if first >= len(truth.frames):
        raise InputError(f"{truth.name} has {len(truth.frames)} frames; it cannot start at frame {first}.")

    def later(known: Mapping[int, _Known]) -> dict[int, _Known]:
        return {index - first: one for index, one in known.items() if index >= first}

    points = truth.points
    return replace(
        truth,
        frames=truth.frames[first:],
        box=_first_box(truth, first),
        T_cam_obj=later(truth.T_cam_obj),
        masks=later(truth.masks),
        visible_masks=later(truth.visible_masks),
        boxes=later(truth.boxes),
        depth=later(truth.depth),
        initial_masks=later(truth.initial_masks),
        points=points and PointTruth(points.positions[first:], points.visible[first:]),
    )


def _first_box(truth: Truth, first: int) -> Box | None:
    """The object's box in frame ``first``: of its mask, or of the nearest frame within `_NEAR` whose box is known."""
    if first == 0:
        return truth.box
    for distance in range(_NEAR + 1):
        for index in (first - distance, first + distance):
            if index == 0 and truth.box is not None:
                return truth.box
            mask = truth.visible_masks.get(index, truth.masks.get(index))
            if mask is not None and np.any(found := mask.read()):
                return box_of(found)
            if index in truth.boxes:
                return truth.boxes[index]
    return None
