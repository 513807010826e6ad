"""Results of other tools are read as answers: hand-written files, round trips, and strangers' damaged ones."""

from __future__ import annotations

import pickle
import struct
from pathlib import Path

import numpy as np
import pytest
from large_arrays import memory_stays_below, write_zeros
from PIL import Image
from scipy.spatial.transform import Rotation

from tracking3d.errors import InputError
from tracking3d.results.files import write_image, write_mask
from tracking3d_bench.datasets.readers import (
    answers_from_bop_csv,
    answers_from_colmap,
    answers_from_masks,
    answers_from_tapvid,
    answers_from_tum,
    read_answers,
    recognise_format,
)
from tracking3d_bench.datasets.truth import PointTruth, Truth

SIZE = (32, 24)
COUNT = 4


def pose(n):
    T = np.eye(4)
    T[:3, :3] = Rotation.from_euler("xyz", [10 * n, 20, -30], degrees=True).as_matrix()
    T[:3, 3] = 0.01 * n, -0.02, 0.5
    return T


def quaternion(T):
    """w, x, y, z."""
    return Rotation.from_matrix(T[:3, :3]).as_quat()[[3, 0, 1, 2]].tolist()


@pytest.fixture
def truth(tmp_path):
    frames = []
    for n in range(COUNT):
        frames.append(tmp_path / "clip" / f"{n:06d}.png")
        frames[n].parent.mkdir(exist_ok=True)
        write_image(frames[n], np.zeros((*SIZE[::-1], 3), np.uint8))
    rng = np.random.default_rng(0)
    points = PointTruth(rng.uniform(0, 20, (COUNT, 3, 2)), np.ones((COUNT, 3), bool))
    return Truth("clip", tuple(frames), points=points, millimetres=1000.0)


def poses_agree(found, expected):
    assert list(found) == list(expected)
    for n, T in expected.items():
        np.testing.assert_allclose(found[n], T, atol=1e-6)


# Masks


def disc(n):
    y, x = np.indices(SIZE[::-1])
    return np.hypot(x - 10 - n, y - 12) < 5


def write_masks(folder, names):
    folder.mkdir(parents=True, exist_ok=True)
    for n, name in names.items():
        write_mask(folder / f"{name}.png", disc(n))
    return folder


def test_masks_belong_to_the_frames_that_they_are_named_after(truth, tmp_path):
    answers = answers_from_masks(write_masks(tmp_path / "m", {0: "000000", 2: "000002", 3: "other"}), truth)
    assert answers.answered == {0, 2} and answers.asked == range(COUNT) and answers.given == 0
    assert (answers.masks[2].read() == disc(2)).all()


def test_numbers_in_names_count_as_numbers(truth, tmp_path):
    answers = answers_from_masks(write_masks(tmp_path / "m", {1: "00001", 3: "3"}), truth)
    assert answers.answered == {1, 3}


def test_a_folder_of_clips_is_entered(truth, tmp_path):
    write_masks(tmp_path / "results" / "clip", {1: "000001"})
    assert answers_from_masks(tmp_path / "results", truth).answered == {1}


def test_one_object_of_a_davis_image_is_picked_by_its_number(truth, tmp_path):
    (tmp_path / "m").mkdir()
    labels = np.zeros(SIZE[::-1], np.uint8)
    labels[:, :10], labels[:, 20:] = 1, 2
    image = Image.frombytes("P", SIZE, labels.tobytes())
    image.putpalette([0, 0, 0, 128, 0, 0, 0, 128, 0])
    image.save(tmp_path / "m" / "000001.png")
    second = answers_from_masks(tmp_path / "m", truth, object_id=2).masks[1].read()
    assert (second == (labels == 2)).all()
    assert (answers_from_masks(tmp_path / "m", truth).masks[1].read() == (labels > 0)).all()


def test_a_folder_without_masks_of_the_clip_is_refused(truth, tmp_path):
    with pytest.raises(InputError, match="no mask image with the name of a frame"):
        answers_from_masks(write_masks(tmp_path / "m", {0: "left", 1: "right"}), truth)
    with pytest.raises(InputError, match="no folder"):
        answers_from_masks(tmp_path / "nowhere", truth)


