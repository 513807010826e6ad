"""What is written is what was rendered, reads back as a clip with truth, and never replaces anything else."""

from __future__ import annotations

import json
import re
import shutil

import numpy as np
import pytest
import trimesh
from PIL import Image

from tracking3d.errors import InputError, OutputError
from tracking3d.video.image_file import read_image
from tracking3d_bench.datasets.clip import read_truth
from tracking3d_bench.synthesis import writing
from tracking3d_bench.synthesis.sequences import render_sequence
from tracking3d_bench.synthesis.spec import SequenceSpec
from tracking3d_bench.synthesis.writing import SUITE_VERSION, is_complete, write_sequence

SPEC = SequenceSpec(
    object="box",
    textured=False,
    frames=3,
    size=(96, 72),
    supersample=1,
    seed=2,
    degrees_per_frame=10.0,
    disturbances={"occluder": 1.0, "wrong_fov": 0.5},
)


@pytest.fixture(scope="module")
def rendered():
    return render_sequence(SPEC)


@pytest.fixture(scope="module")
def written(tmp_path_factory):
    return write_sequence(tmp_path_factory.mktemp("suite") / "one", SPEC)


def content(folder):
    return {str(f.relative_to(folder)): f.read_bytes() for f in sorted(folder.rglob("*")) if f.is_file()}


def test_images_masks_poses_and_box_read_back_as_they_were_rendered(rendered, written):
    truth = read_truth(written)
    assert truth.names == ("000000", "000001", "000002")
    for n in range(3):
        assert (read_image(written / "frames" / f"{n:06d}.png") == rendered.images[n]).all()
        assert (truth.masks[n].read() == rendered.masks[n]).all()
        assert (truth.visible_masks[n].read() == rendered.visible_masks[n]).all()
        assert truth.T_cam_obj[n] == pytest.approx(rendered.scene.T_cam_obj[n], abs=1e-14)
    y, x = np.nonzero(rendered.visible_masks[0])
    assert truth.box == (x.min(), y.min(), np.ptp(x) + 1, np.ptp(y) + 1)


def test_depth_reads_back_to_a_thousandth_of_the_object_and_0_where_it_is_not(rendered, written):
    truth = read_truth(written)
    for n in range(3):
        depth = truth.depth[n].read()
        assert depth == pytest.approx(rendered.depth[n], abs=1e-4)
        assert ((depth > 0) == rendered.masks[n]).all()


def test_the_true_camera_and_the_told_one_are_both_there(rendered, written):
    truth = read_truth(written)
    assert np.allclose(truth.camera.K, rendered.scene.camera.K)
    assert np.allclose(truth.given_camera.K, rendered.scene.given_camera.K)
    assert truth.given_camera.fy < 0.7 * truth.camera.fy
    assert "wrong on purpose" in json.loads((written / "camera.json").read_text())["note"]


def test_points_symmetries_and_the_unit_read_back(rendered, written):
    truth = read_truth(written)
    assert truth.points.positions == pytest.approx(rendered.points.positions, abs=1e-4)
    assert (truth.points.visible == rendered.points.visible).all()
    with np.load(written / "points.npz") as arrays:
        assert arrays["object_points"] == pytest.approx(rendered.points.object_points)
        assert arrays["positions"].dtype == np.float32
    assert truth.millimetres == 100 and truth.symmetries.shape == (4, 4, 4)


def test_info_holds_the_whole_spec_and_the_version(written):
    info = json.loads((written / "info.json").read_text())
    assert SequenceSpec.model_validate(info["spec"]) == SPEC
    assert info["suite_version"] == SUITE_VERSION and info["frames"] == 3
    assert info["source"] == "tracking3d synth" and "wrong_fov 0.5" in info["note"]


def test_the_mesh_projects_onto_the_masks_and_has_its_texture(tmp_path):
    spec = SequenceSpec(object="mug", frames=1, size=(96, 72), supersample=1)
    folder = write_sequence(tmp_path / "mug", spec)
    truth = read_truth(folder)
    mesh = truth.mesh.read()
    assert np.asarray(mesh.visual.material.image).std() > 20
    T = truth.T_cam_obj[0]
    pixels = (mesh.vertices @ T[:3, :3].T + T[:3, 3]) @ truth.camera.K.T
    x, y = (pixels[:, :2] / pixels[:, 2:]).round().astype(int).T
    rows, columns = np.nonzero(truth.masks[0].read())
    assert (x.min(), x.max()) == pytest.approx((columns.min(), columns.max()), abs=1)
    assert (y.min(), y.max()) == pytest.approx((rows.min(), rows.max()), abs=1)


def test_only_what_is_needed_is_written(tmp_path):
    folder = write_sequence(tmp_path / "plain", SequenceSpec(frames=1, size=(32, 24), supersample=1))
    assert not (folder / "visible_masks").exists() and not (folder / "truth_camera.json").exists()
    truth = read_truth(folder)
    assert truth.given_camera is None and not truth.visible_masks and len(truth.symmetries) == 1


def test_jpeg_frames_are_jpeg_files(tmp_path):
    spec = SequenceSpec(frames=2, size=(64, 48), supersample=1, disturbances={"jpeg": 0.8})
    folder = write_sequence(tmp_path / "a", spec)
    assert sorted(f.name for f in (folder / "frames").iterdir()) == ["000000.jpg", "000001.jpg"]
    image = read_image(folder / "frames" / "000000.jpg")
    difference = np.abs(image.astype(int) - render_sequence(spec).images[0])
    assert 1 < difference.mean() < 20


