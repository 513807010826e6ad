"""Each disturbance changes what it is meant to and leaves the truth alone."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.ndimage import distance_transform_edt

from tracking3d.video.image_file import read_image
from tracking3d_bench.synthesis.camera_effects import compress, jpeg_quality
from tracking3d_bench.synthesis.occluder import MOST_HIDDEN
from tracking3d_bench.synthesis.sequences import render_sequence
from tracking3d_bench.synthesis.spec import Disturbances, SequenceSpec

QUICK = {"frames": 5, "size": (96, 72), "degrees_per_frame": 6.0, "seed": 7}


def sequence(disturbances=None, **settings):
    return render_sequence(SequenceSpec(**{**QUICK, **settings}, disturbances=disturbances or {}))


@pytest.fixture(scope="module")
def plain():
    return sequence(object="blob")


@pytest.mark.parametrize("name", sorted(Disturbances.model_fields))
def test_a_disturbance_leaves_poses_full_masks_depth_and_positions_as_they_are(plain, name):
    disturbed = sequence({name: 1.0}, object="blob")
    assert (disturbed.masks == plain.masks).all()
    assert (disturbed.depth == plain.depth).all()
    assert (disturbed.scene.T_cam_obj == plain.scene.T_cam_obj).all()
    assert (disturbed.scene.camera.K == plain.scene.camera.K).all()
    changes = name not in ("wrong_fov", "jpeg")  # those are in what is written
    assert (disturbed.images != plain.images).any() == changes
    assert ((disturbed.visible_masks != plain.visible_masks).any()) == (name == "occluder")
    if name != "occluder":
        assert (disturbed.points.positions == plain.points.positions).all()
        assert (disturbed.points.visible == plain.points.visible).all()


@pytest.mark.parametrize("name", ["light", "highlights", "motion_blur", "noise", "low_contrast"])
def test_half_the_strength_changes_less(name):
    off, half, full = (
        sequence({name: strength}, object="blob", frames=2, size=(64, 48)).images for strength in (0, 0.5, 1)
    )
    assert 0 < np.abs(half.astype(int) - off).mean() < np.abs(full.astype(int) - off).mean()


def test_the_light_of_frame_0_is_the_same_and_that_of_later_frames_is_not(plain):
    lit = sequence({"light": 1.0}, object="blob")
    assert (lit.images[0] == plain.images[0]).all()
    for region in (plain.masks[4], ~plain.masks[4]):
        assert np.abs(lit.images[4].astype(int) - plain.images[4])[region].mean() > 5


def test_highlights_brighten_the_object_only(plain):
    glossy, dull = sequence({"highlights": 1.0}, object="blob"), plain
    away = distance_transform_edt(~dull.masks.any(0)) > 1.5
    assert (glossy.images[:, away] == dull.images[:, away]).all()
    gain = glossy.images.astype(int) - dull.images
    assert gain.min() >= 0 and gain.max() > 60
    assert 0 < (gain.max(-1) > 30)[dull.masks].mean() < 0.3  # a spot, not a veil


def test_motion_blur_blurs_what_moves_and_only_that():
    blurred = sequence({"motion_blur": 1.0}, degrees_per_frame=15.0)
    sharp = sequence(degrees_per_frame=15.0)
    away = distance_transform_edt(~sharp.masks.any(0)) > 6
    assert (blurred.images[:, away] == sharp.images[:, away]).all()
    inner = distance_transform_edt(sharp.masks[2]) > 4
    detail = [np.hypot(*np.gradient(r.images[2].mean(-1)))[inner].mean() for r in (blurred, sharp)]
    assert detail[0] < 0.85 * detail[1]


def test_blur_is_centred_on_the_time_of_the_frame():
    blurred = sequence(
        {"motion_blur": 1.0}, motion="leave_and_return", frames=8, degrees_per_frame=0.0, textured=False
    )
    sharp = sequence(motion="leave_and_return", frames=8, degrees_per_frame=0.0, textured=False)
    empty = sharp.images[np.argmin(sharp.masks.sum((1, 2)))].astype(float)
    n = 1
    x = np.arange(96)
    centres = []
    for rendered in (blurred, sharp):
        weight = np.abs(rendered.images[n] - empty).sum((0, 2))
        centres.append((x * weight).sum() / weight.sum())
    moved = np.abs(np.diff([np.nonzero(m)[1].mean() for m in sharp.masks[n : n + 2]]))[0]
    assert moved > 5
    assert abs(centres[0] - centres[1]) < 0.1 * moved


def test_noise_has_the_asked_spread_and_differs_from_frame_to_frame(plain):
    noisy = sequence({"noise": 1.0}, object="blob")
    noise = noisy.images.astype(int) - plain.images
    middling = (plain.images > 90) & (plain.images < 160)
    assert noise[middling].mean() == pytest.approx(0, abs=1)
    assert noise[middling].std() == pytest.approx(255 * (0.05 + 0.05 * np.sqrt(125 / 255)), rel=0.1)
    assert np.corrcoef(noise[0].ravel(), noise[1].ravel())[0, 1] < 0.05


def test_low_contrast_shrinks_grey_levels_to_a_fifth_around_the_middle(plain):
    faint = sequence({"low_contrast": 1.0}, object="blob")
    assert faint.images.std() == pytest.approx(0.2 * plain.images.std(), rel=0.05)
    expected = 255 * 0.45 + 0.2 * (plain.images - 255 * 0.45)
    assert np.abs(faint.images - expected).max() <= 1


@pytest.mark.parametrize("name", ["box", "mug"])
@pytest.mark.parametrize("seed", [0, 1])
@pytest.mark.parametrize("strength", [0.4, 1.0])
def test_the_hand_hides_as_much_as_asked_at_its_worst_and_nothing_in_frame_0(name, seed, strength):
    covered = sequence({"occluder": strength}, object=name, seed=seed, frames=9, supersample=1)
    assert not (covered.visible_masks & ~covered.masks).any()
    hidden = 1 - covered.visible_masks.sum((1, 2)) / covered.masks.sum((1, 2))
    assert hidden[0] < 0.02 and hidden[-1] < 0.02
    assert hidden.max() == pytest.approx(MOST_HIDDEN * strength, abs=0.05)


def test_what_the_hand_hides_is_skin_and_it_throws_a_shadow():
    covered = sequence({"occluder": 1.0}, size=(160, 120), textured=False)
    free = sequence(size=(160, 120), textured=False)
    hidden = np.stack([distance_transform_edt(m) > 2 for m in covered.masks & ~covered.visible_masks])
    red, green, blue = covered.images[hidden].mean(0)
    assert red > green + 15 and green > blue
    visible = np.stack([distance_transform_edt(mask) > 3 for mask in covered.visible_masks])
    darker = free.images.astype(int).sum(-1) - covered.images.sum(-1)
    assert (darker[visible] > 20).sum() > 100 and darker[visible].min() > -6


def test_a_hand_that_comes_from_below_throws_no_shadow_on_the_object_since_the_lamp_is_above():
    settings = {"seed": 4, "textured": False, "supersample": 1}
    covered, free = sequence({"occluder": 1.0}, **settings), sequence(**settings)
    assert np.sin(covered.scene.hand.angle) > 0.9
    assert (covered.images == free.images)[covered.visible_masks].mean() > 0.98


def test_a_wrong_field_of_view_is_told_but_not_rendered(plain):
    wrong = sequence({"wrong_fov": 0.5}, fov=40.0)
    true = sequence(fov=40.0)
    assert (wrong.images == true.images).all()
    told = wrong.scene.given_camera
    assert told.fy == pytest.approx(0.5 * 72 / np.tan(np.radians(60) / 2))
    assert true.scene.given_camera == true.scene.camera
    assert sequence({"wrong_fov": 1.0}, fov=90.0, frames=1).scene.given_camera.fy > 0


def test_stronger_jpeg_means_smaller_files_further_from_the_image(plain, tmp_path):
    image = plain.images[0]
    sizes, errors = [], []
    for strength in (0.01, 0.5, 1.0):
        (tmp_path / "a.jpg").write_bytes(compress(image, strength))
        sizes.append((tmp_path / "a.jpg").stat().st_size)
        errors.append(np.abs(read_image(tmp_path / "a.jpg").astype(int) - image).mean())
    assert sizes[0] > sizes[1] > sizes[2] and errors[0] < errors[1] < errors[2]
    assert (jpeg_quality(0.01), jpeg_quality(1.0)) == (94, 15)


@pytest.mark.parametrize("wrong", [{"noise": 1.1}, {"noise": -0.1}, {"noise": float("nan")}, {"fog": 0.5}])
def test_strengths_beyond_0_and_1_and_unknown_disturbances_are_refused(wrong):
    with pytest.raises(ValueError, match=r"noise|fog"):
        Disturbances(**wrong)


def test_blur_without_rays_to_average_is_refused():
    with pytest.raises(ValueError, match="supersample"):
        SequenceSpec(supersample=1, disturbances={"motion_blur": 0.5})
