"""Where an export goes: whole or not at all, over nothing that was not meant, and refusals in one sentence."""

from __future__ import annotations

import json
import shutil
import sys
from pathlib import Path

import numpy as np
import pytest

from tracking3d.errors import InputError, OutputError
from tracking3d.estimation.estimate import FREE_ROTATION
from tracking3d.export.exported_run import ExportedRun
from tracking3d.export.exporting import export_run
from tracking3d.export.formats import FORMATS, Exporter
from tracking3d.export.options import ExportOptions
from tracking3d.results.run_reader import RunReader


def names(folder: Path) -> list[str]:
    return sorted(path.name for path in folder.iterdir())


def test_without_a_place_it_goes_into_the_run(run):
    assert export_run(run, "tum").path == run / "export" / "run_tum.txt"
    done = export_run(run, "kitti", overwrite=True)
    assert (done.path, done.frames, done.without, done.unit) == (
        run / "export" / "kitti",
        5,
        (2, 4),
        "arbitrary",
    )
    assert export_run(run, "bop").path.name == "tracking3d_run-test.csv"
    assert export_run(run, "davis").without == (4,)  # a lost frame has a mask


def one_file(to: str) -> bool:
    return bool(FORMATS[to].suffix)


def test_files_are_named_after_the_run_and_no_two_formats_share_a_name(run):
    exported = ExportedRun(RunReader(run), ExportOptions())
    names = {to: one.default_name(exported) for to, one in FORMATS.items()}
    assert len(set(names.values())) == len(names)
    assert names["usdz"] == "run.usdz" and names["glb"] == "run.glb" and names["csv"] == "run.csv"
    assert names["animated-glb"] == "run_animated.glb" and names["points-csv"] == "run_points.csv"
    assert all(name.startswith("run") for to, name in names.items() if one_file(to) and to != "bop")
    assert all(name == to for to, name in names.items() if not one_file(to))


@pytest.mark.parametrize("name", ["box_in_hand", "my run (2)", "v1.2", "käse"])
def test_the_name_of_the_run_folder_is_kept_as_it_is(run, tmp_path, name):
    renamed = Path(shutil.copytree(run, tmp_path / name))
    assert export_run(renamed, "stl").path == renamed / "export" / f"{name}.stl"


def test_files_of_several_objects_can_lie_in_one_folder(run, tmp_path):
    both = tmp_path / "both"
    for number in (0, 1):
        shutil.copytree(run, both / f"object_{number}")
    made = [export_run(both / f"object_{number}", "stl").path.name for number in (0, 1)]
    assert made == ["both_object_0.stl", "both_object_1.stl"]
    shutil.rmtree(both / "object_1")  # a run that somebody has called so
    assert export_run(both / "object_0", "ply").path.name == "object_0.ply"


def test_a_folder_says_what_it_is(run, tmp_path):
    export_run(run, "kitti", tmp_path / "out", options=ExportOptions(object_size=0.2))
    label = json.loads((tmp_path / "out" / "export.json").read_text())
    assert label["to"] == "kitti"
    assert label["run"] == str(run)
    assert label["unit"] == "metre"
    assert label["frames_without_answer"] == [2, 4]


@pytest.mark.parametrize("to", ["tum", "kitti"])
def test_nothing_is_replaced_unless_that_was_asked(run, tmp_path, to):
    place = tmp_path / "out"
    export_run(run, to, place)
    with pytest.raises(OutputError, match="already exists"):
        export_run(run, to, place)
    export_run(run, to, place, options=ExportOptions(of="camera"), overwrite=True)
    text = (place if to == "tum" else place / "poses.txt").read_text()
    export_run(run, to, place, overwrite=True)
    assert (place if to == "tum" else place / "poses.txt").read_text() != text
    assert names(tmp_path) == ["out"]


