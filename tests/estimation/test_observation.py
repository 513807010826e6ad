"""A window of a frame shows the frame, pixel for pixel, and the one camera projects into it."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from scipy.ndimage import distance_transform_edt
from small_scenes import observed, pose_of, small_shape

from tracking3d.estimation.observation import ObservationBatch, crop, halved, mask_distance, observe
from tracking3d.features.rgb import RgbEncoder
from tracking3d.frames import Frame
from tracking3d.geometry.camera import Camera, Window
from tracking3d.rendering import project, rasterize

CPU = torch.device("cpu")
CAMERA = Camera.from_fov(80, 60)


def ramp(height: int = 60, width: int = 80) -> torch.Tensor:
    """``(2, H, W)``: every pixel's own column and row."""
    y, x = torch.meshgrid(torch.arange(height), torch.arange(width), indexing="ij")
    return torch.stack([x, y]).float()


@pytest.mark.parametrize("size", [16, 32, 64, 48])
def test_crop_samples_the_frame_where_window_pixels_lie(size):
    window = Window(20, 10, 32, size)
    shown = crop(ramp(), window)
    inner = slice(size // 8, -size // 8)  # at its outer edge the resampling has taps on one side only
    where = (torch.arange(size) + 0.5) / window.scale - 0.5
    expected = torch.stack([(where + 20)[None].expand(size, size), (where + 10)[:, None].expand(size, size)])
    torch.testing.assert_close(shown[:, inner, inner], expected[:, inner, inner], rtol=0, atol=1e-3)


def test_crop_at_the_scale_of_the_frame_copies_it():
    assert torch.equal(crop(ramp(), Window(20, 10, 32, 32)), ramp()[:, 10:42, 20:52])


@pytest.mark.parametrize(("left", "top"), [(-10, -20), (60, 40), (-10, 40)])
def test_crop_beyond_the_border_is_zero(left, top):
    shown = crop(ramp() + 1, Window(left, top, 32, 32))
    for row in range(32):
        for column in range(32):
            x, y = left + column, top + row
            inside = 0 <= x < 80 and 0 <= y < 60
            assert shown[:, row, column].tolist() == ([x + 1, y + 1] if inside else [0, 0])


def test_a_window_larger_than_the_frame_shows_all_of_it():
    shown = crop(ramp() + 1, Window(-10, -20, 100, 100))
    assert torch.equal(shown[:, 20:80, 10:90], ramp() + 1)
    assert shown.sum() == (ramp() + 1).sum()


@pytest.mark.parametrize(("left", "top"), [(-40, 0), (80, 0), (0, -32), (0, 60), (500, 500), (-500, -500)])
def test_a_window_wholly_outside_the_frame_is_empty(left, top):
    assert crop(ramp() + 1, Window(left, top, 32, 16)).shape == (2, 16, 16)
    assert not crop(ramp() + 1, Window(left, top, 32, 16)).any()


def silhouette(K: np.ndarray, size: tuple[int, int]) -> torch.Tensor:
    shape, pose = small_shape(), pose_of(25, x=0.3)
    screen, depth = project(
        shape.rest, pose.R[None], pose.translation[None], torch.tensor(K, dtype=torch.float32)[None]
    )
    return (rasterize(screen, depth, shape.faces, size).face_index[0] >= 0).float()


@pytest.mark.parametrize(("left", "top", "side"), [(20, 10, 40), (-5, -3, 70), (30, 20, 48)])
def test_rendering_into_a_window_is_cropping_the_rendered_frame(left, top, side):
    full = silhouette(CAMERA.K, (60, 80))
    same_scale = Window(left, top, side, side)
    drawn = silhouette(same_scale.K(CAMERA), (side, side))
    inside = crop(torch.ones(1, 60, 80), same_scale)[0]
    # Pixels on the outline may fall to either side by rounding.
    assert (drawn * inside - crop(full[None], same_scale)[0]).abs().sum() <= 1


@pytest.mark.parametrize("size", [20, 80])
def test_rendering_into_a_window_of_another_scale_covers_the_same_part_of_the_frame(size):
    window = Window(20, 10, 40, size)
    drawn = silhouette(window.K(CAMERA), (size, size))
    shown = crop(silhouette(CAMERA.K, (60, 80))[None], window)[0]
    assert drawn.sum() / size**2 == pytest.approx(shown.sum().item() / size**2, rel=0.02)
    for weights in torch.meshgrid(torch.arange(size), torch.arange(size), indexing="ij"):
        offset = (weights * drawn).sum() / drawn.sum() - (weights * shown).sum() / shown.sum()
        assert abs(offset) < 0.1 * max(window.scale, 1)


@pytest.fixture
def frame() -> Frame:
    rng = np.random.default_rng(0)
    return Frame(3, rng.integers(0, 255, (60, 80, 3), dtype=np.uint8))


def disc(x: int = 40, y: int = 30, radius: int = 12) -> np.ndarray:
    rows, columns = np.mgrid[:60, :80]
    return (rows - y) ** 2 + (columns - x) ** 2 < radius**2


def test_an_observation_has_all_its_parts_in_one_window(frame):
    window = Window(20, 10, 40, 32)
    seen = observe(frame, disc(), window, CAMERA, RgbEncoder(), CPU)
    assert (seen.index, seen.window, seen.has_mask) == (3, window, True)
    image = torch.tensor(frame.image).permute(2, 0, 1) / 255
    torch.testing.assert_close(seen.features, crop(image, window))
    torch.testing.assert_close(seen.image, crop(image, Window(20, 10, 40, 64)))
    torch.testing.assert_close(seen.K.double(), torch.tensor(window.K(CAMERA)))
    torch.testing.assert_close(seen.mask, crop(torch.tensor(disc())[None].float(), window)[0])
    torch.testing.assert_close(seen.distance, mask_distance(seen.mask))
    assert seen.valid.all()


def test_only_what_lies_inside_the_frame_is_valid(frame):
    seen = observe(frame, disc(8, 30), Window(-16, 14, 32, 32), CAMERA, RgbEncoder(), CPU)
    assert not seen.valid[:, :16].any()
    assert seen.valid[:, 16:].all()
    outside = observe(frame, disc(), Window(200, 200, 32, 32), CAMERA, RgbEncoder(), CPU)
    assert not outside.valid.any()
    assert not outside.has_mask


@pytest.mark.parametrize("mask", [None, np.zeros((60, 80), bool)])
def test_a_frame_without_a_mask_has_none(frame, mask):
    seen = observe(frame, mask, Window(20, 10, 40, 32), CAMERA, RgbEncoder(), CPU)
    assert not seen.has_mask
    assert not seen.mask.any()
    assert not seen.distance.any()


def test_features_of_any_stride_are_brought_to_the_window(frame):
    class Quarter:
        channels, stride, tau = 5, 4, 0.1

        def encode(self, images: torch.Tensor) -> torch.Tensor:
            return torch.nn.functional.avg_pool2d(images, 4).repeat(1, 2, 1, 1)[:, :5]

    flat = Frame(0, np.full_like(frame.image, 51))
    seen = observe(flat, disc(), Window(20, 10, 40, 32), CAMERA, Quarter(), CPU)
    torch.testing.assert_close(seen.features, torch.full((5, 32, 32), 0.2))


def test_mask_distance_is_euclidean_and_half_the_window_is_one():
    mask = torch.zeros(40, 40)
    mask[10, 10] = 1
    distance = mask_distance(mask)
    assert distance[10, 10] == 0
    assert distance[10, 30].item() == pytest.approx(20 * 2 / 40)
    assert distance[13, 14].item() == pytest.approx(5 * 2 / 40)
    assert distance[4, 2].item() == pytest.approx(10 * 2 / 40)


@pytest.mark.parametrize("size", [32, 64])
def test_mask_distance_is_exact_to_the_last_bit_so_that_runs_can_be_repeated(size):
    for seed in range(20):
        mask = np.random.default_rng(seed).random((size, size)) > 0.98
        exact = distance_transform_edt(~mask).astype(np.float32) * np.float32(2 / size)
        np.testing.assert_array_equal(mask_distance(torch.from_numpy(mask).float()).numpy(), exact)


def test_mask_distance_is_zero_inside_and_for_an_empty_mask():
    mask = torch.zeros(8, 8)
    assert not mask_distance(mask).any()
    mask[2:6, 2:6] = 0.5
    assert not mask_distance(mask)[2:6, 2:6].any()
    assert mask_distance(mask)[2, 6].item() == pytest.approx(2 / 8)


def test_halving_keeps_projections_where_they_are():
    window = Window(20, 10, 40, 32)
    frame = Frame(0, np.zeros((60, 80, 3), np.uint8))
    half = halved(observe(frame, disc(), window, CAMERA, RgbEncoder(), CPU))
    assert half.window == Window(20, 10, 40, 16)
    torch.testing.assert_close(half.K.double(), torch.tensor(half.window.K(CAMERA)), rtol=1e-6, atol=1e-5)


def test_halving_averages_two_by_two():
    whole = observed(pose_of(20))
    half = halved(whole)
    size = whole.window.size // 2
    blocks = whole.features.reshape(3, size, 2, size, 2).mean((2, 4))
    torch.testing.assert_close(half.features, blocks)
    torch.testing.assert_close(half.mask, whole.mask.reshape(size, 2, size, 2).mean((1, 3)))
    assert (half.has_mask, half.index) == (whole.has_mask, whole.index)


def test_halving_keeps_distances_in_ndc():
    whole = observed(pose_of(20))
    half = halved(whole)
    assert (half.distance - mask_distance(half.mask)).abs().max() < 2 * 2 / half.window.size


def test_halving_calls_a_pixel_valid_that_is_mostly_so():
    frame = Frame(0, np.zeros((60, 80, 3), np.uint8))
    half = halved(observe(frame, disc(8, 30), Window(-15, 14, 32, 32), CAMERA, RgbEncoder(), CPU))
    assert not half.valid[:, :8].any()
    assert half.valid[:, 8:].all()


def test_a_batch_stacks_observations_in_order():
    batch = ObservationBatch.of([observed(pose_of(0), 4), observed(pose_of(20), 7, has_mask=False)])
    assert batch.index.tolist() == [4, 7]
    assert batch.has_mask.tolist() == [1, 0]
    assert batch.K.shape == (2, 3, 3)
    assert batch.features.shape == (2, 3, 48, 48)
    assert batch.valid.shape == batch.mask.shape == batch.distance.shape == (2, 48, 48)
    assert not batch.mask[1].any()


@pytest.mark.parametrize(("stride", "side"), [(1, 16), (2, 32), (4, 32)])
def test_an_encoder_with_a_stride_sees_the_window_twice_as_fine(stride, side):
    shapes = []

    class Strided:
        channels, tau = 3, 0.1

        @classmethod
        def from_options(cls, options):
            return cls()

        def encode(self, images):
            shapes.append(tuple(images.shape))
            return torch.nn.functional.avg_pool2d(images, self.stride)

    Strided.stride = stride
    rows, columns = np.mgrid[:60, :80]
    image = np.dstack([3 * columns, 4 * rows, rows + columns]).astype(np.uint8)
    seen = observe(Frame(0, image), None, Window(20, 10, 32, 16), CAMERA, Strided(), CPU)
    assert shapes == [(1, 3, side, side)]
    assert seen.features.shape == (3, 16, 16)
    if stride < 4:  # a coarser map is interpolated
        plain = observe(Frame(0, image), None, Window(20, 10, 32, 16), CAMERA, RgbEncoder(), CPU)
        torch.testing.assert_close(
            seen.features[:, 1:-1, 1:-1], plain.features[:, 1:-1, 1:-1], atol=0.01, rtol=0
        )
