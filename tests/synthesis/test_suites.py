"""The fixed suites and the command that makes them."""

from __future__ import annotations

import json

import numpy as np
import pytest
from typer.testing import CliRunner

from tracking3d.cli import app
from tracking3d.errors import InputError, OutputError
from tracking3d.geometry.camera import Camera
from tracking3d_bench.datasets.clip import read_truth
from tracking3d_bench.datasets.layout import load_layout
from tracking3d_bench.datasets.reading import read_sequence
from tracking3d_bench.synthesis import suite as suite_module
from tracking3d_bench.synthesis.frame_rendering import render_frame
from tracking3d_bench.synthesis.scene import make_scene
from tracking3d_bench.synthesis.spec import Disturbances, SequenceSpec, check_spec
from tracking3d_bench.synthesis.suite import SUITE_VERSION, SUITES, load_suite, make_suite
from tracking3d_bench.synthesis.writing import is_complete, write_sequence

TINY = [
    SequenceSpec(name=name, object=name, frames=2, size=(32, 24), supersample=1)
    for name in ("box", "blob", "card")
]


@pytest.fixture
def tiny(monkeypatch):
    monkeypatch.setattr(suite_module, "load_suite", lambda name: TINY)


@pytest.fixture
def call(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    return lambda *words: CliRunner().invoke(app, ["synth", *map(str, words)])


def test_suites_grow_and_their_sequences_have_names_of_their_own():
    counts = []
    for name in SUITES:
        specs = load_suite(name)
        assert len({spec.name for spec in specs}) == len(specs)
        counts.append(sum(spec.frames for spec in specs))
    assert SUITES == ("smoke", "standard", "hard", "full") and counts == sorted(counts)
    assert len(load_suite("smoke")) == 3 and len(load_suite("standard")) == 12


@pytest.mark.parametrize("name", ["standard", "full"])
def test_suites_hold_every_object_motion_and_disturbance_they_promise(name):
    specs = load_suite(name)
    assert {spec.object for spec in specs} == {"box", "bottle", "blob", "mug", "card", "wedge"}
    assert len({spec.motion for spec in specs}) == 7
    used = {k for spec in specs for k, value in spec.disturbances if value > 0}
    assert used == set(Disturbances.model_fields) - ({"wrong_fov"} if name == "standard" else set())
    assert {spec.textured for spec in specs} == {True, False}
    assert len({spec.seed for spec in specs}) == len(specs)


def test_the_hard_suite_holds_what_the_standard_one_does_not():
    specs = {spec.name: spec for spec in load_suite("hard")}
    assert not specs.keys() & {spec.name for spec in load_suite("standard")}
    assert 8 <= len(specs) <= 12 and all(40 <= spec.frames <= 72 for spec in specs.values())
    untold = {spec.fov for spec in specs.values() if not spec.camera_told}
    assert untold == {10, 25, 65}
    plain = {spec.name for spec in specs.values() if not spec.textured}
    assert plain == {"blob_plain"}
    assert {spec.object for spec in specs.values()} >= {"vase", "card"}
    assert any(spec.disturbances.occluder == 1 for spec in specs.values())
    assert any(spec.disturbances.low_contrast > 0.8 and spec.textured for spec in specs.values())
    for name in ("box_full_turn", "mug_full_turn", "bottle_full_turn"):
        spec = specs[name]
        assert spec.motion == "turntable" and spec.degrees_per_frame * (spec.frames - 1) == 360


@pytest.mark.parametrize(
    "name", ["box_full_turn", "mug_full_turn", "bottle_full_turn", "wedge_turn_and_back"]
)
def test_sequences_that_return_end_with_their_first_view(name):
    spec = next(spec for spec in load_suite("hard") if spec.name == name)
    poses = make_scene(spec).T_cam_obj[:, :3, :3]
    turned = np.degrees(np.arccos(np.clip((np.einsum("nij,ij->n", poses, poses[0]) - 1) / 2, -1, 1)))
    assert turned[-1] < 1 and turned.max() > 170


def test_a_tracker_can_be_told_nothing_of_the_camera(tmp_path):
    spec = TINY[0].model_copy(update={"camera_told": False, "fov": 20.0})
    told, untold = (read_truth(write_sequence(tmp_path / s.name, s)) for s in (TINY[1], spec))
    assert told.camera_told and not untold.camera_told
    assert untold.given_camera is None and untold.camera == Camera.from_fov(
        32, 24, 20.0, origin=untold.camera.origin
    )


def test_a_sequence_made_before_a_setting_existed_is_not_made_again(tmp_path):
    spec = TINY[0]
    folder = write_sequence(tmp_path / "box", spec)
    info = json.loads((folder / "info.json").read_text())
    del info["spec"]["camera_told"]
    (folder / "info.json").write_text(json.dumps(info))
    assert is_complete(folder, spec)
    assert not is_complete(folder, spec.model_copy(update={"camera_told": False}))
    info["spec"]["colour"] = "red"
    (folder / "info.json").write_text(json.dumps(info))
    assert not is_complete(folder, spec)


def test_an_object_of_revolution_says_so_in_its_info(tmp_path):
    spec = TINY[0].model_copy(update={"object": "vase"})
    folder = write_sequence(tmp_path / "vase", spec)
    assert json.loads((folder / "info.json").read_text())["symmetry"] == "continuous axis"
    assert read_truth(folder).symmetry_axis == pytest.approx([0, 1, 0])
    box = read_truth(write_sequence(tmp_path / "box", TINY[0]))
    assert box.symmetry_axis is None


@pytest.mark.parametrize("spec", [s for name in SUITES for s in load_suite(name)], ids=lambda spec: spec.name)
def test_in_frame_0_the_whole_object_is_in_the_image_and_nearly_all_of_it_is_seen(spec):
    quick = spec.model_copy(
        update={
            "size": (96, 72),
            "supersample": 1,
            "textured": False,
            "disturbances": Disturbances(occluder=spec.disturbances.occluder),
        }
    )
    frame = render_frame(make_scene(quick), 0)
    edge = np.concatenate([frame.mask[0], frame.mask[-1], frame.mask[:, 0], frame.mask[:, -1]])
    assert not edge.any()
    assert frame.visible_mask.sum() > 0.98 * frame.mask.sum()
    assert frame.visible_mask.mean() > 0.03


def test_a_suite_that_does_not_exist_is_refused_with_the_nearest_name():
    with pytest.raises(InputError, match=r"no suite 'standart'.*did you mean 'standard'"):
        load_suite("standart")


@pytest.mark.slow
def test_the_smoke_suite_is_made_and_every_sequence_opens(tmp_path):
    told: list[str] = []
    folders = make_suite("smoke", tmp_path / "new" / "suite", listener=told.append)
    assert [folder.name for folder in folders] == told == [spec.name for spec in load_suite("smoke")]
    for folder in folders:
        truth = read_truth(folder)
        assert len(truth.frames) == 10 and len(truth.T_cam_obj) == 10 and truth.points is not None
    document = json.loads((tmp_path / "new" / "suite" / "suite.json").read_text())
    assert document == {"name": "smoke", "version": SUITE_VERSION, "sequences": told}


def test_only_what_is_missing_or_different_is_made_again(tiny, tmp_path):
    def make(**more):
        told: list[str] = []
        folders = make_suite("smoke", tmp_path, listener=told.append, **more)
        assert [folder.name for folder in folders] == ["box", "blob", "card"]
        return told

    assert make() == ["box", "blob", "card"]
    assert make() == []
    (tmp_path / "blob" / "info.json").write_text('{"source": "tracking3d synth"}')
    assert make() == ["blob"]
    assert make(overwrite=True) == ["box", "blob", "card"]


@pytest.mark.slow
def test_two_processes_make_the_same_bytes_as_one(tiny, tmp_path):
    make_suite("smoke", tmp_path / "one")
    told: list[str] = []
    make_suite("smoke", tmp_path / "two", jobs=2, listener=told.append)
    assert sorted(told) == ["blob", "box", "card"]
    files = [f.relative_to(tmp_path / "one") for f in (tmp_path / "one").rglob("*") if f.is_file()]
    assert len(files) > 30
    for file in files:
        assert (tmp_path / "one" / file).read_bytes() == (tmp_path / "two" / file).read_bytes(), file


def test_an_error_in_a_process_is_the_error_of_the_suite(tiny, tmp_path):
    (tmp_path / "blob").mkdir()
    (tmp_path / "blob" / "mine.txt").write_text("keep")
    with pytest.raises(OutputError, match="not a synthetic sequence"):
        make_suite("smoke", tmp_path, jobs=2)
    assert (tmp_path / "blob" / "mine.txt").read_text() == "keep"


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"objekt": "box"}, "no setting 'objekt'; did you mean 'object'"),
        ({"motion": "spin"}, "'motion' must be 'tumble'"),
        ({"frames": 0}, "'frames' must be greater"),
        ({"size": [8, 8]}, "from 16 to 4096"),
        ({"supersample": 2}, "must be odd"),
        ({"fov": 0}, "'fov'"),
        ({"degrees_per_frame": float("inf")}, "'degrees_per_frame'"),
        ({"name": "../up"}, "'name'"),
        ({"seed": -1}, "'seed'"),
    ],
)
def test_a_spec_that_makes_no_sense_is_one_sentence(settings, message):
    with pytest.raises(InputError, match=message) as refusal:
        check_spec(settings, "here")
    assert str(refusal.value).startswith("here: ") and "\n" not in str(refusal.value)


