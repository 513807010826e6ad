"""Masks from files: every layout, every kind of image, every way to match them with frames."""

from __future__ import annotations

import pickle
from pathlib import Path

import av
import numpy as np
import pytest
from large_arrays import memory_stays_below, write_zeros
from PIL import Image as Pillow
from pydantic import ValidationError

from tracking3d.errors import InputError, PluginError
from tracking3d.frames import Frame, MaskEstimate, Prompt
from tracking3d.trackers.mask_files import holds_cut_outs
from tracking3d.trackers.precomputed import PrecomputedMasks, match_masks
from tracking3d.trackers.protocol import MaskTracker

SIZE = (48, 64)


def truth(index: int, size: tuple[int, int] = SIZE) -> np.ndarray:
    """A square whose place tells the frame."""
    mask = np.zeros(size, bool)
    scale = size[0] // SIZE[0]
    mask[8 * scale : 24 * scale, (4 + 4 * index) * scale : (20 + 4 * index) * scale] = True
    return mask


def frame(index: int, name: str | None = None) -> Frame:
    return Frame(index, np.zeros((*SIZE, 3), np.uint8), name=f"frame {index}" if name is None else name)


def prompt(mask: np.ndarray | None = None) -> Prompt:
    return Prompt((4.0, 8.0, 16.0, 16.0), mask)


def track(path: Path, frames: list[Frame], given: Prompt | None = None) -> list[MaskEstimate]:
    tracker = PrecomputedMasks.from_options(PrecomputedMasks.Options(path=str(path)))
    return [tracker.init(frames[0], given or prompt()), *(tracker.step(f) for f in frames[1:])]


def assert_truth(estimates: list[MaskEstimate], indices: list[int | None]) -> None:
    for estimate, index in zip(estimates, indices, strict=True):
        if index is None:
            assert estimate.mask is None and estimate.score == 0 and estimate.reason
        else:
            assert estimate.mask is not None and estimate.mask.dtype == np.float32
            np.testing.assert_array_equal(estimate.binary, truth(index))


def write_png(path: Path, index: int) -> None:
    Pillow.fromarray(truth(index).astype(np.uint8) * 255).save(path)


def write_video(path: Path, count: int) -> None:
    with av.open(str(path), "w") as container:
        stream = container.add_stream("ffv1", rate=25)
        stream.height, stream.width, stream.pix_fmt = *SIZE, "gray"
        for index in range(count):
            image = truth(index).astype(np.uint8) * 250
            container.mux(stream.encode(av.VideoFrame.from_ndarray(image, format="gray")))
        container.mux(stream.encode())


def test_it_is_a_mask_tracker(tmp_path: Path) -> None:
    write_png(tmp_path / "0.png", 0)
    tracker = PrecomputedMasks.from_options(PrecomputedMasks.Options(path=str(tmp_path)))
    assert isinstance(tracker, MaskTracker)


def test_a_folder_matches_by_name_with_gaps(tmp_path: Path) -> None:
    for index in (0, 1, 3):
        write_png(tmp_path / f"{index:06d}.png", index)
    frames = [frame(index, f"{index:06d}.jpg") for index in range(5)]
    assert_truth(track(tmp_path, frames), [0, 1, None, 3, None])


def test_names_win_over_indices(tmp_path: Path) -> None:
    for index in range(4):
        write_png(tmp_path / f"{index:06d}.png", index)
    frames = [frame(index, f"some/folder/{index + 2}.jpg") for index in range(2)]
    assert_truth(track(tmp_path, frames), [2, 3])


def test_numbers_in_names_match_the_frame_index(tmp_path: Path) -> None:
    for index in (0, 1, 10):
        write_png(tmp_path / f"cam2_mask{index}.png", index)
    frames = [frame(index) for index in (0, 1, 2, 10)]
    assert_truth(track(tmp_path, frames), [0, 1, None, 10])


def test_without_numbers_the_order_counts(tmp_path: Path) -> None:
    for index, name in enumerate("abc"):
        write_png(tmp_path / f"{name}.png", index)
    assert_truth(track(tmp_path, [frame(i) for i in range(4)]), [0, 1, 2, None])