def test_two_masks_of_one_frame_are_refused(truth, tmp_path):
    with pytest.raises(InputError, match="masks of frame 000001"):
        answers_from_masks(write_masks(tmp_path / "m", {0: "000001", 1: "1"}), truth)


@pytest.mark.parametrize("object_id", [None, 1])
def test_a_damaged_mask_is_named_when_it_is_read(truth, tmp_path, object_id):
    folder = write_masks(tmp_path / "m", {1: "000001"})
    (folder / "000001.png").write_bytes(b"\x89PNG but no more")
    mask = answers_from_masks(folder, truth, object_id=object_id).masks[1]
    with pytest.raises(InputError, match=r"000001\.png is not a readable image"):
        mask.read()


# BOP


def bop_row(n, score=0.5, scene=1, obj=1, seconds=0.25, T=None, im_id=None):
    T = pose(n) if T is None else T
    R = " ".join(map(repr, T[:3, :3].ravel().tolist()))
    t = " ".join(map(repr, (1000 * T[:3, 3]).tolist()))
    return f"{scene},{n if im_id is None else im_id},{obj},{score},{R},{t},{seconds}"


def write_bop(tmp_path, *rows, header=True):
    file = tmp_path / "method_data-test.csv"
    file.write_text("\n".join([*(["scene_id,im_id,obj_id,score,R,t,time"] if header else []), *rows]) + "\n")
    return file


@pytest.mark.parametrize("header", [True, False])
def test_bop_poses_come_back_in_the_unit_of_the_truth(truth, tmp_path, header):
    file = write_bop(tmp_path, *(bop_row(n, score=n / 4) for n in (0, 1, 3)), header=header)
    answers = answers_from_bop_csv(file, truth)
    poses_agree(answers.T_cam_obj, {n: pose(n) for n in (0, 1, 3)})
    assert answers.answered == {0, 1, 3} and not answers.lost
    assert answers.confidence == {0: 0, 1: 0.25, 3: 0.75} and answers.seconds[0] == 0.25


def test_the_best_scored_pose_of_an_image_counts(truth, tmp_path):
    file = write_bop(tmp_path, bop_row(0, 0.1, im_id=2), bop_row(1, 0.9, im_id=2), bop_row(3, 0.5, im_id=2))
    poses_agree(answers_from_bop_csv(file, truth).T_cam_obj, {2: pose(1)})


def test_scores_that_are_no_probabilities_are_no_confidence_and_minus_one_is_no_time(truth, tmp_path):
    answers = answers_from_bop_csv(write_bop(tmp_path, bop_row(0, 17.5, seconds=-1)), truth)
    assert not answers.confidence and not answers.seconds


def test_other_scenes_objects_and_images_do_not_count(truth, tmp_path):
    rows = bop_row(0, scene=2), bop_row(1, scene=1), bop_row(2, scene=1, obj=7), bop_row(3, scene=1, im_id=99)
    answers = answers_from_bop_csv(write_bop(tmp_path, *rows), truth, scene_id=1, obj_id=1)
    poses_agree(answers.T_cam_obj, {1: pose(1)})


def test_the_images_of_the_frames_can_be_told(truth, tmp_path):
    file = write_bop(tmp_path, bop_row(2, im_id=40))
    poses_agree(answers_from_bop_csv(file, truth, im_ids=[20, 30, 40, 50]).T_cam_obj, {2: pose(2)})


def test_a_pose_that_is_not_rigid_is_refused_with_its_line_and_image(truth, tmp_path):
    file = write_bop(tmp_path, bop_row(1), bop_row(0, T=2 * pose(0)))
    with pytest.raises(InputError, match=r"Line 3 of .*\(image 0\): R is not a rotation"):
        answers_from_bop_csv(file, truth)


