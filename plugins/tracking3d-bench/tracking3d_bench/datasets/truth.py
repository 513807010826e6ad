"""Ground truth of one rigid object in one clip, from any layout.

OpenCV camera axes; ``x_cam = R x_obj + t``; pixel (0, 0) is the centre of the top-left pixel. Everything but
the frames may be absent, and may be known in some frames only.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Protocol

import cv2
import numpy as np
from numpy.typing import NDArray

from tracking3d.errors import InputError
from tracking3d.frames import Box
from tracking3d.geometry.camera import Camera
from tracking3d.results.files import read_mask
from tracking3d.trackers.crops import clip_box
from tracking3d.video.image_file import read_image

if TYPE_CHECKING:
    import trimesh


class MaskReference(Protocol):
    """A mask that is read when it is asked for."""

    def read(self) -> NDArray[np.bool_]:
        """The mask, ``(H, W)``.

        Raises:
            InputError: If it cannot be read; names the file.
        """
        ...


@dataclass(frozen=True)
class MaskFile:
    """A grey image; brighter than half is the object."""

    path: Path

    def read(self) -> NDArray[np.bool_]:
        """See `MaskReference.read`."""
        mask = read_mask(self.path)
        if mask is None:
            raise InputError(f"The mask {self.path} is not a readable image; restore or remove it.")
        return mask


@dataclass(frozen=True)
class DepthFile:
    """A 16-bit image of the depth along the camera's z axis; 0 is unknown.

    Attributes:
        path: The image.
        scale: Length of one count in the unit of the poses.
    """

    path: Path
    scale: float

    def read(self) -> NDArray[np.float64]:
        """The depth ``(H, W)`` in the unit of the poses; 0 where it is unknown.

        Raises:
            InputError: If it is not a readable 16-bit image.
        """
        try:  # by its bytes: OpenCV ends the process if a path is not UTF-8
            image = cv2.imdecode(np.fromfile(self.path, np.uint8), cv2.IMREAD_UNCHANGED)
        except (OSError, cv2.error):  # missing, or empty
            image = None
        if image is None or image.dtype != np.uint16 or image.ndim != 2:
            raise InputError(
                f"The depth {self.path} is not a readable 16-bit grey image; restore or remove it."
            )
        return image.astype(np.float64) * self.scale


@dataclass(frozen=True, eq=False)
class PointTruth:
    """N surface points in T frames.

    Attributes:
        positions: ``(T, N, 2)`` pixels x and y, known where hidden too; NaN where the point is behind the camera.
        visible: ``(T, N)`` bool.
    """

    positions: NDArray[np.float64]
    visible: NDArray[np.bool_]


@dataclass(frozen=True, eq=False)
class MeshFile:
    """The true shape.

    Attributes:
        path: Any file that trimesh reads.
        scale: Length of the file's unit in the unit of the poses.
    """

    path: Path
    scale: float = 1.0

    def read(self) -> trimesh.Trimesh:
        """The mesh in object coordinates and the unit of the poses.

        Raises:
            InputError: If it is not a readable mesh.
        """
        from tracking3d.geometry.gltf_axes import read_mesh_file
        from tracking3d.geometry.mesh_checks import what_is_wrong

        try:
            mesh = read_mesh_file(self.path)
        except Exception as error:  # every format has errors of its own
            raise InputError(
                f"The mesh {self.path} cannot be read ({error}); restore or remove it."
            ) from error
        if wrong := what_is_wrong(mesh):
            raise InputError(f"The mesh {self.path} {wrong}; restore or remove it.")
        return mesh.apply_scale(self.scale)


@dataclass(frozen=True, eq=False)
class Truth:
    """What is known about a clip. A frame's position in `frames` is its index in all that follows and in a run.

    Attributes:
        name: What tables call it.
        frames: The images in order.
        box: The object in frame 0 as ``(x, y, width, height)``, where a tracker starts from one.
        camera: Camera of all frames, if known.
        given_camera: The camera given to a tracker, if it is not the true one.
        camera_told: Whether a tracker is given a camera.
        T_cam_obj: ``(4, 4)`` pose by frame index; only those that are known and trusted. The rotation or the
            translation is NaN if only the other is known.
        masks: The object's mask by frame index, the part behind other things included if the data know it; else those
            of `visible_masks`.
        visible_masks: Only the part that is seen, where it is known.
        boxes: The object's box by frame index if it has no mask.
        depth: By frame index.
        mesh: The true shape in object coordinates.
        points: Surface points and where they are seen.
        initial_masks: Rough masks that come with the clip, by frame index; a tracker's input.
        millimetres: Length of the unit of the poses in millimetres, if known.
        symmetries: ``(S, 4, 4)`` object transforms that leave the object as it is, the identity among them.
        symmetry_axis: ``(3,)`` unit direction in object coordinates: turned about it by any angle, the object is as
            it was. None without such an axis.
    """

    name: str
    frames: tuple[Path, ...]
    box: Box | None = None
    camera: Camera | None = None
    given_camera: Camera | None = None
    camera_told: bool = True
    T_cam_obj: Mapping[int, NDArray[np.float64]] = field(default_factory=dict)
    masks: Mapping[int, MaskReference] = field(default_factory=dict)
    visible_masks: Mapping[int, MaskReference] = field(default_factory=dict)
    boxes: Mapping[int, Box] = field(default_factory=dict)
    depth: Mapping[int, DepthFile] = field(default_factory=dict)
    mesh: MeshFile | None = None
    points: PointTruth | None = None
    initial_masks: Mapping[int, MaskReference] = field(default_factory=dict)
    millimetres: float | None = None
    symmetries: NDArray[np.float64] = field(default_factory=lambda: np.eye(4)[None])
    symmetry_axis: NDArray[np.float64] | None = None

    def is_visible_part(self, index: int) -> bool:
        """Whether the mask of frame ``index`` leaves out what is hidden, since the data know no other."""
        return index in self.masks and self.masks[index] is self.visible_masks.get(index)

    @cached_property
    def names(self) -> tuple[str, ...]:
        """The frames' names without suffix."""
        return tuple(path.stem for path in self.frames)

    def box_in_frame(self) -> Box | None:
        """The part of `box` inside frame 0, which is what a tracker starts from.

        Data sets often give the box of the whole object, also if a part of it is beyond the edge of the frame.

        Raises:
            InputError: Frame 0 cannot be read.
        """
        return self.box and (clip_box(self.box, read_image(self.frames[0]).shape) or self.box)
