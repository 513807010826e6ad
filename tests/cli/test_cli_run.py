"""``tracking3d run``: what it hands to the pipeline, how it ends, and what it says about bad input."""

from __future__ import annotations

import json
import logging
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from PIL import Image

from tracking3d.cli.tracking import default_folder
from tracking3d.errors import PluginError
from tracking3d.results.run_reader import RunReader

BOX = ("--box", "20,10,20,20")


@pytest.fixture(autouse=True)
def usual_log_level():
    yield
    logging.getLogger("tracking3d").setLevel(logging.NOTSET)


def test_run_writes_the_folder_and_prints_the_closing_table(call, clip, script):
    result = call("run", clip, *BOX, "--tracker", "csrt", "--features", "rgb", "--out", "run")
    assert result.exit_code == 0, result.output
    for word in ["frames", "tracked", "IoU", "seconds per frame", "run/masks", "run/overlay.mp4"]:
        assert word in result.stdout
    run = RunReader(Path("run"))
    assert run.state == "finished"
    assert [frame.index for frame in run.frames] == [0, 1, 2, 3, 4]
    assert run.config["tracker"]["name"] == "csrt"
    assert run.description["command"]


def test_options_reach_the_configuration(call, clip, script, tmp_path):
    (tmp_path / "mine.yaml").write_text("preset: paper\nsolver: {knum: 7, iterations: 9}")
    options = (
        "--flat --trust-masks --prototype ellipsoid --size 64 --device cpu --seed 5 --fov 30 "
        "--set solver.iterations=3"
    )
    result = call(
        "run", clip, *BOX, *options.split(), "--config", "mine.yaml", "--intrinsics", "70,70,32,24", "--quiet"
    )
    assert result.exit_code == 0, result.output
    [(config, prompt)] = script.built
    assert (config.solver.knum, config.solver.iterations) == (7, 3)
    assert (config.object.flat, config.object.prototype) == (True, "ellipsoid")
    assert config.object.trust_masks
    assert (config.crop.size, config.runtime.device, config.runtime.seed) == (64, "cpu", 5)
    assert (config.camera.fov, config.camera.intrinsics) == (30, (70, 70, 32, 24))
    assert prompt.box == (20, 10, 20, 20)
    assert RunReader(Path("runs/clip")).description["seed"] == 5


def test_absent_flag_does_not_undo_the_files(call, clip, script, tmp_path):
    (tmp_path / "mine.yaml").write_text("object: {flat: true}")
    call("run", clip, *BOX, "--config", "mine.yaml")
    assert script.built[0][0].object.flat is True


def test_quiet_prints_nothing_and_a_pipe_gets_no_bar(call, clip, script):
    assert call("run", clip, *BOX, "--quiet").output == ""
    result = call("run", clip, "--box", "-4,10,20,20", "--quiet", "--out", "other")
    assert (result.exit_code, result.output) == (0, "")
    assert "━" not in call("run", clip, *BOX, "--overwrite").stderr


def test_frames_are_selected_and_keep_their_index(call, clip, script):
    assert call("run", clip, *BOX, "--frames", "1:5:2", "--out", "run").exit_code == 0
    assert [frame.index for frame in RunReader(Path("run")).frames] == [1, 3]


def test_mask_is_the_prompt(call, clip, script, mask_file):
    mask = np.zeros((48, 64), dtype=bool)
    mask[10:20, 30:50] = True
    assert call("run", clip, "--mask", mask_file(mask)).exit_code == 0
    [(_, prompt)] = script.built
    assert prompt.box == (30, 10, 20, 10)


def test_masks_choose_the_tracker_and_need_no_prompt(call, clip, script, mask_file, tmp_path):
    (tmp_path / "masks").mkdir()
    mask = np.zeros((48, 64), dtype=bool)
    mask[10:20, 30:50] = True
    mask_file(mask, "masks/000.png")
    assert call("run", clip, "--masks", "masks").exit_code == 0
    assert (
        call("run", clip, "--tracker", "precomputed", "--set", "tracker.path=masks", "--out", "b").exit_code
        == 0
    )
    assert call("run", clip, "--masks", "masks", *BOX, "--out", "c").exit_code == 0
    assert [prompt and prompt.box for _, prompt in script.built] == [None, None, (20, 10, 20, 20)]
    assert all(config.tracker.options == {"path": "masks"} for config, _ in script.built)