@pytest.mark.parametrize(
    ("rows", "message"),
    [
        ([], "has no poses"),
        (["1,2,3"], "Line 2 "),
        (["1,0,1,0.5,1 0 0 0 1 0 0 0,0 0 1,0"], "Line 2 .*nine numbers"),
        (["1,0,1,nan,1 0 0 0 1 0 0 0 1,0 0 1,0"], "not finite"),
        (["1,x,1,0.5,1 0 0 0 1 0 0 0 1,0 0 1,0"], "Line 2 "),
        ([bop_row(0, scene=1), bop_row(0, scene=2)], "has 2 scenes"),
        ([bop_row(0, obj=1), bop_row(0, obj=2)], "has 2 objects"),
        ([bop_row(0, im_id=9)], "no pose of object 1 in scene 1"),
    ],
)
def test_a_table_that_cannot_be_used_says_why(truth, tmp_path, rows, message):
    with pytest.raises(InputError, match=message):
        answers_from_bop_csv(write_bop(tmp_path, *rows), truth)


def test_a_scene_that_the_table_lacks_is_named(truth, tmp_path):
    with pytest.raises(InputError, match="has no scene 5; it has 1"):
        answers_from_bop_csv(write_bop(tmp_path, bop_row(0)), truth, scene_id=5)


# TUM


def tum_line(time, T):
    w, *xyz = quaternion(T)
    return " ".join(map(repr, [time, *T[:3, 3].tolist(), *xyz, w]))


def write_tum(tmp_path, *lines):
    file = tmp_path / "trajectory.txt"
    file.write_text("# timestamp tx ty tz qx qy qz qw\n" + "\n".join(lines) + "\n")
    return file


def test_timestamps_are_frame_indices(truth, tmp_path):
    file = write_tum(tmp_path, *(tum_line(float(n), pose(n)) for n in (3, 0, 1)), "", tum_line(77.0, pose(0)))
    answers = answers_from_tum(file, truth)
    poses_agree(answers.T_cam_obj, {n: pose(n) for n in (0, 1, 3)})
    assert answers.answered == {0, 1, 3} and not answers.lost


def test_timestamps_are_seconds_where_frames_a_second_are_given(truth, tmp_path):
    file = write_tum(tmp_path, *(tum_line(round(n / 30, 4), pose(n)) for n in range(3)))
    poses_agree(answers_from_tum(file, truth, fps=30).T_cam_obj, {n: pose(n) for n in range(3)})


def test_the_cameras_poses_are_inverted(truth, tmp_path):
    file = write_tum(tmp_path, *(tum_line(n, np.linalg.inv(pose(n))) for n in range(2)))
    poses_agree(answers_from_tum(file, truth, of="camera").T_cam_obj, {n: pose(n) for n in range(2)})


def test_a_quaternion_is_read_with_the_real_part_last(truth, tmp_path):
    """A quarter turn about z takes x to y."""
    half = np.sqrt(0.5)
    answers = answers_from_tum(write_tum(tmp_path, f"0 1 2 3 0 0 {half} {half}"), truth)
    np.testing.assert_allclose(answers.T_cam_obj[0] @ [1, 0, 0, 1], [1, 3, 3, 1], atol=1e-6)


@pytest.mark.parametrize(
    ("line", "message"),
    [
        ("0 1 2 3 0 0 0", "not timestamp tx ty tz"),
        ("0 1 2 3 0 0 0 1 5", "not timestamp tx ty tz"),
        ("0 1 2 3 0 0 0 2", "unit quaternion"),
        ("0 1 nan 3 0 0 0 1", "not timestamp"),
        ("0,1,2,3,0,0,0,1", "values that are not numbers"),
        ("0.5 1 2 3 0 0 0 1", "frame indices unless"),
        ("1e300 1 2 3 0 0 0 1", "frame indices unless"),
        ("99 1 2 3 0 0 0 1", "no pose for a frame"),
        ("0 0 0 1 0 0 0 1\n0 0 0 1 0 0 0 1", "second pose of frame 0"),
        ("", "no pose for a frame"),
    ],
)
def test_a_line_that_is_no_pose_is_named(truth, tmp_path, line, message):
    with pytest.raises(InputError, match=message):
        answers_from_tum(write_tum(tmp_path, line), truth)


def test_unknown_meanings_of_a_trajectory_are_refused(truth, tmp_path):
    file = write_tum(tmp_path, tum_line(0, pose(0)))
    with pytest.raises(InputError, match="choose object or camera"):
        answers_from_tum(file, truth, of="world")
    with pytest.raises(InputError, match="positive number"):
        answers_from_tum(file, truth, fps=0)


