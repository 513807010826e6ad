"""Clips written as a BOP data set: every key of the format, in its units, and the poses come back."""

from __future__ import annotations

import json
from dataclasses import replace

import cv2
import numpy as np
import pytest
import trimesh
from scipy.spatial.transform import Rotation

from tracking3d.errors import InputError, OutputError
from tracking3d.geometry.camera import Camera
from tracking3d.results.files import read_mask, write_image, write_mask
from tracking3d.video import read_image
from tracking3d_bench.datasets.bop_export import write_bop
from tracking3d_bench.datasets.layout import load_layout
from tracking3d_bench.datasets.reading import list_sequences, read_sequence
from tracking3d_bench.datasets.truth import DepthFile, MaskFile, MeshFile, Truth

SIZE = (40, 30)


def pose(n):
    T = np.eye(4)
    T[:3, :3] = Rotation.from_euler("xyz", [10 * n, 20, 30], degrees=True).as_matrix()
    T[:3, 3] = 0.01 * n, -0.02, 0.5
    return T


@pytest.fixture
def truth(tmp_path):
    """Three frames in metres: rectangle masks, the right half of frame 1 hidden, all but two pixels of frame 2."""
    rng = np.random.default_rng(0)
    source = tmp_path / "clip"
    source.mkdir()
    whole = np.zeros(SIZE[::-1], bool)
    whole[5:15, 10:30] = True
    seen = [whole.copy() for _ in range(3)]
    seen[1][:, 20:] = False
    seen[2][:] = False
    seen[2][5, 10:12] = True
    depth = np.zeros(SIZE[::-1], np.uint16)
    depth[:10] = 1234
    frames, masks, visible, depths = [], {}, {}, {}
    for n in range(3):
        frames.append(source / f"shot{n}.png")
        write_image(frames[n], rng.integers(0, 256, (*SIZE[::-1], 3), dtype=np.uint8))
        masks[n], visible[n] = (MaskFile(source / f"{part}{n}.png") for part in ("whole", "seen"))
        write_mask(masks[n].path, whole)
        write_mask(visible[n].path, seen[n])
        depths[n] = DepthFile(source / f"depth{n}.png", 0.0002)
        cv2.imwrite(str(depths[n].path), depth)
    mesh = trimesh.creation.box((0.03, 0.04, 0.12))
    mesh.visual.vertex_colors = rng.integers(0, 256, (8, 4), dtype=np.uint8)
    mesh.export(source / "mesh.ply")
    return Truth(
        name="clip",
        frames=tuple(frames),
        camera=Camera(50, 51, 20, 14, *SIZE),
        T_cam_obj={n: pose(n) for n in range(3)},
        masks=masks,
        visible_masks=visible,
        depth=depths,
        mesh=MeshFile(source / "mesh.ply"),
        millimetres=1000.0,
    )


def written(tmp_path, *truths, **options):
    write_bop(tmp_path / "bop", truths, **options)
    return tmp_path / "bop"


def document(*parts):
    return json.loads(parts[0].joinpath(*parts[1:]).read_text())


def test_poses_come_back_in_millimetres(truth, tmp_path):
    gt = document(written(tmp_path, truth), "test", "000001", "scene_gt.json")
    assert list(gt) == ["0", "1", "2"]
    for n in range(3):
        (entry,) = gt[str(n)]
        assert set(entry) == {"cam_R_m2c", "cam_t_m2c", "obj_id"} and entry["obj_id"] == 1
        assert np.reshape(entry["cam_R_m2c"], (3, 3)) == pytest.approx(pose(n)[:3, :3])
        assert entry["cam_t_m2c"] == pytest.approx([10 * n, -20, 500])


def test_the_reader_of_bop_gets_the_same_truth(truth, tmp_path):
    folder = written(tmp_path, truth)
    assert list_sequences(load_layout("bop"), folder) == ["test/000001"]
    back = read_sequence(load_layout("bop"), folder, "test/000001")
    np.testing.assert_allclose(back.camera.K, truth.camera.K)
    assert back.millimetres == 1
    for n in range(3):
        expected = pose(n)
        expected[:3, 3] *= 1000
        assert back.T_cam_obj[n] == pytest.approx(expected)
        assert (back.masks[n].read() == truth.masks[n].read()).all()
        assert (back.visible_masks[n].read() == truth.visible_masks[n].read()).all()
        assert back.depth[n].read() == pytest.approx(truth.depth[n].read() * 1000)
    assert back.mesh.read().extents == pytest.approx([30, 40, 120])


