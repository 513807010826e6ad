"""Suites drawn from a seed: always the same ones, of every kind, and nobody's favourites."""

from __future__ import annotations

import json
from collections import Counter

import numpy as np
import pytest
import trimesh
from typer.testing import CliRunner

from tracking3d.cli import app
from tracking3d.errors import InputError
from tracking3d_bench.synthesis.fresh import OBJECTS, fresh_name, fresh_suite, seed_of
from tracking3d_bench.synthesis.pick_up import PICK_UP
from tracking3d_bench.synthesis.spec import Motion, SequenceSpec
from tracking3d_bench.synthesis.suite import load_suite
from tracking3d_bench.synthesis.writing import write_sequence

SEEDS = range(9000, 9012)


@pytest.fixture
def meshes(tmp_path):
    folder = tmp_path / "things"
    (folder / "my drill").mkdir(parents=True)
    trimesh.creation.box((0.1, 0.2, 0.3)).export(folder / "carton.ply")
    trimesh.creation.icosphere().export(folder / "my drill" / "model.obj")
    (folder / "readme.txt").write_text("no mesh")
    return folder


@pytest.fixture
def call(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    return lambda *words: CliRunner().invoke(app, [*map(str, words)])


def motions():
    return set(Motion.__args__) - {PICK_UP}  # which the suites `phone` show


def test_a_seed_gives_the_same_suite_always_and_another_seed_another_one():
    assert fresh_suite(9000) == fresh_suite(9000) == load_suite("fresh-9000")
    one, other = fresh_suite(9000), fresh_suite(9001)
    assert not {spec.seed for spec in one} & {spec.seed for spec in other}
    assert [spec.object for spec in one] != [spec.object for spec in other]


def test_a_longer_suite_begins_with_the_shorter_one(meshes):
    for folder in (None, meshes):
        longest = fresh_suite(9000, 60, folder)
        for count in (1, 7, 24, 25):
            assert fresh_suite(9000, count, folder) == longest[:count]


@pytest.mark.parametrize("seed", SEEDS)
def test_any_two_dozen_sequences_hold_every_kind(seed):
    suite = fresh_suite(seed, 48)
    for first in range(25):
        specs = suite[first : first + 24]
        assert {spec.object for spec in specs} == set(OBJECTS)
        assert {spec.motion for spec in specs} == motions()
    for specs in (suite[:24], suite[24:]):
        prints = Counter(
            "plain" if not spec.textured else "strong" if spec.print_strength == 1 else "faint"
            for spec in specs
        )
        assert min(prints[kind] for kind in ("strong", "faint", "plain")) >= 3
        assert 11 <= sum(spec.camera_told for spec in specs) <= 13
        assert sum(spec.motion == "walk_round" for spec in specs) == 6
        disturbed = [sum(value > 0 for _, value in spec.disturbances) for spec in specs]
        assert 8 <= np.count_nonzero(disturbed) <= 12 and set(disturbed) == {0, 1, 2}
    assert len({spec.name for spec in suite}) == 48 == len({spec.seed for spec in suite})


@pytest.mark.parametrize("seed", SEEDS)
def test_lenses_are_spread_evenly_by_ratio_from_8_to_75_degrees(seed):
    fov = np.array([spec.fov for spec in fresh_suite(seed)])
    assert fov.min() >= 8 and fov.max() <= 75
    share = np.sort(np.log(fov / 8) / np.log(75 / 8))
    assert np.abs(share - (np.arange(24) + 0.5) / 24).max() < 0.09


def test_no_sequence_is_told_a_wrong_lens_or_goes_where_nothing_could_be_seen():
    for spec in (spec for seed in SEEDS for spec in fresh_suite(seed)):
        assert spec.disturbances.wrong_fov == 0
        assert (spec.size, spec.frames) == ((320, 240), 40)
        assert spec.lamp[1] < 0  # from above
        if spec.motion == "walk_round":
            assert 60 <= spec.degrees_per_frame * (spec.frames - 1) <= 150


def test_names_say_what_a_sequence_is():
    for index, spec in enumerate(fresh_suite(9000)):
        told = "told" if spec.camera_told else "untold"
        assert spec.name == f"{index:02d}_{spec.object}_{spec.motion}_fov{spec.fov:.0f}_{told}"


def test_meshes_of_a_folder_are_a_third_of_the_suite_and_take_turns(meshes):
    specs = fresh_suite(9000, 24, meshes)
    shown = Counter(spec.object for spec in specs)
    assert {shown[str(meshes / "carton.ply")], shown[str(meshes / "my drill" / "model.obj")]} == {4}
    assert set(shown) >= set(OBJECTS)
    assert any("_my_drill_model_" in spec.name for spec in specs)


def test_a_suite_is_called_after_its_seed_and_folder(meshes):
    assert fresh_name(7) == "fresh-7" and fresh_name(7, meshes) == "fresh-7-things"
    assert seed_of("fresh-7") == 7
    assert seed_of("fresh") is seed_of("fresh-7-things") is seed_of("fresh-x") is seed_of("standard") is None


def quick(spec: SequenceSpec) -> SequenceSpec:
    return spec.model_copy(update={"frames": 2, "size": (48, 36), "supersample": 1})


def test_the_same_seed_gives_the_same_bytes(tmp_path):
    spec = next(spec for spec in fresh_suite(9003) if spec.disturbances.motion_blur == 0)
    spec = quick(spec)
    one, other = (write_sequence(tmp_path / name, spec) for name in ("one", "other"))
    for file in (path for path in one.rglob("*") if path.is_file()):
        assert file.read_bytes() == (other / file.relative_to(one)).read_bytes(), file


@pytest.mark.parametrize(
    ("seed", "count", "message"),
    [(-1, 24, "--seed -1 is negative"), (1, 0, "--count 0"), (1, -3, "--count -3"), (1, 10**6, "1 and 1000")],
)
def test_a_seed_or_count_that_makes_no_sense_is_refused(seed, count, message):
    with pytest.raises(InputError, match=message):
        fresh_suite(seed, count)


def test_a_folder_without_meshes_is_refused(tmp_path):
    with pytest.raises(InputError, match="holds no mesh file"):
        fresh_suite(9000, meshes=tmp_path)
    with pytest.raises(InputError, match="is not a folder"):
        fresh_suite(9000, meshes=tmp_path / "nowhere")


def test_the_command_makes_a_fresh_suite(call, tmp_path, monkeypatch, meshes):
    made = []

    def write(folder, spec):
        made.append(spec)
        folder.mkdir()

    monkeypatch.setattr("tracking3d_bench.synthesis.suite.write_sequence", write)
    result = call("synth", "out", "--suite", "fresh", "--seed", 9000, "--count", 3, "--meshes", meshes)
    assert result.exit_code == 0 and result.stdout == "out: 3 sequences\n"
    assert made == fresh_suite(9000, 3, meshes)
    document = json.loads((tmp_path / "out" / "suite.json").read_text())
    assert document["name"] == "fresh-9000-things"


@pytest.mark.parametrize(
    ("words", "message"),
    [
        ("synth out --suite fresh", "give one with --seed N"),
        ("synth out --suite fresh --seed -1", "--seed -1 is negative"),
        ("synth out --suite fresh --seed 9000 --frames 3", "--frames cannot change --suite fresh"),
        ("synth out --suite smoke --count 3", "--count applies to the suite fresh only, not to smoke"),
        ("synth out --object box --count 3", "--count applies to the suite fresh only"),
        ("evaluate suite fresh", "give one with --seed N"),
        ("evaluate suite fresh --seed -1", "--seed -1 is negative"),
        ("evaluate suite fresh --seed 9000 --count 0", "--count 0"),
        ("evaluate suite fresh --seed 9000 --meshes .", "holds no mesh file"),
        (
            "evaluate suite standard --seed 9000",
            "--seed applies to the suites fresh and phone only, not to standard",
        ),
        ("evaluate suite smoke --meshes .", "--meshes applies to the suite fresh only"),
        ("evaluate spread fresh", "give --seed N, or the name fresh-N"),
    ],
)
def test_what_the_commands_cannot_use_is_one_sentence(call, words, message):
    result = call(*words.split())
    assert result.exit_code == 2 and result.stdout == ""
    [line] = result.stderr.splitlines()
    assert line.startswith("error: ") and message in line