# TAP-Vid


def tapvid_arrays(truth, raster=(1, 1), dtype=np.float32):
    scale = np.array(raster) / SIZE
    tracks = ((truth.points.positions + 0.5) * scale).transpose(1, 0, 2).astype(dtype)
    occluded = np.zeros((3, COUNT), bool)
    occluded[1, 2] = True
    return {"points": tracks, "occluded": occluded}


def write_pickle(file, document, protocol=4):
    file.write_bytes(pickle.dumps(document, protocol))
    return file


@pytest.mark.parametrize("protocol", range(6))
def test_tracks_in_the_order_of_the_true_points_answer_about_them(truth, tmp_path, protocol):
    file = write_pickle(tmp_path / "t.pkl", {"clip": tapvid_arrays(truth), "other": {}}, protocol)
    answers = answers_from_tapvid(file, truth)
    positions, visible = answers.points(1, truth.points.positions[1, [2, 1]])
    np.testing.assert_allclose(positions, truth.points.positions[:, [2, 1]], atol=1e-4)
    assert visible[:, 0].all() and visible[:, 1].tolist() == [True, True, False, True]


def test_the_corner_of_the_picture_is_half_a_pixel_before_the_first_centre(truth, tmp_path):
    arrays = tapvid_arrays(truth)
    arrays["points"][0, 3] = 0, 1
    positions, _ = answers_from_tapvid(write_pickle(tmp_path / "t.pkl", arrays), truth).points(
        0, truth.points.positions[0, :1]
    )
    np.testing.assert_allclose(positions[3, 0], [-0.5, SIZE[1] - 0.5])


@pytest.mark.parametrize("suffix", [".npz", ".pkl"])
def test_queries_say_in_which_frame_and_where_a_track_was_asked_for(truth, tmp_path, suffix):
    arrays = tapvid_arrays(truth, (256, 256))
    arrays["tracks"] = arrays.pop("points")[None]  # with a batch of one
    frames = [0, 1, 2]
    xy = arrays["tracks"][0, [0, 1, 2], frames]
    arrays["query_points"] = np.column_stack([frames, xy[:, ::-1]])
    file = tmp_path / f"t{suffix}"
    np.savez(file, **arrays) if suffix == ".npz" else write_pickle(file, arrays)
    points = answers_from_tapvid(file, truth).points
    positions, visible = points(2, truth.points.positions[2])
    assert np.isnan(positions[:, :2]).all() and not visible[:, :2].any()
    np.testing.assert_allclose(positions[:, 2], truth.points.positions[:, 2], atol=1e-3)
    assert visible[:, 2].all()


def test_a_point_may_be_asked_for_within_a_pixel_of_its_query(truth, tmp_path):
    arrays = tapvid_arrays(truth, SIZE)
    arrays["query_points"] = np.column_stack([np.zeros(3), arrays["points"][:, 0, ::-1]])
    points = answers_from_tapvid(write_pickle(tmp_path / "t.pkl", arrays), truth, raster=SIZE).points
    first = truth.points.positions[0, :1]
    for direction in np.array([(1, 0), (-1, 0), (0, 1), (0, -1)]):
        assert points(0, first + 0.9 * direction)[1].any()
        assert not points(0, first + 1.1 * direction)[1].any()


@pytest.mark.parametrize("protocol", [2, 5])
def test_arrays_that_an_older_numpy_pickled_are_read(truth, tmp_path, protocol):
    data = pickle.dumps({"clip": {**tapvid_arrays(truth), "number": np.float32(1)}}, protocol)
    if protocol == 5:  # names have their length in front, and the frame, which need not be, its own
        assert data[2:3] == b"\x95"
        data = data[:2] + data[11:]
        for name in (b"numpy._core.multiarray", b"numpy._core.numeric"):
            data = data.replace(bytes([len(name)]) + name, bytes([len(name) - 1]) + name)
    old = data.replace(b"numpy._core", b"numpy.core")
    assert old.count(b"numpy.core") == 2
    (tmp_path / "t.pkl").write_bytes(old)
    assert answers_from_tapvid(tmp_path / "t.pkl", truth).points is not None