def test_the_camera_of_every_frame_is_told(truth, tmp_path):
    cameras = document(written(tmp_path, truth), "test", "000001", "scene_camera.json")
    assert list(cameras) == ["0", "1", "2"]
    assert cameras["0"]["cam_K"] == [50, 0, 20, 0, 51, 14, 0, 0, 1]


def test_depth_counts_times_the_scale_are_millimetres(truth, tmp_path):
    folder = written(tmp_path, truth)
    counts = cv2.imread(str(folder / "test/000001/depth/000002.png"), cv2.IMREAD_UNCHANGED)
    assert counts.dtype == np.uint16
    scale = document(folder, "test", "000001", "scene_camera.json")["2"]["depth_scale"]
    assert counts[0, 0] * scale == pytest.approx(246.8)
    assert counts * scale / 1000 == pytest.approx(truth.depth[2].read())


def test_masks_are_0_and_255_and_named_by_image_and_instance(truth, tmp_path):
    scene = written(tmp_path, truth) / "test" / "000001"
    for part, masks in (("mask", truth.masks), ("mask_visib", truth.visible_masks)):
        assert sorted(file.name for file in (scene / part).iterdir()) == [
            f"00000{n}_000000.png" for n in range(3)
        ]
        image = cv2.imread(str(scene / part / "000001_000000.png"), cv2.IMREAD_UNCHANGED)
        assert image.ndim == 2 and set(np.unique(image)) == {0, 255}
        assert ((image > 0) == masks[1].read()).all()


def test_boxes_and_counts_are_those_of_hand_counted_rectangles(truth, tmp_path):
    info = document(written(tmp_path, truth), "test", "000001", "scene_gt_info.json")
    assert info["1"] == [
        {
            "bbox_obj": [10, 5, 19, 9],
            "bbox_visib": [10, 5, 9, 9],
            "px_count_all": 200,
            "px_count_valid": 100,
            "px_count_visib": 100,
            "visib_fract": 0.5,
        }
    ]


def test_a_hidden_object_has_no_boxes(truth, tmp_path):
    write_mask(truth.visible_masks[0].path, np.zeros(SIZE[::-1], bool))
    (info,) = document(written(tmp_path, truth), "test", "000001", "scene_gt_info.json")["0"]
    assert info["bbox_obj"] == info["bbox_visib"] == [-1, -1, -1, -1]
    assert info["px_count_all"] == 200 and info["visib_fract"] == 0


def test_frames_of_which_a_tenth_is_seen_are_targets(truth, tmp_path):
    targets = document(written(tmp_path, truth), "test_targets_bop19.json")
    assert targets == [{"scene_id": 1, "im_id": n, "obj_id": 1, "inst_count": 1} for n in (0, 1)]


def test_the_model_is_in_millimetres_with_its_colours(truth, tmp_path):
    folder = written(tmp_path, truth)
    mesh = trimesh.load_mesh(folder / "models" / "obj_000001.ply", process=False)
    assert mesh.extents == pytest.approx([30, 40, 120])
    assert (mesh.visual.vertex_colors == truth.mesh.read().visual.vertex_colors).all()
    header = (folder / "models" / "obj_000001.ply").read_text()
    assert header.startswith("ply\nformat ascii 1.0") and "property float nx" in header
    assert document(folder, "models", "models_info.json")["1"] == pytest.approx(
        {
            "diameter": 130.0,
            "min_x": -15, "min_y": -20, "min_z": -60,
            "size_x": 30, "size_y": 40, "size_z": 120,
        }
    )  # fmt: skip


def test_a_textured_model_gets_the_texture_at_its_vertices(truth, tmp_path):
    from PIL import Image

    mesh = trimesh.creation.box((0.1, 0.1, 0.1))
    texture = Image.new("RGB", (4, 4), (200, 10, 60))
    mesh.visual = trimesh.visual.TextureVisuals(uv=np.full((8, 2), 0.5), image=texture)
    (tmp_path / "textured").mkdir()
    mesh.export(tmp_path / "textured" / "mesh.obj")
    folder = written(tmp_path, replace(truth, mesh=MeshFile(tmp_path / "textured" / "mesh.obj")))
    model = trimesh.load_mesh(folder / "models" / "obj_000001.ply")
    assert (model.visual.vertex_colors[:, :3] == (200, 10, 60)).all()