def test_the_alpha_of_cut_outs_is_their_masks_unless_something_else_is_given(call, script, tmp_path):
    (tmp_path / "cut_outs").mkdir()
    picture = np.full((48, 64, 4), 90, np.uint8)
    picture[..., 3] = 0
    picture[10:20, 30:50, 3] = 255
    for index in range(3):
        Image.fromarray(picture).save(tmp_path / f"cut_outs/{index}.png")
    result = call("run", "cut_outs")
    assert result.exit_code == 0 and "alpha of the images in cut_outs is taken" in result.stderr
    assert "alpha" not in call("run", "cut_outs", *BOX, "--out", "b").stderr
    assert "alpha" not in call("run", "cut_outs", *BOX, "--tracker", "csrt", "--out", "c").stderr
    assert [config.tracker.name for config, _ in script.built] == ["precomputed", "segment", "csrt"]
    assert script.built[0][0].tracker.options == {"path": "cut_outs"}


def test_several_boxes_are_several_objects_with_a_folder_each(call, clip, script):
    result = call("run", clip, *BOX, "--box", "30,5,10,30", "--out", "run")
    assert result.exit_code == 0, result.output
    assert [prompt.box for _, prompt in script.built] == [(20, 10, 20, 20), (30, 5, 10, 30)]
    for number in (0, 1):
        folder = Path("run", f"object_{number}")
        assert RunReader(folder).state == "finished"
        assert f"{folder} (finished)" in result.stdout
    assert not Path("run/run.json").exists()


def test_several_masks_are_several_objects_too(call, clip, script, mask_file):
    masks = np.zeros((2, 48, 64), dtype=bool)
    masks[0, 10:20, 30:50] = masks[1, 5:15, 5:15] = True
    files = [mask_file(mask, f"{number}.png") for number, mask in enumerate(masks)]
    assert call("run", clip, "--mask", files[0], "--mask", files[1], "--quiet").output == ""
    assert [prompt.box for _, prompt in script.built] == [(30, 10, 20, 10), (5, 5, 10, 10)]
    assert sorted(path.name for path in Path("runs/clip").iterdir()) == [
        "index.html",
        "object_0",
        "object_1",
    ]


@pytest.mark.parametrize(
    ("options", "expected"),
    [([], False), (["--final-refine"], True), (["--no-final-refine"], False)],
)
def test_final_refinement_is_switched_by_its_option(call, clip, script, tmp_path, options, expected):
    (tmp_path / "mine.yaml").write_text("solver: {final_refine: false}")
    assert call("run", clip, *BOX, "--config", "mine.yaml", *options).exit_code == 0
    assert script.built[0][0].solver.final_refine is expected
    (tmp_path / "mine.yaml").write_text("solver: {final_refine: true}")
    assert call("run", clip, *BOX, "--config", "mine.yaml", *options, "--overwrite").exit_code == 0
    assert script.built[1][0].solver.final_refine is (options != ["--no-final-refine"])


def test_why_there_is_no_final_refinement_is_on_the_screen(call, clip, script):
    result = call("run", clip, *BOX, "--final-refine", "--set", "solver.name=paper")
    assert "the solver paper gives causal estimates only" in result.stdout


def test_undecodable_frame_is_skipped_and_recorded(call, clip, script):
    (clip / "002.png").write_bytes(b"no image")
    result = call("run", clip, *BOX, "--out", "run")
    assert result.exit_code == 0, result.output
    assert "skipped" in result.stdout
    run = RunReader(Path("run"))
    assert [frame.index for frame in run.frames] == [0, 1, 3, 4]
    assert [skipped["index"] for skipped in run.description["skipped"]] == [2]