def test_positions_are_in_the_raster_that_is_given_or_that_of_the_video(truth, tmp_path):
    arrays = tapvid_arrays(truth, (64, 48))
    expected = truth.points.positions
    with_video = {**arrays, "video": np.zeros((COUNT, 48, 64, 3), np.uint8)}
    for file, options in (
        (write_pickle(tmp_path / "a.pkl", arrays), {"raster": (64, 48)}),
        (write_pickle(tmp_path / "b.pkl", with_video), {}),
    ):
        positions, _ = answers_from_tapvid(file, truth, **options).points(0, expected[0])
        np.testing.assert_allclose(positions, expected, atol=1e-3)


def test_positions_beyond_the_usual_raster_need_to_be_told_theirs(truth, tmp_path):
    with pytest.raises(InputError, match="specify their raster"):
        answers_from_tapvid(write_pickle(tmp_path / "t.pkl", tapvid_arrays(truth, (2048, 2048))), truth)


def test_a_position_that_is_no_number_is_not_visible(truth, tmp_path):
    arrays = tapvid_arrays(truth)
    arrays["points"][0, 1] = np.nan
    _, visible = answers_from_tapvid(write_pickle(tmp_path / "t.pkl", arrays), truth).points(
        0, truth.points.positions[0, :1]
    )
    assert visible[:, 0].tolist() == [True, False, True, True]


class Harmful:
    def __reduce__(self):
        return print, ("this must never be printed",)


class Quiet:
    pass


@pytest.mark.parametrize("protocol", range(6))
@pytest.mark.parametrize(
    "thing",
    [Harmful(), Quiet(), Path("x"), {"a": {1, 2}, "f": len}],
    ids=["harmful", "quiet", "path", "mapping"],
)
def test_pickles_of_anything_but_arrays_and_plain_values_are_refused_unrun(
    truth, tmp_path, capsys, thing, protocol
):
    if isinstance(thing, dict) and protocol >= 4:
        thing = {"f": len}
    file = write_pickle(tmp_path / "t.pkl", {"clip": thing}, protocol)
    with pytest.raises(InputError, match=r"t\.pkl cannot be read as a pickle: it holds \w+"):
        answers_from_tapvid(file, truth)
    assert "never" not in capsys.readouterr().out


@pytest.mark.parametrize(
    ("module", "name"),
    [
        ("builtins", "eval"),
        ("builtins", "getattr"),
        ("builtins", "type"),
        ("os", "system"),
        ("posix", "system"),
        ("numpy", "load"),
        ("numpy._core.multiarray", "fromfile"),
        ("numpy", "ndarray.tofile"),
        ("_codecs", "lookup"),
        ("subprocess", "Popen"),
    ],
)
def test_nothing_else_of_the_admitted_modules_can_be_called(truth, tmp_path, module, name):
    code = b"\x80\x04" + b"".join(
        b"\x8c" + bytes([len(text)]) + text.encode() for text in (module, name)
    ) + b"\x93)R."  # fmt: skip
    (tmp_path / "t.pkl").write_bytes(code)
    with pytest.raises(InputError, match="it holds"):
        answers_from_tapvid(tmp_path / "t.pkl", truth)


def test_numpy_scalars_and_plain_values_are_read(truth, tmp_path):
    document = {**tapvid_arrays(truth), "n": np.float32(2), "s": ["x", (1, 2.5), b"y", True, None]}
    answers_from_tapvid(write_pickle(tmp_path / "t.pkl", document), truth)


def test_arrays_of_objects_are_refused(truth, tmp_path):
    arrays = tapvid_arrays(truth)
    arrays["points"] = arrays["points"].astype(object)
    with pytest.raises(InputError, match=r"an array of type O8, but only numbers and texts are read"):
        answers_from_tapvid(write_pickle(tmp_path / "t.pkl", arrays), truth)
    np.savez(tmp_path / "t.npz", **arrays)
    with pytest.raises(InputError, match="cannot be read as plain arrays"):
        answers_from_tapvid(tmp_path / "t.npz", truth)


