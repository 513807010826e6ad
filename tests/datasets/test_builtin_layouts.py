"""Every built-in description reads a tiny data set in its layout: what was written comes back."""

from __future__ import annotations

import json
import shutil

import cv2
import numpy as np
import pytest
import trimesh
from scipy.spatial.transform import Rotation
from written_datasets import (
    HEIGHT,
    WIDTH,
    rectangle,
    write_frames,
    write_grey,
    write_json,
    write_lines,
    write_palette,
)

from tracking3d.errors import InputError
from tracking3d.testing.synthesis.convex_clips import make_demo_clip
from tracking3d.trackers.vot_regions import encode_mask, format_region
from tracking3d.video import read_image
from tracking3d_bench.datasets.layout import builtin_layouts, load_layout
from tracking3d_bench.datasets.reading import list_sequences, read_sequence


def names(layout, root):
    return list_sequences(load_layout(layout), root)


def read(layout, root, name):
    return read_sequence(load_layout(layout), root, name)


def brightness(truth):
    """What `write_frames` wrote, to see that frames are in order."""
    return [int(read_image(frame)[0, 0, 0]) for frame in truth.frames]


def same(reference, mask):
    return (reference.read() == mask).all()


def test_all_descriptions_can_be_loaded_and_say_what_they_are():
    assert builtin_layouts() == ["bop", "cdtb", "clip", "coin", "davis", "inhand", "tudl", "vot"]
    for name in builtin_layouts():
        layout = load_layout(name)
        assert layout.name == name and layout.title
        assert layout.clips or (layout.link and layout.licence)


# clip


def test_clips_are_read_as_their_own_reader_does(tmp_path):
    make_demo_clip(tmp_path / "b", frames=2, size=(WIDTH, HEIGHT))
    make_demo_clip(tmp_path / "a10", frames=3, size=(WIDTH, HEIGHT))
    make_demo_clip(tmp_path / "a9", frames=3, size=(WIDTH, HEIGHT))
    (tmp_path / "notes").mkdir()
    assert names("clip", tmp_path) == ["a9", "a10", "b"]
    truth = read("clip", tmp_path, "a10")
    assert truth.name == "a10" and len(truth.frames) == len(truth.masks) == len(truth.T_cam_obj) == 3


# vot


@pytest.fixture
def vot(tmp_path):
    for sequence in ("ball", "car"):
        write_frames(tmp_path / sequence / "color", ["00000001", "00000002", "00000003"], ".jpg")
    (tmp_path / "extra").mkdir()
    write_lines(tmp_path / "list.txt", "car", "ball")
    write_lines(tmp_path / "car/groundtruth.txt", "4,5,6,7", "5.5,5,6,7", "6,5,6.5,7")
    write_lines(
        tmp_path / "ball/groundtruth.txt",
        *[format_region(encode_mask(rectangle(n, 2, 5, 3))) for n in range(3)],
    )
    return tmp_path


def test_vot_rectangles_are_boxes_in_the_order_of_the_list(vot):
    assert names("vot", vot) == ["car", "ball"]
    truth = read("vot", vot, "car")
    assert dict(truth.boxes) == {0: (4, 5, 6, 7), 1: (5.5, 5, 6, 7), 2: (6, 5, 6.5, 7)}
    assert truth.box == (4, 5, 6, 7)
    assert not truth.masks and truth.camera is None
    assert truth.names == ("00000001", "00000002", "00000003")
    assert brightness(truth) == [10, 20, 30]


def test_vot_masks_are_masks(vot):
    truth = read("vot", vot, "ball")
    assert not truth.boxes
    assert all(same(truth.masks[n], rectangle(n, 2, 5, 3)) for n in range(3))
    assert truth.box == (0, 2, 5, 3)


def test_vot_polygons_count_by_the_box_around_them(vot):
    write_lines(vot / "car/groundtruth.txt", "10,2,14,6,10,10,6,6")
    truth = read("vot", vot, "car")
    assert dict(truth.boxes) == {0: (6, 2, 8, 8)} and truth.box == (6, 2, 8, 8)


def test_vot_states_that_are_unknown_or_not_annotated_have_no_truth_and_absent_ones_an_empty_mask(vot):
    write_lines(vot / "ball/groundtruth.txt", "m1,1,2,2,0,4", "0")
    truth = read("vot", vot, "ball")
    assert list(truth.masks) == [0]
    write_lines(vot / "ball/groundtruth.txt", "m1,1,2,2,0,4", "1", "m0,0,0,0,0")
    truth = read("vot", vot, "ball")
    assert [int(truth.masks[n].read().sum()) for n in range(3)] == [4, 0, 0]
    assert truth.masks[1].read().shape == (HEIGHT, WIDTH)


