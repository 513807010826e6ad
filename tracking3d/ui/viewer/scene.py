"""The 3D scene: each object's mesh, the camera path around it, and the current camera."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable
from functools import partial
from pathlib import Path

import numpy as np
import viser
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from tracking3d.estimation.estimate import Status
from tracking3d.frames import Image
from tracking3d.geometry.camera import Camera
from tracking3d.results import drawing, layout
from tracking3d.results.records import FrameRecord
from tracking3d.ui.viewer.first_look import fainten, frustum_size, object_box, radius_of
from tracking3d.ui.viewer.followed_run import FollowedRun
from tracking3d.ui.viewer.picture import axes_of

MOST_FRUSTA = 48
"""Frusta along a path; of more frames so many are shown, spread over them."""
LARGEST_MESH = 2**28
"""Bytes of a mesh file that are sent to the browser."""
_CURRENT = 2.5  # size of the current frame's frustum, in those of keyframes
_GAMMA = 2.2
_EVEN_LIGHT, _LIGHT_FROM_ABOVE = 2.4, 0.6
_LANDMARK = (255, 230, 120)
_HALF_TURN_ABOUT_X = (0.0, 1.0, 0.0, 0.0)  # from glTF's axes, in which mesh.glb is, to the object's


def set_up_space(server: viser.ViserServer) -> None:
    """Which way is up, and the light: nearly even, since the light of the video is in the texture already."""
    scene = server.scene
    scene.set_up_direction("-y")
    scene.configure_default_lights(False)
    scene.configure_environment_map(None)
    scene.add_light_ambient("/light/even", intensity=_EVEN_LIGHT)
    scene.add_light_directional("/light/above", intensity=_LIGHT_FROM_ABOVE, position=(-1.0, -2.0, -1.0))


class ObjectScene:
    """One object in the scene.

    Attributes:
        distance: From the object to the camera, in the median.
        place: ``(3,)`` where the object stands.
        path: ``(N, 3)`` the camera's places, in object coordinates.
        box: ``(2, 3)`` two opposite corners of the object, in object coordinates.

    Args:
        server: Shows it.
        run: The object's run.
        number: Tells it from others; they stand below one another.
        jump: Is called with the index of a frame whose frustum was clicked.
    """

    def __init__(
        self, server: viser.ViserServer, run: FollowedRun, number: int, jump: Callable[[int], None]
    ) -> None:
        self._server, self._run, self._jump = server, run, jump
        self._root = server.scene.add_frame(f"/object_{number}", show_axes=False)
        self._way = server.scene.add_frame(f"/object_{number}/path", show_axes=False)
        self._landmarks = server.scene.add_frame(f"/object_{number}/landmarks", show_axes=False)
        self._here: viser.CameraFrustumHandle | None = None
        self._mesh: viser.GlbHandle | None = None
        self._points: viser.PointCloudHandle | None = None
        self._mesh_written = 0.0
        self.place = np.zeros(3)
        self.distance = 4.0
        self.path = np.array([[0.0, 0.0, -4.0]])
        self.box = object_box(None, None, self.distance)

    @property
    def frustum(self) -> float:
        """Size of a keyframe's frustum."""
        return frustum_size(radius_of(self.box), self.distance)

    def draw_again(self) -> None:
        """Show what is new in the run."""
        self._draw_mesh()
        records = [record for record in self._run.frames.values() if np.isfinite(record.T_cam_obj).all()]
        T_obj_cam = [np.linalg.inv(record.T_cam_obj).astype(np.float64) for record in records]
        if records:
            self.path = np.stack(T_obj_cam)[:, :3, 3]
            self.distance = float(np.median(np.linalg.norm(self.path, axis=1)))
        self.box = object_box(self._run.model, axes_of(self._run), self.distance)
        self._draw_path(records, T_obj_cam)

    def go_to(self, index: int, image: Image | None, camera_stands_still: bool) -> None:
        """Put the camera where it was in a frame.

        Args:
            index: The frame.
            image: ``(H, W, 3)`` what it saw, for the frustum; None leaves the frustum empty.
            camera_stands_still: Move the object before the camera, not the camera around the object.
        """
        record = self._run.frames.get(index)
        known = record is not None and bool(np.isfinite(record.T_cam_obj).all())
        if self._here is not None:
            self._here.visible = known
        if record is None or not known:
            return
        T_cam_obj = record.T_cam_obj
        T_obj_cam = np.linalg.inv(T_cam_obj).astype(np.float64)
        camera = record.through(self._run.camera)
        if self._here is None:
            self._here = self._server.scene.add_camera_frustum(
                f"{self._root.name}/here",
                fov=math.radians(camera.fov),
                aspect=camera.width / camera.height,
                scale=_CURRENT * self.frustum,
                thickness=2.0,
                thickness_units="screen",
            )
        self._here.scale = _CURRENT * self.frustum
        self._here.color = drawing.STATUS[record.status]
        self._here.image = None if image is None else _as_seen(camera, image)
        self._here.wxyz, self._here.position = _wxyz(T_obj_cam), T_obj_cam[:3, 3]
        if camera_stands_still:
            self._root.wxyz, self._root.position = _wxyz(T_cam_obj), T_cam_obj[:3, 3]
        else:
            self._root.wxyz, self._root.position = (1.0, 0.0, 0.0, 0.0), self.place

    def show(self, mesh: bool, path: bool, here: bool, landmarks: bool) -> None:
        """Which parts are to be seen."""
        if self._here is not None and not here:
            self._here.visible = False
        self._way.visible, self._landmarks.visible = path, landmarks
        if self._mesh is not None:
            self._mesh.visible = mesh

    def draw_landmarks(self, points: NDArray[np.float32] | None) -> None:
        """Show the points ``(N, 3)`` that the run follows; None takes away those that were shown."""
        if self._points is not None:
            self._points.remove()
            self._points = None
        if points is not None:
            self._points = self._server.scene.add_point_cloud(
                f"{self._landmarks.name}/points",
                points,
                np.full(points.shape, _LANDMARK, np.uint8),
                point_size=0.006 * self.distance,
                point_shape="circle",
            )

    def _draw_mesh(self) -> None:
        path = self._run.folder / layout.GLB
        written, data = _read_if_changed(path, self._mesh_written)
        if data is None:
            return
        self._mesh_written = written
        self._mesh = self._server.scene.add_glb(
            f"{self._root.name}/mesh", data, wxyz=_HALF_TURN_ABOUT_X, cast_shadow=False, receive_shadow=False
        )

    def _draw_path(self, records: list[FrameRecord], T_obj_cam: list[NDArray[np.float64]]) -> None:
        shown = np.array([fainten(drawing.STATUS[record.status]) for record in records]).reshape(-1, 3)
        colours = (
            (255 * (shown / 255) ** _GAMMA).round().astype(np.uint8)
        )  # viser takes those of lines as linear
        if len(records) > 1:
            self._server.scene.add_line_segments(
                f"{self._way.name}/line",
                np.stack([self.path[:-1], self.path[1:]], axis=1).astype(np.float32),
                np.stack([colours[:-1], colours[1:]], axis=1),
                thickness=1.0,
                thickness_units="screen",
            )
        for slot, number in enumerate(_spread_frames(records)):
            self._draw_frustum(slot, records[number], T_obj_cam[number])

    def _on_click(self, index: int, event: object) -> None:
        self._jump(index)

    def _draw_frustum(self, slot: int, record: FrameRecord, T_obj_cam: NDArray[np.float64]) -> None:
        camera = record.through(self._run.camera)
        handle = self._server.scene.add_camera_frustum(
            f"{self._way.name}/frustum_{slot:03d}",
            fov=math.radians(camera.fov),
            aspect=camera.width / camera.height,
            scale=self.frustum * (1.0 if record.keyframe else 0.6),
            thickness=1.0,
            thickness_units="screen",
            color=fainten(drawing.KEYFRAME if record.keyframe else drawing.STATUS[record.status]),
            wxyz=_wxyz(T_obj_cam),
            position=T_obj_cam[:3, 3],
        )
        handle.on_click(partial(self._on_click, record.index))


