"""What the node does, without ROS: pictures, a lens and a box go in, answers in metres come out."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from tracking3d import Frame, FrameEstimate, ObjectModel, Session, Status, load_config
from tracking3d.errors import InputError, Tracking3dError
from tracking3d.results.run_unit import visible_side
from tracking3d.trackers.prompts.prompt import make_prompt

CHANNELS = {"rgb8": (0, 1, 2), "bgr8": (2, 1, 0), "rgba8": (0, 1, 2), "bgra8": (2, 1, 0), "mono8": (0, 0, 0)}
"""Encodings of pictures: which of a pixel's bytes are red, green and blue."""

Lens = tuple[float, float, float, float]
Box = tuple[float, float, float, float]


class Tracking(Protocol):
    """What of a `tracking3d.Session` is used here."""

    def step(self, frame: Frame) -> FrameEstimate:
        """Answer the next frame."""
        ...

    def result(self) -> ObjectModel:
        """The object as far as it is known."""
        ...


@dataclass(frozen=True, eq=False)
class Mesh:
    """Triangles of the object in its own axes.

    Attributes:
        corners: ``(3 F, 3)`` metres, three for each face.
        colours: ``(3 F, 3)`` from 0 to 1.
    """

    corners: NDArray[np.float64]
    colours: NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Answer:
    """What is published of one picture.

    Attributes:
        position: Metres, in the camera's optical axes; None where the object is not tracked.
        quaternion: x, y, z, w; None where it is not.
        mask: ``(H, W)`` uint8, 255 on the object; None where there was no object to look for.
        mesh: The object, now and then.
        level: 0 well, 1 to be doubted, 2 lost or refused, as diagnostics count.
        message: In words.
        values: More to show, by name.
    """

    level: int
    message: str
    position: NDArray[np.float64] | None = None
    quaternion: NDArray[np.float64] | None = None
    mask: NDArray[np.uint8] | None = None
    mesh: Mesh | None = None
    values: dict[str, str] = field(default_factory=dict)


class ObjectTracking:
    """An object in a stream of pictures; failures are answers, so that the stream goes on.

    Args:
        box: The object in the first picture; None waits for `region`.
        object_size: Longest side in metres; 0 leaves the tracker's unit.
        mesh_every: Pictures between two meshes; 0 for none.
        quality: Of `load_config`; None for the default.
        begin: Makes what tracks, of the first frame, the box and the lens.
    """

    def __init__(
        self,
        box: Box | None = None,
        object_size: float = 0.0,
        mesh_every: int = 30,
        quality: str | None = None,
        begin: Callable[[Frame, Box, Lens], Tracking] | None = None,
    ) -> None:
        if not (0 <= object_size < 1000 and mesh_every >= 0):
            raise InputError("object_size is metres from 0 on, and mesh_every a number of images from 0 on.")
        self._box = box
        self._object_size, self._mesh_every = object_size, mesh_every
        self._begin = begin or (lambda frame, box, lens: _session(frame, box, lens, quality))
        self._lens: Lens | None = None
        self._tracking: Tracking | None = None
        self._metres = 0.0
        self._index = self._last_mesh = 0

    def lens(self, p: Sequence[float], k: Sequence[float]) -> None:
        """Take the lens of a ``CameraInfo``: the projection ``p`` (12), or ``k`` (9) where that is empty."""
        fx, cx, fy, cy = (p[0], p[2], p[5], p[6]) if len(p) == 12 and p[0] > 0 else (k[0], k[2], k[4], k[5])
        if fx > 0 and fy > 0:
            self._lens = float(fx), float(fy), float(cx), float(cy)

    def region(self, box: Box) -> None:
        """Begin anew with the object in the next picture."""
        self._box, self._tracking = box, None

    def picture(self, image: NDArray[np.uint8], stamp: float | None = None) -> Answer:
        """Answer a picture.

        Args:
            image: ``(H, W, 3)`` RGB.
            stamp: Seconds.
        """
        if self._lens is None:
            return Answer(1, "waiting for the lens: no camera_info has come")
        if self._tracking is None and self._box is None:
            return Answer(1, "waiting for the object: set the parameter box or publish a region")
        began = time.monotonic()
        try:
            frame = Frame(self._index, image, stamp)
            if self._tracking is None:
                self._start(frame)
            assert self._tracking is not None
            estimate = self._tracking.step(frame)
            answer = self._answered(estimate, self._tracking)
        except Tracking3dError as error:
            self._tracking = self._box = None
            return Answer(2, str(error))
        self._index += 1
        answer.values["seconds"] = f"{time.monotonic() - began:.3f}"
        return answer

    def _start(self, frame: Frame) -> None:
        assert self._box is not None and self._lens is not None
        self._tracking = self._begin(frame, self._box, self._lens)
        self._metres, self._last_mesh = (0.0 if self._object_size else 1.0), self._index

    def _answered(self, estimate: FrameEstimate, tracking: Tracking) -> Answer:
        mask = estimate.mask.astype(np.uint8) * 255
        values = {"status": str(estimate.status), "confidence": f"{estimate.confidence:.3f}"}
        if estimate.status != Status.TRACKED:
            level = 2 if estimate.status == Status.LOST else 1
            return Answer(level, estimate.reason or str(estimate.status), mask=mask, values=values)
        due = self._mesh_every > 0 and estimate.index - self._last_mesh >= self._mesh_every
        mesh = None
        if self._metres == 0 or due:
            model = tracking.result()
            if self._object_size:
                self._metres = self._object_size / visible_side(model)
            if due:
                mesh, self._last_mesh = triangles(model, self._metres), estimate.index
        quaternion = Rotation.from_matrix(estimate.T_cam_obj[:3, :3]).as_quat()
        position = estimate.T_cam_obj[:3, 3] * self._metres
        return Answer(0, "tracked", position, quaternion, mask, mesh, values)


def _session(frame: Frame, box: Box, lens: Lens, quality: str | None) -> Session:
    settings: dict[str, Any] = {} if quality is None else {"quality": quality}
    return Session(load_config(camera={"intrinsics": lens}, **settings), make_prompt(frame, box=box))


def triangles(model: ObjectModel, metres: float) -> Mesh:
    """A mesh as loose triangles with a colour at each corner."""
    height, width = model.texture.shape[:2]
    columns = (model.face_uvs[..., 0] * width).astype(int) % width
    rows = (model.face_uvs[..., 1] * height).astype(int).clip(0, height - 1)
    return Mesh(
        (model.vertices[model.faces] * metres).reshape(-1, 3),
        model.texture[rows, columns].reshape(-1, 3) / 255,
    )


def rgb_of(data: bytes, height: int, width: int, step: int, encoding: str) -> NDArray[np.uint8]:
    """The picture of a ``sensor_msgs/Image``, ``(H, W, 3)`` RGB.

    Raises:
        InputError: If its encoding is not known here, or there are too few bytes.
    """
    if encoding not in CHANNELS:
        raise InputError(f"Images of the encoding {encoding} are not known; publish {', '.join(CHANNELS)}.")
    size = 1 if encoding == "mono8" else 4 if "a" in encoding else 3
    if step < width * size or len(data) < step * height:
        raise InputError(f"An image of {width} x {height} pixels has {len(data)} bytes, which is too few.")
    rows = np.frombuffer(data, np.uint8, step * height).reshape(height, step)
    pixels = rows[:, : width * size].reshape(height, width, size)
    return np.ascontiguousarray(pixels[..., CHANNELS[encoding]])
