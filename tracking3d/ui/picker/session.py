"""A picking session in one video: its frames, the masks of drawings, and the resulting prompts."""

from __future__ import annotations

import base64
import threading
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import Annotated

import cv2
import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict, Field

from tracking3d.config.loading import MODELS, QUALITIES
from tracking3d.config.models import AUTO, PipelineConfig
from tracking3d.errors import InputError
from tracking3d.frames import Box, Frame, Image
from tracking3d.plugins import FEATURES, TRACKERS, build_plugin, list_plugins
from tracking3d.trackers.crops import clip_box
from tracking3d.trackers.first_mask import mask_in_box
from tracking3d.trackers.mask_from_points import mask_from_points
from tracking3d.trackers.prompts.prompt import make_prompt
from tracking3d.trackers.protocol import MaskTracker
from tracking3d.ui.picker.drawing import Drawing, DrawnObject
from tracking3d.video.any_frame import FrameImages

_VEIL = 110  # of 255: how much a mask hides of the frame


@dataclass(frozen=True, eq=False)
class Picked:
    """What was picked."""

    frame: int  # index of the frame that it was picked in, which the run begins with
    objects: tuple[DrawnObject, ...]  # what was drawn
    # one (x, y, width, height) for each object, if boxes are enough, else none
    boxes: list[Box] = field(default_factory=list)
    # one (H, W) bool for each object, if they are not, else none
    masks: list[NDArray[np.bool_]] = field(default_factory=list)
    config: PipelineConfig | None = None  # the settings that were chosen on the page; None if it offers none


class PickingSession:
    """What the page asks for, without the network.

    Args:
        source: What messages call the video.
        images: Its frames.
        frames: Indices of the frames that can be picked in.
        config: With the tracker that makes the masks.
        menu: The settings that can be chosen; None if they are fixed.

    Raises:
        InputError: If the first frame cannot be read.
    """

    def __init__(
        self,
        source: str,
        images: FrameImages,
        frames: range,
        config: PipelineConfig,
        menu: SettingsMenu | None = None,
    ) -> None:
        self.source, self.frames, self.config, self.menu = source, frames, config, menu
        self._images = images
        self._busy = threading.Lock()
        first = images.image(frames.start)
        if first is None:
            raise InputError(f"The first frame of {source} cannot be read; start with another frame.")
        self.height, self.width = first.shape[:2]

    def picture(self, index: int) -> bytes | None:
        """A frame as JPEG; None if there is none."""
        if index not in self.frames:
            return None
        image = self._images.image(index)
        if image is None:
            return None
        return cv2.imencode(".jpg", cv2.cvtColor(image, cv2.COLOR_RGB2BGR), [cv2.IMWRITE_JPEG_QUALITY, 88])[
            1
        ].tobytes()

    def choose(self, chosen: ChosenSettings) -> None:
        """Continue with other settings; the present ones stay if these cannot be used.

        Raises:
            Tracking3dError: If they cannot be.
        """
        if self.menu is None:
            raise InputError("The settings of this run are fixed.")
        config = self.menu.configure(chosen)
        with self._busy:
            self.config, self.menu = config, replace(self.menu, chosen=chosen)

    def mask(self, drawn: DrawnObject, present: NDArray[np.bool_] | None = None) -> NDArray[np.bool_]:
        """The mask ``(H, W)`` that the tracker makes of what was drawn.

        Args:
            drawn: Box, points and paint.
            present: ``(H, W)`` the mask that paint alone changes, see `drawn_mask`.

        Raises:
            InputError: If nothing can be made of it.
            PluginError: If the tracker fails.
        """
        frame = self._frame(drawn.frame)
        with self._busy:  # a tracker takes all that the machine has
            given = drawn_mask(frame.image, drawn, present)
            if given is None and drawn.box is None:
                raise InputError("No object is marked yet.")
            prompt = make_prompt(frame, drawn.box if given is None else None, given)
            tracker: MaskTracker = build_plugin(TRACKERS, self.config.tracker)
            mask = tracker.init(frame, prompt).binary
        if mask is None or not mask.any():
            raise InputError("The tracker finds no object there; mark it differently.")
        return mask

    def veil(self, mask: NDArray[np.bool_], colour: str) -> str:
        """A mask as a PNG to lay over the frame, as a data URL."""
        layer = np.zeros((*mask.shape, 4), np.uint8)
        red, green, blue = (int(colour[start : start + 2], 16) for start in (1, 3, 5))
        layer[mask] = (blue, green, red, _VEIL)
        outline, _ = cv2.findContours(mask.astype(np.uint8), cv2.RETR_LIST, cv2.CHAIN_APPROX_NONE)
        cv2.drawContours(layer, outline, -1, (blue, green, red, 255), max(round(mask.shape[1] / 640), 1))
        return "data:image/png;base64," + base64.b64encode(cv2.imencode(".png", layer)[1].tobytes()).decode()

    def picked(self, drawing: Drawing) -> Picked:
        """The prompts that the run starts with.

        Raises:
            InputError: If the objects are not of one frame, or one cannot be used.
        """
        frames = sorted({one.frame for one in drawing.objects})
        if len(frames) > 1:
            drawn_on = " and ".join(str(index) for index in frames)
            raise InputError(f"The objects are drawn on frames {drawn_on}; draw all of them on one frame.")
        if len(drawing.objects) > 1 and self.config.tracker.name == "precomputed":
            raise InputError("The tracker precomputed has masks of one object; pick one object.")
        frame, chosen = self._frame(frames[0]), self.config if self.menu else None
        if all(one.only_a_box for one in drawing.objects):
            boxes = [one.box for one in drawing.objects if one.box is not None]
            given = [make_prompt(frame, box).box for box in boxes]
            return Picked(frame.index, drawing.objects, given, config=chosen)
        masks = [self.mask(one) for one in drawing.objects]
        return Picked(frame.index, drawing.objects, masks=masks, config=chosen)

    def _frame(self, index: int) -> Frame:
        image = self._images.image(index) if index in self.frames else None
        if image is None:
            raise InputError(f"Frame {index} cannot be read; choose another frame.")
        return Frame(index, image, name=f"frame {index}")


