"""What the reliable frames of a run show of its object, collected in one pass over its video."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from typing import TypeVar

import numpy as np

from tracking3d.estimation.estimate import ObjectModel
from tracking3d.frames import Frame
from tracking3d.geometry.similarity import Similarity
from tracking3d.reconstruction.held_out_test import MOST_LEFT_OUT, is_held_out
from tracking3d.reconstruction.reliable_frames import reliable_frames
from tracking3d.reconstruction.shape import MOST
from tracking3d.reconstruction.shape_views import ShapeView, shape_view, spread_by_rotation
from tracking3d.reconstruction.surface_keypoints import SurfaceKeypoints, shows_other_side, surface_keypoints
from tracking3d.reconstruction.views import TextureView, keep_best_views, texture_view
from tracking3d.results.records import FrameRecord
from tracking3d.results.run_reader import RunReader
from tracking3d.video.source import FrameSource

_View = TypeVar("_View", ShapeView, TextureView)
_NEXT_RUN = 10_000_000  # added to frame indices of another run, so that views of several have different ones


@dataclass(frozen=True, eq=False)
class RunViews:
    """The reliable frames of a run, or of several."""

    shapes: Sequence[ShapeView]  # those that a shape is made from
    left_out: Sequence[ShapeView]  # those that it is judged by
    textures: tuple[TextureView, ...]  # those that a texture is taken from
    keypoints: Sequence[SurfaceKeypoints] = ()  # those that the run is registered by, if that was asked

    def moved(self, similarity: Similarity, number: int) -> RunViews:
        """The same frames with poses of another run's object.

        Args:
            similarity: From this run's object coordinates to the other's.
            number: Which of several runs this is; it makes the frames' indices unique.
        """

        def move(views: Iterable[_View]) -> list[_View]:
            return [
                replace(
                    view,
                    index=view.index + number * _NEXT_RUN,
                    T_cam_obj=similarity.poses(view.T_cam_obj[None])[0],
                )
                for view in views
            ]

        return RunViews(move(self.shapes), move(self.left_out), tuple(move(self.textures)))


def collect_views(
    run: RunReader, source: str | FrameSource | None, most: int, model: ObjectModel | None = None
) -> RunViews:
    """Read the video of a run once more, and keep what its reliable frames show.

    Args:
        run: The run.
        source: Its video, or its path; None for the one that it names.
        most: Frames that a texture is taken from.
        model: The run's object, if keypoints on its surface are wanted.

    Raises:
        InputError: If the run goes on, or the video is another one.
    """
    shapes: list[ShapeView] = []
    left_out: list[ShapeView] = []
    keypoints: list[SurfaceKeypoints] = []
    count = 0
    textures: tuple[TextureView, ...] = ()
    for frame, record in reliable_frames(run, source):
        seen = views_of_frame(run, frame, record)
        if seen is None:
            continue
        textures = keep_best_views(textures, seen[1], most)
        (left_out if is_held_out(count) else shapes).append(seen[0])
        count += 1
        if len(shapes) > 4 * MOST:  # memory does not grow with the video
            shapes = spread_by_rotation(shapes, 0.5, 2 * MOST)
        if len(left_out) > 2 * MOST_LEFT_OUT:
            left_out = spread_by_rotation(left_out, 0.5, MOST_LEFT_OUT)
        if model is not None and shows_other_side(keypoints, np.asarray(record.T_cam_obj)):
            mask, camera = run.visible_pinhole_mask(frame.index), run.camera_of(record)
            keypoints.append(
                surface_keypoints(frame.image, mask, camera, np.asarray(record.T_cam_obj), model)
            )
    return RunViews(shapes, spread_by_rotation(left_out, 0.5, MOST_LEFT_OUT), textures, keypoints)


def views_of_frame(run: RunReader, frame: Frame, record: FrameRecord) -> tuple[ShapeView, TextureView] | None:
    """A frame as shapes and textures are made from it; None if its mask is empty or too small."""
    pose = run.camera_of(record), np.asarray(record.T_cam_obj)
    shape = shape_view(frame.index, frame.image, run.pinhole_mask(frame.index), *pose)
    view = texture_view(frame.index, frame.image, run.visible_pinhole_mask(frame.index), *pose)
    return None if shape is None or view is None else (shape, view)
