"""The picker as a person uses it, in a real browser."""

from __future__ import annotations

import numpy as np
import pytest
from browser import open_page

SHOWN = "#status:has-text('The run starts from this mask')"


@pytest.fixture
def page(picker):
    with open_page(picker.address) as page:
        page.wait_for_selector("#objects li")
        yield page


def at(page, x: float, y: float) -> tuple[float, float]:
    """Where on the screen a pixel of the frame is."""
    area = page.locator("#canvas").bounding_box()
    return area["x"] + x * area["width"] / 96, area["y"] + y * area["height"] / 64


def drag(page, start: tuple[float, float], end: tuple[float, float]) -> None:
    page.mouse.move(*at(page, *start))
    page.mouse.down()
    page.mouse.move(*at(page, *end), steps=3)
    page.mouse.up()


def test_boxes_on_a_later_frame_start_a_run_there(page, picker):
    page.fill("#number", "4")
    page.dispatch_event("#number", "change")
    drag(page, (30, 20), (66, 44))
    page.wait_for_selector(SHOWN)
    page.click("#add")
    page.fill("#objects li:nth-child(2) input[type=text]", "the other")
    drag(page, (5, 2), (20, 12))
    page.wait_for_selector("#objects li:nth-child(2) small:has-text('px')")
    page.click("#start")
    page.wait_for_selector("#run:not([hidden])")
    picked = picker.wait()
    assert picked.frame == 4 and [one.name for one in picked.objects] == ["object", "the other"]
    assert np.allclose(picked.boxes, [(30, 20, 36, 24), (5, 2, 15, 10)], atol=0.5)


def test_points_paint_and_undo_and_the_command_to_copy(page, picker, tmp_path):
    page.keyboard.press("o")
    page.mouse.click(*at(page, 48, 32))
    page.wait_for_selector(SHOWN)
    page.mouse.click(*at(page, 80, 50), button="right")
    page.keyboard.press("p")
    drag(page, (5, 5), (20, 5))
    page.keyboard.press("Control+z")
    page.wait_for_selector("#objects li small:has-text('px')")
    page.click("#save")
    page.wait_for_selector("#told:has-text('--mask')")
    assert "picked/object_0.png" in page.inner_text("#told")
    assert (tmp_path / "out" / "picked" / "object_0.png").is_file() and picker.picked is None
    told = (tmp_path / "out" / "picked.json").read_text()
    assert '"on": false' in told and '"strokes": []' in told


def test_what_cannot_be_used_is_said_in_red_and_nothing_starts(page, picker):
    page.keyboard.press("i")
    page.mouse.click(*at(page, 48, 32))
    page.wait_for_selector("#status.problem:has-text('No object is marked')")
    page.click("#clear")
    page.wait_for_selector("#start:disabled")
