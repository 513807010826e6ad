"""What the reliable frames of a run show of its object, collected in one pass over its video."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np
import torch
from numpy.typing import NDArray

from tracking3d.errors import InputError
from tracking3d.estimation.estimate import ObjectModel, Status
from tracking3d.estimation.online.features.sift import Keypoints, detect
from tracking3d.frames import Frame, pixels
from tracking3d.geometry.similarity import Similarity
from tracking3d.reconstruction.held_out_test import MOST_LEFT_OUT, is_held_out
from tracking3d.reconstruction.shape import MOST
from tracking3d.reconstruction.views import keep_best_views, shape_view, spread_by_rotation, texture_view
from tracking3d.rendering.renderer import project
from tracking3d.rendering.visibility import rasterize
from tracking3d.results.checkpoint.progress import checksum
from tracking3d.results.records import FrameRecord
from tracking3d.results.run_reader import RunReader
from tracking3d.runtime.progress import report_each
from tracking3d.scene.surface import camera_tensors
from tracking3d.scene.view import Mask, ObjectView
from tracking3d.trackers.crops import box_of
from tracking3d.video.opening import open_source
from tracking3d.video.source import FrameSource

_APART = 8.0  # degrees between frames
_MOST = 60  # frames
_MARGIN = 3  # pixels that keypoints stay away from the outline, where the surface is steep


@dataclass(frozen=True, eq=False)
class SurfaceKeypoints:
    """Keypoints of one frame."""

    keypoints: Keypoints  # the N keypoints; pixels are the frame's
    points: NDArray[np.float64]  # (N, 3) in object coordinates
    P: NDArray[np.float64]  # (3, 4) from object coordinates to pixels of the frame, times the depth
    T_cam_obj: NDArray[np.float64]  # (4, 4)
    length: float  # longer side of the object in the frame, pixels


def shows_other_side(kept: Sequence[SurfaceKeypoints], T_cam_obj: NDArray[np.float64]) -> bool:
    """Whether a frame with a pose ``(4, 4)`` shows something that the frames at hand do not."""
    if len(kept) >= _MOST:
        return False
    traces = [np.trace(one.T_cam_obj[:3, :3].T @ T_cam_obj[:3, :3]) for one in kept]
    return max(traces, default=-1.0) < 1 + 2 * np.cos(np.radians(_APART))


def surface_keypoints(frame: ObjectView, model: ObjectModel) -> SurfaceKeypoints:
    """Detect keypoints on the object in a whole frame, where its surface is known and its mask shows it."""
    height, width = frame.frame_size
    screen, z = project(torch.from_numpy(model.vertices).float(), *camera_tensors(frame))
    depth = rasterize(screen, z, torch.from_numpy(model.faces), (height, width)).depth[0].numpy()
    kernel = np.ones((2 * _MARGIN + 1,) * 2, np.uint8)
    region = cv2.erode((frame.mask & np.isfinite(depth)).astype(np.uint8), kernel) > 0
    box = box_of(frame.mask)
    length = float(max(box[2:])) if box is not None else 1.0
    found = detect(frame.grey, region, length)
    column, row = np.rint(found.pixel).astype(int).T if len(found) else np.zeros((2, 0), int)
    there = depth[row.clip(0, height - 1), column.clip(0, width - 1)].astype(np.float64)
    rays = np.column_stack([found.pixel, np.ones(len(found))]) @ np.linalg.inv(frame.K).T
    known = np.isfinite(there)
    camera_points = rays[known] * there[known, None]
    points = (camera_points - frame.T_cam_obj[:3, 3]) @ frame.T_cam_obj[:3, :3]
    kept = replace(found, pixel=found.pixel[known], descriptor=found.descriptor[known])
    return SurfaceKeypoints(kept, points, frame.P, frame.T_cam_obj, length)


_NEXT_RUN = 10_000_000  # added to frame indices of another run, so that views of several have different ones


@dataclass(frozen=True, eq=False)
class RunViews:
    """The reliable frames of a run, or of several."""

    shapes: Sequence[ObjectView]  # those that a shape is made from
    left_out: Sequence[ObjectView]  # those that it is judged by
    textures: tuple[ObjectView, ...]  # those that a texture is taken from
    keypoints: Sequence[SurfaceKeypoints] = ()  # those that the run is registered by, if that was asked

    def moved(self, similarity: Similarity, number: int) -> RunViews:
        """The same frames with poses of another run's object.

        Args:
            similarity: From this run's object coordinates to the other's.
            number: Which of several runs this is; it makes the frames' indices unique.
        """

        def move(views: Iterable[ObjectView]) -> list[ObjectView]:
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
    shapes: list[ObjectView] = []
    left_out: list[ObjectView] = []
    keypoints: list[SurfaceKeypoints] = []
    count = 0
    textures: tuple[ObjectView, ...] = ()
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
            visible = _whole_view(run, frame, record, run.visible_pinhole_mask(frame.index))
            keypoints.append(surface_keypoints(visible, model))
    return RunViews(shapes, spread_by_rotation(left_out, 0.5, MOST_LEFT_OUT), textures, keypoints)


def views_of_frame(run: RunReader, frame: Frame, record: FrameRecord) -> tuple[ObjectView, ObjectView] | None:
    """A frame as shapes and textures are made from it; None if its mask is empty or too small."""
    shape = shape_view(_whole_view(run, frame, record, run.pinhole_mask(frame.index)))
    view = texture_view(_whole_view(run, frame, record, run.visible_pinhole_mask(frame.index)))
    return None if shape is None or view is None else (shape, view)


def _whole_view(run: RunReader, frame: Frame, record: FrameRecord, mask: Mask) -> ObjectView:
    return ObjectView.of_frame(frame.index, frame.image, mask, run.camera_of(record), record.T_cam_obj)


def reliable_frames(run: RunReader, source: str | FrameSource | None) -> Iterator[tuple[Frame, FrameRecord]]:
    """Each frame that is tracked with enough confidence, with its estimate; as the camera of the poses sees it.

    Args:
        run: The run.
        source: Its video, or its path; None for the one that it names.

    Raises:
        InputError: If it goes on, or the video is another one.
    """
    if run.state == "running":
        raise InputError(f"The run {run.folder} is still going; wait for its end.")
    video = source or str(run.description.get("source", ""))
    if isinstance(video, str):
        video = open_source(video, run.description.get("selection"))
    name = video.name
    records = {record.index: record for record in run.frames}
    prompt = run.description.get("prompt") or {}
    for frame in report_each("reading frames", video, video.count):
        record = records.get(frame.index)
        if not isinstance(frame, Frame) or record is None:
            continue
        expected = (run.camera.height, run.camera.width)
        if frame.size != expected:
            raise InputError(
                f"{name} has frames of {pixels(frame.size)} pixels but the run {run.folder} of "
                f"{pixels(expected)}; give its video by --source."
            )
        if frame.index == prompt.get("first_frame") and checksum(frame.image) != prompt.get(
            "first_image_crc"
        ):
            raise InputError(
                f"{name} does not begin as the video of the run {run.folder} did; give that by --source."
            )
        if record.status is Status.TRACKED:
            yield replace(frame, image=run.camera_of(record).undistort(frame.image)), record


def no_reliable_frame_error(run: RunReader) -> InputError:
    """The message if there is no such frame."""
    return InputError(f"No frame of the run {run.folder} is tracked; its mesh stays as it is.")