@pytest.mark.usefixtures("made_anew")
def test_the_same_spec_gives_the_same_bytes(written, tmp_path):
    assert content(write_sequence(tmp_path / "again", SPEC)) == content(written)


def test_a_sequence_is_complete_for_its_own_spec_and_version_only(written, tmp_path, monkeypatch):
    assert is_complete(written, SPEC)
    assert not is_complete(written, SPEC.model_copy(update={"seed": 9}))
    assert not is_complete(tmp_path, SPEC)
    monkeypatch.setattr(writing, "SUITE_VERSION", SUITE_VERSION + 1)
    assert not is_complete(written, SPEC)


@pytest.mark.parametrize("text", ["", "[]", "{}", '{"spec": 3', '"spec"'])
def test_a_damaged_info_is_not_complete(tmp_path, text):
    (tmp_path / "info.json").write_text(text)
    assert not is_complete(tmp_path, SPEC)


def test_another_sequence_replaces_the_earlier_one_without_traces(written, tmp_path):
    folder = shutil.copytree(written, tmp_path / "copy")
    spec = SequenceSpec(frames=1, size=(32, 24), supersample=1)
    write_sequence(folder, spec)
    assert is_complete(folder, spec)
    assert content(folder) == content(write_sequence(tmp_path / "fresh", spec))
    assert sorted(f.name for f in tmp_path.iterdir()) == ["copy", "fresh"]


@pytest.mark.parametrize("name", ["info.json", "photo.jpg"])
def test_a_folder_with_anything_else_in_it_is_never_touched(tmp_path, name):
    (tmp_path / name).write_text('{"source": "my own data"}')
    with pytest.raises(OutputError, match="not a synthetic sequence"):
        write_sequence(tmp_path, SPEC)
    assert [f.name for f in tmp_path.iterdir()] == [name]


def test_a_file_in_the_way_is_one_sentence(tmp_path):
    (tmp_path / "file").write_text("in the way")
    for folder in (tmp_path / "file", tmp_path / "file" / "below"):
        with pytest.raises(OutputError, match="file"):
            write_sequence(folder, SPEC)


def test_an_interrupted_sequence_leaves_the_earlier_one_and_is_started_afresh(written, tmp_path):
    folder = shutil.copytree(written, tmp_path / "copy")

    def interrupt(frame):
        raise KeyboardInterrupt

    longer = SPEC.model_copy(update={"frames": 4})
    with pytest.raises(KeyboardInterrupt):
        write_sequence(folder, longer, interrupt)
    assert content(folder) == content(written)
    told: list[int] = []
    write_sequence(folder, longer, told.append)
    assert told == [0, 1, 2, 3] and is_complete(folder, longer)
    assert [f.name for f in tmp_path.iterdir()] == ["copy"]


def test_a_mesh_file_makes_a_sequence_in_metres(tmp_path):
    mesh = trimesh.creation.icosphere(2, radius=0.05)
    mesh.visual.vertex_colors = np.random.default_rng(0).integers(0, 255, (len(mesh.vertices), 4), np.uint8)
    mesh.export(tmp_path / "ball.ply")
    spec = SequenceSpec(object=str(tmp_path / "ball.ply"), frames=2, size=(64, 48), supersample=1)
    truth = read_truth(write_sequence(tmp_path / "ball", spec))
    assert truth.millimetres == 1000
    assert np.linalg.norm(truth.mesh.read().vertices, axis=1) == pytest.approx(0.05, rel=1e-6)
    assert truth.mesh.read().visual.vertex_colors[:, :3].std() > 30
    # A sphere's outline at distance d has the radius f r / sqrt(d^2 - r^2).
    d = truth.T_cam_obj[0][2, 3]
    area = np.pi * (truth.camera.fy * 0.05) ** 2 / (d**2 - 0.05**2)
    assert truth.masks[0].read().sum() == pytest.approx(area, rel=0.03)


def test_backgrounds_come_from_a_folder_by_the_seed(tmp_path):
    folder = tmp_path / "photos"
    folder.mkdir()
    for name, colour in (("a", (250, 10, 10)), ("b", (10, 250, 10)), ("c", (10, 10, 250))):
        Image.new("RGB", (50, 90), colour).save(folder / f"{name}.png")
    (folder / "notes.txt").write_text("no image")
    corners = set()
    for seed in range(12):
        spec = SequenceSpec(frames=1, size=(64, 48), supersample=1, background=str(folder), seed=seed)
        image = render_sequence(spec).images[0]
        assert (
            image.shape == (48, 64, 3)
            and (image[0] == image[0, 0]).all()
            and (image[-1] == image[0, 0]).all()
        )
        corners.add(tuple(image[0, 0].tolist()))
    assert corners == {(250, 10, 10), (10, 250, 10), (10, 10, 250)}


@pytest.mark.parametrize(
    "make", [lambda folder: None, lambda folder: folder.mkdir(), lambda folder: folder.touch()]
)
def test_a_background_without_images_is_refused(tmp_path, make):
    make(tmp_path / "photos")
    spec = SequenceSpec(background=str(tmp_path / "photos"))
    with pytest.raises(InputError, match="photos' is not a folder of images"):
        render_sequence(spec)


def test_a_damaged_background_image_is_refused_by_name(tmp_path):
    (tmp_path / "a.png").write_bytes(b"\x89PNG damaged")
    with pytest.raises(InputError, match=re.escape("a.png")):
        render_sequence(SequenceSpec(background=str(tmp_path)))
