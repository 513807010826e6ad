"""Poses, lens and surface adjusted together by tracked points, once all frames of a video have been refined.

The final refinement gives a pose to every frame by what is rendered there, through a surface that is a few percent off.
Points that the images follow over many views have no such bias (`tracking3d.points`). Some of the frames, spread over
the video, are bundled; every other one is resected from its neighbours among them, so that memory is bounded.
"""

from __future__ import annotations

import math
from bisect import bisect
from collections.abc import Collection, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation, Slerp

from tracking3d.estimation.estimate import UNALIGNED_MAP, ObjectModel, Status
from tracking3d.estimation.online.features.klt import grey, has_texture, texture_strength
from tracking3d.frames import Image
from tracking3d.geometry.camera import DEFAULT_ORIGIN, LENS_EXCLUDED, LENS_KNOWN, Camera
from tracking3d.points.landmark_adjustment import (
    LandmarkScene,
    LandmarkSupport,
    fit_outlines,
    is_supported,
    refine_scene,
    refine_through,
    resect,
)
from tracking3d.points.view import LANDMARK_WINDOW, cut_window, draw_into_window, open_view
from tracking3d.results.records import FrameRecord
from tracking3d.scene.surface import Drawn
from tracking3d.scene.view import FrameCrop, ObjectView

ROUNDS = (4, 12)
"""Least and most of them. Each brings what is left of an error down by some tenths, not to nothing."""
_DRAWN = 480
"""Views that all rounds draw together, if that allows for more than the least of them."""
_USUAL_VIEWS, _DEGREES_A_VIEW = (24, 48), 5.0
"""Least and most views that are bundled, and the turn between two of them, which share most landmarks then; all that
were kept, if these share too few. The time of a round grows with the square of their number."""
_FRAMES_A_VIEW = 5  # frames of a long video for each view that is bundled
_LEAST_VIEWS = 4
# Degrees that views are apart where the default lens may be excluded (chosen: the photos of the car have 160;
# deviations of views from one side are too small).
_SIDES_APART = 60.0
_Pose = NDArray[np.float64]


