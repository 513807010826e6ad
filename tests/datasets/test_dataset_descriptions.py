"""A new data set by a description alone: every key does what it says, wrong ones get one sentence."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import yaml
from scipy.spatial.transform import Rotation
from written_datasets import HEIGHT, WIDTH, rectangle, write_frames, write_grey, write_json, write_lines

from tracking3d.errors import InputError
from tracking3d.results.files import write_image
from tracking3d_bench.datasets.frame_matching import match_frames, number_of
from tracking3d_bench.datasets.layout import (
    DatasetLayout,
    Depth,
    Intrinsics,
    MaskLayout,
    Poses,
    Regions,
    Sequences,
    ShapeLayout,
    Symmetries,
    builtin_layouts,
    load_layout,
)
from tracking3d_bench.datasets.reading import list_sequences, read_sequence

K = [50.0, 0, 15.5, 0, 51.0, 11.5, 0, 0, 1]


@pytest.fixture
def data(tmp_path):
    """A data set of one sequence with four frames and nothing else."""
    write_frames(tmp_path / "data/cup/images", ["f_1", "f_2", "f_3", "f_10"])
    return tmp_path / "data"


@pytest.fixture
def read(data, tmp_path):
    """Reads the sequence ``cup`` with a description of these keys."""

    def read(name="cup", **keys):
        file = tmp_path / "mine.yaml"
        keys = {"name": "mine", "title": "Mine", "frames": "{sequence}/images/*", **keys}
        file.write_text(yaml.safe_dump(keys))
        return read_sequence(load_layout(file), data, name)

    return read


def pose(n):
    T = np.eye(4)
    T[:3, :3] = Rotation.from_euler("xyz", [10 * n, 20, 30], degrees=True).as_matrix()
    T[:3, 3] = 0.1 * n, 0.2, 2
    return T


# boxes


@pytest.mark.parametrize(
    ("form", "lines"),
    [
        ("xywh", ["3,4,5,6", "4,4,5,6"]),
        ("xywh", ["3\t4\t5\t6", "4  4 5 6"]),
        ("xyxy", ["3;4;8;10", "4; 4; 9; 10"]),
        ("polygon", ["3,4,8,4,8,10,3,10", "4,4,9,4,9,10,4,10"]),
        ("vot", ["3,4,5,6", "4,4,9,4,9,10,4,10"]),
    ],
)
def test_boxes_in_every_form_and_with_every_separator(read, data, form, lines):
    write_lines(data / "cup/boxes.txt", *lines)
    truth = read(regions={"file": "{sequence}/boxes.txt", "form": form})
    assert dict(truth.boxes) == {0: (3, 4, 5, 6), 1: (4, 4, 5, 6)}
    assert truth.box == (3, 4, 5, 6)
    assert not truth.masks


def test_headers_columns_and_a_count_from_one(read, data):
    write_lines(
        data / "cup/boxes.csv",
        "frame,id,left,top,width,height",
        "2,7,4,5,5,6",
        "10,7,5,5,5,6",
        "99,7,5,5,5,6",
    )
    truth = read(
        regions={
            "file": "{sequence}/boxes.csv",
            "form": "xywh",
            "header_lines": 1,
            "frame_column": 0,
            "first_column": 2,
            "one_based": True,
        }
    )
    assert dict(truth.boxes) == {1: (3, 4, 5, 6), 3: (4, 4, 5, 6)}
    assert truth.box is None


def test_rectangles_may_count_as_masks(read, data):
    write_lines(data / "cup/boxes.txt", "3,4,5,6", "nan,nan,nan,nan")
    truth = read(regions={"file": "{sequence}/boxes.txt", "score": "mask"})
    assert not truth.boxes and truth.box == (3, 4, 5, 6)
    assert (truth.masks[0].read() == rectangle(3, 4, 5, 6)).all()
    assert not truth.masks[1].read().any()


def test_rectangles_without_area_say_that_the_object_is_out_of_sight(read, data):
    write_lines(data / "cup/boxes.txt", "3,4,5,6", "0,0,0,0")
    truth = read(regions={"file": "{sequence}/boxes.txt", "form": "xywh"})
    assert list(truth.boxes) == [0] and not truth.masks[1].read().any()


def test_the_first_box_may_have_a_file_of_its_own(read, data):
    write_lines(data / "cup/start.txt", "1,2,3,4")
    write_grey(data / "cup/masks/f_1.png", rectangle(5, 5, 9, 9))
    masks = {"files": "{sequence}/masks/*"}
    assert read(masks=masks).box == (5, 5, 9, 9)
    assert read(masks=masks, box={"file": "{sequence}/start.txt"}).box == (1, 2, 3, 4)


@pytest.mark.parametrize(
    ("form", "line", "reason"),
    [
        ("xywh", "1,2,3", "3 numbers instead of 4"),
        ("xyxy", "1,2,3,4,5", "5 numbers instead of 4"),
        ("xywh", "1,2,3,inf", "infinite"),
        ("xywh", "1,2,3,wide", "'wide' is not a number"),
        ("polygon", "1,2,3,4", "not a polygon"),
        ("vot", "", "is empty"),
    ],
)
def test_damaged_lines_are_named(read, data, form, line, reason):
    good = "1,1,2,1,2,2" if form == "polygon" else "1,2,3,4"
    write_lines(data / "cup/boxes.txt", "a header", good, line, good)
    with pytest.raises(InputError, match=rf"boxes\.txt, line 3: .*{reason}"):
        read(regions={"file": "{sequence}/boxes.txt", "form": form, "header_lines": 1})


@pytest.mark.parametrize(
    ("line", "reason"), [("2", "0 numbers|missing"), ("nan,1,2,3,4", "NaN"), ("1,9,9,9,9", "twice")]
)
def test_damaged_columns_are_named(read, data, line, reason):
    write_lines(data / "cup/boxes.txt", "1,1,2,3,4", line)
    with pytest.raises(InputError, match=rf"boxes\.txt, line 2: .*({reason})"):
        read(regions={"file": "{sequence}/boxes.txt", "form": "xywh", "frame_column": 0, "first_column": 1})


def test_a_file_that_is_no_text_is_named(read, data):
    (data / "cup/boxes.txt").write_bytes(b"\xff\xfe\x00\x80")
    with pytest.raises(InputError, match=r"boxes\.txt cannot be read as text"):
        read(regions={"file": "{sequence}/boxes.txt"})


# masks and their frames


@pytest.mark.parametrize(
    ("values", "expected"),
    [
        ("threshold", rectangle(8, 0, 4, 4)),
        ("nonzero", rectangle(0, 0, 12, 4)),
        (3, rectangle(4, 0, 4, 4)),
        ([3, 3, 3], rectangle(4, 0, 4, 4)),
        (7, rectangle(0, 0, 0, 0)),
    ],
)
def test_masks_by_brightness_by_label_and_by_colour(read, data, values, expected):
    write_grey(
        data / "cup/masks/f_1.png",
        np.select([rectangle(x, 0, 4, 4) for x in (0, 4, 8)], [1, 3, 200]).astype(np.uint8),
    )
    truth = read(masks={"files": "{sequence}/masks/*", "values": values})
    assert (truth.masks[0].read() == expected).all()


def test_colours_tell_an_object_from_a_hand(read, data):
    image = np.zeros((HEIGHT, WIDTH, 3), np.uint8)
    image[5:9, 5:9] = 255, 0, 0
    image[10:20, 10:20] = 255, 128, 0
    (data / "cup/masks").mkdir()
    write_image(data / "cup/masks/f_2.png", image)
    truth = read(masks={"files": "{sequence}/masks/*", "values": [255, 0, 0]})
    assert (truth.masks[1].read() == rectangle(5, 5, 4, 4)).all()


def test_whole_visible_and_rough_masks_are_kept_apart(read, data):
    for part, width in (("whole", 10), ("seen", 6), ("rough", 11)):
        write_grey(data / f"cup/{part}/f_1.png", rectangle(2, 2, width, 9))
    truth = read(
        masks={"files": "{sequence}/whole/*"},
        visible_masks={"files": "{sequence}/seen/*"},
        initial_masks={"files": "{sequence}/rough/*"},
    )
    widths = [masks[0].read().sum() // 9 for masks in (truth.masks, truth.visible_masks, truth.initial_masks)]
    assert widths == [10, 6, 11]
    assert truth.box == (2, 2, 6, 9)
    alone = read(visible_masks={"files": "{sequence}/seen/*"})
    assert list(alone.masks) == [0] and alone.is_visible_part(0) and not truth.is_visible_part(0)


def test_the_first_pattern_that_leads_somewhere_counts(read, data):
    write_grey(data / "cup/b/f_1.png", rectangle(2, 2, 3, 3))
    write_grey(data / "cup/c/f_1.png", rectangle(2, 2, 9, 9))
    truth = read(masks={"files": ["{sequence}/a/*", "{sequence}/b/*", "{sequence}/c/*"]})
    assert truth.masks[0].read().sum() == 9


def test_files_belong_to_frames_by_number_by_name_or_by_order(read, data):
    for name in ("0001", "0003"):
        write_grey(data / f"cup/masks/{name}.png", rectangle(2, 2, 3, 3))
    masks = {"files": "{sequence}/masks/*"}
    assert list(read(masks=masks).masks) == [0, 2]
    assert list(read(masks=masks, match="order").masks) == [0, 1]
    assert list(read(masks=masks, match="order", every=3).masks) == [0, 3]
    with pytest.raises(InputError, match="nothing to score"):
        read(masks=masks, match="name")
    write_grey(data / "cup/masks/f_10.png", rectangle(2, 2, 3, 3))
    assert list(read(masks=masks, match="name").masks) == [3]


def test_files_in_order_are_in_natural_order(read, data):
    for name, width in (("10", 3), ("9", 2)):
        write_grey(data / f"cup/masks/{name}.png", rectangle(2, 2, width, 1))
    truth = read(masks={"files": "{sequence}/masks/*"}, match="order")
    assert [int(truth.masks[n].read().sum()) for n in range(2)] == [2, 3]


def test_two_files_of_one_frame_are_named(read, data):
    for name in ("1", "01"):
        write_grey(data / f"cup/masks/{name}.png", rectangle(2, 2, 3, 3))
    with pytest.raises(InputError, match=r"1\.png and .*1\.png both belong to the frame f_1\.png"):
        read(masks={"files": "{sequence}/masks/*"})


def test_frames_without_a_number_are_named(read, data):
    (data / "cup/images/f_2.png").rename(data / "cup/images/second.png")
    write_grey(data / "cup/masks/1.png", rectangle(2, 2, 3, 3))
    with pytest.raises(InputError, match=r"second\.png has no number in its name"):
        read(masks={"files": "{sequence}/masks/*"})


def test_frames_of_the_same_number_are_named(read, data):
    write_frames(data / "cup/images", ["g_2"])
    write_grey(data / "cup/masks/1.png", rectangle(2, 2, 3, 3))
    with pytest.raises(InputError, match=r"g_2\.png has the same number as f_2\.png"):
        read(masks={"files": "{sequence}/masks/*"})


def test_the_number_of_a_file_is_its_last(tmp_path):
    numbers = [
        number_of(tmp_path / name) for name in ("00012.png", "cam2_0003.jpg", "7_mask.png", "mask.png")
    ]
    assert numbers == [12, 3, 7, None]
    assert match_frames([], [tmp_path / "1.png"], "number") == {}


# objects and folders


def test_objects_by_folder(read, data):
    for name in ("lid", "body"):
        write_grey(data / f"cup/{name}/masks/f_2.png", rectangle(len(name), 2, 3, 3))
    keys = {"objects": "{sequence}/{object}/masks", "masks": {"files": "{sequence}/{object}/masks/*"}}
    assert read("cup/body", **keys).masks[1].read()[2, 4]
    assert read("cup/lid", **keys).masks[1].read()[2, 3]
    with pytest.raises(InputError, match="name one of cup/body, cup/lid"):
        read(**keys)


def test_a_name_that_is_asked_for_as_a_number_is_named(read, data):
    for name in ("lid", "body"):
        write_grey(data / f"cup/{name}/f_2.png", rectangle(2, 2, 3, 3))
    keys = {"objects": "{sequence}/{object}/f_2.png"}
    with pytest.raises(InputError, match="cannot be filled"):
        read("cup/lid", masks={"files": "{sequence}/{object:03d}/*"}, **keys)
    with pytest.raises(InputError, match=r"'lid' .* is not a number"):
        read("cup/lid", masks={"files": "{sequence}/{object}/*", "values": "objects"}, **keys)


def test_names_of_sequences_are_no_patterns(data, tmp_path):
    (data / "cup").rename(data / "cup [1]*")
    write_grey(data / "cup [1]*/masks/f_1.png", rectangle(2, 2, 3, 3))
    layout = DatasetLayout(
        name="mine", title="", frames=("{sequence}/images/*",), masks={"files": ("{sequence}/masks/*",)}
    )
    assert list_sequences(layout, data) == ["cup [1]*"]
    assert read_sequence(layout, data, "cup [1]*").box == (2, 2, 3, 3)


# poses, camera, depth, mesh, symmetries


def test_poses_in_a_file_a_frame(read, data):
    for n, number in enumerate((1, 2, 10)):
        np.savetxt(data / f"cup/pose_{number:04d}.txt", pose(n))
    np.savetxt(data / "cup/pose_0003.txt", np.full((4, 4), np.nan))
    truth = read(poses={"file": "{sequence}/pose_*.txt", "form": "matrices"}, millimetres=1000)
    assert list(truth.T_cam_obj) == [0, 1, 3] and truth.millimetres == 1000
    for n, index in enumerate((0, 1, 3)):
        assert truth.T_cam_obj[index] == pytest.approx(pose(n))


def test_poses_in_a_line_a_frame_that_tell_the_camera_in_the_object(read, data):
    lines = [" ".join(map(str, np.linalg.inv(pose(n))[:3].ravel())) for n in range(4)]
    write_lines(data / "cup/poses.txt", *lines)
    truth = read(poses={"file": "{sequence}/poses.txt", "form": "lines", "inverse": True})
    assert all(truth.T_cam_obj[n] == pytest.approx(pose(n)) for n in range(4))


def test_poses_as_in_clips(read, data):
    entry = {"R": pose(2)[:3, :3].tolist(), "t": pose(2)[:3, 3].tolist()}
    write_json(data / "cup/poses.json", {"frames": {"f_3": entry, "f_1": {**entry, "trusted": False}}})
    truth = read(poses={"file": "{sequence}/poses.json"})
    assert list(truth.T_cam_obj) == [2] and truth.T_cam_obj[2] == pytest.approx(pose(2))


@pytest.mark.parametrize(
    ("line", "reason"),
    [
        ("1 0 0", "3 x 4 or 4 x 4"),
        ("1 0 0 0 0 1 0 0 0 0 -1 0", "not a rotation"),
        ("1 0 0 nan 0 1 0 0 0 0 1 0", "not a rotation"),
        ("1 0 0 0 0 1 0 0 0 0 1 0 0 0 0 2", "not a rotation"),
    ],
)
def test_damaged_poses_are_named(read, data, line, reason):
    write_lines(data / "cup/poses.txt", "1 0 0 0 0 1 0 0 0 0 1 5", line)
    with pytest.raises(InputError, match=rf"poses\.txt, line 2.*{reason}"):
        read(poses={"file": "{sequence}/poses.txt", "form": "lines"})


@pytest.mark.parametrize(
    ("file", "text", "form"),
    [
        ("cam.txt", "50 51 15.5 11.5", "text"),
        ("cam.txt", "50 0 15.5\n0 51 11.5\n0 0 1\n0.1 0 0 0 0", "text"),
        ("cam.json", '{"K": [[50, 0, 15.5], [0, 51, 11.5], [0, 0, 1]]}', "json"),
        ("cam.json", '{"cam_K": [50, 0, 15.5, 0, 51, 11.5, 0, 0, 1]}', "json"),
        ("cam.json", '{"fx": 50, "fy": 51, "cx": 15.5, "cy": 11.5, "width": 32, "height": 24}', "json"),
        ("cam.json", '{"intrinsics": [50, 51, 15.5, 11.5]}', "json"),
    ],
)
def test_cameras_in_every_form(read, data, file, text, form):
    write_lines(data / "cup/boxes.txt", "3,4,5,6")
    (data / file).write_text(text)
    camera = read(regions={"file": "{sequence}/boxes.txt"}, camera={"file": file, "form": form}).camera
    assert camera.K.ravel().tolist() == K and (camera.width, camera.height) == (WIDTH, HEIGHT)


def test_the_camera_may_stand_in_the_description(read, data):
    write_lines(data / "cup/boxes.txt", "3,4,5,6")
    camera = read(regions={"file": "{sequence}/boxes.txt"}, camera={"values": [50, 51, 15.5, 11.5]}).camera
    assert camera.K.ravel().tolist() == K


@pytest.mark.parametrize(
    ("text", "form", "reason"),
    [
        ("", "text", "cannot be read as numbers"),
        ("1 2 3", "text", "K must be 3 x 3"),
        ("50 51 nan 11", "text", "positive focal"),
        ("50 1.5 15 0 51 11 0 0 1", "text", "K must be fx 0 cx"),
        ("", "json", "cannot be read as JSON"),
        ("{}", "json", "neither K nor fx"),
        ('{"K": "wide"}', "json", "K must be 3 x 3"),
        ('{"intrinsics": [50, 51, 15, 11], "width": 0}', "json", "width and height must be positive"),
    ],
)
def test_damaged_cameras_are_named(read, data, text, form, reason):
    write_lines(data / "cup/boxes.txt", "3,4,5,6")
    (data / "camera").write_text(text)
    with pytest.raises(InputError, match=reason) as caught:
        read(regions={"file": "{sequence}/boxes.txt"}, camera={"file": "camera", "form": form})
    assert str(data / "camera") in str(caught.value)


@pytest.mark.parametrize(
    ("keys", "expected"),
    [({}, 0.25), ({"millimetres": 1}, 250.0), ({"depth": {"scale": 0.01}}, 2.5)],
)
def test_depth_counts_are_millimetres_or_what_the_description_says(read, data, keys, expected):
    write_grey(data / "cup/depth/2.png", np.full((HEIGHT, WIDTH), 250, np.uint16))
    write_lines(data / "cup/boxes.txt", "3,4,5,6")
    depth = {"files": "{sequence}/depth/*", **keys.pop("depth", {})}
    truth = read(regions={"file": "{sequence}/boxes.txt"}, depth=depth, **keys)
    assert list(truth.depth) == [1] and truth.depth[1].read()[3, 3] == pytest.approx(expected)


def test_a_mesh_in_another_unit(read, data):
    (data / "shape.obj").write_text("v 0 0 0\nv 30 0 0\nv 0 40 0\nf 1 2 3\n")
    write_lines(data / "cup/boxes.txt", "3,4,5,6")
    truth = read(regions={"file": "{sequence}/boxes.txt"}, mesh={"file": "shape.obj", "scale": 0.001})
    assert truth.mesh.read().extents == pytest.approx([0.03, 0.04, 0])


def test_symmetries_may_stand_in_the_description(read, data):
    write_lines(data / "cup/boxes.txt", "3,4,5,6")
    flip = np.diag([-1.0, -1, 1, 1])
    regions = {"file": "{sequence}/boxes.txt"}
    truth = read(regions=regions, symmetries={"values": [flip.ravel().tolist()]})
    assert truth.symmetries.tolist() == [np.eye(4).tolist(), flip.tolist()]
    with pytest.raises(InputError, match="symmetries must be rigid"):
        read(regions=regions, symmetries={"values": [(2 * flip).ravel().tolist()]})
    with pytest.raises(InputError, match="4 x 4 matrices"):
        read(regions=regions, symmetries={"values": [[1, 2, 3]]})


# the description itself


@pytest.mark.parametrize(
    ("text", "reason"),
    [
        ("", "the key 'name' is missing"),
        ("- a", "has a list at its top level"),
        ("name: [", "not valid YAML"),
        ("{name: a, title: b, mask: {}}", "there is no key 'mask'; did you mean 'masks'"),
        ("{name: a, title: b, masks: {file: x}}", "there is no key 'masks.file'; did you mean 'masks.files'"),
        ("{name: a, title: b, masks: {}}", "the key 'masks.files' is missing"),
        ("{name: a, title: b, frames: '{seq}/*'}", "braces may hold sequence, object, frame or instance"),
        ("{name: a, title: b, frames: '{sequence'}", "brace"),
        ("{name: a, title: b, frames: '{sequence.__class__}'}", "braces may hold"),
        ("{name: a, title: b, frames: /etc/*}", "must lie below the data set's folder"),
        ("{name: a, title: b, frames: ../*}", "must lie below the data set's folder"),
        ("{name: a, title: b, frames: []}", "'frames'"),
        ("{name: a, title: b, match: colour}", "'match' must be 'number', 'name' or 'order'"),
        ("{name: a, title: b, every: 0}", "'every' must be greater than or equal to 1"),
        ("{name: a, title: b, objects: many}", r"path with \{object\} in it"),
        ("{name: a, title: b, camera: {}}", "either file or values"),
        ("{name: a, title: b, camera: {values: [1, 2]}}", "camera.values"),
        ("{name: a, title: b, millimetres: -1}", "'millimetres' must be greater than 0"),
        ("{name: a, title: b, regions: {file: x, form: circle}}", "'regions.form' must be 'vot'"),
    ],
)
def test_wrong_descriptions_get_one_sentence(tmp_path, text, reason):
    file = tmp_path / "wrong.yaml"
    file.write_text(text)
    with pytest.raises(InputError, match=reason) as caught:
        load_layout(file)
    assert str(file) in str(caught.value) and "\n" not in str(caught.value)


def test_objects_need_what_lists_them(read):
    with pytest.raises(InputError, match="mine takes objects from masks but names none"):
        read(objects="masks")
    with pytest.raises(InputError, match="mine takes objects from poses; that needs poses of form bop"):
        read(objects="poses", poses={"file": "poses.json"})


def test_an_unknown_data_set_gets_the_nearest_name():
    with pytest.raises(InputError, match=r"no data set 'davos'; .*did you mean 'davis'\?"):
        load_layout("davos")


def test_a_sequence_without_any_truth_has_nothing_to_score(read):
    with pytest.raises(InputError, match=r"'cup' .* no masks, boxes or poses: nothing to score"):
        read(masks={"files": "{sequence}/masks/*"})


def test_the_documentation_names_every_description_and_key():
    pages = Path(__file__).resolve().parents[2] / "plugins/tracking3d-bench/benchmarks"
    page = (pages / "datasets.md").read_text(encoding="utf-8")
    models = (
        DatasetLayout,
        Sequences,
        MaskLayout,
        Regions,
        Poses,
        Intrinsics,
        Depth,
        ShapeLayout,
        Symmetries,
    )
    named = {*builtin_layouts(), *(key for model in models for key in model.model_fields)}
    assert [name for name in sorted(named) if f"`{name}`" not in page] == []
