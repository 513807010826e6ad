"""Photos in wide steps are joined by the points that they share, and a start that is not reliable is not accepted."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import cv2
import numpy as np
import pytest
from online_runs import estimate_of, frame, known_run, solver, true_mask, turning_clip
from scipy.spatial.transform import Rotation

from tracking3d.config.loading import load_config
from tracking3d.estimation.online.features.klt import grey
from tracking3d.estimation.online.features.sift import Keypoints
from tracking3d.estimation.online.initialization import photo_start
from tracking3d.estimation.online.initialization.photo_start import (
    PhotoStructure,
    PhotoTracks,
    add_photo,
    agree,
    facing,
    is_reliable,
    keep_connected,
    merge,
    overlap_of_hull,
    reverse,
    start_of_photos,
    triangulate,
)
from tracking3d.estimation.online.initialization.photo_tracks import (
    Photo,
    PhotoSilhouette,
    join_tracks,
    match_photos,
    neighbouring_pairs,
)
from tracking3d.estimation.online.solver import OnlineSolver
from tracking3d.estimation.solver import PhotoSet
from tracking3d.features.rgb import RgbEncoder
from tracking3d.frames import Frame
from tracking3d.geometry.camera import Camera
from tracking3d.points.bundle_adjustment.adjustment import Tracks
from tracking3d.testing.synthesis import convex_clips
from tracking3d.testing.synthesis.convex_clips import SyntheticClip, SyntheticSpec, synthesize
from tracking3d_bench.evaluation.metrics import aligned_rotation_errors
from tracking3d_bench.synthesis.sequences import render_sequence
from tracking3d_bench.synthesis.spec import SequenceSpec

STEP = 20.0
K = np.array([[400.0, 0, 159.5], [0, 400.0, 119.5], [0, 0, 1]])


@cache
def turntable(count: int = 8, step: float = STEP) -> SyntheticClip:
    """A painted egg on a turntable, before a background that stands still."""
    return synthesize(
        SyntheticSpec(
            shape="ellipsoid", frames=count, size=(320, 240), degrees_per_frame=step, axis=(0.0, -1.0, 0.25),
            drift=(0.0, 0.0, 0.0), fill=0.85, supersample=1,
        )
    )  # fmt: skip


@cache
def photos_of(count: int = 8, step: float = STEP) -> tuple[Photo, ...]:
    clip = turntable(count, step)
    return tuple(
        Photo.of(index, grey(image), mask)
        for index, (image, mask) in enumerate(zip(clip.images, clip.masks, strict=True))
    )


def errors(found: PhotoStructure, clip: SyntheticClip, places=None) -> np.ndarray:
    joined = sorted(found.photos)
    true = clip.T_cam_obj[joined if places is None else [places[photo] for photo in joined], :3, :3]
    return aligned_rotation_errors(found.R[joined], true)


# ------------------------------------------------------------------ whole sets


def test_photos_twenty_degrees_apart_are_joined_and_right():
    start = start_of_photos([photos_of()], turntable().camera)
    assert start.structure is not None
    assert len(start.structure.photos) == 8
    assert start.reason == ""
    assert errors(start.structure, turntable()).max() < 3


def test_where_one_kind_of_keypoints_joins_too_few_another_does():
    none = [replace(photo, keypoints=(Keypoints.none(),)) for photo in photos_of()]
    start = start_of_photos([none, photos_of()], turntable().camera)
    assert start.joined == set(range(8))
    assert errors(start.structure, turntable()).max() < 3


def test_further_keypoints_that_join_some_photos_only_are_not_believed_alone():
    nothing = (Keypoints.none(),)
    none = [replace(photo, keypoints=nothing) for photo in photos_of()]
    some = [photo if place < 6 else none[place] for place, photo in enumerate(photos_of())]
    first = start_of_photos([some, none], turntable().camera)
    assert first.structure is not None and not first.joined & {6, 7}
    assert start_of_photos([none, some], turntable().camera).structure is None


def test_photos_in_any_order_are_joined_by_all_their_pairs():
    order = np.random.default_rng(0).permutation(8)
    shuffled = [replace(photos_of()[place], index=number) for number, place in enumerate(order)]
    start = start_of_photos([shuffled], turntable().camera)
    assert start.structure is not None
    assert len(start.structure.photos) == 8
    assert errors(start.structure, turntable(), order).max() < 3


def test_a_thing_that_is_turned_over_between_photos_is_one_solid(monkeypatch):
    """Six photos of one side, and six of the other: what both show joins them."""
    poses = convex_clips._poses

    def of_two_sides(spec, camera, radius):
        T = poses(spec, camera, radius)
        over = Rotation.from_rotvec(np.pi * np.array([0.0, 0.25, 1.0]) / np.hypot(0.25, 1.0)).as_matrix()
        for index in range(6, 12):  # upside down, and the same turns again
            T[index, :3, :3] = T[index - 6, :3, :3] @ T[0, :3, :3].T @ over @ T[0, :3, :3]
        return T

    monkeypatch.setattr(convex_clips, "_poses", of_two_sides)
    clip = turntable.__wrapped__(12, 25.0)
    seen = zip(clip.images, clip.masks, strict=True)
    start = start_of_photos(
        [[Photo.of(n, grey(image), mask) for n, (image, mask) in enumerate(seen)]], clip.camera
    )
    assert start.structure is not None
    assert len(start.structure.photos) == 12 and start.reason == ""
    assert errors(start.structure, clip).max() < 3


@pytest.mark.slow
def test_the_lens_need_not_be_known():
    assumed = replace(turntable().camera, assumed=True).zoom(0.6, "a guess")
    start = start_of_photos([photos_of()], assumed)
    assert start.structure is not None
    assert errors(start.structure, turntable()).max() < 3
    assert start.structure.K[0, 0] == pytest.approx(turntable().camera.fx, rel=0.1)


def test_a_photo_that_shows_too_little_is_named_with_its_neighbours():
    photos = list(photos_of())
    nothing = tuple(Keypoints.none() for _ in photos[4].keypoints)
    photos[4] = replace(photos[4], keypoints=nothing)
    start = start_of_photos([photos], turntable().camera)
    assert start.structure is not None
    assert 4 not in start.structure.photos
    assert start.reason.endswith("take one every 20 degrees or less")
    assert "photo 4 shares too few points with photos 3 and 5" in start.reason
    assert start.reason.startswith(f"8 photos, {len(start.structure.photos)} joined; ")


@pytest.mark.parametrize("plain", [True, False])
def test_photos_of_a_plain_object_are_not_blamed_for_their_steps(plain, monkeypatch):
    matched = list[bool]()
    monkeypatch.setattr(photo_start, "match_photos", lambda *_: matched.append(True) or {})
    flat = np.full_like(turning_clip().images[0], 120)
    photos = {n: Frame(n, flat) if plain else frame(4 * n) for n in range(4)}
    photo_set = PhotoSet(
        tuple(photos), lambda indices: ((photos[n], estimate_of(true_mask(4 * n))) for n in indices)
    )
    state, _ = solver().init(photos[0], estimate_of(true_mask(0)))
    state, found = solver().start_from_photos(state, photo_set)
    assert ("hardly any texture" in found.reason) is plain is not bool(matched)
    if plain:
        assert not found.estimates and state.waiting_reason == found.reason


def test_photos_of_a_vase_of_rings_are_not_blamed_for_their_steps():
    spec = SequenceSpec(
        name="vase", object="vase", motion="turntable", frames=7, size=(240, 180), degrees_per_frame=STEP
    )
    made = render_sequence(spec)
    photos = [Frame(n, image) for n, image in enumerate(made.images)]
    masks = [estimate_of(mask > 0.5) for mask in made.masks]
    photo_set = PhotoSet(
        tuple(range(7)), lambda indices: ((photos[index], masks[index]) for index in indices)
    )
    fresh = OnlineSolver(
        load_config(overrides=["object.frequency=7"]), Camera.from_fov(*spec.size), RgbEncoder()
    )
    _, found = fresh.start_from_photos(fresh.init(photos[0], masks[0])[0], photo_set)
    assert found.reason.startswith("7 photos, none joined; it looks the same from all sides")


def test_what_is_known_to_be_plain_is_not_looked_at_as_photos():
    state, _ = known_run(12)
    views = tuple(replace(view, strength=0.1) for view in state.object_map.keyframes)
    plain = replace(state, object_map=replace(state.object_map, keyframes=views, pointless=True))
    same, found = solver().start_from_photos(plain, PhotoSet((0, 1), lambda _: pytest.fail("read in vain")))
    assert same is plain and "hardly any texture" in found.reason


def test_photos_too_far_apart_are_not_joined_and_no_motion_is_asked_for():
    start = start_of_photos([photos_of(6, 60.0)], turntable(6, 60.0).camera)
    assert start.structure is None
    assert start.reason.startswith("6 photos, none joined; photo ")
    assert "take one every 20 degrees or less" in start.reason
    assert "moved" not in start.reason


def test_points_that_do_not_move_as_one_solid_are_called_reflections(monkeypatch):
    monkeypatch.setattr(photo_start, "solve_photos", lambda tracks, cameras: [])
    start = start_of_photos([photos_of()], turntable().camera)
    assert start.structure is None
    assert start.reason == "8 photos, none joined; points on it do not move as one solid (reflections?)"


# ------------------------------------------------------------------ matches and tracks


def test_what_stands_still_in_the_picture_is_no_match():
    one = photos_of()[0]
    assert match_photos([one, one], [(0, 1)], turntable().camera.K, 1.5) == {}


def test_matches_of_neighbours_obey_the_true_motion():
    clip, photos = turntable(), photos_of()
    matches = match_photos(photos, neighbouring_pairs(8, 1), clip.camera.K, 1.5)
    assert len(matches) >= 7
    for (a, b), matched in matches.items():
        if b - a > 1:
            continue
        T = clip.T_cam_obj[b] @ np.linalg.inv(clip.T_cam_obj[a])
        x, y = T[:3, 3], np.linalg.inv(clip.camera.K)
        cross = np.array([[0, -x[2], x[1]], [x[2], 0, -x[0]], [-x[1], x[0], 0]])
        F = y.T @ cross @ T[:3, :3] @ y
        here, there = (
            cv2.convertPointsToHomogeneous(photos[place].pixels[matched[:, side]])[:, 0]
            for side, place in enumerate((a, b))
        )
        line = here @ F.T
        distance = np.abs((there * line).sum(1)) / np.linalg.norm(line[:, :2], axis=1)
        assert np.mean(distance < 2) > 0.8


def test_neighbours_are_those_within_two_places_around_the_turn():
    assert neighbouring_pairs(6, 1) == [(0, 1), (0, 5), (1, 2), (2, 3), (3, 4), (4, 5)]


def keypoints_at(*pixels: tuple[float, float]) -> Photo:
    found = Keypoints(np.array(pixels, np.float32), np.zeros((len(pixels), 128), np.float32))
    return Photo(0, (found,), PhotoSilhouette.of(np.ones((9, 9), bool)), 9.0)


def test_a_track_has_one_place_in_a_photo_and_the_stronger_pair_decides():
    photos = [keypoints_at((0, 0), (20, 0)), keypoints_at((5, 0), (25, 0)), keypoints_at((9, 0), (29, 0))]
    matches = {
        (0, 1): np.array([[0, 0], [1, 1]]),
        (1, 2): np.array([[0, 0], [1, 1]]),
        (0, 2): np.array([[0, 1]]),  # would join both tracks
    }
    tracks = join_tracks(photos, matches)
    assert tracks.visible.all()
    assert sorted(tracks.pixels[:, :, 0].T.tolist()) == [[0, 5, 9], [20, 25, 29]]


# ------------------------------------------------------------------ growth, with points and poses that are known


def solid(count: int = 6, step: float = 20.0, points: int = 60) -> tuple[PhotoTracks, PhotoStructure]:
    """Points of a ball that photos on a turntable show where they face them, and the truth."""
    random = np.random.default_rng(1)
    X = random.normal(size=(points, 3))
    X /= np.linalg.norm(X, axis=1, keepdims=True)
    R = Rotation.from_rotvec(np.radians(step) * np.outer(np.arange(count), [0, -1, 0])).as_matrix()
    t = np.tile([0.0, 0.0, 5.0], (count, 1))
    seen = np.einsum("fij,nj->fni", R, X) + t[:, None]
    pixels = seen[..., :2] / seen[..., 2:] * K[0, 0] + K[:2, 2]
    visible = np.einsum("fij,nj->fni", R, X)[..., 2] < -0.1
    truth = PhotoStructure(tuple(range(count)), R, t, X, visible, K, 0.0)
    return PhotoTracks(Tracks(pixels, visible), 1.0, free_focal=False), truth


def without_points(found: PhotoStructure) -> PhotoStructure:
    return replace(found, points=np.full_like(found.points, np.nan))


def test_points_of_two_photos_or_more_are_triangulated_where_they_are():
    tracks, truth = solid()
    found = triangulate(tracks, without_points(truth))
    several = tracks.visible.sum(0) >= 2
    assert (found.known == several).all()
    assert np.abs(found.points - truth.points)[several].max() < 1e-6


def test_a_point_that_does_not_fit_its_photos_stays_unknown():
    tracks, truth = solid()
    wrong = int(np.flatnonzero(tracks.visible.sum(0) >= 3)[0])
    photo = int(np.flatnonzero(tracks.visible[:, wrong])[0])
    tracks.pixels[photo, wrong, 1] += 15
    assert not triangulate(tracks, without_points(truth)).known[wrong]


def test_rays_that_are_nearly_parallel_make_no_point():
    tracks, truth = solid(step=0.2)
    assert not triangulate(tracks, without_points(truth)).known.any()


def test_a_photo_is_added_at_its_pose():
    tracks, truth = solid()
    begun = triangulate(tracks, replace(without_points(truth), photos=(0, 1, 2)))
    added = add_photo(tracks, begun, 3)
    assert added is not None
    assert added.photos == (0, 1, 2, 3)
    assert np.degrees(Rotation.from_matrix(added.R[3] @ truth.R[3].T).magnitude()) < 0.1


def test_a_photo_whose_points_are_elsewhere_is_not_added():
    tracks, truth = solid()
    begun = triangulate(tracks, replace(without_points(truth), photos=(0, 1, 2)))
    tracks.pixels[3] = np.random.default_rng(2).uniform(80, 240, tracks.pixels[3].shape)
    assert add_photo(tracks, begun, 3) is None


def test_photos_that_agree_with_one_other_only_are_given_up():
    tracks, truth = solid()
    seen = truth.seen.copy()
    wrong = Rotation.from_rotvec([0, 0.35, 0]).as_matrix()
    R = truth.R.copy()
    R[5] = R[5] @ wrong  # the points that it shares with photo 4 alone follow it
    seen[5] &= ~tracks.visible[:4].any(0)
    kept = keep_connected(tracks, replace(truth, R=R, seen=seen))
    assert sorted(kept.photos) == [0, 1, 2, 3, 4]


@pytest.mark.parametrize(("common", "apart"), [(0, 0.15), (6, 0.01)])
def test_structures_that_share_one_photo_are_merged(common, apart):
    """As at the edge of a box: photo 3 shares points with photos 0 to 2 and 4 to 6, which share few or none."""
    tracks, truth = solid(7, 20.0, 300)
    across = np.flatnonzero(tracks.visible[:3].any(0) & tracks.visible[4:].any(0))[common:]
    tracks.visible[4:, across[::2]] = False
    tracks.visible[:3, across[1::2]] = False
    truth = replace(truth, seen=tracks.visible.copy())
    one, other = (
        triangulate(tracks, replace(without_points(truth), photos=photos))
        for photos in ((0, 1, 2, 3), (3, 4, 5, 6))
    )
    turn = Rotation.from_euler("xyz", [40, 70, 10], degrees=True).as_matrix()
    other = replace(other, R=truth.R @ turn, t=0.5 * truth.t, points=0.5 * other.points @ turn)
    made = merge(tracks, one, other)
    assert made is not None and sorted(made.photos) == list(range(7))
    turned = Rotation.from_matrix(made.R @ truth.R.transpose(0, 2, 1)).magnitude()
    assert np.degrees(turned).max() < 1
    assert np.abs(made.t[6] - truth.t[6]).max() < apart * 5
    assert len(keep_connected(tracks, replace(made, joints=frozenset())).photos) == 4 or common
    assert merge(tracks, made, other) is None  # it has nothing new


# ------------------------------------------------------------------ what is reliable


def full_turn() -> tuple[PhotoTracks, PhotoStructure, list[Photo]]:
    """Points on a ball, and the silhouettes of a flat thing, all around."""
    tracks, truth = solid(12, 30.0, 200)
    random = np.random.default_rng(3)
    body = random.normal(size=(20000, 3))
    body /= np.linalg.norm(body, axis=1, keepdims=True)
    body *= [1.5, 0.8, 0.4]
    photos = []
    for index, (R, t) in enumerate(zip(truth.R, truth.t, strict=True)):
        seen = body @ R.T + t
        pixels = np.round(seen[:, :2] / seen[:, 2:] * K[0, 0] + K[:2, 2]).astype(int)
        mask = np.zeros((240, 320), np.uint8)
        mask[pixels[:, 1], pixels[:, 0]] = 1
        mask = cv2.morphologyEx(mask, cv2.MORPH_CLOSE, np.ones((9, 9), np.uint8)) > 0
        photos.append(Photo(index, (Keypoints.none(),), PhotoSilhouette.of(mask), 200.0))
    return tracks, truth, photos


def test_true_poses_fill_the_masks_and_a_turn_half_as_far_does_not():
    _, truth, photos = full_turn()
    assert overlap_of_hull(photos, truth) > 0.97
    half = Rotation.from_rotvec(np.radians(15.0) * np.outer(np.arange(12), [0, -1, 0])).as_matrix()
    assert overlap_of_hull(photos, replace(truth, R=half)) < 0.9


def test_photos_show_the_near_side_and_those_of_a_reversal_the_far_one():
    tracks, truth, _ = full_turn()
    turned = reverse(tracks, truth)
    assert facing(truth) > 0.3
    assert facing(turned) < -0.3
    assert turned.cost > truth.cost


@pytest.mark.parametrize(
    ("change", "evidence", "reliable"),
    [({}, 1.0, True), ({}, 0.9, False), ({"cost": 0.31}, 1.0, False), ({"photos": (0, 1, 2)}, 1.0, False)],
)
def test_too_few_photos_points_that_fit_badly_and_a_possible_reversal_are_not_reliable(
    change, evidence, reliable
):
    _, truth, photos = full_turn()
    assert is_reliable(photos, replace(truth, **change), evidence) is reliable


def test_other_keypoints_that_turn_alike_excuse_points_that_fit_badly():
    _, truth, photos = full_turn()
    turns = Rotation.from_rotvec(np.radians(30.0) * np.outer(np.arange(12), [0, -1, 0])).as_matrix()
    R = truth.R @ Rotation.from_euler("x", 50, degrees=True).as_matrix()  # axes of its own
    assert agree(truth, replace(truth, R=R, photos=truth.photos[2:8]))
    assert not agree(truth, replace(truth, R=R, photos=truth.photos[:3]))  # too few to tell
    assert not agree(truth, replace(truth, R=turns @ truth.R))
    poor = replace(truth, cost=0.31)
    assert is_reliable(photos, poor, 1.0, confirmed=True)
    assert not is_reliable(photos, poor, 0.9, confirmed=True)
