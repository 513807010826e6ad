"""From what is drawn to a mask, a file, a command; and what is no drawing."""

from __future__ import annotations

import json
import shlex

import numpy as np
import pytest
import typer
from recorded_runs import frame_of

from tracking3d.cli import app
from tracking3d.config.loading import load_config
from tracking3d.errors import InputError
from tracking3d.ui.picker.correction import command_of, save_outcome
from tracking3d.ui.picker.drawing import Drawing, DrawnObject, Point, Stroke, parse
from tracking3d.ui.picker.session import Picked, drawn_mask

OBJECT = {"name": "cup", "colour": "#00a5e0", "frame": 0}


def drawn(**more) -> DrawnObject:
    return DrawnObject(**{**OBJECT, **more})


def iou(a, b) -> float:
    return np.count_nonzero(a & b) / np.count_nonzero(a | b)


TRUTH = np.zeros((64, 96), bool)
TRUTH[20:44, 30:66] = True


def test_a_box_alone_is_left_to_the_tracker():
    assert drawn_mask(frame_of(0).image, drawn(box=(30, 20, 36, 24))) is None
    assert drawn_mask(frame_of(0).image, drawn()) is None


@pytest.mark.parametrize("box", [None, (26, 16, 44, 32)])
def test_a_click_on_the_object_finds_it(box):
    mask = drawn_mask(frame_of(3).image, drawn(box=box, points=(Point(x=48, y=32, on=True),)))
    assert iou(mask, TRUTH) > 0.85


def test_a_click_beside_the_object_keeps_off_what_is_there():
    image = frame_of(3).image.copy()
    image[20:44, 70:90] = image[30, 40]  # its twin
    on = Point(x=48, y=32, on=True)
    box = (26, 16, 66, 32)
    beside = Point(x=80, y=32, on=False)
    assert drawn_mask(image, drawn(box=box, points=(on, beside)))[32, 80] == False  # noqa: E712
    assert iou(drawn_mask(image, drawn(box=box, points=(on,))), TRUTH) > 0.85  # the twin is not touched


def test_paint_is_what_it_says_over_everything_else():
    paint = Stroke(path=((5, 5), (20, 5)), radius=2, on=True)
    erase = Stroke(path=((48, 32),), radius=6, on=False)
    mask = drawn_mask(frame_of(3).image, drawn(points=(Point(x=48, y=32, on=True),), strokes=(paint, erase)))
    assert mask[5, 5:20].all() and not mask[32, 48] and mask[22, 33]
    assert drawn_mask(frame_of(3).image, drawn(strokes=(paint,))).sum() < 120
    assert drawn_mask(frame_of(3).image, drawn(strokes=(erase,))) is None


def test_a_picture_of_one_colour_and_points_far_outside_end_nothing():
    flat = np.zeros((64, 96, 3), np.uint8)
    points = (Point(x=60000, y=-60000, on=True), Point(x=48, y=32, on=True), Point(x=-1, y=1e4, on=False))
    stroke = Stroke(path=((-6e4, 6e4), (6e4, -6e4)), radius=65536, on=True)
    for image in (flat, frame_of(0).image):
        for more in ({}, {"box": (6e4, 6e4, 1, 1)}, {"strokes": (stroke,)}):
            mask = drawn_mask(image, drawn(points=points, **more))
            assert mask is None or mask.shape == (64, 96)