@pytest.mark.parametrize("frames", ["0:", "1:"])
@pytest.mark.parametrize("objects", [BOX, [*BOX, "--box", "1,1,9,9"]], ids=["one", "two"])
def test_a_damaged_first_frame_does_not_hand_its_box_to_the_next(refused, clip, script, frames, objects):
    (clip / f"00{frames[0]}.png").write_bytes(b"no image")
    line = refused("run", clip, *objects, "--out", "run", "--frames", frames)
    assert f"00{frames[0]}.png" in line and "--skip-damaged" in line
    assert not Path("run").exists()


def test_a_damaged_first_frame_is_skipped_where_that_is_asked_for(call, clip, script):
    (clip / "000.png").write_bytes(b"no image")
    assert call("run", clip, *BOX, "--out", "run", "--skip-damaged").exit_code == 0
    run = RunReader(Path("run"))
    assert [frame.index for frame in run.frames] == [1, 2, 3, 4]
    assert [skipped["index"] for skipped in run.description["skipped"]] == [0]


def test_box_partly_outside_is_clipped_and_the_run_goes_on(call, clip, script, caplog):
    assert call("run", clip, "--box", "-4,10,20,20").exit_code == 0
    assert script.built[0][1].box == (0, 10, 16, 20)
    assert "extends beyond the frame" in caplog.text


def test_interrupted_run_keeps_what_was_finished_and_its_whole_command_continues_it(
    call, clip, script, monkeypatch
):
    script.faults[3] = KeyboardInterrupt()
    line = ["run", "a clip", *BOX, "--overwrite", "--out", "run"]
    monkeypatch.setattr("sys.argv", ["/somewhere/tracking3d", *line])
    result = call(*line[:1], clip, *line[2:])
    assert result.exit_code == 130
    assert result.stderr.splitlines() == [
        "interrupted",
        "The frames finished until then are in run.",
        f"To continue from there: tracking3d run 'a clip' {' '.join(BOX)} --out run --resume",
    ]
    run = RunReader(Path("run"))
    assert run.state == "interrupted"
    assert [frame.index for frame in run.frames] == [0, 1, 2]
    assert Path("run/overlay.mp4").stat().st_size


def test_interrupt_before_the_first_answer_leaves_nothing_in_the_way(call, clip, script):
    script.faults[0] = KeyboardInterrupt()
    result = call("run", clip, *BOX, "--out", "run")
    assert (result.exit_code, result.stderr) == (130, "interrupted\n")
    assert RunReader("run").frames == []
    script.faults.clear()
    assert call("run", clip, *BOX, "--out", "run").exit_code == 0


def test_a_stopped_run_is_resumed_by_the_same_command(call, clip, script):
    script.faults[3] = KeyboardInterrupt()
    call("run", clip, *BOX, "--out", "run")
    script.faults.clear()
    assert call("run", clip, *BOX, "--out", "run", "--resume").exit_code == 0
    run = RunReader(Path("run"))
    assert (run.state, [frame.index for frame in run.frames]) == ("finished", [0, 1, 2, 3, 4])
    assert [one["frames"] for one in run.description["resumed"]] == [3]
    again = call("run", clip, *BOX, "--out", "run", "--resume")
    assert (again.exit_code, again.stdout) == (
        0,
        "The run run is already finished; there is nothing to resume.\n",
    )


def test_a_run_of_other_settings_is_not_resumed(call, clip, script):
    script.faults[3] = KeyboardInterrupt()
    call("run", clip, *BOX, "--out", "run")
    result = call("run", clip, *BOX, "--out", "run", "--resume", "--seed", "5")
    assert result.exit_code == 2
    assert "runtime.seed was 0 and is 5" in result.stderr
    both = call("run", clip, *BOX, "--out", "run", "--resume", "--overwrite")
    assert both.exit_code == 2
    assert "either --resume, which continues" in both.stderr


def test_a_run_is_corrected_with_its_own_settings(call, clip, script):
    assert call("run", clip, *BOX, "--fov", "30", "--out", "run").exit_code == 0
    result = call("correct", "run", "3:21,11,20,20", "--no-report")
    assert result.exit_code == 0, result.output
    description = json.loads(Path("run/run.json").read_text())
    assert description["prompt"]["corrections"][0]["box"] == [21, 11, 20, 20]
    assert (description["config"]["camera"]["fov"], description["state"]) == (30, "finished")
    assert not Path("run/.correcting").exists()


