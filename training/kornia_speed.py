"""What kornia has too and is not taken: milliseconds of one call on one thread; docs/kornia.md has the figures.

python training/kornia_speed.py
"""

from __future__ import annotations

import time
from collections.abc import Callable

import cv2
import numpy as np
import torch
from kornia.color import rgb_to_grayscale, rgb_to_lab
from kornia.contrib import distance_transform
from kornia.filters import gaussian_blur2d
from kornia.geometry.calibration import undistort_image
from kornia.geometry.camera import PinholeCamera
from kornia.geometry.liegroup import Se3
from kornia.geometry.quaternion import Quaternion
from kornia.geometry.transform import remap, warp_perspective
from kornia.morphology import erosion
from torch import Tensor

from tracking3d.estimation.observation import mask_distance
from tracking3d.estimation.paper.losses import erode
from tracking3d.geometry.pose import Pose
from tracking3d.rendering import sample_texture
from tracking3d.rendering.renderer import project

CALLS = 20
VIEWS, VERTICES = 7, 1212


def milliseconds(call: Callable[[], object]) -> float:
    """The median of some calls, after one that does not count."""
    taken = []
    for _ in range(CALLS + 1):
        started = time.perf_counter()
        call()
        taken.append(time.perf_counter() - started)
    return 1e3 * float(np.median(taken[1:]))


def row(name: str, ours: Callable[[], object], theirs: Callable[[], object]) -> None:
    """Print both, and how much longer kornia takes."""
    one, other = milliseconds(ours), milliseconds(theirs)
    print(f"{name:32} {one:8.2f} {other:8.2f}  x {other / one:.2g}")


def both_ways(function: Callable[[Tensor], Tensor], image: Tensor) -> Callable[[], None]:
    """Forwards and backwards."""
    leaf = image.clone().requires_grad_()
    return lambda: function(leaf).sum().backward()


def tensors() -> None:
    """What solvers do in their loops."""
    generator = torch.Generator().manual_seed(0)
    quaternion = torch.nn.functional.normalize(torch.randn(VIEWS, 4, generator=generator), dim=1)
    pose = Pose(torch.randn(VIEWS, 3, generator=generator) + torch.tensor([0.0, 0, 5]), quaternion)
    row("poses to matrices", lambda: pose.R, lambda: Se3(Quaternion(quaternion), pose.translation).matrix())
    vertices, R = torch.randn(VERTICES, 3, generator=generator), pose.R
    K, extrinsics = torch.eye(4).repeat(VIEWS, 1, 1), torch.eye(4).repeat(VIEWS, 1, 1)
    K[:, 0, 0] = K[:, 1, 1] = 100.0
    extrinsics[:, :3, :3], extrinsics[:, :3, 3] = R, pose.translation
    camera = PinholeCamera(K, extrinsics, *torch.full((2, VIEWS), 128.0))
    row(
        "vertices to pixels",
        lambda: project(vertices, R, pose.translation, K[:, :3, :3]),
        lambda: camera.project(vertices.expand(VIEWS, -1, -1)),
    )
    texture, uv = torch.rand(16, 150, 150, generator=generator), torch.rand(8000, 2, generator=generator)
    x, y = 150 * uv.T[:, None, None]
    row("texture at places", lambda: sample_texture(texture, uv), lambda: remap(texture[None], x, y))
    kernel = torch.ones(3, 3)
    for views in (VIEWS, 1):
        soft = torch.rand(views, 128, 128, generator=generator)
        row(
            f"erosion of {views}, both ways",
            both_ways(erode, soft),
            both_ways(lambda image: erosion(image[:, None], kernel), soft),
        )
    mask = torch.zeros(128, 128)
    mask[40:90, 50:100] = 1
    row("distance to a mask", lambda: mask_distance(mask), lambda: distance_transform(mask[None, None]))


def pictures() -> None:
    """What is done with frames."""
    image = np.random.default_rng(0).integers(0, 256, (480, 640, 3), np.uint8)
    tensor = torch.tensor(image).permute(2, 0, 1)[None]
    row(
        "RGB to Lab", lambda: cv2.cvtColor(image, cv2.COLOR_RGB2LAB), lambda: rgb_to_lab(tensor.float() / 255)
    )
    row(
        "RGB to grey",
        lambda: cv2.cvtColor(image, cv2.COLOR_RGB2GRAY),
        lambda: rgb_to_grayscale(tensor.float() / 255),
    )
    grey = image[..., 0].astype(np.float32)
    plane = torch.tensor(grey)[None, None]
    row(
        "Gaussian blur",
        lambda: cv2.GaussianBlur(grey, (0, 0), 2),
        lambda: gaussian_blur2d(plane, (13, 13), (2.0, 2.0)),
    )
    H = np.array([[1.02, 0.03, 4], [-0.02, 0.98, 3], [1e-5, 2e-5, 1]], np.float32)
    row(
        "perspective warp",
        lambda: cv2.warpPerspective(image, H, (640, 480)),
        lambda: warp_perspective(tensor.float(), torch.tensor(H)[None], (480, 640)),
    )
    K = np.array([[500.0, 0, 320], [0, 500, 240], [0, 0, 1]], np.float32)
    bent = np.array([0.1, -0.05, 0.001, 0.001, 0], np.float32)
    maps = cv2.initUndistortRectifyMap(K, bent, np.eye(3), K, (640, 480), cv2.CV_32FC1)
    row(
        "undistortion",
        lambda: cv2.remap(image, *maps, cv2.INTER_LINEAR),
        lambda: undistort_image(tensor.float() / 255, torch.tensor(K)[None], torch.tensor(bent)[None]),
    )


if __name__ == "__main__":
    torch.set_num_threads(1)
    cv2.setNumThreads(1)
    tensors()
    pictures()