_SIZE = 320  # longer side in pixels at which colours are compared
_SEED = 0.012  # radius around a point that is certain, as a share of the longer side
_LEAST_CONTRAST = 2.0


def drawn_mask(
    image: Image, drawn: DrawnObject, present: NDArray[np.bool_] | None = None
) -> NDArray[np.bool_] | None:
    """The mask ``(H, W)`` of what was drawn; None if nothing was, or only a box, which a tracker takes as it is.

    Points alone make the mask that they make as a prompt (`mask_from_points`); in a box they decide by colour (GrabCut,
    Rother et al. 2004, with the points as what is known). Paint is what it says.

    Args:
        image: ``(H, W, 3)`` uint8 RGB.
        drawn: Box, points and strokes in pixels of the image.
        present: ``(H, W)`` the mask that paint alone changes; a box or points replace it. None starts from nothing.
    """
    if drawn.only_a_box:
        return None
    mask = np.zeros(image.shape[:2], np.uint8)
    if drawn.points and drawn.box is not None:
        mask = _in_box(image, drawn, drawn.box)
    elif drawn.points:
        mask = _of_points(image, drawn)
    elif drawn.box is not None:
        mask = (mask_in_box(image, drawn.box) >= 0.5).astype(np.uint8)
    elif present is not None:
        mask = present.astype(np.uint8)
    for stroke in drawn.strokes:
        path = np.array(stroke.path).round().astype(np.int32)
        radius, value = max(round(stroke.radius), 1), int(stroke.on)
        cv2.polylines(mask, [path], False, value, min(2 * radius, 32767))
        for end in (path[0], path[-1]):
            cv2.circle(mask, (int(end[0]), int(end[1])), radius, value, -1)
    return mask.astype(bool) if mask.any() else None


def _of_points(image: Image, drawn: DrawnObject) -> NDArray[np.uint8]:
    """The object by points alone, of those inside the image; nothing if none of them is on it."""
    height, width = image.shape[:2]
    points = [
        (one.x, one.y, one.on) for one in drawn.points if 0 <= one.x <= width - 1 and 0 <= one.y <= height - 1
    ]
    if not any(on for _, _, on in points):
        return np.zeros((height, width), np.uint8)
    return (mask_from_points(image, np.array(points, np.float32)) >= 0.5).astype(np.uint8)