def test_vot_without_a_list_takes_the_folders_with_ground_truth(vot):
    (vot / "list.txt").unlink()
    assert names("vot", vot) == ["ball", "car"]


def test_vots_sequences_have_a_truth_for_each_object(vot):
    (vot / "ball/groundtruth.txt").unlink()
    for key, x in (("10", 3), ("9", 20)):
        write_lines(vot / f"ball/groundtruth_{key}.txt", format_region(encode_mask(rectangle(x, 2, 5, 3))))
    assert names("vot", vot) == ["car", "ball/9", "ball/10"]
    assert read("vot", vot, "ball/9").name == "ball/9"
    assert read("vot", vot, "ball/9").box == (20, 2, 5, 3)
    assert read("vot", vot, "ball/10").box == (3, 2, 5, 3)


# cdtb


@pytest.fixture
def cdtb(tmp_path):
    write_frames(tmp_path / "box_darkroom/color", ["00000001", "00000002", "00000003"], ".jpg")
    for n in (1, 2, 3):
        write_grey(
            tmp_path / f"box_darkroom/depth/0000000{n}.png", np.full((HEIGHT, WIDTH), 500 * n, np.uint16)
        )
    write_lines(tmp_path / "box_darkroom/groundtruth.txt", "4,5,6,7", "nan,nan,nan,nan", "5,5,6,7")
    return tmp_path


def test_cdtb_has_boxes_depth_and_knows_when_the_target_is_out_of_sight(cdtb):
    assert names("cdtb", cdtb) == ["box_darkroom"]
    truth = read("cdtb", cdtb, "box_darkroom")
    assert dict(truth.boxes) == {0: (4, 5, 6, 7), 2: (5, 5, 6, 7)}
    assert list(truth.masks) == [1] and not truth.masks[1].read().any()
    assert [float(truth.depth[n].read()[0, 0]) for n in range(3)] == pytest.approx([0.5, 1.0, 1.5])


def test_cdtb_of_vot_2022_has_masks(cdtb):
    write_lines(cdtb / "box_darkroom/groundtruth.txt", "m4,5,2,2,0,4", "nan,nan,nan,nan", "m4,5,2,2,0,3")
    truth = read("cdtb", cdtb, "box_darkroom")
    assert [int(truth.masks[n].read().sum()) for n in range(3)] == [4, 0, 3]
    assert not truth.boxes


# davis


@pytest.fixture
def davis(tmp_path):
    frames, masks = tmp_path / "JPEGImages/480p", tmp_path / "Annotations/480p"
    for sequence in ("dogs", "cow"):
        write_frames(frames / sequence, ["00000", "00001", "00002"], ".jpg")
    for n in range(3):
        labels = rectangle(2, 2, 4, 4) * 1 + rectangle(10 + n, 3, 5, 5) * 2 + rectangle(0, 20, 32, 1) * 255
        labels[labels == 2] = 0 if n == 1 else 2
        write_palette(masks / f"dogs/0000{n}.png", labels)
        write_grey(masks / f"cow/0000{n}.png", rectangle(5 + n, 6, 7, 8))
    return tmp_path


def test_davis_2017_has_a_truth_for_each_label_and_255_is_none(davis):
    assert names("davis", davis) == ["cow", "dogs/1", "dogs/2"]
    one, two = read("davis", davis, "dogs/1"), read("davis", davis, "dogs/2")
    assert (one.name, two.name) == ("dogs/1", "dogs/2")
    assert all(same(one.masks[n], rectangle(2, 2, 4, 4)) for n in range(3))
    assert same(two.masks[0], rectangle(10, 3, 5, 5)) and same(two.masks[2], rectangle(12, 3, 5, 5))
    assert two.box == (10, 3, 5, 5)
    assert brightness(two) == [10, 20, 30]


def test_a_label_without_a_pixel_is_an_empty_mask(davis):
    empty = read("davis", davis, "dogs/2").masks[1].read()
    assert empty.shape == (HEIGHT, WIDTH) and not empty.any()


def test_davis_2016_has_one_object(davis):
    truth = read("davis", davis, "cow")
    assert truth.name == "cow" and truth.box == (5, 6, 7, 8)
    assert all(same(truth.masks[n], rectangle(5 + n, 6, 7, 8)) for n in range(3))


# coin and in-hand