@pytest.mark.parametrize(
    ("masks", "frames", "expected"),
    [
        (["mask_0001", "mask_0002"], ["img_0001.jpg", "img_0002.jpg"], [0, 1]),
        (["mask_0000", "mask_0001"], ["img_0001.jpg", "img_0002.jpg"], [0, 1]),
        (["mask_0002"], ["img_0001.jpg", "img_0002.jpg"], [None, 0]),
        (["000001"], ["000000.jpg", "000001.jpg"], [None, 0]),
        (["a_2023", "b_2023"], ["", ""], [0, 1]),
        (["1_2023", "0_2023"], ["", ""], [1, 0]),
        ([], ["000007.jpg", "000008.jpg"], [0, 1]),
    ],
)
def test_matching(masks: list[str], frames: list[str], expected: list[int | None]) -> None:
    sequence = [frame(index, name) for index, name in enumerate(frames)]
    find = match_masks(masks, sequence[0])
    assert [find(f) for f in sequence] == expected


def test_the_first_mask_falls_back_to_the_prompt(tmp_path: Path) -> None:
    write_png(tmp_path / "000001.png", 1)
    frames = [frame(index, f"{index:06d}.jpg") for index in range(2)]
    assert_truth(track(tmp_path, frames, prompt(truth(7))), [7, 1])
    assert_truth(track(tmp_path, frames, prompt()), [None, 1])


def test_the_file_wins_over_the_prompt(tmp_path: Path) -> None:
    write_png(tmp_path / "000000.png", 0)
    assert_truth(track(tmp_path, [frame(0, "000000.jpg")], prompt(truth(7))), [0])


def _palette(mask: np.ndarray) -> Pillow.Image:
    image = Pillow.fromarray(mask.astype(np.uint8)).convert("P")
    image.putpalette([0, 0, 0, 128, 0, 0] + [0] * 762)
    return image


def _palette_with_alpha(mask: np.ndarray) -> Pillow.Image:
    """A cut-out of 256 colours, as tools write that make files small; its background is not black."""
    colours = np.dstack([mask * 60 + 90] * 3 + [mask * 255]).astype(np.uint8)
    image = Pillow.fromarray(colours).quantize(8, method=Pillow.Quantize.FASTOCTREE)
    assert image.mode == "P" and image.has_transparency_data
    return image


KINDS = {
    "8 bit.png": lambda m: Pillow.fromarray(m.astype(np.uint8) * 255),
    "0 and 1.png": lambda m: Pillow.fromarray(m.astype(np.uint8)),
    "labels.png": lambda m: Pillow.fromarray(m.astype(np.uint8) * 3),
    "1 bit.png": Pillow.fromarray,
    "16 bit.png": lambda m: Pillow.fromarray(m.astype(np.uint16) * 65535),
    "16 bit of 0 and 1.png": lambda m: Pillow.fromarray(m.astype(np.uint16)),
    "float.tif": lambda m: Pillow.fromarray(m.astype(np.float32)),
    "palette.png": _palette,
    "palette and alpha.png": _palette_with_alpha,
    "colour.png": lambda m: Pillow.fromarray((m[..., None] * [200, 0, 20]).astype(np.uint8)),
    "opaque.png": lambda m: Pillow.fromarray(np.dstack([m * 255] * 3 + [m * 0 + 255]).astype(np.uint8)),
    "cut-out.png": lambda m: Pillow.fromarray(np.dstack([m * 0 + 90] * 3 + [m * 255]).astype(np.uint8)),
    "grey and alpha.png": lambda m: Pillow.fromarray(
        np.dstack([m * 0 + 255, m * 255]).astype(np.uint8), "LA"
    ),
    "cmyk.tif": lambda m: Pillow.fromarray(m.astype(np.uint8) * 255).convert("RGB").convert("CMYK"),
}


@pytest.mark.filterwarnings("ignore:.*mode.*parameter.*:DeprecationWarning")
@pytest.mark.parametrize("name", KINDS)
def test_every_kind_of_image(tmp_path: Path, name: str) -> None:
    KINDS[name](truth(0)).save(tmp_path / name)
    assert_truth(track(tmp_path, [frame(0, name)]), [0])


