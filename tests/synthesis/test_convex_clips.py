"""The truth of synthetic clips is consistent with their images, and the same seed gives the same clip."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.ndimage import distance_transform_edt, map_coordinates
from scipy.spatial.transform import Rotation

from tracking3d.testing.synthesis.convex_clips import SURFACES, SyntheticSpec, degrade_masks, synthesize
from tracking3d_bench.evaluation.metrics import mask_iou

QUICK = SyntheticSpec(frames=6, size=(160, 120), supersample=1)


def project(clip, frame, points):
    """Pixel ``(N, 2)`` of object points ``(N, 3)``, and whether the surface shows them there."""
    T = clip.T_cam_obj[frame]
    camera = points @ T[:3, :3].T + T[:3, 3]
    homogeneous = camera @ clip.K.T
    origin = -T[:3, :3].T @ T[:3, 3]
    hits = clip.surface.cast(origin, points - origin)
    return homogeneous[:, :2] / homogeneous[:, 2:], hits.hit & (hits.distance > 1 - 1e-6)


def surface_points(clip, frame, margin=0.0):
    """What the mask's pixels show, except within ``margin`` pixels of its boundary; and the pixels."""
    y, x = np.nonzero(distance_transform_edt(clip.masks[frame]) > margin)
    T = clip.T_cam_obj[frame]
    rays = np.stack([x, y, np.ones_like(x)], 1) @ np.linalg.inv(clip.K).T @ T[:3, :3]
    hits = clip.surface.cast(-T[:3, :3].T @ T[:3, 3], rays)
    return hits, np.stack([x, y], 1)


@pytest.mark.parametrize("shape", SURFACES)
def test_a_clip_has_the_asked_form_and_the_object_stays_in_the_picture(shape):
    clip = synthesize(replace(QUICK, shape=shape))
    assert clip.images.shape == (6, 120, 160, 3) and clip.images.dtype == np.uint8
    assert clip.masks.shape == (6, 120, 160) and clip.masks.dtype == bool
    assert clip.T_cam_obj.shape == (6, 4, 4)
    for pose, mask in zip(clip.T_cam_obj, clip.masks, strict=True):
        u, v, w = clip.K @ pose[:3, 3]
        assert mask[round(v / w), round(u / w)]
        assert 0.05 < mask.mean() < 0.4
        assert not (mask[0].any() or mask[-1].any() or mask[:, 0].any() or mask[:, -1].any())


@pytest.mark.parametrize("shape", SURFACES)
def test_the_mask_is_what_rays_through_pixel_centres_hit(shape):
    clip = synthesize(replace(QUICK, shape=shape, supersample=3))
    hits, _ = surface_points(clip, 3)
    assert hits.hit.all()
    outside = replace(clip, masks=~clip.masks)
    assert not surface_points(outside, 3)[0].hit.any()


def test_an_ellipsoid_covers_the_area_of_its_projected_ellipse():
    clip = synthesize(replace(QUICK, shape="ellipsoid", frames=1, size=(320, 240)))
    # Outline of an ellipsoid: the conic dual to P diag(radii^2, -1) P^T (Hartley and Zisserman, eq. 8.5).
    P = clip.K @ clip.T_cam_obj[0, :3]
    conic = np.linalg.inv(P @ np.diag([*SURFACES["ellipsoid"].radii ** 2, -1]) @ P.T)
    upper = np.linalg.det(conic[:2, :2])
    area = np.pi * abs(np.linalg.det(conic)) / upper**1.5
    assert clip.masks[0].sum() == pytest.approx(area, rel=0.003)


@pytest.mark.parametrize("degrees", [0.0, 2.0, 25.0])
def test_each_frame_turns_by_the_asked_angle_about_the_asked_axis(degrees):
    clip = synthesize(replace(QUICK, degrees_per_frame=degrees, axis=(1.0, 2.0, -2.0)))
    R = clip.T_cam_obj[:, :3, :3]
    turns = Rotation.from_matrix(R[1:] @ R[:-1].transpose(0, 2, 1)).as_rotvec(degrees=True)
    assert turns == pytest.approx(np.tile(degrees * np.array([1, 2, -2]) / 3, (5, 1)), abs=1e-9)


def test_the_object_drifts_by_the_asked_distance_in_radii():
    clip = synthesize(replace(QUICK, drift=(0.5, -0.25, 1.0)))
    moved = clip.T_cam_obj[-1, :3, 3] - clip.T_cam_obj[0, :3, 3]
    assert moved / clip.surface.radius == pytest.approx([0.5, -0.25, 1.0])
    assert clip.masks[-1].sum() < clip.masks[0].sum()


