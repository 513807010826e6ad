"""Once the run has started, the page shows how far it is and its latest masks, stops it, and links to the report."""

from __future__ import annotations

import time
from pathlib import Path

import pytest
from browser import open_page
from raw_requests import request, status
from recorded_runs import write_run
from test_picker_in_browser import SHOWN, drag
from test_picker_server import BOX, body, post, whole

from tracking3d.results import layout
from tracking3d.ui.picker import server as server_module
from tracking3d.ui.picker.server import PageProgress, Picker, ShownRun


@pytest.fixture
def run(tmp_path) -> Path:
    """A run of one object, with a report of its own."""
    folder = write_run(tmp_path / "run", 6)
    (folder / layout.REPORT).write_text("<title>The report</title><a href='mesh.obj'>mesh</a>")
    return folder


@pytest.fixture
def started(picker, run) -> Picker:
    """A page whose run goes on."""
    post(picker, "/start", {"objects": [BOX]})
    picker.run = ShownRun(
        [run], lambda: PageProgress(True, "tracking 3/6, about 5 s left", share=0.4, frame=2)
    )
    return picker


def progress(picker: Picker) -> dict:
    return body(whole(picker, request("GET", "/progress.json")))


def end(picker: Picker) -> None:
    picker.run = ShownRun(picker.run.folders, lambda: PageProgress(sentence="The run is finished."))


def test_it_tells_how_far_the_run_is_with_the_masks_of_the_latest_frame(started):
    told = progress(started)
    assert (told["running"], told["share"], told["frame"]) == (True, 0.4, 2)
    assert told["sentence"].startswith("tracking 3/6")
    assert [veil.startswith("data:image/png;base64,") for veil in told["veils"]] == [True]
    assert (told["reports"], told["viewer"]) == ([], False)
    assert body(whole(started, request("GET", "/session.json")))["started"]


def test_after_its_end_it_links_to_the_report_and_to_what_that_links_to(started, run):
    end(started)
    [link] = progress(started)["reports"]
    answer = whole(started, request("GET", f"/{link}"))
    assert status(answer) == 200 and b"The report" in answer and b"text/html" in answer
    assert (
        b"default-src" not in answer.partition(b"\r\n\r\n")[0]
    )  # the report's own policy lets its script run
    assert status(whole(started, request("GET", "/run/0/mesh.obj"))) == 200


@pytest.mark.parametrize(
    "path", ["/run/1/report.html", "/run/0/run.json", "/run/0/masks", "/run/0/..", "/run/0/../secret.txt"]
)
def test_no_other_file_is_given_away(started, run, path):
    (run.parent / "secret.txt").write_text("secret")
    assert status(whole(started, request("GET", path))) == 404


def test_stop_does_what_ctrl_c_does_but_only_once_the_run_has_started(picker, run):
    assert status(post(picker, "/stop", {})) == 404
    post(picker, "/start", {"objects": [BOX]})
    with pytest.raises(KeyboardInterrupt):
        assert status(post(picker, "/stop", {})) == 200
        time.sleep(20)


def test_the_page_is_waited_for_until_it_no_longer_asks(started, monkeypatch):
    monkeypatch.setattr(server_module, "LEFT", 0.5)
    progress(started)
    began = time.monotonic()
    started.wait_until_left()
    assert 0.3 < time.monotonic() - began < 5


def test_a_person_sees_the_run_go_on_and_end(picker, run, monkeypatch):
    stops: list[bool] = []
    monkeypatch.setattr(server_module, "_interrupt", lambda: stops.append(True))
    with open_page(picker.address) as page:
        page.wait_for_selector("#objects li")
        drag(page, (30, 20), (66, 44))
        page.wait_for_selector(SHOWN)
        page.click("#start")
        picker.wait()
        picker.run = ShownRun(
            [run],
            lambda: PageProgress(True, "tracking 3/6", share=0.4, frame=2),
            lambda: f"{picker.address}picker.css",
        )
        page.wait_for_selector("#status:has-text('tracking 3/6')")
        assert page.evaluate("document.getElementById('progress').value") == pytest.approx(0.4)
        assert page.is_hidden("#tools") and page.is_visible("#viewer")
        while page.evaluate("[frame, (veils ?? []).length].join()") != "2,1":
            page.wait_for_timeout(50)
        page.click("#viewer")
        page.wait_for_selector("#links a[href$='picker.css']:has-text('Viewer')")
        page.click("#stop")
        end(picker)
        page.wait_for_selector("#status:has-text('The run is finished')")
        page.wait_for_selector("#links a:has-text('Report')")
        assert page.is_hidden("#stop") and page.is_hidden("#progress") and stops == [True]


def test_of_a_run_that_is_continued_the_page_shows_the_run_at_once(session, started):
    again = Picker(session, started.save, started.access, 0, started.picked)
    try:
        with open_page(again.address) as page:
            page.wait_for_selector("#status:has-text('Starting')")
            assert page.is_hidden("#tools") and page.is_visible("#stop")
    finally:
        again.close()


def test_every_tracker_of_the_list_has_a_line_that_says_what_it_is_for(picker_with_settings):
    with open_page(picker_with_settings.address) as page:
        page.wait_for_selector("#objects li")
        lines = page.evaluate(
            "[...document.querySelectorAll('[data-setting=tracker] option')].map(one => one.textContent).slice(1)"
        )
    assert any(line.startswith("segment: an object in a hand") for line in lines)
    assert all(": " in line for line in lines)