def test_cut_outs_are_known_by_their_alpha(tmp_path: Path) -> None:
    assert not holds_cut_outs(str(tmp_path / "absent")) and not holds_cut_outs(str(tmp_path))
    for index in range(3):
        KINDS["cut-out.png"](truth(index)).save(tmp_path / f"{index}.png")
    assert holds_cut_outs(str(tmp_path))
    KINDS["opaque.png"](truth(3)).save(tmp_path / "3.png")
    assert not holds_cut_outs(str(tmp_path))


def test_jpeg_masks_are_thresholded(tmp_path: Path) -> None:
    Pillow.fromarray(truth(0).astype(np.uint8) * 255).save(tmp_path / "0.jpg", quality=50)
    (estimate,) = track(tmp_path, [frame(0)])
    assert (estimate.binary ^ truth(0)).sum() < 0.05 * truth(0).sum()


def test_arrays(tmp_path: Path) -> None:
    stack = np.stack([truth(index) for index in range(3)])
    np.save(tmp_path / "bool.npy", stack)
    np.savez(tmp_path / "grey.npz", masks=stack.astype(np.uint8) * 255)
    np.savez_compressed(tmp_path / "float.npz", stack.astype(np.float64)[:, None])
    frames = [frame(index, f"{index + 5:06d}.jpg") for index in range(4)]
    for name in ("bool.npy", "grey.npz", "float.npz"):
        assert_truth(track(tmp_path / name, frames), [0, 1, 2, None])


def test_arrays_by_frame_name(tmp_path: Path) -> None:
    np.savez(tmp_path / "m.npz", **{f"{index:06d}": truth(index) for index in (10, 2, 3)})
    frames = [frame(index, f"{index + 2:06d}.jpg") for index in range(3)]
    assert_truth(track(tmp_path / "m.npz", frames), [2, 3, None])
    np.savez(tmp_path / "one.npz", **{"000003": truth(3)})
    assert_truth(track(tmp_path / "one.npz", frames), [None, 3, None])


def test_a_video(tmp_path: Path) -> None:
    write_video(tmp_path / "masks.mkv", 4)
    assert_truth(track(tmp_path / "masks.mkv", [frame(i) for i in (0, 1, 3, 4, 5)]), [0, 1, 3, None, None])
    assert_truth(track(tmp_path / "masks.mkv", [frame(i) for i in (2, 0)]), [2, 0])


def test_masks_of_another_size_are_scaled(tmp_path: Path) -> None:
    double = Pillow.fromarray(truth(1, (96, 128)).astype(np.uint8) * 255)
    double.save(tmp_path / "0.png")
    (estimate,) = track(tmp_path, [frame(0)])
    np.testing.assert_array_equal(estimate.binary, truth(1))


def test_masks_of_other_proportions_are_refused_on_the_first_frame(tmp_path: Path) -> None:
    write_png(tmp_path / "0.png", 0)
    Pillow.new("L", (64, 64)).save(tmp_path / "7.png")
    with pytest.raises(InputError, match=r"7\.png is 64x64 pixels but frame 0 is 64x48"):
        track(tmp_path, [frame(0)])
    np.save(tmp_path / "m.npy", np.ones((2, 30, 30)))
    with pytest.raises(InputError, match=r"30x30"):
        track(tmp_path / "m.npy", [frame(0)])


def test_an_empty_mask_is_a_gap(tmp_path: Path) -> None:
    np.save(tmp_path / "m.npy", np.stack([truth(0), truth(0) & False]))
    assert_truth(track(tmp_path / "m.npy", [frame(0), frame(1)]), [0, None])