@pytest.mark.parametrize(("frames", "masks"), [("frames", "masks"), ("rgb", "segmentation"), ("img", "gt")])
def test_coin_sequences_are_found_in_several_layouts(tmp_path, frames, masks):
    write_frames(tmp_path / "coin" / frames, ["0001", "0002", "0003"], ".jpg")
    for n in (1, 3):
        write_grey(tmp_path / "coin" / masks / f"000{n}_seg.png", rectangle(n, 5, 9, 9).astype(np.uint8))
    truth = read("coin", tmp_path, "coin")
    assert list(truth.masks) == [0, 2]
    assert same(truth.masks[2], rectangle(3, 5, 9, 9))


def test_coin_masks_may_lie_beside_the_frames(tmp_path):
    write_frames(tmp_path / "coin", ["1", "2"], ".jpg")
    write_grey(tmp_path / "coin/2.png", rectangle(4, 5, 9, 9))
    truth = read("coin", tmp_path, "coin")
    assert len(truth.frames) == 2 and list(truth.masks) == [1]


def test_in_hand_masks_exist_for_every_tenth_frame(tmp_path):
    write_frames(tmp_path / "mug/rgb", [f"{n}" for n in range(21)])
    for n in (0, 10, 20):
        labels = rectangle(n, 4, 5, 6) * 1 + rectangle(0, 15, 30, 5) * 2  # a hand below
        write_grey(tmp_path / f"mug/labels/{n:06d}.png", labels.astype(np.uint8))
    truth = read("inhand", tmp_path, "mug")
    assert brightness(truth) == [10 * n for n in range(1, 22)]
    assert list(truth.masks) == [0, 10, 20]
    assert same(truth.masks[10], rectangle(10, 4, 5, 6))


# bop and tudl


def pose(n):
    return Rotation.from_euler("xyz", [5 * n, 20, 30], degrees=True).as_matrix(), [n, -20.0, 500.0 + n]


@pytest.fixture
def bop(tmp_path):
    """Images 3 and 4 of a scene show object 7 twice and objects 2 and 11 once; image 5 shows 11 only."""
    scene = tmp_path / "test/000001"
    write_frames(scene / "rgb", ["000003", "000004", "000005"])
    shown = {3: [7, 11, 7, 2], 4: [2, 11, 7, 7], 5: [11]}
    scene_gt, camera = {}, {}
    for image, objects in shown.items():
        scene_gt[image] = []
        for instance, obj_id in enumerate(objects):
            R, t = pose(image + obj_id)
            scene_gt[image].append({"cam_R_m2c": R.ravel().tolist(), "cam_t_m2c": t, "obj_id": obj_id})
            name = f"{image:06d}_{instance:06d}.png"
            write_grey(scene / "mask" / name, rectangle(obj_id, image, 6, 6))
            write_grey(scene / "mask_visib" / name, rectangle(obj_id, image, 3, 6))
        camera[image] = {"cam_K": [50, 0, 15.5, 0, 51, 11.5, 0, 0, 1], "depth_scale": 0.1 * image}
        write_grey(scene / f"depth/{image:06d}.png", np.full((HEIGHT, WIDTH), 1000, np.uint16))
    write_json(scene / "scene_gt.json", scene_gt)
    write_json(scene / "scene_camera.json", camera)
    half_turn = np.diag([-1.0, -1, 1, 1])
    half_turn[0, 3] = 4
    write_json(
        tmp_path / "models/models_info.json",
        {
            "2": {"diameter": 50},
            "11": {"diameter": 50, "symmetries_discrete": [half_turn.ravel().tolist()]},
            "7": {"diameter": 50, "symmetries_continuous": [{"axis": [0, 0, 1], "offset": [1, 2, 3]}]},
        },
    )
    trimesh.creation.box((30, 40, 120)).export(tmp_path / "models/obj_000011.ply")
    return tmp_path


def test_bop_objects_of_a_scene_are_truths_of_their_own_but_not_those_shown_twice(bop):
    assert names("bop", bop) == ["test/000001/2", "test/000001/11"]
    truth = read("bop", bop, "test/000001/11")
    assert truth.names == ("000003", "000004", "000005")
    assert brightness(truth) == [10, 20, 30]


def test_bop_poses_are_in_millimetres(bop):
    truth = read("bop", bop, "test/000001/11")
    assert truth.millimetres == 1 and list(truth.T_cam_obj) == [0, 1, 2]
    for n in range(3):
        R, t = pose(n + 3 + 11)
        assert truth.T_cam_obj[n][:3, :3] == pytest.approx(R)
        assert truth.T_cam_obj[n][:3, 3] == pytest.approx(t)


