"""Suites of phone videos: a thing stands still, then a hand takes it, turns it and puts it down; the truth is exact."""

from __future__ import annotations

import json
from collections import Counter
from functools import cache

import cv2
import numpy as np
import pytest
from scipy.ndimage import map_coordinates
from scipy.spatial.transform import Rotation
from typer.testing import CliRunner

from tracking3d.cli import app
from tracking3d.errors import InputError
from tracking3d.geometry.camera import Camera
from tracking3d_bench.synthesis import tabletop
from tracking3d_bench.synthesis.camera_effects import linear
from tracking3d_bench.synthesis.frame_rendering import render_frame
from tracking3d_bench.synthesis.phone import phone_name, phone_seed, phone_suite
from tracking3d_bench.synthesis.pick_up import PICK_UP, Schedule, plan_pick_up
from tracking3d_bench.synthesis.pixel_rays import camera_to_pixels
from tracking3d_bench.synthesis.point_tracks import sample_point_tracks
from tracking3d_bench.synthesis.procedural_solids import make_procedural_solid
from tracking3d_bench.synthesis.scene import make_scene, make_solid
from tracking3d_bench.synthesis.spec import Disturbances, SequenceSpec, check_spec
from tracking3d_bench.synthesis.suite import load_suite
from tracking3d_bench.synthesis.writing import write_sequence

SEEDS = (5, 9000)


def quick(spec: SequenceSpec, **settings) -> SequenceSpec:
    return spec.model_copy(update={"size": (144, 256), "supersample": 1, **settings})