def test_a_damaged_mask_is_a_gap(tmp_path: Path) -> None:
    for index in range(3):
        write_png(tmp_path / f"{index}.png", index)
    whole = (tmp_path / "1.png").read_bytes()
    (tmp_path / "1.png").write_bytes(whole[: len(whole) // 2])
    estimates = track(tmp_path, [frame(i) for i in range(3)])
    assert_truth(estimates, [0, None, 2])
    assert "1.png" in estimates[1].reason


def test_a_truncated_video_ends_in_gaps(tmp_path: Path) -> None:
    write_video(tmp_path / "m.mkv", 6)
    whole = (tmp_path / "m.mkv").read_bytes()
    (tmp_path / "m.mkv").write_bytes(whole[: len(whole) * 2 // 3])
    estimates = track(tmp_path / "m.mkv", [frame(i) for i in range(6)])
    assert_truth(estimates[:1], [0])
    assert estimates[-1].mask is None


@pytest.mark.parametrize(
    "name", ["absent", "folder", "notes", "text.png", "text.npz", "text.mp4", "pickle.npy"]
)
def test_unusable_paths_are_refused_at_once(tmp_path: Path, name: str) -> None:
    path = tmp_path / name
    if name == "folder":
        path.mkdir()
    elif name == "notes":
        path.mkdir()
        (path / "readme.txt").write_text("no mask")
        (path / "broken.png").write_text("no mask")
    elif name == "pickle.npy":
        np.save(path, np.array([{"a": 1}], dtype=object), allow_pickle=True)
    elif name != "absent":
        path.write_text("no mask")
    with pytest.raises(InputError, match=name):
        PrecomputedMasks.from_options(PrecomputedMasks.Options(path=str(path)))


def test_nothing_is_unpickled(tmp_path: Path) -> None:
    (tmp_path / "m.npy").write_bytes(pickle.dumps(np.zeros((2, 4, 4))))
    with pytest.raises(InputError):
        PrecomputedMasks.from_options(PrecomputedMasks.Options(path=str(tmp_path / "m.npy")))


@pytest.mark.parametrize("shape", [(0, 4, 4), (4,), (2, 3, 4, 4), (2, 0, 4)])
def test_arrays_of_other_shapes_are_refused(tmp_path: Path, shape: tuple[int, ...]) -> None:
    np.save(tmp_path / "m.npy", np.zeros(shape))
    with pytest.raises(InputError, match="holds no masks"):
        PrecomputedMasks.from_options(PrecomputedMasks.Options(path=str(tmp_path / "m.npy")))


def test_options_are_checked() -> None:
    with pytest.raises(ValidationError):
        PrecomputedMasks.Options()
    with pytest.raises(ValidationError):
        PrecomputedMasks.Options(path=".", folder=".")


def test_a_frame_before_the_start_is_a_plugin_error(tmp_path: Path) -> None:
    write_png(tmp_path / "0.png", 0)
    tracker = PrecomputedMasks.from_options(PrecomputedMasks.Options(path=str(tmp_path)))
    with pytest.raises(PluginError):
        tracker.step(frame(0))


def test_masks_in_an_archive_are_decompressed_one_at_a_time(tmp_path: Path) -> None:
    """The archive has under 1 MB; its masks together would take 157 MB."""
    write_zeros(tmp_path / "m.npz", masks=(512, 480, 640))
    with memory_stays_below(2**26):
        estimates = track(tmp_path / "m.npz", [frame(0), frame(400), frame(3)])
    assert all("is empty" in estimate.reason for estimate in estimates)


@pytest.mark.parametrize("shape", [(1, 2**14, 2**13 + 1), (2**14, 2**13 + 1)], ids=["stack", "frame"])
def test_masks_larger_than_a_frame_can_be_are_refused_before_they_are_read(tmp_path: Path, shape) -> None:
    write_zeros(tmp_path / "m.npz", masks=shape)
    with memory_stays_below(2**24), pytest.raises(InputError, match=r"m\.npz holds masks that are larger"):
        PrecomputedMasks.from_options(PrecomputedMasks.Options(path=str(tmp_path / "m.npz")))


def test_a_stack_in_fortrans_order_is_read_too(tmp_path: Path) -> None:
    np.savez(tmp_path / "m.npz", np.asfortranarray(np.stack([truth(index) for index in range(3)])))
    assert_truth(track(tmp_path / "m.npz", [frame(2), frame(0)]), [2, 0])
