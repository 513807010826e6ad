"""Points that `tracking3d.track` is asked to follow: what is asked, and what every answer says of them."""

from __future__ import annotations

import numpy as np
import pytest

from tracking3d import load_config, track
from tracking3d.errors import InputError
from tracking3d.pipeline.point_queries import validate_queries
from tracking3d.testing.synthesis.convex_clips import SyntheticClip, SyntheticSpec, synthesize

SETTINGS = [
    "crop.size=64",
    "object.frequency=4",
    "object.texture_size=16",
    "object.texture_views=0",
    "camera.fov=45",
]


@pytest.fixture(scope="module")
def clip() -> SyntheticClip:
    return synthesize(SyntheticSpec(frames=10, size=(120, 96), degrees_per_frame=5.0))


@pytest.fixture(scope="module")
def config():
    return load_config(overrides=SETTINGS)


@pytest.mark.parametrize(
    ("follow", "sentence"),
    [
        ("centre", r"^follow='centre' is text that does not hold points; give \(x, y\)"),
        ([], r"^follow=.* does not hold points"),
        ([1, 2], r"^follow=.* does not hold points"),
        ([(1, 2, 3, 4)], r"^follow=.* does not hold points"),
        ([(1, 2), (1,)], r"^follow=.* does not hold points"),
        ([(np.nan, 2)], r"^follow= has values that are no finite numbers"),
        ([(-1, 2, 3)], r"^follow= asks in frame -1, which is no index"),
        ([(0.5, 2, 3)], r"^follow= asks in frame 0.5, which is no index"),
    ],
)
def test_what_holds_no_points_is_refused_at_once(clip, config, follow, sentence):
    with pytest.raises(InputError, match=sentence):
        track(clip.images, mask=clip.masks[0], config=config, follow=follow)


def test_pixels_alone_are_of_the_frame_in_which_the_object_is_given():
    np.testing.assert_array_equal(validate_queries([(3, 4)]), [(-1, 3, 4)])
    np.testing.assert_array_equal(validate_queries([(5, 3, 4)]), [(5, 3, 4)])
    assert validate_queries(None) is None


def test_a_pixel_outside_the_frame_is_told_by_the_first(clip, config):
    with pytest.raises(InputError, match=r"^follow= asks for the pixel 120,3, but frames have 120 x 96"):
        next(track(clip.images, mask=clip.masks[0], config=config, follow=[(120, 3)]))


def middle(clip, index: int) -> tuple[float, float]:
    """Where the object's origin is seen."""
    x, y, z = clip.T_cam_obj[index, :3, 3] @ clip.K.T
    return float(x / z), float(y / z)


def test_every_answer_says_where_the_points_are_by_the_frames_until_then(clip, config):
    queries = [(0, *middle(clip, 0)), (0, 1.0, 1.0), (5, *middle(clip, 5))]
    estimates, revised = [], {}
    for estimate in track(clip.images, mask=clip.masks[0], config=config, follow=queries):
        estimates.append(estimate)
        revised.update({one.index: one.points for one in estimate.revised})
    positions = np.stack([estimate.points.positions for estimate in estimates])
    assert positions.shape == (10, 3, 2)
    np.testing.assert_array_equal(positions[0, 0], queries[0][1:])
    assert np.isfinite(positions[:, 0]).all()
    assert np.isnan(positions[:, 1]).all()  # beside the object
    assert np.isnan(positions[:5, 2]).all() and np.isfinite(positions[5:, 2]).all()
    assert estimates[-1].points.visible.tolist() == [True, False, True]
    assert np.isfinite(estimates[-1].points.points[[0, 2]]).all()
    assert (estimates[-1].points.uncertainty[[0, 2]] > 0).all()
    # The object turns: its front goes on, and so do the points; both are asked again after the start is solved.
    moved = np.linalg.norm(positions[-1, 0] - positions[0, 0])
    assert moved > 2
    assert set(revised) and all(np.isfinite(one.positions[0]).all() for one in revised.values())


def test_without_a_question_answers_say_nothing_of_points(clip, config):
    assert next(track(clip.images, mask=clip.masks[0], config=config)).points is None


@pytest.mark.slow
def test_the_result_follows_them_by_the_whole_video(clip, config):
    queries = [(0, *middle(clip, 0)), (5, *middle(clip, 5)), (0, middle(clip, 0)[0] + 3, middle(clip, 0)[1])]
    first, second = track(clip.images, mask=clip.masks[0], config=config, follow=queries).result().tracks
    assert (first.query_frame, second.query_frame) == (0, 5)
    assert first.positions.shape == (10, 2, 2)
    assert second.on_object.all() and np.isfinite(second.uncertainty).all()
