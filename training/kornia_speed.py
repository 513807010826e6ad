"""What kornia does here and could do: milliseconds of one call on one thread; history/pages/kornia.md has figures.

Each operation is written down twice, as it is or was without kornia and with it. The two take turns, so that whatever
else the machine does slows both.

python training/kornia_speed.py
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable

import cv2
import numpy as np
import torch
from kornia.color import rgb_to_grayscale, rgb_to_lab
from kornia.contrib import distance_transform, extract_tensor_patches
from kornia.enhance import adjust_gamma, normalize
from kornia.filters import filter2d, gaussian_blur2d
from kornia.geometry.calibration import undistort_image
from kornia.geometry.camera import PinholeCamera
from kornia.geometry.conversions import quaternion_to_rotation_matrix, rotation_matrix_to_quaternion
from kornia.geometry.liegroup import Se3
from kornia.geometry.linalg import transform_points
from kornia.geometry.quaternion import Quaternion
from kornia.geometry.transform import remap, resize, warp_perspective
from kornia.losses import cauchy_loss
from kornia.metrics import angle_error_mat, psnr, ssim
from kornia.morphology import dilation, erosion
from scipy.spatial.transform import Rotation
from skimage.metrics import structural_similarity
from torch import Tensor
from torch.nn import functional

from tracking3d.estimation.observation import mask_distance
from tracking3d.estimation.paper.problem import erode
from tracking3d.geometry.pose import Pose, from_matrix, rotation_angle, rotation_exponential
from tracking3d.rendering import sample_texture
from tracking3d.rendering.renderer import project, to_camera

Result = Tensor | np.ndarray
CALLS = 20
VIEWS, VERTICES = 7, 1212


def row(
    name: str, ours: Callable[[], Result], theirs: Callable[[], Result], *, comparable: bool = True
) -> None:
    """Print the median of some calls of both, after one that does not count, and how far the results differ."""
    difference = _difference(ours(), theirs()) if comparable else ""
    taken: tuple[list[float], list[float]] = [], []
    for _ in range(CALLS):
        for call, times in zip((ours, theirs), taken, strict=True):
            started = time.perf_counter()
            call()
            times.append(time.perf_counter() - started)
    one, other = (1e3 * float(np.median(times)) for times in taken)
    print(f"{name:40} {one:9.3f} {other:9.3f}  x {other / one:<6.2g} {difference}")


def _difference(ours: Result, theirs: Result) -> str:
    one, other = (np.asarray(result, np.float64) for result in (ours, theirs))
    largest = float(np.abs(one - other).max())
    return f"{largest:.1g}" if largest else "the same digits"


def gradient(function: Callable[[Tensor], Tensor], values: Tensor) -> Callable[[], Tensor]:
    """Forwards and backwards."""
    leaf = values.clone().requires_grad_()

    def both_ways() -> Tensor:
        leaf.grad = None
        function(leaf).sum().backward()
        assert leaf.grad is not None
        return leaf.grad

    return both_ways


def poses(generator: torch.Generator) -> None:
    """Rotations and poses, one by one and as batches."""
    quaternion = functional.normalize(torch.randn(VIEWS, 4, generator=generator), dim=1)
    pose = Pose(torch.randn(VIEWS, 3, generator=generator) + torch.tensor([0.0, 0, 5]), quaternion)
    R, one = pose.R, pose[0]
    row("a quaternion to a matrix", lambda: one.R, lambda: quaternion_to_rotation_matrix(quaternion[0]))
    row(
        "a matrix to a quaternion",
        lambda: from_matrix(R[0], one.translation).quaternion,
        lambda: rotation_matrix_to_quaternion(R[0]),
    )
    row(
        "poses to matrices",
        lambda: pose.R,
        lambda: Se3(Quaternion(quaternion), pose.translation).matrix()[:, :3, :3].detach(),
    )
    turns = torch.randn(VIEWS, 3, generator=generator)
    row(
        "rotation vectors to matrices",
        lambda: torch.stack([rotation_exponential(turn) for turn in turns]),
        lambda: rotation_exponential(turns),
    )
    near = functional.normalize(quaternion + 1e-2, dim=1)
    for name, choose in (("", lambda angle, q: lambda: angle(q)), (", both ways", gradient)):
        row(
            f"angle between rotations{name}",
            choose(lambda q: rotation_angle(q, near[0]), quaternion[0]),
            choose(
                lambda q: (Quaternion(q).inv() * Quaternion(near[0])).to_axis_angle().norm(dim=-1),
                quaternion[0],
            ),
        )


def rotation_errors() -> None:
    """Of the poses of a run, as arrays."""
    found, true = (Rotation.random(200, rng=seed).as_matrix() for seed in (0, 1))
    row(
        "rotation errors of 200 frames",
        lambda: np.degrees((Rotation.from_matrix(found).inv() * Rotation.from_matrix(true)).magnitude()),
        lambda: angle_error_mat(torch.from_numpy(found), torch.from_numpy(true)),
    )


def cameras(generator: torch.Generator) -> None:
    """Points to cameras and to pixels."""
    quaternion = functional.normalize(torch.randn(VIEWS, 4, generator=generator), dim=1)
    translation = torch.randn(VIEWS, 3, generator=generator) + torch.tensor([0.0, 0, 8])
    R, vertices = Pose(translation, quaternion).R, torch.randn(VERTICES, 3, generator=generator)
    K, extrinsics = (torch.eye(4).repeat(VIEWS, 1, 1) for _ in range(2))
    K[:, 0, 0] = K[:, 1, 1] = 100.0
    extrinsics[:, :3, :3], extrinsics[:, :3, 3] = R, translation
    camera = PinholeCamera(K, extrinsics, *torch.full((2, VIEWS), 128.0))
    everywhere = vertices.expand(VIEWS, -1, -1)
    row(
        "vertices to cameras",
        lambda: to_camera(vertices, R, translation),
        lambda: transform_points(extrinsics, everywhere),
    )
    row(
        "vertices to pixels",
        lambda: project(vertices, R, translation, K[:, :3, :3])[0],
        lambda: camera.project(everywhere),
    )
    ones, zero = torch.tensor([100.0, 100.0, 64.0, 64.0]), torch.zeros(())

    def by_hand() -> Tensor:
        intrinsics = torch.eye(4)
        intrinsics[[0, 1, 0, 1], [0, 1, 2, 2]] = ones
        size = torch.tensor([[128.0], [128.0]]).expand(2, VIEWS)
        same = torch.eye(4).expand(VIEWS, 4, 4)
        return PinholeCamera(intrinsics.expand(VIEWS, 4, 4), same, size[0], size[1]).intrinsics

    row(
        "a camera to kornia's",
        by_hand,
        lambda: (
            PinholeCamera.from_parameters(
                *ones, 128, 128, zero, zero, zero, VIEWS, torch.device("cpu"), torch.float32
            ).intrinsics
        ),
    )


def losses(generator: torch.Generator) -> None:
    """What solvers minimize, and scores of pictures."""
    residual, nothing = torch.randn(8000, 16, generator=generator), torch.zeros(8000, 16)
    factor = math.sqrt(2) / 0.25
    row(
        "Cauchy loss",
        lambda: torch.log1p((residual / 0.25).square()),
        lambda: cauchy_loss(residual * factor, nothing * factor, reduction="none"),
    )
    mask = torch.zeros(128, 128)
    mask[40:90, 50:100] = 1
    row(
        "distance to a mask",
        lambda: mask_distance(mask) * 64,
        lambda: distance_transform(mask[None, None])[0, 0],
    )
    picture, other = np.random.default_rng(0).random((2, 160, 160, 3))
    one, two = (torch.from_numpy(array) for array in (picture, other))
    row(
        "PSNR",
        lambda: np.array(-10 * np.log10(np.square(picture - other).mean())),
        lambda: psnr(one, two, 1.0),
    )
    row(
        "SSIM",
        lambda: structural_similarity(
            picture, other, channel_axis=2, full=True, data_range=1.0, gaussian_weights=True
        )[1][5:-5, 5:-5].mean(),
        lambda: ssim(*(x.permute(2, 0, 1)[None] for x in (one, two)), 11)[..., 5:-5, 5:-5].mean(),
    )


def erosions(views: int, generator: torch.Generator) -> None:
    """Of soft silhouettes."""
    soft, kernel = torch.rand(views, 128, 128, generator=generator), torch.ones(3, 3)
    row(f"erosion of {views}", lambda: erode(soft), lambda: erosion(soft[:, None], kernel)[:, 0])
    row(
        f"erosion of {views}, both ways",
        gradient(erode, soft),
        gradient(lambda image: erosion(image[:, None], kernel), soft),
    )


def features(generator: torch.Generator) -> None:
    """Textures, feature maps and patches."""
    texture, uv = torch.rand(16, 150, 150, generator=generator), torch.rand(8000, 2, generator=generator)
    uv = 0.1 + 0.8 * uv  # away from the border, where the two differ
    x, y = 150 * uv.T[:, None, None] - 0.5
    row(
        "texture at places",
        lambda: sample_texture(texture, uv),
        lambda: remap(texture[None], x, y, align_corners=True)[0, :, 0].T,
    )
    points = 190 * torch.rand(300, 2, generator=generator)
    described = torch.rand(128, 96, 96, generator=generator)
    columns, rows = ((points + 0.5) / 2 - 0.5).T[:, None, None]
    row(
        "feature map at places",
        lambda: functional.grid_sample(
            described[None], (points[None, None] + 0.5) / 96 - 1, align_corners=False
        ),
        lambda: remap(described[None], columns, rows, align_corners=True),
    )
    image = torch.rand(1, 3, 192, 192, generator=generator)
    mean, std = torch.tensor([0.485, 0.456, 0.406]), torch.tensor([0.229, 0.224, 0.225])
    row(
        "colours of a network's input",
        lambda: (image - mean[:, None, None]) / std[:, None, None],
        lambda: normalize(image, mean, std),
    )
    kernel = torch.tensor([[1.0, 2.0, 1.0]]) / 4

    def filtered() -> Tensor:
        padded = functional.pad(image, (1, 1, 0, 0), mode="replicate")
        return functional.conv2d(padded, kernel.expand(3, 1, 1, 3), groups=3)

    row("small filter", filtered, lambda: filter2d(image, kernel[None], border_type="replicate"))
    row(
        "window at a working size",
        lambda: functional.interpolate(image, size=(128, 128), mode="bilinear", antialias=True),
        lambda: resize(image, (128, 128), antialias=True),
    )


def patches(stride: int, generator: torch.Generator) -> None:
    """One around every n-th pixel."""
    side = 256 + 32 - stride
    grey = torch.rand(1, 1, side, side, generator=generator)
    row(
        f"patches, one in {stride} pixels",
        lambda: functional.unfold(grey, 32, stride=stride).transpose(1, 2).reshape(-1, 1, 32, 32),
        lambda: extract_tensor_patches(grey, 32, stride).flatten(0, 1),
    )


def pictures() -> None:
    """What is done with frames, and with pictures that a network is trained on."""
    image = np.random.default_rng(0).integers(0, 256, (480, 640, 3), np.uint8)
    tensor = torch.tensor(image).permute(2, 0, 1)[None].float() / 255
    row(
        "RGB to Lab",
        lambda: cv2.cvtColor(image, cv2.COLOR_RGB2LAB),
        lambda: rgb_to_lab(tensor),
        comparable=False,
    )
    row(
        "RGB to grey",
        lambda: cv2.cvtColor(image, cv2.COLOR_RGB2GRAY),
        lambda: 255 * rgb_to_grayscale(tensor)[0, 0],
    )
    picture = tensor[0].permute(1, 2, 0).contiguous().numpy()
    row(
        "Gaussian blur",
        lambda: cv2.GaussianBlur(picture, (17, 17), 2),
        lambda: gaussian_blur2d(tensor, (17, 17), (2.0, 2.0))[0].permute(1, 2, 0),
    )
    kernel = np.full((1, 7), 1 / 7, np.float32)
    row(
        "motion blur",
        lambda: cv2.filter2D(picture, -1, kernel),
        lambda: filter2d(tensor, torch.from_numpy(kernel)[None])[0].permute(1, 2, 0),
    )
    row(
        "gamma",
        lambda: picture ** np.float32(0.7),
        lambda: adjust_gamma(tensor, 0.7)[0].permute(1, 2, 0),
    )
    H = np.array([[1.02, 0.03, 4], [-0.02, 0.98, 3], [1e-5, 2e-5, 1]], np.float32)
    row(
        "perspective warp",
        lambda: cv2.warpPerspective(image, H, (640, 480)),
        lambda: 255 * warp_perspective(tensor, torch.tensor(H)[None], (480, 640))[0].permute(1, 2, 0),
    )
    K = np.array([[500.0, 0, 320], [0, 500, 240], [0, 0, 1]], np.float32)
    bent = np.array([0.1, -0.05, 0.001, 0.001, 0], np.float32)
    maps = cv2.initUndistortRectifyMap(K, bent, np.eye(3), K, (640, 480), cv2.CV_32FC1)
    row(
        "undistortion",
        lambda: cv2.remap(image, *maps, cv2.INTER_LINEAR),
        lambda: (
            255 * undistort_image(tensor, torch.tensor(K)[None], torch.tensor(bent)[None])[0].permute(1, 2, 0)
        ),
    )
    mask = np.zeros((480, 640), np.uint8)
    mask[100:300, 200:400] = 1
    disk = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (9, 9))
    soft = torch.from_numpy(mask)[None, None].float()
    row(
        "dilation of a mask",
        lambda: cv2.dilate(mask, disk),
        lambda: dilation(soft, torch.from_numpy(disk).float())[0, 0],
    )


if __name__ == "__main__":
    torch.set_num_threads(1)
    cv2.setNumThreads(1)
    print(f"{'':40} {'ours':>9} {'kornia':>9}  kornia / ours, difference")
    random = torch.Generator().manual_seed(0)
    for group in (poses, cameras, losses, features):
        group(random)
    rotation_errors()
    for count in (VIEWS, 1):
        erosions(count, random)
    for pixels in (4, 8):
        patches(pixels, random)
    pictures()