@pytest.mark.slow
@pytest.mark.parametrize("shape", SURFACES)
def test_the_texture_sticks_to_the_surface(shape):
    clip = synthesize(
        replace(QUICK, shape=shape, size=(320, 240), supersample=3, noise=0.0, drift=(0.1, 0.1, 0.0))
    )
    hits, pixels = surface_points(clip, 0, margin=4)
    there, visible = project(clip, 5, hits.points)
    assert visible.mean() > 0.3
    here = clip.images[0][pixels[:, 1], pixels[:, 0]].astype(float)
    coordinates = there[:, ::-1].T
    later = np.stack(
        [map_coordinates(c.astype(float), coordinates, order=1) for c in clip.images[5].transpose(2, 0, 1)]
    )
    stuck = np.abs(later.T - here)[visible].mean()
    unmoved = np.abs(clip.images[5][pixels[:, 1], pixels[:, 0]] - here)[visible].mean()
    assert stuck < 15
    assert unmoved > 2 * stuck


def test_new_faces_come_into_view():
    clip = synthesize(replace(QUICK, frames=36))
    first, last = (set(surface_points(clip, n)[0].panel) for n in (0, 35))
    assert last - first and first - last and first & last


def test_the_background_does_not_move():
    clip = synthesize(replace(QUICK, noise=0.0))
    outside = ~(clip.masks[0] | clip.masks[-1])
    outside &= distance_transform_edt(outside) > 2
    assert (clip.images[0][outside] == clip.images[-1][outside]).all()


def test_less_clutter_means_a_plainer_background():
    spread = [synthesize(replace(QUICK, frames=1, clutter=c)).images[0][:20].std() for c in (0.0, 1.0)]
    assert spread[0] < 0.5 * spread[1]


def test_the_object_is_richly_textured():
    clip = synthesize(replace(QUICK, size=(320, 240), frames=1))
    grey = clip.images[0].mean(axis=2)
    inside = distance_transform_edt(clip.masks[0]) > 3
    gradient = np.hypot(*np.gradient(grey))[inside]
    assert grey[inside].std() > 25
    assert (gradient > 5).mean() > 0.4


@pytest.mark.usefixtures("made_anew")
def test_the_same_seed_gives_the_same_clip_and_another_seed_another():
    a, b, c = (synthesize(replace(QUICK, frames=2, seed=seed)) for seed in (4, 4, 5))
    assert (a.images == b.images).all() and (a.masks == b.masks).all() and (a.T_cam_obj == b.T_cam_obj).all()
    assert (a.images != c.images).any()


def test_supersampling_changes_the_edges_of_the_image_but_not_the_mask():
    rough, smooth = (synthesize(replace(QUICK, frames=1, noise=0.0, supersample=s)) for s in (1, 5))
    assert (rough.masks == smooth.masks).all()
    far = distance_transform_edt(~smooth.masks[0]) > 2
    assert (rough.images[0] != smooth.images[0]).any()
    assert (rough.images[0][far] == smooth.images[0][far]).all()


def test_an_object_that_leaves_the_picture_or_comes_very_close_is_still_drawn_exactly():
    away = synthesize(replace(QUICK, drift=(40.0, 0.0, 0.0)))
    assert not away.masks[0].any() and not away.masks[-1].any()
    near = synthesize(replace(QUICK, fill=3.0, frames=1))
    assert near.masks[0].mean() > 0.95


@pytest.mark.parametrize("wrong", [{"supersample": 2}, {"frames": 0}])
def test_a_spec_that_makes_no_sense_is_refused(wrong):
    with pytest.raises(ValueError, match="supersample must be odd"):
        synthesize(replace(QUICK, **wrong))


def test_the_box_holds_the_first_mask_tightly():
    clip = synthesize(QUICK)
    y, x = np.nonzero(clip.masks[0])
    assert clip.box == (x.min(), y.min(), x.max() - x.min() + 1, y.max() - y.min() + 1)


def test_degraded_masks_differ_near_the_boundary_only_and_by_the_asked_amount():
    masks = synthesize(replace(QUICK, frames=4, size=(320, 240))).masks
    rough = degrade_masks(masks, seed=1, pixels=1.5)
    for mask, other in zip(masks, rough, strict=True):
        changed = mask != other
        distance = np.where(mask, distance_transform_edt(mask), distance_transform_edt(~mask))
        assert distance[changed].max() < 8
        perimeter = (distance_transform_edt(mask) == 1).sum()
        # The mean of |N(0, 1.5)| is 1.2 pixels.
        assert 0.7 < changed.sum() / perimeter < 1.7
    assert abs(rough.sum() / masks.sum() - 1) < 0.05
    assert (rough[0] ^ masks[0]).sum() != (rough[1] ^ masks[1]).sum()


def test_degrading_is_reproducible_monotonous_and_leaves_empty_and_full_masks_alone():
    masks = synthesize(replace(QUICK, frames=2)).masks
    assert (degrade_masks(masks, 3) == degrade_masks(masks, 3)).all()
    assert (degrade_masks(masks, 3) != degrade_masks(masks, 4)).any()
    ious = [mask_iou(degrade_masks(masks, 3, pixels)[0], masks[0]) for pixels in (0.0, 1.0, 3.0)]
    assert ious[0] == 1.0 > ious[1] > ious[2] > 0.5
    uniform = np.stack([np.zeros((20, 20), bool), np.ones((20, 20), bool)])
    assert (degrade_masks(uniform, 0) == uniform).all()