def test_the_video_in_a_file_of_tracks_is_not_read(truth, tmp_path):
    np.savez(tmp_path / "t.npz", **tapvid_arrays(truth, (64, 48)))
    write_zeros(tmp_path / "t.npz", video=(2**14, 48, 64, 3))
    with memory_stays_below(2**24):
        positions, _ = answers_from_tapvid(tmp_path / "t.npz", truth).points(0, truth.points.positions[0])
    np.testing.assert_allclose(positions, truth.points.positions, atol=1e-3)


def test_more_tracks_than_a_frame_has_pixels_are_refused_before_they_are_read(truth, tmp_path):
    write_zeros(tmp_path / "t.npz", points=(2**23, COUNT, 2), occluded=(2**23, COUNT))
    with memory_stays_below(2**24), pytest.raises(InputError, match=r"t\.npz has more tracks than"):
        answers_from_tapvid(tmp_path / "t.npz", truth)


@pytest.mark.parametrize("suffix", [".pkl", ".npz"])
@pytest.mark.parametrize(
    "data", [b"", b"\x80\x04", b"PK\x03\x04", b"hello", b"\x80\x04]\x94(.", b"\xff" * 50]
)
def test_damaged_files_of_tracks_are_named(truth, tmp_path, suffix, data):
    (tmp_path / f"t{suffix}").write_bytes(data)
    with pytest.raises(InputError, match=rf"t\{suffix} "):
        answers_from_tapvid(tmp_path / f"t{suffix}", truth)


def test_a_truncated_pickle_is_named(truth, tmp_path):
    file = write_pickle(tmp_path / "t.pkl", tapvid_arrays(truth))
    file.write_bytes(file.read_bytes()[:-40])
    with pytest.raises(InputError, match=r"t\.pkl cannot be read as a pickle"):
        answers_from_tapvid(file, truth)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"points": np.zeros((3, COUNT + 1, 2))}, r"points .* must be \(N, 4, 2\)"),
        ({"occluded": np.zeros((2, COUNT))}, r"occluded .* must be \(3, 4\)"),
        ({"points": "text"}, "not an array of numbers"),
        ({"query_points": np.zeros((2, 3))}, r"query_points .* must be \(3, 3\)"),
        ({"query_points": np.full((3, 3), 4)}, "query_points .* frames 0 to 3"),
        ({"query_points": np.full((3, 3), np.nan)}, "query_points .* frames 0 to 3"),
        ({"points": np.zeros((2, COUNT, 2)), "occluded": np.zeros((2, COUNT))}, "no query_points"),
    ],
)
def test_arrays_that_do_not_fit_the_clip_are_named(truth, tmp_path, change, message):
    file = write_pickle(tmp_path / "t.pkl", {**tapvid_arrays(truth), **change})
    with pytest.raises(InputError, match=message):
        answers_from_tapvid(file, truth)


@pytest.mark.parametrize(
    ("document", "message"),
    [
        ([1, 2], "no dict"),
        ({}, "no dict"),
        ({"a": {}, "b": {}}, "no clip clip"),
        ({"clip": {}}, "no tracks or"),
    ],
)
def test_a_file_without_the_clip_is_named(truth, tmp_path, document, message):
    with pytest.raises(InputError, match=message):
        answers_from_tapvid(write_pickle(tmp_path / "t.pkl", document), truth)


# COLMAP


def colmap_text(folder, images, points="1.5 2.5 -1 3 4 7"):
    folder.mkdir(parents=True, exist_ok=True)
    lines = ["# Image list with two lines of data per image:", "#   IMAGE_ID, QW, QX, QY, QZ, ..."]
    for number, (name, T) in enumerate(images.items(), 1):
        values = " ".join(map(repr, [*quaternion(T), *T[:3, 3].tolist()]))
        lines += [f"{number} {values} 1 {name}", points]
    (folder / "images.txt").write_text("\n".join(lines) + "\n")
    return folder


def colmap_binary(folder, images):
    folder.mkdir(parents=True, exist_ok=True)
    data = struct.pack("<Q", len(images))
    for number, (name, T) in enumerate(images.items(), 1):
        data += struct.pack("<I7dI", number, *quaternion(T), *T[:3, 3], 1) + name.encode() + b"\0"
        data += struct.pack("<Q", number) + number * struct.pack("<2dq", 1.5, 2.5, -1)
    (folder / "images.bin").write_bytes(data)
    return folder