def test_bop_masks_are_those_of_the_instance_in_each_image(bop):
    truth = read("bop", bop, "test/000001/2")
    assert list(truth.masks) == list(truth.visible_masks) == [0, 1]
    for n in range(2):
        assert same(truth.masks[n], rectangle(2, n + 3, 6, 6))
        assert same(truth.visible_masks[n], rectangle(2, n + 3, 3, 6))
    assert truth.box == (2, 3, 3, 6)  # of what is seen


def test_bop_camera_depth_and_mesh(bop):
    truth = read("bop", bop, "test/000001/11")
    assert truth.camera is not None
    np.testing.assert_array_equal(truth.camera.K, [[50, 0, 15.5], [0, 51, 11.5], [0, 0, 1]])
    assert (truth.camera.width, truth.camera.height) == (WIDTH, HEIGHT)
    assert [float(truth.depth[n].read()[0, 0]) for n in range(3)] == pytest.approx([300, 400, 500])
    assert truth.mesh is not None and truth.mesh.read().extents == pytest.approx([30, 40, 120])
    assert read("bop", bop, "test/000001/2").mesh is None


def test_bop_symmetries_are_those_of_the_object(bop):
    assert read("bop", bop, "test/000001/2").symmetries.tolist() == [np.eye(4).tolist()]
    half_turn = read("bop", bop, "test/000001/11").symmetries[1]
    assert half_turn @ [1, 2, 3, 1] == pytest.approx([3, -2, 3, 1])


def test_a_camera_that_changes_from_image_to_image_is_not_the_camera_of_all(bop):
    file = bop / "test/000001/scene_camera.json"
    entries = json.loads(file.read_text())
    entries["4"]["cam_K"][2] = 16.5
    write_json(file, entries)
    assert read("bop", bop, "test/000001/11").camera is None


def test_bop_images_may_be_grey_and_scenes_in_several_splits(bop):
    shutil.copytree(bop / "test", bop / "train_primesense")
    (bop / "train_primesense/000001/rgb").rename(bop / "train_primesense/000001/gray")
    assert names("bop", bop)[2:] == ["train_primesense/000001/2", "train_primesense/000001/11"]
    assert len(read("bop", bop, "train_primesense/000001/2").frames) == 3


def test_tudl_scenes_have_one_object_and_are_called_by_the_scene(bop):
    file = bop / "test/000001/scene_gt.json"
    only = {
        image: [each for each in entries if each["obj_id"] == 11]
        for image, entries in json.loads(file.read_text()).items()
    }
    write_json(file, only)
    assert names("tudl", bop) == ["test/000001"]
    truth = read("tudl", bop, "test/000001")
    assert truth.name == "test/000001" and list(truth.T_cam_obj) == [0, 1, 2] and len(truth.symmetries) == 2


# what is missing


@pytest.mark.parametrize("layout", builtin_layouts())
def test_a_missing_and_an_empty_folder_are_named(layout, tmp_path):
    with pytest.raises(InputError, match=r"no folder .*nowhere; give the folder of the data set"):
        names(layout, tmp_path / "nowhere")
    with pytest.raises(InputError, match=f"is not the data set {layout}"):
        names(layout, tmp_path)


def test_an_unknown_sequence_and_object_get_the_nearest_name(davis):
    with pytest.raises(InputError, match=r"no sequence 'dgos'; did you mean 'dogs'\?"):
        read("davis", davis, "dgos")
    with pytest.raises(InputError, match="name one of dogs/1, dogs/2"):
        read("davis", davis, "dogs")
    with pytest.raises(InputError, match="'dogs' has no object '3'"):
        read("davis", davis, "dogs/3")
    with pytest.raises(InputError, match="'cow' has no object '255'"):
        read("davis", davis, "cow/255")


def test_a_listed_sequence_that_is_not_there_is_named(vot):
    write_lines(vot / "list.txt", "car", "bicycle")
    with pytest.raises(InputError, match=r"list\.txt names the sequence 'bicycle'"):
        names("vot", vot)


def test_missing_frames_are_named(vot):
    shutil.rmtree(vot / "car/color")
    with pytest.raises(InputError, match="'car' has no images"):
        read("vot", vot, "car")


def test_missing_ground_truth_is_named(vot):
    (vot / "car/groundtruth.txt").unlink()
    with pytest.raises(
        InputError, match=r"'car' in .* has no .*car/groundtruth\.txt, which holds its regions"
    ):
        read("vot", vot, "car")


