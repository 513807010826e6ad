"""The viewer as a person uses it, in a real browser."""

from __future__ import annotations

import pytest
from browser import open_page
from recorded_runs import estimate_of, frame_of, model, open_run, write_frames
from turning_sphere import turning_sphere_of, written_run

pytest.importorskip("viser", reason="viser is absent: pip install 'tracking3d[view]'")

from tracking3d.ui.viewer.opening import open_viewer
from tracking3d.ui.web.access import Access

pytestmark = pytest.mark.slow  # without a graphics card the browser draws the model on the processor


@pytest.fixture
def shown():
    """Open a viewer of these folders, and a page of it."""
    viewers = []

    def shown(*folders, width=1360, height=760):
        viewers.append(open_viewer(folders, Access(), port=0))
        return open_page(viewers[-1].address, width, height)

    yield shown
    for viewer in viewers:
        viewer.close()


def close_notice(page) -> None:
    """The notice that there is no graphics card lies over the panels."""
    page.wait_for_selector(".timeline svg")
    page.evaluate("document.querySelector('.mantine-Notifications-root').style.display = 'none'")


def wait_for_frame(page, index: int) -> None:
    page.wait_for_selector(f".told[data-frame='{index}']")


def test_the_timeline_and_the_doubts_lead_to_their_frames(shown, run):
    with shown(run) as page:
        close_notice(page)
        wait_for_frame(page, 0)
        area = page.locator(".timeline").bounding_box()
        page.mouse.click(area["x"] + area["width"] * 5 / 11, area["y"] + 60)
        wait_for_frame(page, 5)
        assert "<b onclick='alert(1)'>too few</b> points" in page.inner_text("body")
        page.click("text=Problems")
        page.click(".streak >> nth=2")
        wait_for_frame(page, 8)
        page.click("text=▶▶")
        page.click("text=◀◀")
        wait_for_frame(page, 5)
        page.click("text=Play")
        wait_for_frame(page, 11)
        assert page.locator("canvas").first.bounding_box()["width"] > 200


@pytest.mark.parametrize(("width", "height"), [(1366, 768), (390, 844)], ids=["desktop", "phone"])
def test_a_picture_that_stands_fits_the_window_with_slider_and_play_under_it(shown, tmp_path, width, height):
    written_run(tmp_path / "run", turning_sphere_of(3, 720, 1280))
    with shown(tmp_path / "run", width=width, height=height) as page:
        close_notice(page)
        wait_for_frame(page, 0)
        picture = page.locator("img[src^='blob:']").bounding_box()
        play = page.locator("text=Play").bounding_box()
        assert picture["width"] / picture["height"] == pytest.approx(720 / 1280, abs=0.01)
        assert picture["height"] <= 0.7 * height
        assert picture["y"] + picture["height"] < page.locator(".timeline").bounding_box()["y"] < play["y"]
        assert play["y"] + play["height"] < height


def test_nothing_stands_before_the_model_when_looking_through_the_camera(shown, run):
    with shown(run) as page:
        close_notice(page)
        wait_for_frame(page, 0)
        for name in ("camera path", "current frame"):
            assert page.get_by_label(name).is_checked()
        page.click("text=Look through the camera")
        label = "[...document.querySelectorAll('label')].find(one => one.textContent.trim() === name)"
        for name in ("camera path", "current frame"):
            page.wait_for_function(f"name => !{label}.control.checked", arg=name)


def test_the_line_of_the_present_frame_goes_along_without_the_plot_being_sent_again(shown, run):
    with shown(run) as page:
        close_notice(page)
        wait_for_frame(page, 0)
        plot = page.locator(".timeline").evaluate_handle("plot => plot")
        area = page.locator(".timeline").bounding_box()
        for share in (5 / 11, 9 / 11):
            page.mouse.click(area["x"] + area["width"] * share, area["y"] + 60)
            wait_for_frame(page, round(11 * share))
            line = page.locator(".timeline > div:last-child").bounding_box()
            assert line["x"] == pytest.approx(area["x"] + area["width"] * share, abs=3)
        assert plot.evaluate("plot => plot.isConnected")


def test_a_run_that_goes_on_is_followed_to_its_end(shown, tmp_path):
    write_frames(tmp_path / "frames", 10)
    with open_run(tmp_path / "run", str(tmp_path / "frames")) as writer:
        for index in range(3):
            writer.write(estimate_of(index), frame_of(index))
        with shown(tmp_path / "run") as page:
            close_notice(page)
            wait_for_frame(page, 2)
            for index in range(3, 9):
                writer.write(estimate_of(index), frame_of(index))
            wait_for_frame(page, 8)
            area = page.locator(".timeline").bounding_box()
            page.mouse.click(area["x"] + area["width"] * 2 / 8, area["y"] + 60)
            wait_for_frame(page, 2)
            writer.write(estimate_of(9), frame_of(9))
            writer.finish(model(), "finished")
            page.click("[role=tab]:has-text('Run')")
            page.wait_for_selector("td:text('finished')")
            wait_for_frame(page, 2)  # who looks at another frame is left there