def _as_seen(camera: Camera, image: Image) -> Image:
    """The picture ``(H, W, 3)`` without the distortion of a lens; one that was made smaller is left as it is."""
    return camera.undistort(image) if image.shape[:2] == (camera.height, camera.width) else image


def _spread_frames(records: list[FrameRecord]) -> list[int]:
    """Positions of the records that get a frustum: keyframes, uncertain and lost frames, and others spread evenly
    between."""
    keyframes = [place for place, record in enumerate(records) if record.keyframe]
    doubtful = [
        place
        for place, record in enumerate(records)
        if record.status != Status.TRACKED and (not place or records[place - 1].status == Status.TRACKED)
    ]
    chosen = {*_evenly(keyframes, MOST_FRUSTA // 3), *_evenly(doubtful, MOST_FRUSTA // 3)}
    others = [place for place in range(len(records)) if place not in chosen]
    return sorted({*chosen, *_evenly(others, MOST_FRUSTA - len(chosen))})


def _evenly(places: list[int], most: int) -> Iterable[int]:
    if len(places) <= most:
        return places
    return [places[round(step)] for step in np.linspace(0, len(places) - 1, most)]


def _wxyz(T: NDArray[np.float64]) -> NDArray[np.float64]:
    x, y, z, w = Rotation.from_matrix(T[:3, :3]).as_quat()
    return np.array([w, x, y, z])


def _read_if_changed(path: Path, before: float) -> tuple[float, bytes | None]:
    """When a file was written, and what it holds if that is not as ``before``; None if it is, or there is none."""
    try:
        stat = path.stat()
        if stat.st_mtime == before or stat.st_size > LARGEST_MESH:
            return before, None
        return stat.st_mtime, path.read_bytes()
    except OSError:
        return before, None