def test_symmetries_are_told_in_millimetres_without_the_identity(truth, tmp_path):
    turn = np.diag([-1.0, -1.0, 1.0, 1.0])
    turn[:3, 3] = 0.002, 0, 0
    folder = written(tmp_path, replace(truth, symmetries=np.stack([np.eye(4), turn])))
    (symmetry,) = document(folder, "models", "models_info.json")["1"]["symmetries_discrete"]
    assert symmetry == [-1, 0, 0, 2, 0, -1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1]


def test_images_are_copied_or_turned_into_png(truth, tmp_path):
    bitmap, jpeg = tmp_path / "frame.bmp", tmp_path / "frame.JPEG"
    image = read_image(truth.frames[0])
    cv2.imwrite(str(bitmap), image[..., ::-1])
    cv2.imwrite(str(tmp_path / "x.jpg"), image[..., ::-1])
    (tmp_path / "x.jpg").rename(jpeg)
    rgb = written(tmp_path, replace(truth, frames=(truth.frames[0], bitmap, jpeg))) / "test/000001/rgb"
    assert (rgb / "000000.png").read_bytes() == truth.frames[0].read_bytes()
    assert (read_image(rgb / "000001.png") == image).all()
    assert (rgb / "000002.jpg").read_bytes() == jpeg.read_bytes()


def test_clips_of_one_mesh_are_scenes_of_one_object(truth, tmp_path):
    other = tmp_path / "other.ply"
    trimesh.creation.icosphere(radius=0.05).export(other)
    folder = written(tmp_path, truth, replace(truth, mesh=MeshFile(other)), truth, split="val")
    ids = [document(folder, "val", f"00000{n}", "scene_gt.json")["0"][0]["obj_id"] for n in (1, 2, 3)]
    assert ids == [1, 2, 1]
    assert sorted(document(folder, "models", "models_info.json")) == ["1", "2"]
    assert not (folder / "test_targets_bop19.json").exists()


def test_frames_without_pose_or_mask_have_no_annotation(truth, tmp_path):
    poses, masks = dict(truth.T_cam_obj), dict(truth.masks)
    del poses[0], masks[2]
    seen = {n: mask for n, mask in truth.visible_masks.items() if n != 2}
    folder = written(tmp_path, replace(truth, T_cam_obj=poses, masks=masks, visible_masks=seen))
    assert list(document(folder, "test", "000001", "scene_gt.json")) == ["1"]
    assert list(document(folder, "test", "000001", "scene_camera.json")) == ["0", "1", "2"]


def test_one_kind_of_mask_stands_in_for_the_other(truth, tmp_path):
    folder = written(tmp_path, replace(truth, visible_masks={}))
    scene = folder / "test" / "000001"
    assert (read_mask(scene / "mask_visib/000001_000000.png") == truth.masks[1].read()).all()


def test_a_clip_without_depth_has_no_depth_and_none_of_it_is_valid(truth, tmp_path):
    folder = written(tmp_path, replace(truth, depth={}))
    assert not (folder / "test/000001/depth").exists()
    assert document(folder, "test", "000001", "scene_gt_info.json")["0"][0]["px_count_valid"] == 0


@pytest.mark.parametrize("missing", ["camera", "mesh", "millimetres"])
def test_a_clip_that_lacks_what_bop_needs_is_named(truth, tmp_path, missing):
    with pytest.raises(InputError, match="clip clip lacks"):
        written(tmp_path, replace(truth, **{missing: None}))


def test_a_missing_frame_is_named(truth, tmp_path):
    with pytest.raises(InputError, match=r"nowhere\.png"):
        written(tmp_path, replace(truth, frames=(tmp_path / "nowhere.png",)))


def test_a_folder_that_cannot_be_written_is_named(truth, tmp_path):
    (tmp_path / "bop").write_text("in the way")
    with pytest.raises(OutputError, match="bop"):
        written(tmp_path, truth)