def test_the_command_makes_one_sequence_of_its_options(call, tmp_path):
    words = (
        "out --object card --motion flip --frames 2 --size 64,48 --degrees 9 --fov 30 --seed 5 --textureless"
    )
    result = call(*words.split(), "--disturb", "noise=0.2", "--disturb", "wrong_fov=1")
    assert result.exit_code == 0 and result.stdout == "out: 2 frames\n"
    info = json.loads((tmp_path / "out" / "info.json").read_text())
    assert SequenceSpec.model_validate(info["spec"]) == SequenceSpec(
        object="card",
        motion="flip",
        frames=2,
        size=(64, 48),
        degrees_per_frame=9,
        fov=30,
        seed=5,
        textured=False,
        disturbances={"noise": 0.2, "wrong_fov": 1.0},
    )
    before = (tmp_path / "out" / "info.json").stat().st_mtime_ns
    assert call(*words.split(), "--disturb", "noise=0.2", "--disturb", "wrong_fov=1", "-q").stdout == ""
    assert (tmp_path / "out" / "info.json").stat().st_mtime_ns == before


def test_the_command_writes_bops_layout_too(call, tmp_path):
    result = call("out", "--object", "card", "--frames", 2, "--size", "64,48", "--bop", "bop")
    assert result.exit_code == 0, result.output
    back = read_sequence(load_layout("bop"), tmp_path / "bop", "test/000001")
    truth = read_truth(tmp_path / "out")
    for n in range(2):
        assert (back.masks[n].read() == truth.masks[n].read()).all()
        assert back.T_cam_obj[n][:3, 3] == pytest.approx(100 * truth.T_cam_obj[n][:3, 3])
    assert pytest.approx(truth.camera.K) == back.camera.K


