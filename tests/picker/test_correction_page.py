"""The page on which a frame of a run is drawn anew: what it orders is a box or a mask, and nothing else."""

from __future__ import annotations

import pytest
from raw_requests import raw_request, request, status
from test_picker_server import BOX, POINTS, body, post, whole

from tracking3d.errors import InputError
from tracking3d.picker.correction import CorrectionPage, CorrectionProgress
from tracking3d.web.access import Access


@pytest.fixture
def begun() -> list:
    return []


@pytest.fixture
def page(session, begun):
    def begin(drawn):
        if drawn.frame == 5:
            raise InputError("A correction is in progress; wait for it to finish.")
        begun.append(drawn)

    page = CorrectionPage(
        session, "cup", begin, lambda: CorrectionProgress(bool(begun), "so far", share=0.5), Access(), 0
    )
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
    assert body(whole(page, request("GET", "/progress.json"))) == {
        "running": False,
        "sentence": "so far",
        "failed": False,
        "share": 0.5,
    }


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