@pytest.mark.parametrize(
    "fault",
    [
        {"name": ""},
        {"name": "a" * 41},
        {"name": "a\nb"},
        {"name": "\u202eabc"},
        {"colour": "red"},
        {"colour": "#00a5e0\n"},
        {"colour": "url(http://evil.example)"},
        {"frame": -1},
        {"frame": 1.5},
        {"box": [1, 2, 3]},
        {"box": [1, 2, 0, 4]},
        {"box": [1, 2, 1e30, 4]},
        {"points": [{"x": 1, "y": 2}]},
        {"points": [{"x": 1, "y": 2, "on": True}] * 201},
        {"points": [{"x": 1, "y": 2, "on": True, "path": "/etc/passwd"}]},
        {"strokes": [{"path": [], "radius": 2, "on": True}]},
        {"strokes": [{"path": [[1, 2]] * 2001, "radius": 2, "on": True}]},
        {"strokes": [{"path": [[1, 2]], "radius": -1, "on": True}]},
        {"mask": "/etc/passwd"},
    ],
)
def test_what_is_no_drawing_is_refused_in_a_sentence(fault):
    with pytest.raises(InputError, match="cannot be used"):
        parse(json.dumps({**OBJECT, **fault}).encode(), DrawnObject)


@pytest.mark.parametrize("text", [b"", b"{", b"[]", b"null", b"\xff", b'{"objects": []}', b"[" * 100_000])
def test_nonsense_is_refused_in_a_sentence(text):
    with pytest.raises(InputError):
        parse(text, Drawing)
    with pytest.raises(InputError):
        parse(json.dumps({"objects": [OBJECT] * 17}).encode(), Drawing)


def test_numbers_that_are_none_are_refused():
    for number in ("NaN", "Infinity", "1e999"):
        with pytest.raises(InputError):
            parse(
                f'{{"name": "a", "colour": "#000000", "frame": 0, "box": [{number}, 1, 1, 1]}}'.encode(),
                DrawnObject,
            )


def understood(command: str):
    """The arguments of ``tracking3d run``, as the program takes them."""
    program = typer.main.get_command(app)
    words = shlex.split(command)
    assert words[:2] == ["tracking3d", "run"]
    return program.commands["run"].make_context("run", words[2:]).params


def test_the_command_is_one_that_the_program_takes(tmp_path):
    folder, config = tmp_path / "a run", load_config()
    boxes = Picked(7, (drawn(box=(1, 2, 3, 4)),), boxes=[(1.0, 2.0, 3.5, 4.0)])
    masks = Picked(0, (drawn(), drawn()), masks=[TRUTH, TRUTH])
    for picked in (boxes, masks):
        save_outcome(picked, config, folder, "my clip.mp4")
        given = understood(command_of(picked, folder, "my clip.mp4", None))
        assert (given["source"], given["out"]) == ("my clip.mp4", folder)
        assert load_config(given["config"]) == config
        if picked.boxes:
            assert (given["box"], given["start_frame"]) == (["1,2,3.5,4"], 7)
        else:
            assert given["start_frame"] is None and all(path.is_file() for path in given["mask"])
            assert len(given["mask"]) == 2


def test_names_and_colours_are_kept_in_the_run_folder_and_nothing_is_written_elsewhere(tmp_path):
    before = set(tmp_path.rglob("*"))
    save_outcome(Picked(0, (drawn(),), masks=[TRUTH]), load_config(), tmp_path / "run", "a.mp4")
    told = json.loads((tmp_path / "run" / "picked.json").read_text())
    assert [(one["name"], one["colour"]) for one in told["objects"]] == [("cup", "#00a5e0")]
    assert all(path.is_relative_to(tmp_path / "run") for path in set(tmp_path.rglob("*")) - before)


@pytest.mark.parametrize(
    ("frame", "asked", "start"),
    [(0, None, None), (12, None, 12), (0, "0:50", None), (20, "0:50:5", 20), (4, "4::2", None)],
)
def test_the_run_is_of_all_that_was_asked_for_both_ways_from_what_was_picked(tmp_path, frame, asked, start):
    picked = Picked(frame, (drawn(),), boxes=[(1.0, 2.0, 3.0, 4.0)])
    given = understood(command_of(picked, tmp_path / "run", "a.mp4", asked))
    assert (given["start_frame"], given["frames"]) == (start, asked)


def test_a_drawing_keeps_the_order_of_its_objects():
    drawing = Drawing(objects=(drawn(name="a"), drawn(name="b")))
    assert [one.name for one in parse(drawing.model_dump_json().encode(), Drawing).objects] == ["a", "b"]