def test_a_folder_of_somebody_elses_is_never_replaced(run, tmp_path):
    (tmp_path / "letters").mkdir()
    (tmp_path / "letters" / "dear.txt").write_text("dear")
    with pytest.raises(OutputError, match="not an export"):
        export_run(run, "kitti", tmp_path / "letters", overwrite=True)
    assert names(tmp_path / "letters") == ["dear.txt"]
    with pytest.raises(OutputError, match="is a folder, and tum is a file"):
        export_run(run, "tum", tmp_path / "letters", overwrite=True)
    with pytest.raises(OutputError, match="is a file, and kitti is a folder"):
        export_run(run, "kitti", tmp_path / "letters" / "dear.txt", overwrite=True)


def test_an_empty_folder_is_a_place(run, tmp_path):
    (tmp_path / "out").mkdir()
    export_run(run, "kitti", tmp_path / "out")
    assert "poses.txt" in names(tmp_path / "out")


@pytest.mark.parametrize("to", ["tum", "kitti"])
@pytest.mark.parametrize("earlier", [False, True])
def test_an_export_that_fails_leaves_what_was_there(run, tmp_path, monkeypatch, to, earlier):
    place = tmp_path / "out"
    if earlier:
        export_run(run, to, place)
    write = Exporter.write

    def fail(exporter, exported, path):
        write(exporter, exported, path)
        raise InputError("half of it is there")

    monkeypatch.setattr(Exporter, "write", fail)
    with pytest.raises(InputError, match="half of it"):
        export_run(run, to, place, overwrite=True)
    assert names(tmp_path) == (["out"] if earlier else [])
    if earlier and to == "kitti":
        assert "export.json" in names(place)


def test_what_a_killed_export_left_is_cleared_away(run, tmp_path):
    (tmp_path / ".out.part").mkdir()
    (tmp_path / ".out.part" / "half").write_text("")
    export_run(run, "tum", tmp_path / "out")
    assert names(tmp_path) == ["out"]


def test_an_export_that_was_killed_while_it_was_put_in_place_is_given_back(run, tmp_path):
    export_run(run, "kitti", tmp_path / "out")
    (tmp_path / ".out.part").mkdir()
    (tmp_path / "out").rename(tmp_path / ".out.part" / "earlier")
    with pytest.raises(InputError):
        # Whatever comes next, here one that fails.
        export_run(run, "kitti", tmp_path / "out", options=ExportOptions(of="hand"))
    export_run(run, "kitti", tmp_path / "out", overwrite=True)
    assert "poses.txt" in names(tmp_path / "out")
    assert names(tmp_path) == ["out"]


def test_files_of_the_run_are_not_replaced(run):
    before = (run / "run.json").read_bytes()
    with pytest.raises(OutputError, match="is a file of the run itself"):
        export_run(run, "coco", run / "run.json", overwrite=True)
    with pytest.raises(OutputError, match="not an export"):
        export_run(run, "davis", run / "masks", overwrite=True)
    assert (run / "run.json").read_bytes() == before


def test_an_earlier_export_survives_where_the_new_one_cannot_be_put_in_place(run, tmp_path, monkeypatch):
    export_run(run, "kitti", tmp_path / "out")
    before = (tmp_path / "out" / "poses.txt").read_bytes()
    monkeypatch.setattr(Exporter, "write", lambda exporter, exported, path: None)
    with pytest.raises(OutputError, match="cannot be written"):
        export_run(run, "kitti", tmp_path / "out", overwrite=True)
    assert (tmp_path / "out" / "poses.txt").read_bytes() == before
    assert names(tmp_path) == ["out"]


def test_every_format_is_listed_by_its_name_with_options_that_there_are():
    for name, exporter in FORMATS.items():
        assert exporter.name == name
        assert bool(exporter.module) == bool(exporter.extra)
        assert exporter.options <= set(ExportOptions.__dataclass_fields__)


@pytest.mark.parametrize("to", [name for name, exporter in FORMATS.items() if exporter.module])
def test_without_its_extra_a_format_says_what_to_install(run, tmp_path, monkeypatch, to):
    module = FORMATS[to].module
    monkeypatch.setitem(sys.modules, module, None)  # as if it were not installed
    with pytest.raises(InputError, match=rf"needs {module}.*pip install 'tracking3d\[{FORMATS[to].extra}\]'"):
        export_run(run, to, tmp_path / "out")
    assert not FORMATS[to].is_available


