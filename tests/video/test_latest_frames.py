"""A consumer that is too slow gets the newest frame and is told of those it missed; nothing is left behind."""

from __future__ import annotations

import threading
import time
from itertools import count

import numpy as np
import pytest

from tracking3d.errors import InputError
from tracking3d.frames import Frame, SkippedFrame
from tracking3d.pipeline.track import validate_image
from tracking3d.video import FrameSource, LatestFrames, open_source
from tracking3d.video.latest_frames import DROPPED, newest

IMAGE = np.zeros((4, 6, 3), np.uint8)


def frame(index: int) -> Frame:
    return Frame(index, IMAGE + np.uint8(index), name=f"frame {index}")


class Stepped:
    """A source that gives so many items and then waits until it is told to go on."""

    def __init__(self, *groups) -> None:
        self.groups = groups
        self.go = [threading.Event() for _ in groups]
        self.given = [threading.Event() for _ in groups]
        self.closed_by = None

    def __iter__(self):
        try:
            for group, go, given in zip(self.groups, self.go, self.given, strict=True):
                assert go.wait(5)
                for item in group:
                    if isinstance(item, Exception):
                        raise item
                    yield item
                # It is asked for more only after its last item was left.
                given.set()
        finally:
            self.closed_by = threading.current_thread()

    def give(self, group: int) -> None:
        self.go[group].set()
        assert self.given[group].wait(5)


def told(items) -> list[int | str]:
    """Frames by their index, skipped ones by index and reason."""
    return [item.index if isinstance(item, Frame) else f"{item.index} {item.reason}" for item in items]


@pytest.fixture(autouse=True)
def no_thread_is_left():
    yield
    assert not [thread for thread in threading.enumerate() if thread.name == "latest frames"]


def test_a_consumer_that_keeps_up_misses_nothing():
    source = Stepped(*([frame(n)] for n in range(5)))
    seen = []
    frames = newest(source)
    for n in range(5):
        source.go[n].set()
        seen.append(next(frames))
    assert told(seen) == [0, 1, 2, 3, 4] and list(frames) == []
    assert [int(one.image[0, 0, 0]) for one in seen] == [0, 1, 2, 3, 4]


def test_a_slow_consumer_gets_the_newest_frame_after_those_that_were_dropped():
    source = Stepped([frame(0)], [frame(n) for n in range(1, 5)], [frame(5), frame(6)])
    frames = newest(source)
    source.go[0].set()
    assert told([next(frames)]) == [0]
    source.give(1)
    assert told(next(frames) for _ in range(4)) == [f"1 {DROPPED}", f"2 {DROPPED}", f"3 {DROPPED}", 4]
    source.give(2)
    assert told(frames) == [f"5 {DROPPED}", 6]


def test_the_first_frame_is_never_dropped_for_the_prompt_is_about_it():
    for _ in range(50):
        items = list(newest([frame(n) for n in range(20)]))
        assert told(items[:1]) == [0] and told(items[-1:]) == [19]
        assert [item.index for item in items] == list(range(20))


def test_frames_that_the_source_itself_skips_stay_in_their_place():
    bad = SkippedFrame(0, "damaged"), SkippedFrame(2, "damaged"), SkippedFrame(5, "damaged")
    source = Stepped([bad[0], frame(1)], [bad[1], frame(3), frame(4), bad[2]])
    frames = newest(source)
    source.go[0].set()
    assert told(next(frames) for _ in range(2)) == ["0 damaged", 1]
    source.give(1)
    assert told(frames) == ["2 damaged", f"3 {DROPPED}", 4, "5 damaged"]


@pytest.mark.parametrize("group", [0, 1])
def test_an_error_of_the_source_is_raised_in_the_consumer_after_what_was_there(group):
    groups = [[frame(0)], [frame(1)]]
    groups[group] = [*groups[group], InputError("unplugged")]
    source = Stepped(*groups)
    for go in source.go:
        go.set()
    seen = []
    with pytest.raises(InputError, match="unplugged"):
        for item in newest(source):
            seen.append(item)
    assert told(seen)[: 1 + group] == [0, 1][: 1 + group]


def test_a_source_that_is_none_is_an_error_in_the_consumer():
    with pytest.raises(TypeError):
        next(newest(3))


def test_a_consumer_that_stops_ends_the_thread_and_the_source_in_it():
    source = Stepped([frame(0)], [frame(1)])
    source.go[0].set()
    frames = newest(source)
    next(frames)
    source.go[1].set()
    frames.close()
    assert source.closed_by is not None and source.closed_by is not threading.current_thread()


def test_a_source_without_an_end_stops_with_its_consumer():
    given = []

    def endless():
        for index in count():
            given.append(index)
            time.sleep(0.001)
            yield frame(index % 200)

    frames = newest(endless())
    next(frames)
    frames.close()
    ended = len(given)
    time.sleep(0.02)
    assert len(given) == ended


def test_a_source_that_fails_while_it_is_closed_does_not_leave_the_consumer_waiting():
    def failing():
        try:
            yield frame(0)
            yield frame(1)
        finally:
            raise InputError("cannot be closed")

    frames = newest(failing())
    with pytest.raises(InputError, match="cannot be closed"):
        list(frames)


def test_a_source_is_played_at_a_rate_and_every_frame_is_taken_or_told_of():
    source = LatestFrames(open_source([IMAGE] * 30), rate=100)
    assert isinstance(source, FrameSource) and (source.fps, source.count) == (100, 30)
    started = time.monotonic()
    items, lags = [], []
    for item in source:
        items.append(item)
        if isinstance(item, Frame):
            validate_image(item.image, item.index)
            lags.append(time.monotonic() - started - item.time)
            time.sleep(0.035)  # three and a half frames
    assert [item.index for item in items] == list(range(30))
    taken = [item for item in items if isinstance(item, Frame)]
    assert 6 <= len(taken) <= 12 and taken[0].index == 0 and taken[-1].index == 29
    assert {item.reason for item in items if isinstance(item, SkippedFrame)} == {DROPPED}
    times = [item.time for item in taken]
    assert all(item.time >= item.index / 100 for item in taken) and times == sorted(times)
    # It does not fall behind: a frame is never older than the work on the one before it.
    assert max(lags) < 0.15


def test_a_source_that_is_played_as_fast_as_it_comes_keeps_its_times():
    source = LatestFrames(open_source([IMAGE] * 3))
    assert {item.time for item in source if isinstance(item, Frame)} == {None}
    assert not source.repeatable


@pytest.mark.parametrize("rate", [0, -1, float("nan"), float("inf")])
def test_a_rate_that_makes_no_sense_is_refused(rate):
    with pytest.raises(InputError, match="frames per second"):
        LatestFrames(open_source([IMAGE]), rate)