MODEL = {"000003.jpg": pose(3), "sub folder/000000.jpg": pose(0), "000001.png": pose(1)}


@pytest.mark.parametrize("write", [colmap_text, colmap_binary])
def test_registered_images_have_poses_and_the_others_are_lost(truth, tmp_path, write):
    answers = answers_from_colmap(write(tmp_path / "m", MODEL), truth)
    poses_agree(answers.T_cam_obj, {n: pose(n) for n in (0, 1, 3)})
    assert answers.lost == {2} and answers.asked == range(COUNT)


POINTS = np.array([[7.0, -2.0, 30.0], [9.0, 0.0, 31.0], [8.0, 4.0, 90.0]])


def points_text(folder):
    lines = [f"{n} {x} {y} {z} 10 20 30 0.5 1 2 3 4" for n, (x, y, z) in enumerate(POINTS)]
    (folder / "points3D.txt").write_text("\n".join(["# 3D point list", *lines, ""]))


def points_binary(folder):
    data = struct.pack("<Q", len(POINTS))
    for n, point in enumerate(POINTS):
        data += struct.pack("<Q3d3BdQ", n, *point, 10, 20, 30, 0.5, n) + n * struct.pack("<2i", 1, 2)
    (folder / "points3D.bin").write_bytes(data)


@pytest.mark.parametrize("write_points", [points_text, points_binary])
def test_the_origin_of_a_model_is_moved_to_the_median_of_its_points(truth, tmp_path, write_points):
    folder = colmap_text(tmp_path / "m", MODEL)
    write_points(folder)
    answers = answers_from_colmap(folder, truth)
    for n in (0, 1, 3):
        assert answers.T_cam_obj[n][:3, :3] == pytest.approx(pose(n)[:3, :3])
        assert answers.T_cam_obj[n][:3, 3] == pytest.approx((pose(n) @ [8, 0, 31, 1])[:3])


@pytest.mark.parametrize(("name", "data"), [("points3D.bin", b"\x05\0\0"), ("points3D.txt", b"1 2 3\n")])
def test_damaged_points_of_a_model_are_named(truth, tmp_path, name, data):
    folder = colmap_text(tmp_path / "m", MODEL)
    (folder / name).write_bytes(data)
    with pytest.raises(InputError, match=name.replace(".", r"\.")):
        answers_from_colmap(folder, truth)


def test_an_image_of_a_text_model_may_have_no_points(truth, tmp_path):
    answers = answers_from_colmap(colmap_text(tmp_path / "m", MODEL, points=""), truth)
    poses_agree(answers.T_cam_obj, {n: pose(n) for n in (0, 1, 3)})


def test_points_are_never_taken_for_images(truth, tmp_path):
    points = "9 1 0 0 0 0 0 1 1 000002.jpg"
    assert answers_from_colmap(colmap_text(tmp_path / "m", MODEL, points=points), truth).lost == {2}


def test_of_several_models_the_one_with_most_images_counts(truth, tmp_path):
    colmap_binary(tmp_path / "sparse" / "0", {"000000.jpg": pose(1)})
    colmap_text(tmp_path / "sparse" / "1", MODEL)
    colmap_binary(tmp_path / "sparse" / "2", {"000000.jpg": pose(2), "000001.jpg": pose(2)})
    for folder in (tmp_path, tmp_path / "sparse"):
        assert len(answers_from_colmap(folder, truth).T_cam_obj) == 3


def test_rigs_and_frames_of_new_models_are_ignored(truth, tmp_path):
    folder = colmap_binary(tmp_path / "m", MODEL)
    for name in ("rigs.bin", "frames.bin", "cameras.bin"):
        (folder / name).write_bytes(b"\xff")
    assert len(answers_from_colmap(folder, truth).T_cam_obj) == 3


def test_a_folder_without_a_model_or_with_that_of_another_clip_is_refused(truth, tmp_path):
    with pytest.raises(InputError, match="holds no COLMAP model"):
        answers_from_colmap(tmp_path, truth)
    with pytest.raises(InputError, match="no image with the name of a frame"):
        answers_from_colmap(colmap_text(tmp_path / "m", {"a.jpg": pose(0)}), truth)