def test_a_correction_says_before_it_starts_what_it_replaces(call, clip, script):
    call("run", clip, *BOX, "--out", "run")
    Path("run/export").mkdir()
    script.faults[3] = PluginError("The tracker gave up.")  # as soon as it starts
    assert "run/export shows the run as it is now" in call("correct", "run", "3:21,11,20,20").stderr
    assert "export" not in call("correct", "run", "3:21,11,20,20", "--quiet").stderr
    assert Path("run/export").is_dir()


@pytest.mark.parametrize(
    ("words", "told"),
    [
        (["nowhere", "3:1,1,9,9"], "nowhere is not a run folder"),
        (["run", "3;1,1,9,9"], "is not of the form FRAME:X,Y,W,H"),
        (["run", "77:1,1,9,9"], "frame 77 is not among"),
        (["run", "3@2:1,1,9,9"], "is for object 2, but there is 1 object"),
        (["run", "0:1,1,9,9"], "is the frame of the prompt"),
        (["run", "3:mask.png"], "mask.png"),
        (["run", "3:1,1,9,9", "--source", "gone.mp4"], "gone.mp4"),
    ],
)
def test_what_cannot_be_corrected_is_refused_and_the_run_is_as_it_was(
    call, refused, clip, script, words, told
):
    call("run", clip, *BOX, "--out", "run")
    before = Path("run/run.json").read_bytes()
    assert told in refused("correct", *words)
    assert Path("run/run.json").read_bytes() == before


def test_a_correction_that_fails_says_how_to_go_on(call, clip, script):
    call("run", clip, *BOX, "--out", "run")
    before = Path("run/run.json").read_bytes()
    script.faults[3] = PluginError("The tracker gave up.")
    result = call("correct", "run", "3:21,11,20,20")
    assert result.exit_code == 2
    assert "The run run is unchanged; the same command " in result.stderr
    assert Path("run/run.json").read_bytes() == before


def test_a_damaged_state_gets_one_piece_of_advice(call, refused, clip, script):
    script.faults[3] = KeyboardInterrupt()
    call("run", clip, *BOX, "--out", "run")
    for state in Path("run/.state").glob("*.json*"):
        state.write_text("{}")
    script.faults.clear()
    line = refused("run", clip, *BOX, "--out", "run", "--resume")  # one line
    assert "--overwrite" in line and "--resume" not in line


def test_failing_plugin_ends_the_run_with_a_sentence_and_keeps_what_was_finished(call, clip, script):
    script.faults[2] = PluginError("The tracker gave up.")
    result = call("run", clip, *BOX, "--out", "run")
    assert result.exit_code == 2
    *told, advice = result.stderr.splitlines()
    assert told == ["error: The tracker gave up.", "The frames finished until then are in run."]
    assert advice.startswith("To continue from there: tracking3d ") and advice.endswith(" --resume")
    description = json.loads(Path("run/run.json").read_text())
    assert (description["state"], description["error"]) == ("failed", "The tracker gave up.")
    assert len(RunReader(Path("run")).frames) == 2


def test_fault_of_the_program_is_no_traceback_unless_asked_for(call, clip, script):
    script.faults[0] = ZeroDivisionError("division by zero")
    result = call("run", clip, *BOX)
    assert result.exit_code == 1
    assert "Traceback" not in result.output
    assert "ZeroDivisionError: division by zero" in result.stderr
    assert "Traceback" in call("run", clip, *BOX, "--debug").stderr
    assert "Traceback" in call("--debug", "run", clip, *BOX).stderr


