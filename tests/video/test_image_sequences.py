"""Folders and glob patterns of images."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from PIL import Image as Pillow

from tracking3d.errors import InputError
from tracking3d.frames import Frame, SkippedFrame
from tracking3d.video import FrameSource, open_source
from tracking3d.video.source import source_notes


def save(path: Path, value: int = 0, size: tuple[int, int] = (12, 10)) -> None:
    path.parent.mkdir(exist_ok=True)
    Pillow.new("RGB", size, (value, value, value)).save(path)


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """Twelve images 0.png to 11.png, each as bright as its number, among other files."""
    shots = tmp_path / "shots"
    for number in range(12):
        save(shots / f"{number}.png", number)
    save(shots / ".hidden.png")
    (shots / "._1.png").write_bytes(b"metadata of another system")
    (shots / "notes.txt").write_text("not an image")
    (shots / "Thumbs.db").write_bytes(b"\0")
    (shots / "folder.png").mkdir()
    return shots


def test_a_folder_is_read_in_natural_order_without_foreign_files(folder: Path) -> None:
    source = open_source(folder)
    frames = list(source)
    assert isinstance(source, FrameSource)
    assert (source.name, source.count, source.fps) == (str(folder), 12, None)
    assert [frame.index for frame in frames] == list(range(12))
    assert [frame.name for frame in frames] == [f"{number}.png" for number in range(12)]
    assert [int(frame.image.max()) for frame in frames] == list(range(12))
    assert all(frame.size == (10, 12) and frame.time is None for frame in frames)


@pytest.mark.parametrize(
    ("others", "left_out"),
    [
        (["texture.png"], "texture.png is left out, since most images here have other names"),
        (
            ["DSC_1.jpg", "DSC_22.JPG"],
            "2 images such as DSC_1.jpg are left out, since most images here have other",
        ),
        (
            [f"{number}.mask.png" for number in range(12)],
            "12 images such as 0.mask.png are left out, since most",
        ),
        (
            [f"{number:02}-depth.png" for number in range(20)],
            "20 images such as 00-depth.png are left out: 16-bit grey",
        ),
    ],
    ids=["one picture beside", "another camera", "as many masks", "more depths"],
)
def test_of_several_kinds_of_names_the_frames_are_taken_and_the_others_named(
    folder, others, left_out
) -> None:
    for name in others:
        kind = "I;16" if "depth" in name else "1" if "mask" in name else "RGB"
        Pillow.new(kind, (12, 10)).save(folder / name)
    source = open_source(folder)
    assert [frame.name for frame in source] == [f"{number}.png" for number in range(12)]
    [note] = source_notes(source)
    assert note.startswith(left_out)
    assert open_source(f"{folder}/[!.]*.*").count == 12 + len(others)


def test_names_of_their_own_and_depths_alone_are_all_taken(tmp_path: Path) -> None:
    for name in ("front", "back", "left side", "top", "IMG_1", "IMG_2"):
        save(tmp_path / "words" / f"{name}.png")
    assert open_source(tmp_path / "words").count == 6
    (tmp_path / "deep").mkdir()
    for name in ("a1", "b1", "b2"):
        Pillow.new("I;16", (12, 10)).save(tmp_path / "deep" / f"{name}.png")
    assert open_source(tmp_path / "deep").count == 3
    assert source_notes(open_source(tmp_path / "deep")) == ()


def test_a_source_of_files_can_be_read_again(folder: Path) -> None:
    source = open_source(str(folder))
    assert len(list(source)) == len(list(source)) == 12


def test_a_pattern_selects_files(folder: Path) -> None:
    assert [frame.name for frame in open_source(f"{folder}/1*.png")] == ["1.png", "10.png", "11.png"]
    assert open_source(f"{folder.parent}/**/*.png").count == 12


def test_a_folder_whose_name_looks_like_a_pattern_is_a_folder(tmp_path: Path) -> None:
    save(tmp_path / "take [1]" / "0.png")
    assert open_source(tmp_path / "take [1]").count == 1


def test_selected_frames_keep_their_index(folder: Path) -> None:
    source = open_source(folder, "3:11:4")
    assert source.count == 2
    assert [(frame.index, int(frame.image.max())) for frame in source] == [(3, 3), (7, 7)]


def test_files_are_read_one_at_a_time(folder: Path) -> None:
    frames = iter(open_source(folder))
    next(frames)
    save(folder / "1.png", 200)
    assert next(frames).image.max() == 200


def test_a_damaged_image_is_skipped_and_the_run_goes_on(folder: Path) -> None:
    data = (folder / "4.png").read_bytes()
    (folder / "4.png").write_bytes(data[:-30])
    (folder / "5.png").write_bytes(b"")
    frames = list(open_source(folder))
    skipped = [frame for frame in frames if isinstance(frame, SkippedFrame)]
    assert [frame.index for frame in frames] == list(range(12))
    assert [frame.index for frame in skipped] == [4, 5]
    assert "4.png" in skipped[0].reason and "5.png" in skipped[1].reason


def test_an_image_of_another_size_is_skipped_with_both_sizes(folder: Path) -> None:
    save(folder / "6.png", size=(13, 10))
    frames = list(open_source(folder))
    assert isinstance(frames[7], Frame)
    assert isinstance(frames[6], SkippedFrame)
    assert all(part in frames[6].reason for part in ("6.png", "13 x 10", "0.png", "12 x 10"))


def test_the_first_readable_image_sets_the_size(folder: Path) -> None:
    (folder / "0.png").write_bytes(b"damaged")
    frames = list(open_source(folder))
    assert isinstance(frames[0], SkippedFrame)
    assert sum(isinstance(frame, Frame) for frame in frames) == 11


def test_a_folder_of_nothing_but_damage_is_an_input_error(tmp_path: Path) -> None:
    for number in range(3):
        (tmp_path / f"{number}.png").write_bytes(b"damaged")
    with pytest.raises(InputError, match=r"no frame that can be decoded .*0\.png"):
        list(open_source(tmp_path))


def test_an_empty_folder_is_an_input_error(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="holds no image"):
        open_source(tmp_path)


def test_a_folder_without_images_is_an_input_error(tmp_path: Path) -> None:
    (tmp_path / "notes.txt").write_text("nothing here")
    save(tmp_path / ".hidden.png")
    with pytest.raises(InputError, match="holds no image"):
        open_source(tmp_path)


def test_a_pattern_without_a_match_is_an_input_error(folder: Path) -> None:
    with pytest.raises(InputError, match="holds no image"):
        open_source(f"{folder}/*.jpg")


def test_a_selection_beyond_the_end_is_an_input_error(folder: Path) -> None:
    with pytest.raises(InputError, match=r"no frame 12.*12 images"):
        open_source(folder, "12:")


@pytest.mark.parametrize("name", ["one.png", "one.jpg", "one.gif", "no_suffix"])
def test_a_single_image_is_an_input_error_that_says_so(tmp_path: Path, name: str) -> None:
    Pillow.new("RGB", (12, 10)).save(
        tmp_path / name, format={".jpg": "JPEG", ".gif": "GIF"}.get(Path(name).suffix, "PNG")
    )
    with pytest.raises(InputError, match="single image"):
        open_source(tmp_path / name)


def test_a_damaged_single_image_is_called_an_image_too(tmp_path: Path) -> None:
    (tmp_path / "one.png").write_bytes(b"damaged")
    with pytest.raises(InputError, match="single image"):
        open_source(tmp_path / "one.png")


def test_an_animated_gif_is_a_video(tmp_path: Path) -> None:
    pictures = [Pillow.fromarray(np.full((10, 12), value, np.uint8)) for value in (10, 100, 200)]
    pictures[0].save(
        tmp_path / "moving.gif", save_all=True, append_images=pictures[1:], duration=[100, 300, 100]
    )
    frames = list(open_source(tmp_path / "moving.gif"))
    assert [int(frame.image.mean()) for frame in frames] == [10, 100, 200]
    assert [frame.time for frame in frames] == pytest.approx([0.0, 0.1, 0.4])


def test_real_photographs_are_read(shared_data: Path) -> None:
    source = open_source(shared_data / "car_shadow" / "frames", "0:40:13")
    assert source.count == 4
    assert [(frame.index, frame.size) for frame in source] == [
        (index, (480, 854)) for index in (0, 13, 26, 39)
    ]