def test_the_page_names_every_format_and_extra():
    page = (Path(__file__).resolve().parents[2] / "docs/export.md").read_text(encoding="utf-8")
    rows = [line.split("|")[1] for line in page.splitlines() if line.startswith("| `")]
    for name, exporter in FORMATS.items():
        assert sum(f"`{name}`" in row for row in rows) == 2, name  # what it is, and what checked it
        assert f"tracking3d[{exporter.extra}]" in page or not exporter.extra


def test_extras_are_declared():
    import tomllib

    file = Path(__file__).resolve().parents[2] / "pyproject.toml"
    extras = tomllib.loads(file.read_text(encoding="utf-8"))["project"]["optional-dependencies"]
    assert {exporter.extra for exporter in FORMATS.values() if exporter.extra} <= set(extras)


@pytest.mark.parametrize(
    ("to", "options", "words"),
    [
        ("gltf", {}, "There is no format gltf (to= takes tum, kitti"),
        ("tum", {"cut_out": True}, "does not use cut_out="),
        ("vot", {"object_size": 1.0}, "does not use object_size="),
        ("tum", {"unseen": "cut"}, "does not use unseen="),
        ("glb", {"unseen": "guess"}, "'guess' is no value of unseen="),
        ("tum", {"fps": 0.0}, "fps= is 0"),
        ("tum", {"start_time": 5.0}, "does not use start_time="),
        ("csv", {"compressed_images": True}, "does not use compressed_images="),
        ("tum", {"object_size": float("nan")}, "object_size= is nan"),
        ("tum", {"of": "hand"}, "Poses cannot be of 'hand'"),
        ("tum", {"answers": "best"}, "Estimates cannot be 'best'"),
        ("tapvid", {"xy": ((500.0, 3.0),)}, "has no pixel 500,3"),
        ("tapvid", {"frame": 2}, "lost in frame 2"),
        ("tapvid", {"frame": 99}, "no frame 99"),
        ("cut-outs", {"source": "absent.mp4"}, "give the present path of its video as source="),
    ],
)
def test_what_cannot_be_used_is_refused_in_a_sentence(run, tmp_path, to, options, words):
    with pytest.raises(InputError) as told:
        export_run(run, to, tmp_path / "out", options=ExportOptions(**options))
    assert words in str(told.value)
    assert names(tmp_path) == []


def test_the_video_of_another_run_is_refused(run, tmp_path):
    from PIL import Image

    for folder, size in (("other", (128, 96)), ("larger", (130, 96))):
        (tmp_path / folder).mkdir()
        Image.fromarray(np.zeros((size[1], size[0], 3), np.uint8)).save(tmp_path / folder / "000.png")
    for folder, words in (("other", "not the video of the run"), ("larger", "130 x 96 pixels")):
        with pytest.raises(InputError, match=words):
            export_run(
                run, "cut-outs", tmp_path / "out", options=ExportOptions(source=str(tmp_path / folder))
            )


def test_a_relative_source_is_found_from_another_folder(run, tmp_path, monkeypatch):
    """Below a folder above the run's, as where it was begun there."""
    file = run / "run.json"
    told = json.loads(file.read_text())
    shutil.copytree(told["source"], tmp_path / "begun/clips/one")
    moved = shutil.copytree(run, tmp_path / "begun/runs/one")
    (moved / "run.json").write_text(json.dumps(told | {"source": "clips/one"}))
    (tmp_path / "elsewhere").mkdir()
    monkeypatch.chdir(tmp_path / "elsewhere")
    assert export_run(moved, "cut-outs", tmp_path / "out").frames == 6
    with pytest.raises(InputError, match="give the present path of its video as source="):
        export_run(moved, "cut-outs", tmp_path / "other", options=ExportOptions(source="clips/one"))


