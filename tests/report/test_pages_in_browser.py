"""The pages in a real browser: they run without a word, ask for nothing, obey the keyboard and fit a phone."""

from __future__ import annotations

import json
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hostile import HOSTILE
from turning_sphere import turning_sphere_of, written_run

from tracking3d.results.files import write_probability
from tracking3d.results.run_reader import RunReader
from tracking3d.ui.report import run_report
from tracking3d.ui.report.comparison import write_comparison
from tracking3d.ui.report.differences import compare_runs
from tracking3d.ui.report.run_report import write_report

PHONE = {"width": 390, "height": 844}
WHITE, DARK = "rgb(251, 251, 249)", "rgb(19, 20, 22)"


@pytest.fixture(scope="module")
def report(written, tmp_path_factory) -> Path:
    """The report of the run with lost frames, made once."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(run_report, "write_turntable", lambda *_: None)
        return write_report(shutil.copytree(written, tmp_path_factory.mktemp("reported") / "sphere"))


@contextmanager
def opened(browser: Any, file: Path, **about: Any) -> Iterator[Any]:
    """The page, which must not say, ask for, or fail in anything."""
    said: list[str] = []
    context = browser.new_context(**about)
    page = context.new_page()
    # WebGL without a graphics card says that it is slow.
    page.on("console", lambda one: said.append(one.text) if "GL Driver Message" not in one.text else None)
    page.on("pageerror", lambda error: said.append(str(error)))
    page.on("request", lambda one: said.append(one.url) if not one.url.startswith("data:") else None)
    page.goto(file.as_uri())
    yield page
    context.close()
    assert said == [file.as_uri()]


def test_the_slider_moves_picture_words_plots_and_model(browser, report):
    with opened(browser, report) as page:
        first = page.get_attribute("#picture", "src")
        assert page.inner_text("#said").startswith("Frame 0: tracked, confidence 0.9")
        page.focus("#slider")
        for _ in range(5):
            page.keyboard.press("ArrowRight")
        assert page.inner_text("#said") == "Frame 5: lost, confidence 0, keyframe, 0.17 s\nout of sight"
        assert page.get_attribute("#picture", "src") != first
        assert page.get_attribute("#slider", "aria-valuetext") == "frame 5, lost"
        assert {line.get_attribute("x1") for line in page.query_selector_all(".cursor")} == {
            str(1000 * 5.5 / 12)
        }
        page.wait_for_selector("#model.unknown")  # the model is dimmed where nothing is known of its pose
        page.keyboard.press("Home")
        page.wait_for_selector("#model:not(.unknown)")


def test_arrow_keys_move_the_frame_from_anywhere_but_turn_the_model_when_it_is_chosen(browser, report):
    with opened(browser, report) as page:
        page.keyboard.press("ArrowRight")
        assert page.inner_text("#said").startswith("Frame 1:")
        page.focus("#model")
        page.keyboard.press("ArrowRight")
        assert page.inner_text("#said").startswith("Frame 1:")
        assert page.get_attribute("#follow", "aria-pressed") == "false"


def test_all_that_can_be_used_is_reached_by_keyboard_and_its_focus_is_seen(browser, report):
    with opened(browser, report) as page:
        reached = []
        for _ in range(20):
            page.keyboard.press("Tab")
            reached.append(page.evaluate("document.activeElement.id || document.activeElement.tagName"))
            assert page.evaluate("getComputedStyle(document.activeElement).outlineStyle") in ("solid", "auto")
            if reached[-1] == "SUMMARY":
                break
        assert [name for name in reached if name != "A"][:7] == [
            "slider",
            "play",
            "before",
            "after",
            "model",
            "follow",
            "spin",
        ]
        assert "SUMMARY" in reached


def test_doubts_plots_and_play_lead_to_frames(browser, report):
    with opened(browser, report) as page:
        page.click("#after")
        assert page.inner_text("#said").startswith("Frame 4: lost")
        page.click("#after")
        assert page.inner_text("#said").startswith("Frame 7: uncertain")
        page.click("#before")
        assert page.inner_text("#said").startswith("Frame 4: lost")
        page.click("text=frames 7 to 8")
        assert page.inner_text("#said").startswith("Frame 7: uncertain")
        plot = page.locator("[data-plot] svg").nth(1)
        box = plot.bounding_box()
        plot.click(position={"x": box["width"] * 0.99, "y": 20})
        assert page.inner_text("#said").startswith("Frame 11:")
        page.evaluate(
            "window.shown = []; const said = document.getElementById('said');"
            "new MutationObserver(() => shown.push(said.textContent)).observe(said, {childList: true})"
        )
        page.click("#play")  # from the end it begins anew
        page.wait_for_selector("#play[aria-pressed=false]")
        shown = list(dict.fromkeys(text.partition(":")[0] for text in page.evaluate("window.shown")))
        assert shown == [f"Frame {number}" for number in range(12)]


def at_rest(page: Any, selector: str) -> bytes:
    """The picture of an element once it no longer changes."""
    before, now = b"", page.locator(selector).screenshot()
    while now != before:
        page.wait_for_timeout(200)
        before, now = now, page.locator(selector).screenshot()
    return now


def test_the_model_is_drawn_and_turns(browser, report):
    with opened(browser, report) as page:
        page.wait_for_selector("#model:visible")
        assert page.is_hidden("#still")
        before = at_rest(page, "#model")
        box = page.locator("#model").bounding_box()
        page.mouse.move(box["x"] + 100, box["y"] + 100)
        page.mouse.down()
        page.mouse.move(box["x"] + 220, box["y"] + 130)
        page.mouse.up()
        assert at_rest(page, "#model") != before
        page.click("#follow")
        assert at_rest(page, "#model") == before


@pytest.mark.parametrize("kind", ["report", "comparison"])
def test_pages_fit_a_phone_and_follow_its_colours(browser, report, written, tmp_path, kind):
    file = report
    if kind == "comparison":
        file = tmp_path / "comparison.html"
        write_comparison(compare_runs([written, written]), file)
    for scheme, colour in (("light", WHITE), ("dark", DARK)):
        with opened(browser, file, viewport=PHONE, color_scheme=scheme) as page:
            for summary in page.query_selector_all("summary"):
                summary.click()
            assert page.evaluate("document.documentElement.scrollWidth") <= PHONE["width"]
            assert page.evaluate("getComputedStyle(document.body).backgroundColor") == colour


def test_on_a_phone_the_picture_is_seen_while_the_slider_moves_it(browser, report):
    with opened(browser, report, viewport=PHONE) as page:
        boxes = [page.locator(name).bounding_box() for name in ("#picture", "#slider", "#said")]
        assert boxes[2]["y"] + boxes[2]["height"] - boxes[0]["y"] < PHONE["height"]


@pytest.fixture(scope="module", params=[(90, 160), (160, 90)], ids=["portrait", "landscape"])
def sized_report(request, tmp_path_factory) -> Path:
    """The report of a run whose pictures stand, or lie."""
    folder = tmp_path_factory.mktemp("sized") / "sphere"
    written_run(folder, turning_sphere_of(3, *request.param))
    return write_report(folder, turntable=False)


def test_picture_slider_and_play_fit_the_window_with_the_model_beside_them(browser, sized_report):
    with opened(browser, sized_report, viewport={"width": 1366, "height": 768}) as page:
        picture, slider, play, model = (
            page.locator(name).bounding_box() for name in ("#picture", "#slider", "#play", "#model")
        )
        assert picture["height"] <= 0.7 * 768 + 1
        assert picture["y"] + picture["height"] <= slider["y"] <= play["y"]
        assert play["y"] + play["height"] - picture["y"] < 768
        assert model["x"] >= picture["x"] + picture["width"]
        assert abs(model["y"] - picture["y"]) < 20


def test_the_first_screen_of_a_phone_is_the_picture(browser, sized_report):
    with opened(browser, sized_report, viewport=PHONE) as page:
        for name in ("#picture", "#slider", "#play"):
            box = page.locator(name).bounding_box()
            assert 0 < box["y"] < box["y"] + box["height"] < PHONE["height"], name
        assert page.locator("text=Do this next").bounding_box()["y"] > PHONE["height"]


def test_without_javascript_the_first_frame_and_the_model_are_there(browser, report):
    with opened(browser, report, java_script_enabled=False) as page:
        assert page.is_visible("#picture")
        assert page.is_visible("#still")
        assert page.is_visible("noscript p")


def test_a_hostile_run_is_shown_and_does_nothing(browser, run_folder, described, monkeypatch):
    monkeypatch.setattr(run_report, "write_turntable", lambda *_: None)
    lines = [json.loads(line) for line in (run_folder / "frames.jsonl").read_text().splitlines()]
    for line in lines:
        line["reason"] = HOSTILE
    (run_folder / "frames.jsonl").write_text("".join(json.dumps(line) + "\n" for line in lines))
    described(run_folder, source=HOSTILE, command=HOSTILE, notes=[HOSTILE])
    with opened(browser, write_report(run_folder)) as page:
        page.click("#after")
        assert HOSTILE in page.inner_text("#said")
        assert page.title() == "sphere"


def test_the_policy_of_a_page_holds_even_if_something_got_into_it(browser, report, tmp_path):
    """Markup that no escaping would let through: neither its script runs, nor is its picture asked for."""
    injected = (
        "<img src='http://localhost:9/x.png' onerror='window.taken = 1'><script>window.taken = 2</script>"
    )
    file = tmp_path / "injected.html"
    file.write_text(report.read_text(encoding="utf-8").replace("<h1>", f"{injected}<h1>"), encoding="utf-8")
    page = browser.new_page()
    left: list[str] = []
    page.on("response", lambda one: left.append(one.url) if one.url.startswith("http") else None)
    page.goto(file.as_uri())
    page.click("#after")
    assert page.inner_text("#said").startswith("Frame 4")
    assert page.evaluate("window.taken") is None
    assert left == []
    page.close()


def test_probabilities_are_laid_over_the_picture_when_asked_for(browser, run_folder, monkeypatch):
    monkeypatch.setattr(run_report, "write_turntable", lambda *_: None)
    camera = RunReader(run_folder).camera
    for index in (0, 2):
        write_probability(run_folder, index, np.full((camera.height, camera.width), 0.9, np.float32))
    with opened(browser, write_report(run_folder)) as page:
        assert not page.is_visible("#probability")
        page.focus("#likely")
        page.keyboard.press("Enter")
        assert page.locator("#probability").bounding_box() == page.locator("#picture").bounding_box()
        assert page.is_visible("#ramp")
        page.keyboard.press("ArrowRight")
        assert not page.is_visible("#probability")
        assert "no probability" in page.inner_text("#said")
        page.keyboard.press("ArrowRight")
        assert page.is_visible("#probability")
        page.click("#likely")
        assert not page.is_visible("#probability")
        assert not page.is_visible("#ramp")
