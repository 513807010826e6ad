"""The overlay and the contact sheet show what they say."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from tracking3d.estimation.estimate import Status
from tracking3d.frames import Frame
from tracking3d.geometry.camera import Camera
from tracking3d.results import drawing
from tracking3d.results.contact_sheet import (
    COLUMNS,
    CROPS,
    MOST,
    TILE,
    Thumbnails,
    crop_positions,
    draw_contact_sheet,
)
from tracking3d.results.description import summary
from tracking3d.results.overlay import ObjectAxes, OverlaySize, draw_overlay
from tracking3d.results.records import FrameRecord

pytestmark = pytest.mark.usefixtures("as_users_see_it")


def overlay_of(clip, number, axes=None, **changes):
    estimate = dataclasses.replace(clip.estimates[number], **changes)
    record = FrameRecord.of(estimate, "", estimate.initial_mask)
    return draw_overlay(clip.frames[number], estimate, record, clip.camera, axes)


@pytest.mark.parametrize(
    ("size", "picture"),
    [
        ((160, 120), (320, 240)),
        ((320, 241), (320, 241)),
        ((641, 480), (640, 480)),
        ((3840, 2160), (1920, 1080)),
    ],
)
def test_overlays_are_readable_and_of_even_size(size, picture):
    layout = OverlaySize.of(Camera.from_fov(*size))
    assert (layout.width, layout.picture) == picture
    assert layout.width % 2 == layout.height % 2 == 0
    assert layout.bar >= 22


@pytest.mark.parametrize("size", [(160, 120), (333, 251), (640, 480)])
def test_an_overlay_has_its_size_and_leaves_the_frame_alone(make_turning_sphere, size):
    clip = make_turning_sphere(1, *size)
    before = clip.frames[0].image.copy()
    image = overlay_of(clip, 0)
    layout = OverlaySize.of(clip.camera)
    assert image.shape == (layout.height, layout.width, 3)
    assert image.dtype == np.uint8
    assert np.array_equal(clip.frames[0].image, before)


def test_outlines_lie_on_the_edges_of_the_masks(make_turning_sphere):
    clip = make_turning_sphere(1, 640, 480)
    estimate, initial = np.zeros((480, 640), dtype=bool), np.zeros((480, 640), dtype=bool)
    estimate[100:200, 100:200] = True
    estimate[140:160, 140:160] = False  # a hole has an edge too
    initial[300:400, 300:400] = True
    image = overlay_of(clip, 0, mask=estimate, initial_mask=initial)
    for y, x in [(100, 150), (199, 150), (150, 100), (140, 150)]:
        assert tuple(image[y, x]) == drawing.REFINED
    assert tuple(image[300, 350]) == drawing.INITIAL
    assert np.array_equal(image[120, 120], clip.frames[0].image[120, 120])


def test_axes_start_at_the_objects_middle_and_have_its_length(make_turning_sphere):
    clip = make_turning_sphere(8, 640, 480)
    axes = ObjectAxes.of(clip.estimates[0], clip.camera)
    assert np.abs(axes.origin).max() < 0.05
    assert axes.length == pytest.approx(1.0, abs=0.05)
    image = overlay_of(clip, 0, axes)
    x = round(clip.camera.cx - 0.6 / 4 * clip.camera.fx)
    y = round(clip.camera.cy + 0.1 / 4 * clip.camera.fx)
    assert (image[y - 4 : y + 5, x + 60] == (255, 60, 60)).all(1).any()  # x to the right
    assert (image[y + 60, x - 4 : x + 5] == (60, 220, 60)).all(1).any()  # y down
    assert not (image[y, x - 60 : x - 10] == (255, 60, 60)).all(1).any()


@pytest.mark.parametrize("T", [np.full((4, 4), np.nan), np.diag([1.0, 1, 1, 1]), -np.eye(4)])
def test_a_pose_that_cannot_be_drawn_is_left_out(turning_sphere, T):
    axes = ObjectAxes(np.zeros(3), 1.0)
    assert (
        ObjectAxes.of(dataclasses.replace(turning_sphere.estimates[0], T_cam_obj=T), turning_sphere.camera)
        is None
    )
    assert np.array_equal(overlay_of(turning_sphere, 0, axes, T_cam_obj=T), overlay_of(turning_sphere, 0))


@pytest.mark.parametrize("status", [Status.UNCERTAIN, Status.LOST])
def test_a_pose_that_is_not_believed_has_no_axes(turning_sphere, status):
    axes = ObjectAxes.of(turning_sphere.estimates[0], turning_sphere.camera)
    without = overlay_of(turning_sphere, 0, None, status=status)
    assert np.array_equal(overlay_of(turning_sphere, 0, axes, status=status), without)
    assert not np.array_equal(overlay_of(turning_sphere, 0, axes), overlay_of(turning_sphere, 0))


@pytest.mark.parametrize("shift", [(40, 0), (0, -40)])
def test_axes_that_begin_beside_the_mask_are_left_out(turning_sphere, shift):
    axes = ObjectAxes.of(turning_sphere.estimates[0], turning_sphere.camera)
    elsewhere = np.roll(turning_sphere.estimates[0].mask, shift, (1, 0))
    assert np.array_equal(
        overlay_of(turning_sphere, 0, axes, mask=elsewhere), overlay_of(turning_sphere, 0, mask=elsewhere)
    )


def test_axes_that_begin_in_a_hole_of_the_mask_are_drawn(turning_sphere):
    estimate, camera = turning_sphere.estimates[0], turning_sphere.camera
    axes = ObjectAxes.of(estimate, camera)
    rows, columns = (round(float(places.mean())) for places in np.nonzero(estimate.mask))
    pierced = estimate.mask.copy()
    pierced[rows - 3 : rows + 4, columns - 3 : columns + 4] = False
    with_axes, without = (overlay_of(turning_sphere, 0, one, mask=pierced) for one in (axes, None))
    assert not np.array_equal(with_axes, without)
    pierced[: rows + 1, columns - 3 : columns + 4] = False
    with_axes, without = (overlay_of(turning_sphere, 0, one, mask=pierced) for one in (axes, None))
    assert np.array_equal(with_axes, without), "a hole that is open to the outside is beside the object"


def test_axes_of_a_pose_far_outside_of_the_frame_are_left_out(turning_sphere):
    axes, T = ObjectAxes(np.zeros(3), 1.0), np.eye(4)
    T[:3, 3] = 1e9, 0, 1
    assert np.array_equal(overlay_of(turning_sphere, 0, axes, T_cam_obj=T), overlay_of(turning_sphere, 0))


@pytest.mark.parametrize("status", list(Status))
def test_the_status_bar_shows_status_by_colour_and_survives_any_reason(turning_sphere, status):
    bar = overlay_of(turning_sphere, 0, status=status, reason="ünsehr lang " * 60, confidence=float("nan"))[
        240:
    ]
    assert (np.abs(bar.astype(int) - drawing.STATUS[status]).max(2) < 40).any()
    assert (bar[:, -3:] == drawing.PAPER).all()  # nothing runs out of the picture


REASON = "the rendered mask overlaps the initial one by an IoU of 0.45 only, so that one is the answer"


@pytest.fixture
def texts(monkeypatch):
    """The texts that are drawn, with the column at which each ends."""
    drawn, draw_text = [], drawing.draw_text

    def recorded(image, text, *where):
        drawn.append((text, end := draw_text(image, text, *where)))
        return end

    monkeypatch.setattr(drawing, "draw_text", recorded)
    return drawn


@pytest.mark.parametrize("width", [96, 320, 500, 640, 1920])
@pytest.mark.parametrize("reason", [REASON, "csrt: " + 4 * REASON, "no pose", ""])
def test_a_reason_is_shown_in_whole_words_in_frames_of_any_width(make_turning_sphere, texts, width, reason):
    clip = make_turning_sphere(1, width, width // 2)
    overlay_of(clip, 0, status=Status.UNCERTAIN, reason=reason)
    after_figures = [text for text, _ in texts][[text for text, _ in texts].index("estimate") + 1 :]
    shown = " ".join(after_figures)
    if len(reason) <= len(REASON):
        assert shown == reason
    else:
        assert shown.endswith("...") and reason.startswith(shown.removesuffix("...") + " ")
        assert len(shown) > 80
    assert max(end for _, end in texts) <= OverlaySize.of(clip.camera).width


def test_text_is_shortened_between_words():
    words = ["points", "agree,", "pixels", "do", "not"]
    beginnings = [" ".join(words[:count]) + "..." for count in range(1, len(words))]
    for width in range(60, 400):
        short = drawing.shorten(" ".join(words), 10, width)
        assert drawing.text_width(short, 10) <= width
        assert short in [*beginnings, " ".join(words)] or "points".startswith(short.removesuffix("..."))


def test_of_a_single_long_word_the_beginning_is_kept():
    assert drawing.shorten("/a/very/long/path" * 20, 10, 200).startswith("/a/very/long/")
    assert drawing.wrap("/a/very/long/path" * 20 + " is missing", 10, 200, 2)[1] == "is missing"


def test_thumbnails_are_few_and_spread_over_a_clip_of_any_length(turning_sphere):
    picture = np.zeros((240, 320, 3), dtype=np.uint8)
    small = dataclasses.replace(turning_sphere.estimates[0], mask=np.zeros((4, 4), dtype=bool))
    thumbnails = Thumbnails()
    for index in range(1000):
        thumbnails.add(picture, 2.0, dataclasses.replace(small, index=index))
        assert len(thumbnails.kept) <= MOST
        steps = np.diff([thumbnail.index for thumbnail in thumbnails.kept])
        assert len(set(steps)) <= 1
        assert [thumbnail.index for thumbnail in thumbnails.kept] == list(crop_positions(index + 1))
    chosen = [thumbnail.index for thumbnail in thumbnails.spread(CROPS)]
    assert len(chosen) == CROPS
    assert chosen[0] == 0
    assert chosen[-1] >= 900
    assert Thumbnails().spread(CROPS) == []


def test_a_thumbnail_is_centred_on_the_object(turning_sphere):
    mask = np.zeros((120, 160), dtype=bool)
    mask[40:60, 100:120] = True
    picture = np.repeat(np.repeat(mask, 2, 0), 2, 1)[..., None] * np.full(3, 255, dtype=np.uint8)
    thumbnails = Thumbnails()
    thumbnails.add(picture, 2.0, dataclasses.replace(turning_sphere.estimates[0], mask=mask))
    rows, columns = np.nonzero(thumbnails.kept[0].image[..., 0] > 128)
    assert rows.mean() == pytest.approx(TILE / 2, abs=3)
    assert columns.mean() == pytest.approx(TILE / 2, abs=3)
    assert 0.5 < np.ptp(rows) / TILE < 0.7


@pytest.mark.parametrize(("count", "rows"), [(0, 1), (5, 2), (12, 3)])
def test_the_sheet_has_crops_texture_mesh_and_figures(turning_sphere, count, rows):
    thumbnails = Thumbnails()
    for index in range(count):
        estimate = dataclasses.replace(turning_sphere.estimates[0], index=index, keyframe=index == 1)
        thumbnails.add(overlay_of(turning_sphere, 0)[:240], 2.0, estimate)
    figures = summary([], 0, {})
    sheet = draw_contact_sheet(thumbnails.spread(CROPS), turning_sphere.model, figures)
    assert sheet.shape == (rows * TILE, COLUMNS * TILE, 3)
    framed = [tuple(sheet[1, column * TILE + 1]) == drawing.KEYFRAME for column in range(COLUMNS)]
    assert framed == [count > 1 and column == 1 for column in range(COLUMNS)]


def test_the_sheet_shows_the_model_from_sides_of_tracked_frames_only(turning_sphere):
    def model_tiles(statuses):
        thumbnails = Thumbnails()
        for number, status in enumerate(statuses):
            estimate = dataclasses.replace(turning_sphere.estimates[number], status=status)
            thumbnails.add(overlay_of(turning_sphere, number)[:240], 2.0, estimate)
        sheet = draw_contact_sheet(thumbnails.spread(CROPS), turning_sphere.model, summary([], 0, {}))
        row = sheet[-TILE:, TILE:-TILE]
        return [row[:, n * TILE : (n + 1) * TILE] for n in range(COLUMNS - 2)]

    drawn = [(tile != drawing.PAPER).any(2).mean() > 0.5 for tile in model_tiles([Status.TRACKED] * 2)]
    assert drawn == [True, True, False, False]
    drawn = [(tile != drawing.PAPER).any(2).mean() > 0.5 for tile in model_tiles([Status.LOST] * 4)]
    assert drawn == [True, False, False, False]  # from the front, since no side is known


def test_the_sheet_says_which_crops_show_an_answer_that_was_replaced(turning_sphere):
    thumbnails = Thumbnails()
    thumbnails.add(overlay_of(turning_sphere, 0)[:240], 2.0, turning_sphere.estimates[0])
    sheets = [
        draw_contact_sheet(thumbnails.spread(CROPS), None, summary([], 0, {}), replaced)
        for replaced in ({0}, {1}, set())
    ]
    assert np.array_equal(sheets[1], sheets[2])
    changed = (sheets[0] != sheets[2]).any(2)
    assert changed[:24, 100:TILE].any()
    assert not changed[24:].any()


def test_the_sheet_of_a_run_without_a_mesh_has_no_mesh(turning_sphere):
    thumbnails = Thumbnails()
    thumbnails.add(overlay_of(turning_sphere, 0)[:240], 2.0, turning_sphere.estimates[0])
    sheet = draw_contact_sheet(thumbnails.spread(CROPS), None, summary([], 0, {}))
    assert sheet.shape[0] == 2 * TILE
    assert (sheet[TILE:, TILE:] == drawing.PAPER).all()


def test_a_frame_of_another_size_than_the_cameras_is_scaled(turning_sphere):
    camera = turning_sphere.camera
    frame = Frame(0, np.zeros((60, 80, 3), dtype=np.uint8))
    estimate = turning_sphere.estimates[0]
    record = FrameRecord.of(estimate)
    assert draw_overlay(frame, estimate, record, camera, None).shape[1] == OverlaySize.of(camera).width