def test_a_camera_cannot_be_looked_through_again(run, tmp_path):
    shutil.copytree(run, tmp_path / "live")
    file = tmp_path / "live" / "run.json"
    file.write_text(json.dumps(json.loads(file.read_text()) | {"source": "0"}))
    with pytest.raises(InputError, match="cannot be read again"):
        export_run(tmp_path / "live", "cut-outs", tmp_path / "out")
    export_run(tmp_path / "live", "colmap", tmp_path / "out", options=ExportOptions(images=False))


@pytest.mark.parametrize("to", ["colmap", "nerfstudio"])
def test_what_can_do_without_images_is_exported_without_them_if_the_video_is_gone(run, tmp_path, to):
    moved = Path(shutil.copytree(run, tmp_path / "moved"))
    told = json.loads((moved / "run.json").read_text())
    (moved / "run.json").write_text(json.dumps(told | {"source": "gone.mp4"}))
    done = export_run(moved, to, tmp_path / "out")
    assert done.note.startswith("The images are left out. The video of the run") and "source" in done.note
    assert not (tmp_path / "out" / "images").exists()
    assert export_run(run, to, tmp_path / "whole").note == ""
    assert (tmp_path / "whole" / "images").is_dir()
    with pytest.raises(InputError, match="absent"):  # one that was given has to be there
        export_run(moved, to, tmp_path / "other", options=ExportOptions(source="absent.mp4"))


@pytest.mark.parametrize(
    ("to", "options", "note"),
    [
        (
            "blender",
            {"source": "absent.mp4"},
            "The source that was given, absent.mp4, does not exist; the export does without it.",
        ),
        (
            "nerfstudio",
            {"source": "clip", "images": False},
            "The source that was given is not used without images.",
        ),
        ("blender", {}, ""),
    ],
)
def test_a_video_that_was_given_in_vain_is_told(run, tmp_path, to, options, note):
    assert export_run(run, to, tmp_path / "out", options=ExportOptions(**options)).note == note


def test_exports_of_poses_say_that_a_rotation_is_not_known(run, tmp_path):
    free = Path(shutil.copytree(run, tmp_path / "free"))
    lines = [json.loads(line) for line in (free / "frames.jsonl").read_text().splitlines()]
    lines[-1]["free_axis"] = [0.0, 1.0, 0.0]
    (free / "frames.jsonl").write_text("".join(json.dumps(line) + "\n" for line in lines))
    said = f"{FREE_ROTATION.capitalize()}."
    assert export_run(free, "csv", tmp_path / "poses.csv").note == said
    export_run(free, "colmap", tmp_path / "out", options=ExportOptions(images=False))
    assert json.loads((tmp_path / "out" / "export.json").read_text())["note"] == said
    assert export_run(free, "coco", tmp_path / "masks").note == ""


def test_a_run_without_a_pose_has_no_trajectory_but_masks(run, tmp_path):
    shutil.copytree(run, tmp_path / "lost")
    lines = (run / "frames.jsonl").read_text().replace('"status": "tracked"', '"status": "lost"')
    (tmp_path / "lost" / "frames.jsonl").write_text(lines)
    with pytest.raises(InputError, match="no frame with a pose"):
        export_run(tmp_path / "lost", "tum", tmp_path / "out.txt")
    assert export_run(tmp_path / "lost", "davis", tmp_path / "out").frames == 6


def test_causal_answers_are_those_before_the_refinement(run, tmp_path):
    shutil.copytree(run, tmp_path / "refined")
    file = tmp_path / "refined" / "frames.jsonl"
    first = json.loads(file.read_text().splitlines()[0])
    first["T_cam_obj"][2][3] = 9.0
    with file.open("a") as lines:
        lines.write(json.dumps(first | {"refined": True}) + "\n")
    depths = []
    for answers in ("final", "causal"):
        options = ExportOptions(answers=answers)
        path = export_run(tmp_path / "refined", "tum", tmp_path / answers, options=options).path
        depths.append(np.loadtxt(path)[0, 3])
    assert depths == [9.0, 4.0]
