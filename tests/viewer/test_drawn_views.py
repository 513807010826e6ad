"""What is drawn of a run: the frame with its layers, the timeline, the list of doubts."""

from __future__ import annotations

import dataclasses
import re
from html.parser import HTMLParser

import numpy as np
import pytest
from recorded_runs import append_lines, frame_of

from tracking3d.estimation.estimate import FREE_ROTATION
from tracking3d.results import drawing
from tracking3d.ui.viewer import descriptions, timeline
from tracking3d.ui.viewer.followed_run import FollowedRun
from tracking3d.ui.viewer.picture import CAUSAL, LAYERS, Shown, axes_of, beside, draw_picture
from tracking3d.ui.viewer.run_images import LatestImages, OverlayPictures, images_of_run
from tracking3d.video import open_source

pytestmark = pytest.mark.usefixtures("as_users_see_it")


@pytest.fixture
def follower(run):
    follower = FollowedRun(run, "a <run>")
    follower.look_again()
    return follower


class Tags(HTMLParser):
    """The elements of a page that are not of this program's making would show here."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.names: set[str] = set()
        self.text = ""
        self.feed(text)

    def handle_starttag(self, tag, attrs):
        self.names.add(tag)

    def handle_data(self, data):
        self.text += data


def has(picture, colour) -> bool:
    return bool((np.abs(picture.astype(int) - colour).max(axis=2) < 30).any())


@pytest.mark.parametrize("layer", ["initial", "refined"])
def test_each_layer_is_drawn_where_it_is_asked_for(follower, layer):
    image = np.zeros((64, 96, 3), np.uint8)
    for asked in (frozenset(), frozenset({layer})):
        picture = draw_picture(image, [follower], 0, Shown(asked, axes=False), [None])
        assert has(picture, LAYERS[layer]) == bool(asked)
    assert not has(picture, CAUSAL)


def test_the_outlines_of_several_objects_have_colours_of_their_own(follower):
    blank = np.zeros_like(frame_of(0).image)
    shown = Shown(frozenset({"initial", "refined"}), axes=False)
    picture = draw_picture(blank, [follower, follower], 0, shown, [None, None], [(9, 200, 9), (200, 9, 9)])
    assert (picture == (200, 9, 9)).all(-1).any()
    assert not (picture == LAYERS["refined"]).all(-1).any()


def test_a_doubt_frames_the_picture_in_its_colour(follower):
    for index, colour in ((0, None), (3, (250, 200, 60)), (5, (255, 85, 85))):
        picture = draw_picture(frame_of(index).image, [follower], index, Shown(frozenset(), False), [None])
        corner = tuple(int(value) for value in picture[0, 0])
        assert (corner == colour) == (colour is not None)


def test_axes_are_in_the_middle_of_the_object_and_not_beside_a_lost_one(follower):
    axes = axes_of(follower)
    assert np.abs(axes.origin).max() < 0.05
    blank = np.zeros((64, 96, 3), np.uint8)
    tracked = draw_picture(blank, [follower], 0, Shown(frozenset()), [axes])
    middle = np.argwhere(np.abs(tracked.astype(int) - (255, 60, 60)).max(axis=2) < 40)
    assert len(middle) and abs(middle[:, 0].mean() - 31.5) < 3
    lost = draw_picture(blank, [follower], 5, Shown(frozenset()), [axes])
    assert not lost[12:-12, 12:-12].any()


def test_a_frame_that_is_not_at_hand_is_said_to_be_so(follower):
    picture = draw_picture(None, [follower], 0, Shown(), [None])
    assert picture.shape == (64, 96, 3) and has(picture, drawing.INK)


def test_what_a_run_says_is_text_and_never_markup(follower):
    pages = [
        descriptions.list_doubtful_frames([follower, follower]),
        descriptions.describe_frame(follower, follower.frames[5]),
        descriptions.describe_frame(follower, None),
    ]
    for page in pages:
        tags = Tags(page)
        assert tags.names <= {"div", "b", "br", "span"}
        assert "a <run>" in tags.text and "alert" not in "".join(re.findall("<[^>]*>", page))
    assert "<b onclick='alert(1)'>too few</b> points" in Tags(pages[0]).text


def test_a_rotation_that_is_not_known_is_said(follower):
    record = dataclasses.replace(follower.frames[0], free_axis=(0.0, 1.0, 0.0))
    assert FREE_ROTATION in Tags(descriptions.describe_frame(follower, record)).text
    assert FREE_ROTATION not in Tags(descriptions.describe_frame(follower, follower.frames[0])).text


@pytest.mark.parametrize(
    "fault",
    [
        {
            "config": {"tracker": "<script>"},
            "timings": {"seconds_total": "<script>"},
            "notes": [["<script>"]],
        },
        {"config": {}, "timings": {}, "source": {"<script>": 1}, "fps": "fast"},
    ],
)
def test_a_description_of_any_kind_is_told_as_text(follower, fault):
    follower.description = {**follower.description, **fault}
    page = Tags(descriptions.about(follower))
    assert page.names <= {"div", "b", "table", "tr", "td", "p"} and "a <run>" in page.text


def test_the_list_names_frames_status_and_reason_of_every_range(follower):
    text = Tags(descriptions.list_doubtful_frames([follower])).text
    assert "uncertain frames 3 to 4: points" in text and "lost frame 8: no reason given" in text
    follower.frames = {0: follower.frames[0]}
    assert "No frame is uncertain or lost" in descriptions.list_doubtful_frames([follower])


def test_the_timeline_of_a_long_run_stays_small(run):
    append_lines(run, 3000)
    follower = FollowedRun(run, "run")
    follower.look_again()
    assert len(follower.frames) == 3000
    follower.frames[1500].losses["appearance"] = 77.0
    drawn = timeline.draw_timeline([follower], "appearance", 0, 2999)
    points = re.search(r'polyline points="([^"]*)"', drawn)[1].split()
    assert len(points) <= 1400
    lowest = min(float(point.split(",")[1]) for point in points)
    assert lowest == min(float(p.split(",")[1]) for p in points if abs(float(p.split(",")[0]) - 500) < 2)
    assert len(descriptions.list_doubtful_frames([follower])) < 200_000


def test_every_quantity_of_the_run_can_be_plotted(follower):
    assert timeline.quantities([follower]) == [*timeline.PLAIN_QUANTITIES, "appearance"]
    for quantity in timeline.quantities([follower]):
        assert "polyline" in timeline.draw_timeline([follower], quantity, 0, 11)
    follower.frames = {}
    assert "polyline" in timeline.draw_timeline([follower], "confidence", 0, 1)


def test_frames_are_found_where_the_run_found_them_or_in_its_overlay(run, tmp_path, monkeypatch):
    monkeypatch.chdir(run.parent)
    for name in (str(tmp_path / "run_frames"), "run_frames"):
        assert np.array_equal(images_of_run(name, run).image(2), frame_of(2).image)
    monkeypatch.chdir("/")
    assert images_of_run("run_frames", run) is not None
    assert images_of_run("elsewhere", run) is None and images_of_run("0", run) is None
    overlay = OverlayPictures(run, list(range(12)), 64, 96)
    assert overlay.image(12) is None
    assert overlay.image(3).shape[0] == round(64 * overlay.image(3).shape[1] / 96)


def test_the_latest_frames_of_a_camera_are_kept_within_bounds():
    source = LatestImages(open_source(frame_of(n).image for n in range(6)), most=3 * frame_of(0).image.nbytes)
    assert source.image(0) is None
    assert [frame.index for frame in source] == list(range(6))
    assert source.image(2) is None and np.array_equal(source.image(4), frame_of(4).image)


def test_several_videos_stand_in_rows_of_two_and_one_alone_is_left_as_it_is():
    wide, tall = np.full((60, 120, 3), 200, np.uint8), np.full((200, 100, 3), 90, np.uint8)
    assert beside([wide], ["a"]) is wide
    three = beside([wide, tall, wide], ["a", "b" * 500, ""])
    assert three.shape == (2 * (960 + 22), 960, 3)
    assert three[100, 100, 0] == 200 and three[100, 600, 0] == 90 and three[-1, -1, 0] == drawing.PAPER[0]
