"""Masks that were exported come back by --masks: the tracker ``precomputed`` reads what other tools read."""

from __future__ import annotations

import json

import numpy as np
import pytest
from PIL import Image

from tracking3d.errors import InputError
from tracking3d.frames import Frame, Prompt
from tracking3d.results.run_reader import RunReader
from tracking3d.trackers.mask_files import CocoMasks, decompress, open_masks
from tracking3d.trackers.mask_images import objects_in
from tracking3d.trackers.precomputed import PrecomputedMasks
from tracking3d.trackers.prompts.prompt import read_mask_file

SIZE = (96, 128)
ANSWERED = (0, 1, 2, 3, 5, 6)  # 4 was skipped


def frame(index: int) -> Frame:
    return Frame(index, np.zeros((*SIZE, 3), np.uint8), name=f"frame {index}")


def tracked(path, object=None):
    tracker = PrecomputedMasks.from_options(PrecomputedMasks.Options(path=str(path), object=object))
    whole = Prompt((0.0, 0.0, float(SIZE[1]), float(SIZE[0])))
    return {n: tracker.init(frame(n), whole) if n == 0 else tracker.step(frame(n)) for n in range(7)}


@pytest.mark.parametrize(
    ("format", "suffix"), [("davis", ""), ("youtube-vos", ""), ("coco", ".json"), ("vot", ".txt")]
)
def test_an_export_is_read_as_it_was(export, run, format, suffix):
    written = export(run, format)
    answers = tracked(written.rename(written.with_name(f"masks{suffix}")))
    for index in ANSWERED:
        np.testing.assert_array_equal(answers[index].binary, RunReader(run).mask(index))
    assert answers[4].mask is None and answers[4].reason


def test_one_of_several_objects_is_told_by_its_index(tmp_path):
    labels = np.zeros(SIZE, np.uint8)
    labels[10:30, 10:40], labels[50:70, 60:90], labels[0, 0] = 1, 2, 255
    image = Image.fromarray(labels)
    image.putpalette([0, 0, 0, 128, 0, 0, 0, 128, 0] + 253 * [0, 0, 0])
    image.save(tmp_path / "00000.png")
    assert objects_in(tmp_path / "00000.png") == [1, 2]
    np.testing.assert_array_equal(tracked(tmp_path, 2)[0].binary, labels == 2)
    np.testing.assert_array_equal(read_mask_file(tmp_path / "00000.png@1", "mask"), labels == 1)


def coco(path, annotations, **more):
    images = [{"id": 7, "file_name": "0.jpg", "height": SIZE[0], "width": SIZE[1]}]
    path.write_text(json.dumps({"images": images, "annotations": annotations, **more}))
    return path


def test_compressed_runs_and_polygons_of_coco(tmp_path):
    mask = pytest.importorskip("pycocotools.mask")
    truth = np.zeros(SIZE, bool)
    truth[20:40, 30:80] = True
    truth[35:60, 50:55] = True
    encoded = mask.encode(np.asfortranarray(truth.astype(np.uint8)))
    text = encoded["counts"].decode()
    whole = {"image_id": 7, "track_id": 1, "segmentation": {"size": list(SIZE), "counts": text}}
    square = {"image_id": 7, "track_id": 2, "segmentation": [[10, 10, 21, 10, 21, 31, 10, 31]]}
    path = coco(tmp_path / "masks.json", [whole, square])
    np.testing.assert_array_equal(CocoMasks(path, 1).read(0), truth)
    square = CocoMasks(path, 2).read(0)
    assert square.sum() == 11 * 21 and square[10:31, 10:21].all()
    with pytest.raises(InputError, match=r"several objects \(1, 2\)"):
        CocoMasks(path)
    with pytest.raises(InputError, match="no object 3"):
        CocoMasks(path, 3)


@pytest.mark.parametrize("text", ["P", "\x00", "éé", "PPPPPPPPPPPPPPPPPPPPP"])
def test_damaged_runs_are_refused(text):
    with pytest.raises(ValueError):
        decompress(text)


@pytest.mark.parametrize(
    "segmentation", [None, 5, {}, {"size": [4, 4], "counts": [3]}, {"size": [0, 0], "counts": []}, [[1]]]
)
def test_a_damaged_segmentation_is_a_gap(tmp_path, segmentation):
    answer = tracked(
        coco(tmp_path / "m.json", [{"image_id": 7, "category_id": 1, "segmentation": segmentation}])
    )[0]
    assert answer.mask is None and "cannot be read" in answer.reason


@pytest.mark.parametrize(
    "text",
    [
        "",
        "{",
        "[]",
        '{"images": 3}',
        '{"images": [], "annotations": []}',
        '{"images": [{}], "annotations": []}',
    ],
)
def test_what_is_no_coco_is_refused(tmp_path, text):
    (tmp_path / "m.json").write_text(text)
    with pytest.raises(InputError, match=r"m.json"):
        open_masks(tmp_path / "m.json")


def test_rectangles_are_boxes_that_the_object_is_segmented_in(tmp_path):
    rng = np.random.default_rng(0)
    file = tmp_path / "groundtruth.txt"
    lines, frames = [], []
    for index in range(3):
        image = rng.integers(0, 40, (*SIZE, 3)).astype(np.uint8)
        image[30:60, 40 + 4 * index : 80 + 4 * index] = (200, 60, 60)
        frames.append(Frame(index, image, name=f"frame {index}"))
        lines.append(f"{40 + 4 * index},30,40,30")
    lines[2] = "nan,nan,nan,nan"
    file.write_text("\n".join(lines))
    tracker = PrecomputedMasks.from_options(PrecomputedMasks.Options(path=str(file)))
    answers = [tracker.init(frames[0], Prompt((0.0, 0.0, 128.0, 96.0))), *map(tracker.step, frames[1:])]
    for index, answer in enumerate(answers):
        truth = np.zeros(SIZE, bool)
        truth[30:60, 40 + 4 * index : 80 + 4 * index] = True
        assert (answer.binary & truth).sum() / (answer.binary | truth).sum() > 0.9
    assert answers[2].reason == "there is no box for this frame" and answers[2].score <= 0.5


@pytest.mark.parametrize("text", ["", "1,2,3\n", "hello\n", "m1,2\n"])
def test_a_damaged_file_of_regions_is_refused_by_its_line(tmp_path, text):
    (tmp_path / "r.txt").write_text(text)
    with pytest.raises(InputError, match=r"r.txt"):
        open_masks(tmp_path / "r.txt")


def test_a_folder_of_several_videos_asks_for_one(tmp_path):
    for name in ("a", "b"):
        (tmp_path / name).mkdir()
        Image.new("L", SIZE[::-1], 255).save(tmp_path / name / "0.png")
    with pytest.raises(InputError, match=r"several videos .*give the folder of one"):
        open_masks(tmp_path)
