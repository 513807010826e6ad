"""Points and corrections as texts, and every way to get them wrong."""

from __future__ import annotations

import json
import logging
from pathlib import Path

import numpy as np
import pytest

from tracking3d.errors import InputError
from tracking3d.frames import Frame
from tracking3d.trackers.prompts.corrections import Correction, parse_correction, validate_corrections
from tracking3d.trackers.prompts.points import parse_points, validate_points
from tracking3d.trackers.prompts.prompt import make_prompt


@pytest.fixture(autouse=True)
def usual_log_level():
    yield
    logging.getLogger("tracking3d").setLevel(logging.NOTSET)


IMAGE = np.full((48, 64, 3), (40, 80, 200), np.uint8)
IMAGE[10:30, 20:45] = 220, 90, 30
FRAME = Frame(0, IMAGE, name="000.png")


def test_points_are_numbers_with_a_sign_behind():
    assert parse_points("10,20+  3.5,4-").tolist() == [[10, 20, 1], [3.5, 4, 0]]


@pytest.mark.parametrize(
    ("text", "sentence"),
    [
        ("", "has no point"),
        ("10,20", "'10,20' is not a point; write points as"),
        ("10,20+ x,y-", "'x,y-' is not a point"),
        ("10+", "'10\\+' is not a point"),
        ("1,2,3+", "'1,2,3\\+' is not a point"),
        ("nan,2+", "not a number of pixels"),
        ("1e99,2+", "not a number of pixels"),
        ("10,20-", "no point on the object"),
        ("10,20+ 10,20-", "has the point 10,20 both"),
        ("10,20+ 10.4,20.4-", "has the point 10,20 both"),
        ("1,1+ " * 1001, "at most 1000"),
    ],
)
def test_bad_points_are_refused(text, sentence):
    with pytest.raises(InputError, match=sentence):
        parse_points(text)


@pytest.mark.parametrize(
    "given", ["10,20+", 5, [], [(1, 2)], [(1, 2, 3)], [(1, 2, -1)], {"a": 1}, [[None] * 3], object()]
)
def test_what_is_no_list_of_points_is_refused_by_the_library(given):
    with pytest.raises(InputError, match=r"points="):
        validate_points(given)


def test_points_make_a_mask_and_its_box():
    prompt = make_prompt(FRAME, points=[(30, 20, True), (5, 5, False)])
    x, y, width, height = prompt.box
    assert abs(x - 20) <= 1 and abs(y - 10) <= 1 and abs(width - 25) <= 2 and abs(height - 20) <= 2
    assert prompt.points.tolist() == [[30, 20, 1], [5, 5, 0]]


def test_points_outside_the_frame_are_refused_with_its_size():
    with pytest.raises(InputError, match=r"70,20 lies outside 000\.png, which is 64 x 48 pixels"):
        make_prompt(FRAME, points=[(30, 20, 1), (70, 20, 0)])


def test_points_that_tell_nothing_are_refused():
    with pytest.raises(InputError, match="do not separate an object from the background in frame 0"):
        make_prompt(Frame(0, np.zeros((2, 2, 3), np.uint8)), points=[(0, 0, 1)])


def test_one_kind_of_prompt_is_wanted():
    with pytest.raises(InputError, match="one of a box, a mask or points"):
        make_prompt(FRAME, (1, 1, 5, 5), points=[(1, 1, 1)])


def test_a_correction_is_a_box_a_mask_or_points():
    assert parse_correction("40:1,2,30,40").box == (1, 2, 30, 40)
    assert parse_correction("40:masks/a,b.png").mask == Path("masks/a,b.png")
    assert parse_correction(" 40:1,2+ 3,4- ").points.tolist() == [[1, 2, 1], [3, 4, 0]]
    assert (parse_correction("40@2:1,2,3,4").frame, parse_correction("40@2:1,2,3,4").object) == (40, 2)


@pytest.mark.parametrize(
    ("text", "sentence"),
    [
        ("1,2,3,4", "is not of the form FRAME:X,Y,W,H"),
        ("x:1,2,3,4", "is not of the form FRAME"),
        ("-1:1,2,3,4", "is not of the form FRAME"),
        ("5:", "is not of the form FRAME"),
        ("5:1,2,3", "5:.* is not four numbers"),
        ("5:1,2,0,4", "has no size"),
        ("5:1,2-", "no point on the object"),
    ],
)
def test_bad_corrections_are_refused(text, sentence):
    with pytest.raises(InputError, match=sentence):
        parse_correction(text)