def test_a_damaged_line_is_named_with_its_file(vot):
    write_lines(vot / "car/groundtruth.txt", "4,5,6,7", "4,5,six,7", "1,2,3,4")
    with pytest.raises(InputError, match=r"groundtruth\.txt, line 2: 'six' is not a number"):
        read("vot", vot, "car")


def test_more_lines_than_frames_are_named(vot):
    write_lines(vot / "car/groundtruth.txt", *["4,5,6,7"] * 4)
    with pytest.raises(InputError, match=r"groundtruth\.txt has 4 lines, .* only 3 frames"):
        read("vot", vot, "car")


@pytest.mark.parametrize(
    ("file", "reason"),
    [("scene_gt.json", "objects"), ("scene_camera.json", "camera")],
)
def test_missing_files_of_a_scene_are_named(bop, file, reason):
    layout = load_layout("bop")
    layout = layout.model_copy(update={"sequences": layout.sequences.model_copy(update={"holding": None})})
    (bop / "test/000001" / file).unlink()
    with pytest.raises(InputError, match=rf"has no test/000001/{file}, which holds its {reason}"):
        read_sequence(layout, bop, "test/000001/11")


@pytest.mark.parametrize(
    ("file", "text", "reason"),
    [
        ("test/000001/scene_gt.json", "{", "cannot be read as JSON"),
        ("test/000001/scene_gt.json", "[]", "not a JSON object"),
        ("test/000001/scene_gt.json", '{"a": []}', "keys must be numbers"),
        ("test/000001/scene_gt.json", '{"3": {}}', "entry 3 is not a list"),
        ("test/000001/scene_gt.json", '{"3": [{"obj_id": 1}]}', "image 3 needs obj_id, cam_R_m2c"),
        (
            "test/000001/scene_gt.json",
            '{"3": [{"obj_id": 1, "cam_R_m2c": [1,0,0,0,1,0,0,0,-1], "cam_t_m2c": [0,0,1]}]}',
            "image 3: cam_R_m2c of object 1 is not a rotation",
        ),
        ("test/000001/scene_camera.json", '{"3": {}}', "image 3 needs cam_K"),
        ("test/000001/scene_camera.json", '{"3": {"cam_K": [1, 2]}}', "K must be 3 x 3 numbers"),
        ("test/000001/scene_camera.json", '{"3": {"cam_K": [1,0,0,0,-1,0,0,0,1]}}', "positive focal lengths"),
        (
            "test/000001/scene_camera.json",
            '{"3": {"cam_K": [9,0,0,0,9,0,0,0,1], "depth_scale": 0}}',
            "depth_scale",
        ),
        ("models/models_info.json", '{"2": {}}', "has no object 11"),
        ("models/models_info.json", '{"11": {"symmetries_discrete": [[1, 2]]}}', "symmetries of object 11"),
        (
            "models/models_info.json",
            '{"11": {"symmetries_continuous": [{"axis": [0, 0, 1]}]}}',
            "symmetries of object 11",
        ),
        (
            "models/models_info.json",
            '{"11": {"symmetries_continuous": [{"axis": [0, 0, 0], "offset": [0, 0, 0]}]}}',
            "symmetries of object 11",
        ),
        (
            "models/models_info.json",
            '{"11": {"symmetries_discrete": [[1,0,0,0, 0,1,0,0, 0,0,-1,0, 0,0,0,1]]}}',
            "not a rigid transform",
        ),
    ],
)
def test_damaged_files_of_a_bop_data_set_are_named(bop, file, text, reason):
    (bop / file).write_text(text)
    with pytest.raises(InputError, match=reason) as caught:
        read("bop", bop, "test/000001/11")
    assert str(bop / file) in str(caught.value)


def test_a_damaged_mask_is_named_when_it_is_read(davis):
    truth = read("davis", davis, "dogs/1")
    (davis / "Annotations/480p/dogs/00001.png").write_bytes(b"\x89PNG\r\n")
    with pytest.raises(InputError, match=r"00001\.png is not a readable image"):
        truth.masks[1].read()


def test_labels_that_are_colours_are_named(davis):
    image = np.zeros((HEIGHT, WIDTH, 3), np.uint8)
    image[..., 0] = 9
    cv2.imwrite(str(davis / "Annotations/480p/dogs/00001.png"), image)
    with pytest.raises(InputError, match="colours instead of numbered labels"):
        read("davis", davis, "dogs/1").masks[1].read()