def test_folder_with_a_run_is_refused_unless_it_may_be_overwritten(call, refused, clip, script):
    assert call("run", clip, *BOX, "--out", "run").exit_code == 0
    before = Path("run/frames.jsonl").read_bytes()
    held = refused("run", clip, *BOX, "--out", "run", "--frames", "0:2")
    assert held.endswith("already holds a run; choose another --out or pass --overwrite.")
    assert Path("run/frames.jsonl").read_bytes() == before
    assert call("run", clip, *BOX, "--out", "run", "--frames", "0:2", "--overwrite").exit_code == 0
    assert len(RunReader(Path("run")).frames) == 2


def test_folders_of_other_files_need_to_be_confirmed_and_a_root_is_refused(
    call, refused, clip, script, monkeypatch
):
    Path("mine").mkdir()
    Path("mine/notes.txt").write_text("mine")
    for more in ((), ("--resume",), ("--box", "5,5,20,20")):
        line = refused("run", clip, *BOX, "--out", "mine", *more)
        assert "mine holds notes.txt" in line and line.endswith(
            "pass --overwrite to write the run next to it."
        )
    assert [path.name for path in Path("mine").iterdir()] == ["notes.txt"] and not script.built
    assert call("run", clip, *BOX, "--out", "mine", "--overwrite").exit_code == 0
    assert Path("mine/notes.txt").read_text() == "mine" and len(RunReader(Path("mine")).frames) == 5
    monkeypatch.setattr(Path, "mkdir", lambda *given, **named: pytest.fail("a folder was made"))
    for more in ((), ("--overwrite",), ("--resume",), ("--box", "5,5,20,20")):
        assert "is the root of a file system" in refused("run", clip, *BOX, "--out", Path.cwd().anchor, *more)


def test_folder_that_cannot_be_written_is_named(refused, clip, script, tmp_path):
    (tmp_path / "file").write_text("")
    assert "file" in refused("run", clip, *BOX, "--out", "file")
    assert "file/inner" in refused("run", clip, *BOX, "--out", "file/inner")


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ("", "--mask FILE, --points"),
        ("--box 1,2,3", "error: --box '1,2,3' is not four numbers"),
        ("--box here", "'here' is not four numbers"),
        ("--box a,b,c,d", "'a,b,c,d' is not four numbers"),
        ("--box 1,2,nan,4", "not a finite number"),
        ("--box 1,2,0,4", "has no size"),
        ("--box 1,2,3,-4", "has no size"),
        ("--box 100,100,9,9", "error: --box 100,100,9,9 lies outside 000.png, which is 64 x 48"),
        ("--mask absent.png", "error: --mask absent.png does not exist"),
        ("--box 1,1,9,9 --mask m.png", "only one of --box, --mask and --points"),
        ("--box 1,1,9,9 --box 1,2", "'1,2' is not four numbers"),
        ("--box 1,1,9,9 --box 100,100,9,9", "outside 000.png, which is 64 x 48"),
        ("--masks absent", "absent"),
        ("--masks . --tracker csrt", "leave out --tracker csrt"),
        ("--box 1,1,9,9 --tracker crst", "did you mean 'csrt'?"),
        ("--box 1,1,9,9 --features rbg", "did you mean 'rgb'?"),
        ("--box 1,1,9,9 --preset papr", "did you mean 'paper'?"),
        ("--box 1,1,9,9 --set solver.local_windo=9", "did you mean 'solver.local_window'?"),
        ("--box 1,1,9,9 --set tracker.networ=1", "mask tracker 'segment'"),
        ("--box 1,1,9,9 --tracker csrt --set tracker.paddin=1", "did you mean 'padding'?"),
        ("--box 1,1,9,9 --set crop", "section.key=value"),
        ("--box 1,1,9,9 --config absent.yaml", "absent.yaml does not exist"),
        ("--box 1,1,9,9 --size 3", "'crop.size' must be greater than or equal to 32, not 3"),
        ("--box 1,1,9,9 --size big", "--size"),
        ("--box 1,1,9,9 --fov 200", "'camera.fov'"),
        ("--box 1,1,9,9 --fov wide", "--fov"),
        ("--box 1,1,9,9 --intrinsics 1,2,3", "--intrinsics '1,2,3' is not 4 numbers"),
        ("--box 1,1,9,9 --intrinsics a,b,c,d", "FX,FY,CX,CY"),
        ("--box 1,1,9,9 --intrinsics 1,2,nan,4", "is not 4 numbers"),
        ("--box 1,1,9,9 --seed -1", "'runtime.seed'"),
        ("--box 1,1,9,9 --frames 3:1", "error: --frames '3:1' selects no frame"),
        ("--box 1,1,9,9 --frames x", "START:STOP:STEP"),
        ("--box 1,1,9,9 --frames 90:99", "no"),
        ("--boxx 1,1,9,9", "No such option"),
        ("--box", "requires an argument"),
        ("extra --box 1,1,9,9", "unexpected extra argument"),
    ],
)
def test_bad_option_is_refused_in_one_sentence(refused, clip, script, options, words):
    assert words in refused("run", clip, *options.split())
    assert not Path("runs").exists()