class GlobalAdjustment:
    """The frames of the final refinement as they come by, and what they say together.

    Args:
        model: The final object; its surface is what points are on.
        camera: Camera of the full frame.
        answered: Indices of the frames that will come, ascending.
        most: How many of them are kept.

    Attributes:
        camera: The same, with another focal length if none was given and `settle` estimated it.
        vertices: ``(V, 3)`` of the object; others after `settle`.
        vertices_of_landmarks: The same as landmarks alone have it, which know nothing of what masks are wrong by.
        faces: ``(F, 3)``.
    """

    def __init__(self, model: ObjectModel, camera: Camera, answered: Sequence[int], most: int) -> None:
        self.camera, self.vertices = camera, np.asarray(model.vertices, np.float64)
        self.vertices_of_landmarks = self.vertices
        self._frames = len(answered)
        self._lens, self.faces = camera.fx, np.asarray(model.faces, np.int64)
        count = min(most, len(answered))
        at = np.linspace(0, len(answered) - 1, count).round().astype(int) if count else ()
        self._wanted = {answered[index] for index in at}
        self._views: dict[int, tuple[FrameCrop, _Pose]] = {}
        self._strengths: list[float] = []
        self._scene: LandmarkScene | None = None
        self._bundled: list[int] = []
        self._before: dict[int, _Pose] = {}
        self._turn = np.eye(3)

    def wants(self, index: int) -> bool:
        """Whether a frame is one of those that `see` may keep."""
        return index in self._wanted

    def see(self, record: FrameRecord, image: Image, mask: NDArray[np.bool_]) -> None:
        """Keep a frame, if it is one of those that may be bundled and its object was found."""
        if self.wants(record.index) and record.status is not Status.LOST:
            crop = self._cut(record.T_cam_obj, image, mask)
            if crop is not None and crop.mask is not None:
                self._views[record.index] = crop, record.T_cam_obj
                self._strengths.append(texture_strength(crop.image, np.asarray(crop.mask > 127)))

    def settle(self) -> None:
        """Put poses, lens and surface right, as far as the frames say how.

        Corners that are found on a plain surface are shades and edges, which slide over it: what they say of its poses
        is worse than what pixels and outlines said before.
        """
        if len(self._views) < _LEAST_VIEWS or not has_texture(self._strengths):
            self._views = {}
            return
        R_cam_obj = np.stack([self._views[index][1][:3, :3] for index in sorted(self._views)])
        scene = self._refine(max(views_needed(R_cam_obj), self._frames // _FRAMES_A_VIEW))
        if not is_supported(scene) and len(self._bundled) < len(self._views):
            scene = self._refine(len(self._views))  # nearer to one another, views share more landmarks
        self._views = {}
        self.vertices_of_landmarks = scene.vertices
        self._scene = fit_outlines(scene)
        self.vertices = self._scene.vertices
        self._turn = self._common_turn()
        deviation = scene.focal_deviation
        factor = scene.focal_factor
        is_default = math.isclose(factor, self.camera.default_factor)
        if deviation is not None and deviation > LENS_KNOWN and is_default:
            self.camera = self.camera.zoom(factor, DEFAULT_ORIGIN)
        elif factor != 1:
            self.camera = self.camera.with_solved_focal(factor)
        if deviation is not None:
            self.camera = replace(self.camera, focal_deviation=deviation)

    def _refine(self, most: int) -> LandmarkScene:
        """The scene of at most so many views, spread evenly, as their landmarks have it.

        Through a lens that they do not tell, whatever the first map took for the likeliest one, the default is used,
        unless views from sides apart speak against that one.
        """
        there = sorted(self._views)
        at = np.unique(np.linspace(0, len(there) - 1, min(most, len(there))).round().astype(int))
        self._bundled = [there[place] for place in at]
        self._before = {index: self._views[index][1] for index in self._bundled}
        views: list[Drawn | None] = [
            draw_into_window(self._views[index][0], self.camera, T, self.vertices, self.faces)
            for index, T in self._before.items()
        ]
        scene = LandmarkScene(views, self.vertices, self.faces, may_reverse=True)
        rounds = int(np.clip(_DRAWN // len(views), *ROUNDS))
        refined = refine_through(scene, rounds, self.camera)
        deviation, factor = refined.focal_deviation, self.camera.default_factor
        if deviation is None or deviation <= LENS_KNOWN or math.isclose(factor, 1):
            return refined
        R = np.stack([T[:3, :3] for T in self._before.values()])
        turn = np.degrees(np.arccos(np.clip((np.einsum("aij,bij->ab", R, R).min() - 1) / 2, -1, 1)))
        if turn > _SIDES_APART and abs(math.log(factor / refined.focal_factor)) > LENS_EXCLUDED * deviation:
            return refined
        poses = [_through_lens(T, factor) for T in self._before.values()]
        refined = refine_scene(scene.redrawn(self.vertices, dict(enumerate(poses)), factor), rounds)
        return replace(refined, focal_deviation=deviation)

    def pose(
        self, record: FrameRecord, image: Image, mask: NDArray[np.bool_]
    ) -> tuple[_Pose, LandmarkSupport | None]:
        """The pose ``(4, 4)`` of any frame after `settle`, and what landmarks say of it; None if nothing does.

        Args:
            record: Its estimate.
            image: ``(H, W, 3)`` RGB.
            mask: ``(H, W)`` the estimate's.
        """
        scene = self._scene
        if scene is None or not np.isfinite(record.T_cam_obj).all():
            return record.T_cam_obj, None
        after = bisect(self._bundled, record.index)
        around = [at for at in (after - 1, after) if 0 <= at < len(self._bundled)]
        lost = record.status is Status.LOST
        if lost and UNALIGNED_MAP not in record.diagnostics and len(around) == 2:
            return self._between(record.index, *around), None
        nearest = min(around, key=lambda at: abs(self._bundled[at] - record.index))
        kept = scene.views[nearest]
        assert kept is not None
        if self._bundled[nearest] == record.index:
            return kept.T_cam_obj, scene.support.get(nearest)
        # What the nearest frame's pose was moved by in object coordinates: mostly, the object frame itself moved.
        T_before_now = np.linalg.inv(self._as_settled(self._before[self._bundled[nearest]])) @ kept.T_cam_obj
        predicted = self._as_settled(record.T_cam_obj) @ T_before_now
        view = None if lost else self._view(predicted, image, mask)
        if view is None:
            return predicted, None
        T_cam_obj, share = resect(scene, view, around)
        there = [scene.support[at] for at in around if at in scene.support]
        followed = max((one.followed for one in there), default=0)
        return T_cam_obj, LandmarkSupport(followed, round(share * followed))

    def deviation(self, record: FrameRecord, T_cam_obj: _Pose) -> float:
        """Degrees by which `pose` turned a frame against the other frames; infinite if it had no landmarks to do so.

        Args:
            record: The frame's estimate before.
            T_cam_obj: ``(4, 4)`` its pose after.
        """
        if self._scene is None:
            return math.inf
        turned = self._as_settled(record.T_cam_obj)[:3, :3].T @ T_cam_obj[:3, :3]
        return float(np.degrees(Rotation.from_matrix(self._turn.T @ turned).magnitude()))

    def _common_turn(self) -> NDArray[np.float64]:
        """``(3, 3)`` how the object frame was turned: of all bundled frames, the turn that is nearest to the others."""
        assert self._scene is not None
        kept = [view.T_cam_obj for view in self._scene.views if view is not None]
        before = [self._as_settled(self._before[index]) for index in self._bundled]
        turns = np.stack([b[:3, :3].T @ a[:3, :3] for b, a in zip(before, kept, strict=True)])
        cosines = np.clip((np.einsum("nij,mij->nm", turns, turns) - 1) / 2, -1, 1)
        return np.asarray(turns[np.arccos(cosines).sum(1).argmin()])

    def moved(self, model: ObjectModel) -> ObjectModel:
        """The model with the surface that was found."""
        return replace(model, vertices=self.vertices)

    def seen_by(self, view: ObjectView, record: FrameRecord) -> ObjectView:
        """What the texture is taken from, with the pose that its frame has in the end."""
        factor = self.camera.fx / self._lens
        return replace(view, K=view.K @ np.diag([factor, factor, 1.0]), T_cam_obj=record.T_cam_obj)

    def _between(self, index: int, before: int, after: int) -> _Pose:
        """The pose of a frame in which the object was not found: it goes on steadily from one view to the next."""
        kept = [self._scene.views[at] for at in (before, after)] if self._scene else []
        poses = np.stack([view.T_cam_obj for view in kept if view is not None])
        times = self._bundled[before], self._bundled[after]
        T = np.eye(4)
        T[:3, :3] = Slerp(times, Rotation.from_matrix(poses[:, :3, :3]))(index).as_matrix()
        share = (index - times[0]) / (times[1] - times[0])
        T[:3, 3] = (1 - share) * poses[0, :3, 3] + share * poses[1, :3, 3]
        return T

    def _cut(self, T_cam_obj: _Pose, image: Image, mask: NDArray[np.bool_]) -> FrameCrop | None:
        image, mask = self.camera.undistort(image), self.camera.mask_to_pinhole(mask)
        return cut_window(image, mask, self.camera, T_cam_obj, self.vertices, LANDMARK_WINDOW)

    def _view(self, T_cam_obj: _Pose, image: Image, mask: NDArray[np.bool_]) -> Drawn | None:
        crop = self._cut(T_cam_obj, image, mask)
        surface = self.vertices, self.faces
        return None if crop is None else draw_into_window(crop, self.camera, T_cam_obj, *surface)

    def _as_settled(self, T_cam_obj: _Pose) -> _Pose:
        """A pose of before as it is after what was done to all: the way round of depth, and the lens."""
        assert self._scene is not None
        T = T_cam_obj if self._scene.reversal is None else self._scene.reversal.poses(T_cam_obj)
        return _through_lens(T, self._scene.focal_factor)


def views_needed(R_cam_obj: NDArray[np.float64]) -> int:
    """How many views of an object that turns as ``(N, 3, 3)`` in order of time are to be bundled."""
    steps = Rotation.from_matrix(R_cam_obj[1:] @ R_cam_obj[:-1].transpose(0, 2, 1)).magnitude()
    return round(np.clip(np.degrees(steps.sum()) / _DEGREES_A_VIEW, *_USUAL_VIEWS))


def _through_lens(T_cam_obj: _Pose, focal_factor: float) -> _Pose:
    """A pose as seen with another focal length, through which the object has the same size."""
    T = T_cam_obj.copy()
    T[2, 3] *= focal_factor
    return T


# Poses of some frames adjusted to landmarks of frames that keep their refined poses.
#
# `tracking3d.reconstruction.global_adjustment` moves all poses, the lens and the surface together. If most of a video
# was refined before, lens and surface are known, and each other frame is resected from the frames that show the same
# side.

SPREAD, NEAR = 24, 4
"""Frames to resect from: so many spread over the video, and so many before and after the frames that are resected."""
_COMPARED = 4
"""Of them, those that a frame is resected from: the most alike."""


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
        self._views: dict[int, Drawn] = {}
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
        T_cam_obj, share = resect(scene, view, range(len(sources)))
        followed = max(self._shares[index].followed for index in sources)
        return T_cam_obj, LandmarkSupport(followed, round(share * followed))

    def moved(self, model: ObjectModel) -> ObjectModel:
        """The model as it is: its surface was refined before."""
        return model

    def seen_by(self, view: ObjectView, record: FrameRecord) -> ObjectView:
        """What the texture is taken from, with the pose that its frame has in the end."""
        return replace(view, T_cam_obj=record.T_cam_obj)

    def _view(self, T_cam_obj: _Pose, image: Image, mask: NDArray[np.bool_]) -> Drawn | None:
        image, mask = self.camera.undistort(image), self.camera.mask_to_pinhole(mask)
        return open_view(
            image, mask, self.camera, T_cam_obj, self.vertices_of_landmarks, self.faces, LANDMARK_WINDOW
        )