@pytest.fixture(scope="module", autouse=True)
def coarse_table():
    """Small images show no more of it."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(tabletop, "_TABLE", (256, 10.0))
        patch.setattr(tabletop, "_WALL", (128, 16.0))
        yield


@pytest.fixture(scope="module")
def scenes():
    """Small scenes of a box, a mug and a fourth thing, without noise."""
    specs = [phone_suite(5)[k] for k in (0, 6, 11)]
    return [
        make_scene(quick(spec, disturbances=spec.disturbances.model_copy(update={"noise": 0.0})))
        for spec in specs
    ]


def held_frames(spec: SequenceSpec, count: int = 6) -> list[int]:
    plan = Schedule.of(spec)
    return np.linspace(plan.grasp + 1, plan.released - 1, count).round().astype(int).tolist()


def hidden(frame) -> float:
    return 1 - frame.visible_mask.sum() / frame.mask.sum()


@cache
def plans(seed: int):
    """The spec, solid and path of every sequence of a suite, with the poses of the object on its table."""
    return list(_plans(seed))


def _plans(seed: int):
    for spec in phone_suite(seed):
        solid = make_solid(spec)
        path, _ = plan_pick_up(spec, solid, Camera.from_fov(*spec.size, spec.fov))
        frames = np.arange(spec.frames, dtype=np.float64)
        yield spec, solid, path, np.linalg.inv(path.T_cam_rest(frames)) @ path.T_cam_obj(frames)


def test_a_seed_gives_the_same_suite_always_and_another_seed_another_one():
    assert phone_suite(5) == phone_suite(5) == load_suite("phone-5")
    assert not {spec.seed for spec in phone_suite(5)} & {spec.seed for spec in phone_suite(6)}
    assert phone_name(5) == "phone-5" and phone_seed("phone-5") == 5
    assert phone_seed("phone") is phone_seed("fresh-5") is phone_seed("phone-x") is None
    with pytest.raises(InputError, match="--seed -1 is negative"):
        phone_suite(-1)
    with pytest.raises(InputError, match="generated from a seed"):
        load_suite("phone")


@pytest.mark.parametrize("seed", SEEDS)
def test_four_things_are_printed_four_faint_and_four_plain_in_portrait_videos(seed):
    suite = phone_suite(seed)
    kinds = Counter(
        "label"
        if spec.label
        else "plain"
        if not spec.textured
        else "strong"
        if spec.print_strength == 1
        else "faint"
        for spec in suite
    )
    assert kinds == {"strong": 4, "label": 2, "faint": 2, "plain": 4}
    shapes = Counter(spec.object for spec in suite)
    assert shapes["box"] == shapes["bottle"] == shapes["mug"] == 3 and len(shapes) == 6
    assert len({spec.name for spec in suite}) == 12 == len({spec.seed for spec in suite})
    for spec in suite:
        assert spec.motion == PICK_UP and spec.size == (720, 1280) and not spec.camera_told
        assert 65 <= spec.fov <= 75 and 150 <= spec.frames <= 300 and 30 <= spec.still_frames <= 90


def test_the_same_seed_gives_the_same_bytes_and_another_seed_others(tmp_path):
    spec = quick(phone_suite(5)[4], frames=3, still_frames=1, size=(54, 96))
    one, again = (write_sequence(tmp_path / name, spec) for name in ("one", "again"))
    files = [path.relative_to(one) for path in one.rglob("*") if path.is_file()]
    assert all((one / file).read_bytes() == (again / file).read_bytes() for file in files)
    assert {file.parts[0] for file in files} >= {"frames", "masks", "visible_masks", "depth", "poses.json"}
    assert json.loads((one / "camera.json").read_text())["given"] is False
    other = write_sequence(tmp_path / "other", spec.model_copy(update={"seed": 1}))
    image = "frames/000000.jpg"
    assert (one / image).read_bytes() != (other / image).read_bytes()


@pytest.mark.parametrize("seed", SEEDS)
def test_the_object_stands_still_at_first_while_the_camera_shakes_a_little(seed):
    for spec, solid, path, T in plans(seed):
        still = int(Schedule.of(spec).grasp)
        assert still >= spec.still_frames
        assert np.abs(T[: still + 1] - np.eye(4)).max() < 1e-6
        camera = Camera.from_fov(*spec.size, spec.fov)
        seen = path.T_cam_rest(np.arange(float(spec.frames)))[:, :3, 3]
        moved = np.linalg.norm(camera_to_pixels(camera, seen) - (camera.cx, camera.cy), axis=1)
        assert moved[0] < 1e-6 and 2 < moved.max() < 60
        assert np.linalg.norm(np.diff(camera_to_pixels(camera, seen), axis=0), axis=1).max() < 5
        outline = camera.fy * solid.radius / np.sqrt(seen[0, 2] ** 2 - solid.radius**2)
        assert 2 * outline == pytest.approx(spec.fill * spec.size[1])


@pytest.mark.parametrize("seed", SEEDS)
def test_it_is_then_turned_by_more_than_half_a_turn_about_changing_axes_with_pauses(seed):
    for spec, _, _, T in plans(seed):
        plan = Schedule.of(spec)
        R = Rotation.from_matrix(T[:, :3, :3])
        steps = np.degrees((R[1:] * R[:-1].inv()).as_rotvec())
        speed = np.linalg.norm(steps, axis=1)
        assert 180 <= speed.sum() < 500 and speed.max() < 14
        # Pauses between turns: slow for a while, with a fast turn before and after.
        window = speed[int(plan.lifted) : int(plan.lower)]
        slow = "".join("s" if value < 0.7 else "f" if value > 2.5 else "-" for value in window)
        turns = [part for part in slow.replace("-", "").split("sss") if "f" in part]
        assert len(turns) >= 2, slow
        fast = steps[speed > 2.5] / speed[speed > 2.5, None]
        assert (fast @ fast.T).min() < 0.7
        assert np.degrees((R[-1] * R[0].inv()).magnitude()) > 55


@pytest.mark.parametrize("seed", SEEDS)
def test_it_ends_upright_on_the_table_and_never_goes_through_it(seed):
    for _, solid, _, T in plans(seed):
        table = solid.vertices[:, 1].min()
        lowest = np.array([(solid.vertices @ pose[1, :3]).min() + pose[1, 3] for pose in T])
        assert lowest.min() > table - 1e-6 and lowest.max() > table + 0.3
        assert lowest[-1] == pytest.approx(table, abs=1e-6)
        assert T[-1, 1, 1] == pytest.approx(1, abs=1e-9)


def test_nothing_hides_it_before_the_hand_comes_and_a_part_of_it_is_hidden_while_it_is_held(scenes):
    for scene in scenes:
        plan = Schedule.of(scene.spec)
        for frame in (0, int(plan.arrive)):
            seen = render_frame(scene, frame)
            assert hidden(seen) == 0 and scene.hand.surface_at(float(frame)) is None
        shares = [hidden(render_frame(scene, frame)) for frame in held_frames(scene.spec)]
        assert 0.03 < np.median(shares) < 0.45 and max(shares) < 0.65


def test_the_hand_touches_what_it_holds_and_moves_along(scenes):
    for scene in scenes:
        for frame in held_frames(scene.spec):
            surface, T_hand = scene.hand.surface_at(float(frame)), scene.hand.T_cam_hand(float(frame))
            T = scene.T_cam_obj[frame]
            joints = surface.vertices @ T_hand[:3, :3].T + T_hand[:3, 3]
            in_object = (joints - T[:3, 3]) @ T[:3, :3]
            away = np.linalg.norm(in_object, axis=1)
            assert away.min() < scene.solid.radius
            assert scene.hand.hull.intersector.mesh.contains(in_object[away < scene.solid.radius]).any()


def test_without_a_hand_the_object_moves_the_same(scenes):
    bare = make_scene(scenes[0].spec.model_copy(update={"disturbances": Disturbances()}))
    assert bare.hand is None and (bare.T_cam_obj == scenes[0].T_cam_obj).all()
    frame = held_frames(bare.spec)[0]
    alone = render_frame(bare, frame)
    assert (alone.visible_mask == alone.mask).all()
    assert (alone.mask == render_frame(scenes[0], frame).mask).all()


def test_the_truth_is_that_of_the_rendered_object(scenes):
    scene = scenes[0]  # a box
    tracks = sample_point_tracks(scene, 60)
    for frame in (0, *held_frames(scene.spec, 4)):
        seen = render_frame(scene, frame)
        assert (seen.visible_mask <= seen.mask).all() and ((seen.depth > 0) == seen.mask).all()
        rows, columns = np.nonzero(seen.mask)
        rays = np.stack([columns, rows, np.ones(len(rows))], 1) @ np.linalg.inv(scene.camera.K).T
        T = scene.T_cam_obj[frame]
        points = (seen.depth[rows, columns, None] * rays - T[:3, 3]) @ T[:3, :3]
        assert np.abs((np.abs(points) - (0.62, 0.48, 0.56)).max(1)).max() < 1e-4
        hull = cv2.convexHull(
            camera_to_pixels(scene.camera, scene.solid.vertices @ T[:3, :3].T + T[:3, 3]).astype(np.float32)
        )
        assert seen.mask.sum() == pytest.approx(cv2.contourArea(hull), rel=0.03)
        x, y = tracks.positions[frame][tracks.visible[frame]].round().astype(int).T
        assert len(x) > 3
        around = cv2.dilate(seen.visible_mask.astype(np.uint8), np.ones((3, 3), np.uint8))
        assert around[y, x].all()


def test_the_table_moves_as_the_camera_does(scenes):
    scene = scenes[0]
    frames = np.array([0, scene.spec.still_frames - 1])
    T = scene.path.T_cam_rest(frames.astype(float))
    axes, origin = scene.tabletop.table.axes, scene.tabletop.table.origin
    a, b = np.meshgrid(np.linspace(-1.6, 1.6, 40), np.linspace(-2.5, -1.2, 20))  # before the object
    place = origin + np.stack([a.ravel(), b.ravel()], 1) @ axes[:, :2].T
    images = [linear(render_frame(scene, int(frame)).image).mean(2) for frame in frames]

    def looks(image, pose):
        x, y = camera_to_pixels(scene.camera, place @ pose[:3, :3].T + pose[:3, 3]).T
        return map_coordinates(image, [y, x], order=1)

    followed = np.abs(looks(images[0], T[0]) - looks(images[1], T[1])).mean()
    assert followed < 0.5 * np.abs(looks(images[0], T[0]) - looks(images[1], T[0])).mean()


def test_the_object_throws_a_shadow_on_the_table_beside_it(scenes):
    for scene in scenes:
        seen, table = render_frame(scene, 0), scene.tabletop.table
        to_pixels = table.to_pixels(scene.camera.K, scene.path.T_cam_rest(np.zeros(1))[0])
        to_picture = table.to_picture @ np.linalg.inv(to_pixels)
        flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
        albedo = cv2.warpPerspective(table.picture, to_picture, scene.spec.size, flags=flags)
        received = linear(seen.image).sum(2) / albedo.sum(2).clip(1e-3)
        around = cv2.dilate(seen.mask.astype(np.uint8), np.ones((9, 9), np.uint8)).astype(bool)
        close = around & ~cv2.dilate(seen.mask.astype(np.uint8), np.ones((3, 3), np.uint8)).astype(bool)
        rows = np.nonzero(seen.mask)[0]
        close[: int(rows.mean())] = False  # what is higher may be the wall
        away = received[rows.max() + 20 :]
        assert (received[close] < 0.75 * np.median(away)).sum() > 5


@pytest.mark.parametrize("shape", ["box", "bottle", "mug", "organic", "assembly"])
def test_a_label_is_one_small_print_on_the_outside(shape):
    plain = SequenceSpec(object=shape, textured=False, seed=3)
    label = plain.model_copy(update={"label": True})
    one, other = make_procedural_solid(label), make_procedural_solid(plain)
    changed = (one.texture.astype(int) != other.texture).any(2)
    assert 0.002 < changed.mean() < 0.2
    panels = changed.reshape(-1, 256, changed.shape[1] // 256, 256).any((1, 3))
    assert panels.sum() == 1
    assert len(one.symmetries) == 1 and one.axis is None


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"background": "photos"}, "pick_up has its own table as background"),
        ({"disturbances": {"motion_blur": 0.5}}, "pick_up is rendered without motion_blur"),
    ],
)
def test_what_a_pick_up_cannot_have_is_refused(settings, message):
    with pytest.raises(InputError, match=message):
        check_spec({"motion": PICK_UP, **settings}, "test")


def test_the_commands_know_the_suite(tmp_path, monkeypatch):
    made = []

    def write(folder, spec):
        made.append(spec)
        folder.mkdir()

    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("tracking3d_bench.synthesis.suite.write_sequence", write)
    result = CliRunner().invoke(app, ["synth", "out", "--suite", "phone", "--seed", "5"])
    assert result.exit_code == 0 and result.stdout == "out: 12 sequences\n"
    assert made == phone_suite(5)
    assert json.loads((tmp_path / "out" / "suite.json").read_text())["name"] == "phone-5"


@pytest.mark.parametrize(
    ("words", "message"),
    [
        ("synth out --suite phone", "The suite phone is drawn from a seed; give one with --seed N"),
        ("synth out --suite phone --seed 5 --frames 3", "--frames cannot change --suite phone"),
        ("evaluate suite phone", "give one with --seed N"),
        ("evaluate suite phone --seed 5 --count 3", "--count applies to the suite fresh only, not to phone"),
        ("evaluate spread phone", "give --seed N, or the name phone-N"),
    ],
)
def test_what_the_commands_cannot_use_is_one_sentence(tmp_path, monkeypatch, words, message):
    monkeypatch.chdir(tmp_path)
    result = CliRunner().invoke(app, words.split())
    assert result.exit_code == 2 and message in result.stderr