def test_bad_sources_are_refused_in_one_sentence(refused, script, tmp_path):
    (tmp_path / "empty.mp4").touch()
    (tmp_path / "text.mp4").write_text("no video")
    (tmp_path / "folder").mkdir()
    for source in ["absent.mp4", "empty.mp4", "text.mp4", "folder", "none/*.png", ""]:
        assert source in refused("run", source, *BOX)
    assert "SOURCE" in refused("run")


@pytest.mark.parametrize(
    ("mask", "words"),
    [
        (np.zeros((48, 64)), "is empty"),
        (np.ones((48, 64)), "covers all"),
        (np.eye(20), "is 20 x 20 pixels, but 000.png is 64 x 48"),
    ],
)
def test_bad_mask_is_refused_in_one_sentence(refused, clip, script, mask_file, mask, words):
    assert words in refused("run", clip, "--mask", mask_file(mask))


def test_images_of_different_sizes_are_skipped(call, clip, script):
    Image.new("RGB", (20, 20)).save(clip / "003.png")
    assert call("run", clip, *BOX, "--out", "run").exit_code == 0
    assert [s["index"] for s in RunReader(Path("run")).description["skipped"]] == [3]


def test_broken_plugin_stops_only_the_run_that_selects_it(call, refused, clip, script, monkeypatch):
    monkeypatch.setenv("TRACKING3D_PLUGINS", "tracking3d.trackers:bad=no_such_module_at_all:Bad")
    assert call("run", clip, *BOX).exit_code == 0
    line = refused("run", clip, *BOX, "--tracker", "bad")
    assert "'bad'" in line
    assert "No module named 'no_such_module_at_all'" in line


def test_default_folder_is_named_after_the_source(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "shots" / "frames").mkdir(parents=True)
    (tmp_path / "film.one.mp4").touch()
    assert default_folder("film.one.mp4") == Path("runs/film.one")
    assert default_folder("shots/") == Path("runs/shots")
    assert default_folder("shots/frames") == Path("runs/shots")
    assert default_folder("shots/*.png") == Path("runs/shots")
    assert default_folder(".") == Path("runs") / tmp_path.name
    assert default_folder("0") == Path("runs/camera_0")


@pytest.mark.parametrize(
    "options",
    [["--model", "fine"], ["--quality", "best", "--tracker", "csrt"], ["--set", "object.shape=fine"]],
)
def test_the_shape_is_made_anew_once_and_the_run_says_what_came_of_it(
    call, clip, script, monkeypatch, options
):
    made = []
    monkeypatch.setattr(
        "tracking3d.reconstruction.rebuild.rebuild_shape",
        lambda folder, *_: made.append(folder) or SimpleNamespace(sentence="It is better."),
    )
    assert "It is better." in call("run", clip, *BOX, *options, "--out", "run").stdout
    assert json.loads(Path("run/run.json").read_text())["shape"] == "It is better."
    call("run", clip, *BOX, *options, "--out", "run", "--resume")  # is finished
    assert made == [Path("run")]
    several = ["--box", "5,5,10,10", *options, "--out", "several"]
    assert call("run", clip, *BOX, *several).exit_code == 0
    assert made[1:] == [Path("several/object_0"), Path("several/object_1")]
