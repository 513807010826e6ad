"""The page on which a frame of a run is drawn anew: what it orders is a box or a mask, and nothing else."""

from __future__ import annotations

import base64

import cv2
import numpy as np
import pytest
from browser import open_page
from raw_requests import raw_request, request, status
from test_picker_server import BOX, POINTS, body, post, whole

from tracking3d.errors import InputError
from tracking3d.ui.picker.correction import CorrectionPage
from tracking3d.ui.picker.server import PageProgress
from tracking3d.ui.web.access import Access

NOTHING = {**BOX, "box": None}
PAINT = {"path": [[80, 10]], "radius": 4, "on": True}
ERASE = {"path": [[50, 0], [50, 63]], "radius": 3, "on": False}


def mask_of_run(index: int) -> np.ndarray | None:
    """The left half of the object is missing; frame 2 has no mask."""
    mask = np.zeros((64, 96), bool)
    mask[20:44, 48:66] = True
    return None if index == 2 else mask


@pytest.fixture
def begun() -> list:
    return []


def colours_of(page, drawn) -> np.ndarray:
    """``(H, W)`` which pixels the page colours for a drawing."""
    veil = body(post(page, "/mask", drawn))["veil"]
    layer = np.frombuffer(base64.b64decode(veil.partition(",")[2]), np.uint8)
    return cv2.imdecode(layer, cv2.IMREAD_UNCHANGED)[..., 3] > 0


def test_before_anything_is_drawn_the_mask_of_the_run_is_shown(page):
    assert np.array_equal(colours_of(page, {**NOTHING, "frame": 3}), mask_of_run(3))
    assert status(post(page, "/mask", {**NOTHING, "frame": 2})) == 422


def test_paint_and_erase_start_from_the_mask_of_the_run(page, begun):
    drawn = {**NOTHING, "frame": 3, "strokes": [PAINT, ERASE]}
    assert status(post(page, "/correct", drawn)) == 200
    mask, before = begun[0].mask, mask_of_run(3)
    assert mask[10, 80] and not mask[:, 50].any()
    assert np.array_equal(mask[:, 55:70], before[:, 55:70])
    assert np.array_equal(mask, colours_of(page, drawn))


@pytest.mark.parametrize("given", [BOX, POINTS], ids=["box", "points"])
def test_a_box_or_points_replace_the_mask_of_the_run(page, begun, given):
    assert status(post(page, "/correct", {**given, "frame": 3, "strokes": [PAINT]})) == 200
    assert begun[0].mask[22:42, 33:46].mean() > 0.9


def test_of_a_frame_without_a_mask_paint_is_all_there_is(page, begun):
    assert status(post(page, "/correct", {**NOTHING, "frame": 2, "strokes": [PAINT]})) == 200
    assert 40 < begun[0].mask.sum() < 80


def test_a_drawing_of_nothing_corrects_nothing(page, begun):
    answer = post(page, "/correct", {**NOTHING, "frame": 3})
    assert status(answer) == 422 and b"Nothing is drawn yet" in answer
    wiped = {"path": [[0, 32], [95, 32]], "radius": 60, "on": False}
    assert status(post(page, "/correct", {**NOTHING, "frame": 3, "strokes": [wiped]})) == 422
    assert begun == []


def test_a_person_sees_the_mask_of_the_run_and_erases_from_it(page, begun):
    with open_page(f"{page.address}#frame=3") as opened:
        opened.wait_for_selector("#status:has-text('This is the mask of the run')")
        opened.wait_for_selector("#start:disabled")
        opened.keyboard.press("e")
        area = opened.locator("#canvas").bounding_box()
        for press, y in ((opened.mouse.down, 0.25), (opened.mouse.up, 0.75)):
            opened.mouse.move(area["x"] + area["width"] * 50 / 96, area["y"] + area["height"] * y)
            press()
        opened.wait_for_selector("#status:has-text('The run continues from this mask')")
        opened.click("#start")
        opened.wait_for_selector("#status:has-text('so far')")
    before = mask_of_run(3)
    assert 0 < begun[0].mask.sum() < before.sum() and not (begun[0].mask & ~before).any()


@pytest.fixture
def page(session, begun):
    def begin(drawn):
        if drawn.frame == 5:
            raise InputError("A correction is in progress; wait for it to finish.")
        begun.append(drawn)

    def progress():
        return PageProgress(bool(begun), "so far" if begun else "", share=0.5)

    page = CorrectionPage(session, "cup", mask_of_run, begin, progress, Access(), 0)
    yield page
    page.close()


def test_a_box_or_what_the_mask_was_made_of_begins_a_correction(page, begun):
    assert status(post(page, "/correct", {**BOX, "frame": 3})) == 200
    assert status(post(page, "/correct", {**POINTS, "frame": 4})) == 200
    assert [(one.frame, one.box, one.mask is None) for one in begun] == [
        (3, (30, 20, 36, 24), True),
        (4, None, False),
    ]
    assert 600 < begun[1].mask.sum() < 1100


def test_it_says_whom_it_corrects_and_how_far_that_is(page, begun):
    told = body(whole(page, request("GET", "/session.json")))
    assert (told["correcting"], told["first"], told["last"]) == ("cup", 0, 5)
    now = body(whole(page, request("GET", "/progress.json")))
    assert (now["running"], now["sentence"], now["failed"], now["share"]) == (False, "", False, 0.5)


@pytest.mark.parametrize(
    "told",
    [
        {"frame": 1},
        {**BOX, "frame": 77},
        {**BOX, "frame": -1},
        {**BOX, "frame": "1; rm -rf"},
        {**BOX, "box": [900, 900, 5, 5]},
        {**BOX, "box": None},
        {**BOX, "mask": "/etc/passwd"},
        {**BOX, "folder": "/tmp"},
        {**BOX, "command": "tracking3d"},
        {"objects": [BOX]},
    ],
)
def test_what_is_no_drawing_is_refused_and_begins_nothing(page, begun, told):
    assert status(post(page, "/correct", told)) == 422
    assert begun == []


def test_a_refusal_is_told_in_a_sentence(page):
    answer = post(page, "/correct", {**BOX, "frame": 5})
    assert status(answer) == 422 and b"A correction is in progress; wait for it to finish." in answer


@pytest.mark.parametrize("path", ["/start", "/save", "/correct/../start"])
def test_no_run_is_begun_there(page, begun, path):
    assert status(post(page, path, {"objects": [BOX]})) == 404


@pytest.mark.parametrize("origin", [None, "http://elsewhere.example"])
def test_other_pages_are_refused(page, begun, origin):
    assert status(post(page, "/correct", BOX, Origin=origin)) == 403
    assert status(raw_request(page.port, request("GET", "/progress.json", Host="rebound.example"))) == 403
    assert begun == []