def _in_box(image: Image, drawn: DrawnObject, box: Box) -> NDArray[np.uint8]:
    """The object in a box, by points on it and on the background."""
    height, width = image.shape[:2]
    scale = _SIZE / max(height, width)
    small = cv2.resize(
        image, (max(round(width * scale), 8), max(round(height * scale), 8)), interpolation=cv2.INTER_AREA
    )
    on = [(point.x * scale, point.y * scale) for point in drawn.points if point.on]
    off = [(point.x * scale, point.y * scale) for point in drawn.points if not point.on]
    labels = np.full(small.shape[:2], cv2.GC_BGD, np.uint8)
    inside = clip_box((box[0] * scale, box[1] * scale, box[2] * scale, box[3] * scale), small.shape)
    if inside is None:
        return np.zeros((height, width), np.uint8)
    left, top, across, down = (round(side) for side in inside)
    labels[top : top + down, left : left + across] = cv2.GC_PR_FGD
    radius = max(round(_SEED * _SIZE), 2)
    for points, label in ((on, cv2.GC_FGD), (off, cv2.GC_BGD)):
        for x, y in points:
            cv2.circle(labels, (round(x), round(y)), radius, int(label), -1)
    if small.std(axis=(0, 1)).max() >= _LEAST_CONTRAST and (labels == cv2.GC_BGD).any():
        cv2.setRNGSeed(0)
        cv2.grabCut(cv2.GaussianBlur(small, (3, 3), 0), labels, None, None, None, 4, cv2.GC_INIT_WITH_MASK)
    found = ((labels == cv2.GC_FGD) | (labels == cv2.GC_PR_FGD)).astype(np.uint8)
    found = _touching(found, on) if on else found
    full = cv2.resize(found.astype(np.float32), (width, height), interpolation=cv2.INTER_LINEAR)
    return (full >= 0.5).astype(np.uint8)


def _touching(found: NDArray[np.uint8], on: list[tuple[float, float]]) -> NDArray[np.uint8]:
    """The parts of a mask that a point is on."""
    _, parts = cv2.connectedComponents(found)
    height, width = found.shape
    kept = {parts[min(max(round(y), 0), height - 1), min(max(round(x), 0), width - 1)] for x, y in on} - {0}
    return np.isin(parts, list(kept)).astype(np.uint8)


TRACKER_FOR = {
    "segment": "an object in a hand, a vehicle, most real videos; the default where no network was downloaded",
    "auto": "the best masks, by networks that `tracking3d models get recommended` downloads (7 MB); the default from "
    "then on",
    "flow": "an object on a turntable, or one that moves by itself, with nothing that moves along",
    "csrt": "an object that looks like its background, if other masks spread over it",
    "precomputed": "masks of all frames that another program has made (`--masks`)",
}
"""What each mask tracker is for; the documentation has the same table."""
_NEEDS_FILES = "precomputed"
"""The tracker whose masks lie in a folder, which a page cannot choose."""

Word = Annotated[str, Field(min_length=1, max_length=80)]
Pixels = Annotated[float, Field(allow_inf_nan=False)]


class ChosenSettings(BaseModel):
    """What was chosen; None stands for what is below it: quality, preset and configuration file."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    tracker: Word | None = None  # name of the mask tracker, as --tracker takes it
    quality: Word | None = None  # as --quality takes it
    model: Word | None = None  # the final mesh, as --model takes it
    features: Word | None = None  # name of the feature encoder, as --features takes it
    fov: Pixels | None = None  # vertical field of view in degrees, as --fov takes it
    # (fx, fy, cx, cy) in pixels, as --intrinsics takes them
    intrinsics: tuple[Pixels, Pixels, Pixels, Pixels] | None = None


@dataclass(frozen=True)
class SettingsMenu:
    """The settings that can be chosen on the page."""

    chosen: ChosenSettings  # those that are chosen at first
    # makes the configuration of a run from them; raises a `Tracking3dError` if it cannot
    configure: Callable[[ChosenSettings], PipelineConfig]


def setting_choices(config: PipelineConfig) -> dict[str, list[str]]:
    """The words that each setting can have: those of the command line, and installed plug-ins that work.

    Args:
        config: The configuration at first, whose plug-ins are always among them.
    """
    usable = [plugin for plugin in list_plugins() if plugin.status == "ok"]
    trackers = [one.name for one in usable if one.group == TRACKERS and one.name != _NEEDS_FILES]
    features = [one.name for one in usable if one.group == FEATURES]
    return {
        "tracker": list(dict.fromkeys([AUTO, config.tracker.name, *trackers])),
        "quality": list(QUALITIES),
        "model": list(MODELS),
        "features": list(dict.fromkeys([config.features.name, *features])),
    }


def tracker_lines() -> dict[str, str]:
    """What each mask tracker is for; of further ones, where they come from."""
    further = {one.name: f"from {one.package}" for one in list_plugins() if one.group == TRACKERS}
    return further | {"onnx": "networks that you name"} | TRACKER_FOR


def settings_in_words(config: PipelineConfig) -> dict[str, str]:
    """What a configuration comes to, for the settings that were not chosen."""
    shape = config.object
    textured = shape.texture_views and config.solver.final_refine
    return {
        "tracker": config.tracker.name,
        "model": shape.shape if textured or shape.shape == "fine" else "none",
        "features": config.features.name,
    }
