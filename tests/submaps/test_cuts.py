"""Where a video is cut, and into how many parts."""

from __future__ import annotations

import itertools

import numpy as np
import pytest

from tracking3d.config.models import PluginChoice
from tracking3d.errors import InputError
from tracking3d.pipeline.submaps.cuts import Sighting, cuts_in, overlap_of, parse_length, parts_at, windows
from tracking3d.pipeline.submaps.plan import stride_of, tracker_for_looking


def steady(count: int, **changed: dict[int, object]) -> list[Sighting]:
    """An object that is seen well all the time, but for what is said of some frames."""
    sightings = []
    for position in range(count):
        own = {name: values[position] for name, values in changed.items() if position in values}
        sightings.append(
            Sighting(**{"position": position, "area": 900, "touches_border": False, "score": 0.9, **own})
        )
    return sightings


@pytest.mark.parametrize(
    ("text", "fps", "frames"), [("60", 30, 1800), ("2.5s", 20, 50), ("900f", None, 900), (" 30F ", 5, 30)]
)
def test_a_length_is_in_seconds_or_in_frames(text, fps, frames):
    assert parse_length(text, fps) == frames


@pytest.mark.parametrize(
    "text", ["0", "-3", "-0", "nan", "inf", "1e999", "ten", "", "5m", "1.2.3", "f", "0f", "٣"]
)
def test_what_is_no_length_is_refused_in_one_sentence(text):
    with pytest.raises(InputError, match=r"\.$") as refused:
        parse_length(text, 30.0)
    assert "--split" in refused.value.at_the_command_line


def test_seconds_mean_nothing_without_a_rate():
    with pytest.raises(InputError, match="in frames"):
        parse_length("60", None)


def test_a_part_too_short_to_tell_a_shape_is_refused():
    with pytest.raises(InputError, match="24"):
        parse_length("0.1", 30.0)


@pytest.mark.parametrize(
    ("count", "length"), [(1000, 100), (1000, 999), (97, 24), (30, 1000), (1, 24), (149, 100)]
)
def test_parts_are_of_one_length_and_cover_every_frame(count, length):
    cuts = [window[len(window) // 2] for window in windows(count, length)]
    parts = parts_at(cuts, count, overlap_of(length))
    assert len(parts) == max(round(count / length), 1)
    assert parts[0].start == parts[0].owns_from == 0
    assert parts[-1].stop == count
    for before, part in itertools.pairwise(parts):
        assert before.start < part.start < part.owns_from == before.stop <= count
    owned = [part.owns_from for part in parts] + [count]
    assert owned == sorted(owned)


def test_a_video_shorter_than_a_part_is_not_cut():
    assert windows(30, 1000) == []
    assert len(parts_at([], 30, 12)) == 1


def test_a_cut_is_made_where_the_object_is_seen_best():
    [window] = windows(100, 50)
    hidden = dict.fromkeys(range(46, 57), 300)
    border = dict.fromkeys([*range(38, 42), 57, 58], True)
    doubted = dict.fromkeys(range(59, 64), 0.4)
    [cut] = cuts_in(steady(100, area=hidden, touches_border=border, score=doubted), [window])
    assert cut.position in window
    assert cut.area == 900
    assert not cut.touches_border
    assert cut.score == 0.9


def test_of_frames_alike_the_one_in_the_middle_is_cut_at():
    [window] = windows(101, 50)
    [cut] = cuts_in(steady(101), [window])
    assert abs(cut.position - 50) <= 1


def test_a_frame_in_which_the_mask_jumps_is_no_place_to_cut():
    [window] = windows(100, 50)
    jumps = {position: 900 if position % 2 else 2000 for position in range(100) if position != 45}
    flat = dict.fromkeys((44, 45, 46), 900)
    [cut] = cuts_in(steady(100, area=jumps | flat), [window])
    assert cut.position in (44, 45, 46)


def test_there_is_no_cut_where_the_object_is_nowhere_well_seen():
    allowed = windows(300, 100)
    gone = dict.fromkeys(allowed[0], 0)
    cuts = cuts_in(steady(300, area=gone), allowed)
    assert [cut.position in allowed[1] for cut in cuts] == [True]
    assert cuts_in([], allowed) == []


def test_no_choice_beats_brute_force():
    """The worth of a frame is monotonous in each of its parts, whatever else a window holds."""
    random = np.random.default_rng(0)
    [window] = windows(60, 30)
    for _ in range(20):
        scores = {position: float(random.uniform(0.3, 1)) for position in range(60)}
        [cut] = cuts_in(steady(60, score=scores), [window])
        middle = (window.start + window.stop - 1) / 2
        no_worse = [
            other
            for other in window
            if scores[other] > scores[cut.position] and abs(other - middle) < abs(cut.position - middle)
        ]
        assert not no_worse


def test_about_twelve_frames_a_second_are_looked_at_by_the_quick_tracker_unless_masks_are_given():
    assert [stride_of(fps) for fps in (None, 5.0, 12.0, 25.0, 30.0, 240.0)] == [2, 1, 1, 2, 2, 4]
    assert tracker_for_looking(PluginChoice(name="csrt")).name == "flow"
    given = PluginChoice(name="precomputed", path="masks")
    assert tracker_for_looking(given) is given
