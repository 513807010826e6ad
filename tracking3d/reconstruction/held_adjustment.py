"""Poses of some frames adjusted to landmarks of frames that keep their refined poses.

`tracking3d.reconstruction.global_adjustment` moves all poses, the lens and the surface together. If most of a video was
refined before, lens and surface are known, and each other frame is resected from the frames that show the same side.
"""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from tracking3d.estimation.estimate import ObjectModel, Status
from tracking3d.estimation.online.features.klt import grey
from tracking3d.estimation.online.features.texture_strength import has_texture, texture_strength
from tracking3d.frames import Image
from tracking3d.geometry.camera import Camera
from tracking3d.points.landmark_adjustment import LandmarkScene, LandmarkSupport
from tracking3d.points.resection import resect
from tracking3d.points.view import LANDMARK_WINDOW, SurfaceView, open_view
from tracking3d.reconstruction.views import TextureView
from tracking3d.results.records import FrameRecord

SPREAD, NEAR = 24, 4
"""Frames to resect from: so many spread over the video, and so many before and after the frames that are resected."""
_COMPARED = 4
"""Of them, those that a frame is resected from: the most alike."""
_Pose = NDArray[np.float64]


class HeldAdjustment:
    """The frames of a refinement of which only some are new; see `GlobalAdjustment` for the methods.

    Args:
        model: The object, with the surface of the earlier refinement.
        camera: Its camera.
        kept: Indices of the frames whose estimates stand, ascending.
        changed: Indices of the others, ascending.

    Attributes:
        camera: As given.
        vertices_of_landmarks: ``(V, 3)`` the surface.
        faces: ``(F, 3)``.
    """

    def __init__(
        self, model: ObjectModel, camera: Camera, kept: Sequence[int], changed: Collection[int]
    ) -> None:
        self.camera, self._changed = camera, frozenset(changed)
        self.vertices_of_landmarks = np.asarray(model.vertices, np.float64)
        self.faces = np.asarray(model.faces, np.int64)
        places = np.linspace(0, len(kept) - 1, min(SPREAD, len(kept))).round().astype(int)
        self._wanted = {kept[place] for place in places}
        for index in changed:
            self._wanted.update([one for one in kept if one < index][-NEAR:])
            self._wanted.update([one for one in kept if one > index][:NEAR])
        self._views: dict[int, SurfaceView] = {}
        self._shares: dict[int, LandmarkSupport] = {}
        self._strengths: list[float] = []

    def wants(self, index: int) -> bool:
        """Whether a frame is one of those that others are resected from."""
        return index in self._wanted

    def see(self, record: FrameRecord, image: Image, mask: NDArray[np.bool_]) -> None:
        """Keep a frame, if it is one of those and its object was found."""
        if not self.wants(record.index) or record.status is Status.LOST:
            return
        view = self._view(record.T_cam_obj, image, mask)
        if view is not None:
            self._views[record.index] = view
            self._strengths.append(texture_strength(grey(image), mask))
            followed, agreeing = (
                int(record.diagnostics.get(name, 0)) for name in ("landmark_matches", "landmark_inliers")
            )
            self._shares[record.index] = LandmarkSupport(followed, agreeing)

    def settle(self) -> None:
        """All frames were seen; nothing is moved."""

    def pose(
        self, record: FrameRecord, image: Image, mask: NDArray[np.bool_]
    ) -> tuple[_Pose, LandmarkSupport | None]:
        """The pose ``(4, 4)`` of a frame, and what landmarks say of it; a frame whose estimate stands keeps it.

        So do all frames of a plain object, see `GlobalAdjustment.settle`.
        """
        if not self._views or not has_texture(self._strengths):
            return record.T_cam_obj, None
        if record.index not in self._changed or record.status is Status.LOST:
            return record.T_cam_obj, None
        view = self._view(record.T_cam_obj, image, mask)
        if view is None:
            return record.T_cam_obj, None
        R = record.T_cam_obj[:3, :3]
        alike = sorted(self._views, key=lambda one: -float(np.sum(self._views[one].T_cam_obj[:3, :3] * R)))
        sources = alike[:_COMPARED]
        scene = LandmarkScene(
            [self._views[index] for index in sources], self.vertices_of_landmarks, self.faces
        )
        resected, share = resect(scene, view, range(len(sources)))
        followed = max(self._shares[index].followed for index in sources)
        return resected.T_cam_obj, LandmarkSupport(followed, round(share * followed))

    def moved(self, model: ObjectModel) -> ObjectModel:
        """The model as it is: its surface was refined before."""
        return model

    def seen_by(self, view: TextureView, record: FrameRecord) -> TextureView:
        """What the texture is taken from, with the pose that its frame has in the end."""
        return replace(view, T_cam_obj=record.T_cam_obj)

    def _view(self, T_cam_obj: _Pose, image: Image, mask: NDArray[np.bool_]) -> SurfaceView | None:
        image, mask = self.camera.undistort(image), self.camera.mask_to_pinhole(mask)
        return open_view(
            image, mask, self.camera, T_cam_obj, self.vertices_of_landmarks, self.faces, LANDMARK_WINDOW
        )