@pytest.mark.parametrize(
    ("given", "sentence"),
    [
        ("5:1,2,3,4", "give a list of Correction"),
        ([(5, (1, 2, 3, 4))], "is a tuple"),
        ([Correction(5)], "give either a box, a mask or points"),
        ([Correction(5, box=(1, 1, 5, 5), points=[(1, 1, 1)])], "give either a box, a mask or points"),
        ([Correction(-5, box=(1, 1, 5, 5))], "is not an index"),
        ([Correction(5, mask=Path("absent.png"))], r"absent\.png does not exist"),
        ([Correction(5, mask=np.zeros((4, 4)))], "is empty"),
        ([Correction(5, box=(1, 1, 5, 5)), Correction(5, box=(1, 1, 6, 6))], "corrected twice"),
        ([Correction(5, box=(1, 1, 5, 5), object=1)], "for object 1, but there is 1"),
    ],
)
def test_corrections_that_cannot_be_are_refused(given, sentence):
    with pytest.raises(InputError, match=sentence):
        validate_corrections(given)


BAD = {
    "points outside": (["--points", "70,20+"], "--points 70,20 lies outside 000.png"),
    "nothing on the object": (["--points", "7,20-"], "no point on the object"),
    "box and points": (
        ["--box", "20,10,20,20", "--points", "7,20+"],
        "only one of --box, --mask and --points",
    ),
    "no such frame": (
        ["--box", "20,10,20,20", "--start-frame", "9"],
        "--start-frame 9 is not among the selected frames",
    ),
    "a negative frame": (
        ["--box", "20,10,20,20", "--start-frame", "-1"],
        "--start-frame -1 is not a frame index",
    ),
    "not selected": (
        ["--box", "20,10,20,20", "--start-frame", "2", "--frames", "1:5:2"],
        "--start-frame 2 is not among the selected frames",
    ),
    "a solver that goes forwards": (
        ["--box", "20,10,20,20", "--start-frame", "2", "--preset", "paper"],
        "Solver 'paper' cannot track backwards. Use solver.name=online, or start at the prompt frame",
    ),
    "a box outside": (["--box", "20,10,20,20", "--correct", "3:70,2,5,5"], "--correct 3:"),
    "the first frame": (["--box", "20,10,20,20", "--correct", "0:1,2,5,5"], "is the frame of the prompt"),
    "beyond the end": (["--box", "20,10,20,20", "--correct", "7:1,2,5,5"], "frame 7 is not among"),
    "an absent mask": (["--box", "20,10,20,20", "--correct", "3:absent.png"], "absent.png does not exist"),
    "another object": (["--box", "20,10,20,20", "--correct", "3@1:1,2,5,5"], "for object 1, but there is 1"),
}


@pytest.mark.parametrize("name", BAD)
def test_the_command_line_says_what_is_wrong(refused, clip, script, name):
    arguments, sentence = BAD[name]
    assert sentence in refused("run", clip, *arguments)
    assert not Path("runs").exists()


def test_masks_that_were_made_elsewhere_are_not_corrected(refused, clip, script, mask_file):
    mask_file(np.eye(48, 64, dtype=bool))
    Path("masks").mkdir()
    for number in range(5):
        Path(f"masks/{number:03d}.png").write_bytes(Path("mask.png").read_bytes())
    line = refused("run", clip, "--masks", "masks", "--correct", "3:1,2,5,5")
    assert "replace the mask file of that frame" in line


def test_a_file_says_what_is_tracked_and_the_command_line_wins(call, clip, script):
    Path("mine.yaml").write_text(
        "prompt:\n  points: 20,20+ 60,40-\n  start_frame: 2\n  correct: '4:1,2,5,5'\n"
        "solver: {final_refine: false}\n"
    )
    assert call("run", clip, "--config", "mine.yaml", "--quiet", "--out", "one").exit_code == 0
    [(_, prompt)] = script.built
    assert prompt.points.tolist() == [[20, 20, 1], [60, 40, 0]]
    prompt = json.loads(Path("one/run.json").read_text())["prompt"]
    assert (prompt["start_frame"], [one["frame"] for one in prompt["corrections"]]) == (2, [4])
    arguments = (
        "--box",
        "20,10,20,20",
        "--start-frame",
        "1",
        "--correct",
        "3:1,2,6,6",
        "--out",
        "two",
        "--quiet",
    )
    assert call("run", clip, "--config", "mine.yaml", *arguments).exit_code == 0
    assert script.built[1][1].points is None
    prompt = json.loads(Path("two/run.json").read_text())["prompt"]
    assert (prompt["start_frame"], [one["frame"] for one in prompt["corrections"]]) == (1, [3])


@pytest.mark.parametrize(
    ("text", "sentence"),
    [
        ("prompt: 1,2,3,4", "'prompt' must be a mapping"),
        ("prompt: {bx: '1,2,3,4'}", "did you mean 'box'"),
        ("prompt: {start_frame: -1}", "start_frame"),
        ("prompt: {box: [1, 2, 3, 4]}", "box"),
        ("prompt: {box: '1,2,3'}", "is not four numbers"),
    ],
)
def test_a_bad_prompt_in_a_file_is_refused(refused, clip, script, text, sentence):
    Path("mine.yaml").write_text(text)
    assert sentence in refused("run", clip, "--config", "mine.yaml")
