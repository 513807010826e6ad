"""A finished run of known truth with its pictures, and the silhouette that numbers of an exported file give."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray
from PIL import Image
from scipy.spatial.transform import Rotation

from tracking3d.estimation.estimate import FrameEstimate, ObjectModel, Status
from tracking3d.export.exporting import export_run
from tracking3d.export.options import ExportOptions
from tracking3d.frames import Frame, SkippedFrame
from tracking3d.geometry.camera import Camera
from tracking3d.geometry.prototypes import ellipsoid
from tracking3d.results.checkpoint.progress import checksum
from tracking3d.results.description import RunHeader
from tracking3d.results.run_reader import RunReader
from tracking3d.results.run_writer import RunWriter

HEIGHT, WIDTH, FPS = 96, 128, 25.0
LAST, LOST, SKIPPED = 6, 2, 4
"""Frames are 0 to 6; in one the object is lost, one cannot be decoded."""
CENTRED = Camera(150.0, 150.0, (WIDTH - 1) / 2, (HEIGHT - 1) / 2, WIDTH, HEIGHT)
SHIFTED = replace(CENTRED, fx=160.0, cx=50.0, cy=58.0)


def silhouette(
    K: NDArray[np.float64],
    T_cam_obj: NDArray[np.float64],
    vertices: NDArray[np.float64],
    faces: NDArray[np.int64],
) -> NDArray[np.bool_]:
    """Drawn by OpenCV, which shares nothing with our renderer; pixel (0, 0) is the centre of the first one."""
    points = (vertices @ T_cam_obj[:3, :3].T + T_cam_obj[:3, 3]) @ K.T
    pixels = np.round(points[:, :2] / points[:, 2:] * 16).astype(np.int32)
    canvas = np.zeros((HEIGHT, WIDTH), np.uint8)
    for face in pixels[faces]:
        cv2.fillConvexPoly(canvas, face, 1, shift=4)
    return canvas.astype(bool)


def iou(a: NDArray[np.bool_], b: NDArray[np.bool_]) -> float:
    return np.count_nonzero(a & b) / np.count_nonzero(a | b)


def make_model() -> ObjectModel:
    """An ellipsoid of three different axes beside the origin, half red and half green-blue: no two views are alike."""
    turn = Rotation.from_euler("xyz", [20, 30, 40], degrees=True).as_matrix()
    mesh = ellipsoid(np.array([0.9, 0.5, 0.3]), turn, frequency=5)
    side = 32
    v, u = np.mgrid[:side, :side] / side
    texture = np.stack([255 * (u < 0.5), 255 * v, 200 * u], axis=2).astype(np.uint8)
    weight = np.ones((side, side), np.float32)
    features = np.zeros((side, side, 3), np.float32)
    vertices = mesh.vertices + np.array([0.1, 0.2, -0.1])
    return ObjectModel(vertices, mesh.faces, mesh.face_uvs, texture, weight, features)


def pose(index: int) -> NDArray[np.float64]:
    T = np.eye(4)
    T[:3, :3] = Rotation.from_rotvec(np.radians(index) * np.array([12.0, 20.0, -7.0])).as_matrix()
    T[:3, 3] = -0.4 + 0.12 * index, 0.1 - 0.05 * index, 4.0 + 0.1 * index
    return T


def write_run(folder: Path, camera: Camera, lenses: Mapping[int, Camera] | None = None) -> Path:
    """Write the run and, in ``folder/video``, its pictures; ``lenses`` are of frames with a camera of their own."""
    model, video = make_model(), folder / "video"
    video.mkdir(parents=True)
    rng = np.random.default_rng(0)
    pictures = rng.integers(0, 255, (LAST + 1, HEIGHT, WIDTH, 3), dtype=np.uint8)
    for index, picture in enumerate(pictures):
        Image.fromarray(picture).save(video / f"{index:03d}.png")
    (video / f"{SKIPPED:03d}.png").write_bytes(b"no picture")
    given = {"first_frame": 0, "first_image_crc": checksum(pictures[0])}
    header = RunHeader(config={}, camera=camera, source=str(video), seed=0, fps=FPS, command="", prompt=given)
    with RunWriter(folder / "run", header) as writer:
        for index, picture in enumerate(pictures):
            if index == SKIPPED:
                writer.skip(SkippedFrame(index, "damaged"))
                continue
            T = pose(index)
            lens = (lenses or {}).get(index, camera)
            mask = silhouette(lens.K, T, model.vertices, model.faces)
            status = Status.LOST if index == LOST else Status.TRACKED
            estimate = FrameEstimate(
                index=index,
                time=index / FPS,
                T_cam_obj=T,
                mask=mask,
                initial_mask=mask,
                status=status,
                reason="",
                confidence=0.5 + 0.05 * index,
                seconds=0.2,
                camera=lens,
            )
            writer.write(estimate, Frame(index, picture, index / FPS, f"{index:03d}.png"))
        writer.finish(model, "finished")
    return folder / "run"


@pytest.fixture(scope="session")
def run(tmp_path_factory) -> Path:
    """A run whose principal point is in the middle."""
    return write_run(tmp_path_factory.mktemp("centred"), CENTRED)


@pytest.fixture(scope="session")
def shifted_run(tmp_path_factory) -> Path:
    """A run whose principal point is not, and whose pixels are not square."""
    return write_run(tmp_path_factory.mktemp("shifted"), SHIFTED)


@pytest.fixture(scope="session")
def zooming_run(tmp_path_factory) -> Path:
    """A run whose first two frames were solved with a shorter lens, as where nobody gave one."""
    shorter = CENTRED.zoom(0.8, "a test")
    return write_run(tmp_path_factory.mktemp("zooming"), CENTRED, {0: shorter, 1: shorter})


@pytest.fixture
def export(tmp_path: Path) -> Callable[..., Path]:
    """Export a run: ``export(run, to, **options)``; gives the path."""

    def export(run: Path, to: str, name: str = "out", **options: object) -> Path:
        return export_run(run, to, tmp_path / name, options=ExportOptions(**options)).path

    return export


@dataclass(frozen=True)
class Silhouettes:
    """Compares what an exported file says with the masks of the run.

    Attributes:
        run: The run.
    """

    run: Path

    def agree(
        self,
        index: int,
        K: NDArray[np.float64],
        T: NDArray[np.float64],
        vertices: NDArray[np.float64],
        faces: NDArray[np.int64],
        least: float = 0.97,
    ) -> None:
        drawn = silhouette(K, T, np.asarray(vertices), np.asarray(faces))
        assert iou(drawn, RunReader(self.run).mask(index)) > least, index


@pytest.fixture
def silhouettes() -> type[Silhouettes]:
    return Silhouettes