def test_the_command_makes_a_suite(call, tiny, tmp_path):
    result = call("out", "--suite", "smoke")
    assert result.exit_code == 0 and result.stdout == "out: 3 sequences\n"
    assert (tmp_path / "out" / "card" / "info.json").is_file()


@pytest.mark.parametrize(
    ("words", "message"),
    [
        ("", "Give a suite with --suite"),
        ("--suite smok", "did you mean 'smoke'"),
        ("--suite smoke --frames 3", "--frames cannot change --suite smoke, which is fixed"),
        ("--object bx", "did you mean 'box'"),
        ("--object nope.obj", "'nope.obj' does not exist"),
        ("--object box --motion spin", "'motion' must be"),
        ("--object box --size 3", "--size '3' is not 2 numbers"),
        ("--object box --size 3,x", "--size '3,x'"),
        ("--object box --frames -1", "'frames' must be"),
        ("--object box --disturb noise", "is not NAME=STRENGTH"),
        ("--object box --disturb =1", "is not NAME=STRENGTH"),
        ("--object box --disturb noise=lots", "'lots' is not"),
        ("--object box --disturb noise=2", "'disturbances.noise' must be"),
        ("--object box --disturb nois=1", "did you mean 'disturbances.noise'"),
        ("--object box --background nowhere", "'nowhere' is not a folder"),
    ],
)
def test_what_the_command_cannot_use_is_one_sentence(call, words, message):
    result = call("out", *words.split())
    assert result.exit_code == 2 and result.stdout == ""
    [line] = result.stderr.splitlines()
    assert line.startswith("error: ") and message in line