@pytest.mark.parametrize("keep", [0, 5, 20, 60, 85, 100, -1])
def test_a_truncated_binary_model_is_named(truth, tmp_path, keep):
    file = colmap_binary(tmp_path / "m", MODEL) / "images.bin"
    file.write_bytes(file.read_bytes()[:keep])
    with pytest.raises(InputError, match=r"images\.bin cannot be read as COLMAP's images"):
        answers_from_colmap(tmp_path / "m", truth)


@pytest.mark.parametrize(
    "line", ["1 1 0 0", "1 x 0 0 0 0 0 1 1 000000.jpg", "1 2 0 0 0 0 0 1 1 000000.jpg", "\0"]
)
def test_a_damaged_line_of_a_text_model_is_named(truth, tmp_path, line):
    (tmp_path / "images.txt").write_text(f"# comment\n{line}\n\n")
    with pytest.raises(InputError, match=r"Line 2 of .*images\.txt"):
        answers_from_colmap(tmp_path, truth)


def test_a_binary_model_with_a_wrong_quaternion_is_named(truth, tmp_path):
    folder = colmap_binary(tmp_path / "m", MODEL)
    data = bytearray((folder / "images.bin").read_bytes())
    data[12:20] = struct.pack("<d", np.nan)
    (folder / "images.bin").write_bytes(data)
    with pytest.raises(InputError, match=r"Image 1 of .* no unit quaternion"):
        answers_from_colmap(folder, truth)


# Recognition


def test_every_format_is_recognised_by_what_is_there(truth, tmp_path):
    written = {
        "masks": write_masks(tmp_path / "masks", {1: "000001"}),
        "bop": write_bop(tmp_path, bop_row(0)),
        "tum": write_tum(tmp_path, tum_line(0, pose(0))),
        "tapvid": write_pickle(tmp_path / "t.pkl", {"clip": tapvid_arrays(truth)}),
        "colmap": colmap_binary(tmp_path / "model" / "sparse" / "0", MODEL).parents[1],
    }
    for name, path in written.items():
        assert recognise_format(path) == name
        answers, title = read_answers(path, truth)
        assert answers.origin == path and answers.answered and title


def test_options_reach_the_format_and_unknown_ones_are_named(truth, tmp_path):
    file = write_tum(tmp_path, tum_line(0, np.linalg.inv(pose(0))))
    answers, title = read_answers(file, truth, format="tum", of="camera")
    poses_agree(answers.T_cam_obj, {0: pose(0)})
    assert title == "a TUM trajectory"
    with pytest.raises(InputError, match=r"a TUM trajectory, which has no such option .*object_id"):
        read_answers(file, truth, object_id=1)


def test_what_is_not_there_not_known_or_not_recognised_is_named(truth, tmp_path):
    with pytest.raises(InputError, match="does not exist"):
        read_answers(tmp_path / "nowhere", truth)
    with pytest.raises(InputError, match="no format 'kitti'"):
        read_answers(tmp_path, truth, format="kitti")
    (tmp_path / "empty").mkdir()
    with pytest.raises(InputError, match="is not recognized"):
        read_answers(tmp_path / "empty", truth)
    (tmp_path / "x.mp4").touch()
    with pytest.raises(InputError, match="is not recognized"):
        read_answers(tmp_path / "x.mp4", truth)


@pytest.mark.parametrize("read", [answers_from_bop_csv, answers_from_tum, answers_from_tapvid])
def test_missing_files_and_folders_in_their_place_are_named(truth, tmp_path, read):
    with pytest.raises(InputError, match=r"no file .*nowhere\.txt"):
        read(tmp_path / "nowhere.txt", truth)
    with pytest.raises(InputError, match="cannot be read"):
        read(tmp_path, truth)


@pytest.mark.parametrize("read", [answers_from_bop_csv, answers_from_tum])
def test_binary_files_are_no_text(truth, tmp_path, read):
    (tmp_path / "x.csv").write_bytes(b"\xff\xfe\x00\x80")
    with pytest.raises(InputError, match=r"x\.csv cannot be read as text"):
        read(tmp_path / "x.csv", truth)
