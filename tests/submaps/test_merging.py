"""Parts that tell of one object are joined where it is; parts that contradict each other are not."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from parts_of_runs import degrees_between, inverse, records_of, turning
from scipy.spatial.transform import Rotation

from tracking3d import Frame, Session, load_config
from tracking3d.estimation.estimate import Status
from tracking3d.estimation.online.atlas import match_landmarks, merge, transform_map
from tracking3d.estimation.online.mapping.global_refinement import keyframe_cost
from tracking3d.estimation.online.state.solver_state import Mapped
from tracking3d.frames import Prompt
from tracking3d.geometry.camera import Camera
from tracking3d.geometry.similarity import Similarity
from tracking3d.pipeline.components import build_encoder
from tracking3d.pipeline.submaps import merge_step, merged_run
from tracking3d.pipeline.submaps.alignment import (
    DisagreementError,
    align_submaps,
    by_lens,
    check_agreement,
    common_poses,
    fit_similarity,
    reproject_features,
    through_lens,
)
from tracking3d.pipeline.submaps.merge_step import merge_submap_states
from tracking3d.results import layout
from tracking3d.results.files import read_mask, write_mask, write_visible_masks
from tracking3d.results.run_writer import write_initial_mask
from tracking3d.testing.synthesis.convex_clips import SyntheticSpec, synthesize

TURN = Similarity(Rotation.from_rotvec([0.4, -0.9, 0.3]).as_matrix(), 1.7, np.array([0.1, -0.2, 0.15]))
"""From the second part's object to the first's."""


@pytest.fixture(scope="module")
def solved() -> tuple[Mapped, dict[int, np.ndarray]]:
    """What the solver knows after a short clip, and its answers."""
    clip = synthesize(SyntheticSpec(frames=9, size=(96, 80), supersample=1, degrees_per_frame=5))
    config = settings()
    session = Session(config, Prompt(clip.box, clip.masks[0]))
    poses = {}
    for index, image in enumerate(clip.images):
        estimate = session.step(Frame(index, image))
        for answer in (*estimate.revised, estimate):
            poses[answer.index] = answer.T_cam_obj
    state = session.state_dict()["solver"]
    assert isinstance(state, Mapped)
    return state, poses


def settings():
    return load_config(
        overrides=["tracker.name=flow", "tracker.segmentation_size=64", "crop.size=48", "object.frequency=2",
                   "object.texture_size=32"],
        camera={"fov": 45},
    )  # fmt: skip


def seen_otherwise(state: Mapped, similarity: Similarity) -> Mapped:
    """The same knowledge as another run would have it: other coordinates, other names of landmarks."""
    known = transform_map(state.object_map, inverse(similarity))
    order = np.random.default_rng(0).permutation(len(known.landmarks))
    names = np.argsort(order)
    keyframes = []
    for view in known.keyframes:
        points = replace(view.points, landmark=names[view.points.landmark])
        label = np.where(view.keypoint_landmark >= 0, names[view.keypoint_landmark], -1)
        keyframes.append(replace(view, points=points, keypoint_landmark=label))
    other = replace(
        known, landmarks=known.landmarks[order], candidate=known.candidate[order], keyframes=tuple(keyframes)
    )
    return replace(state, object_map=other)


def test_moving_a_map_there_and_back_changes_nothing(solved):
    known = solved[0].object_map
    back = transform_map(transform_map(known, TURN), inverse(TURN))
    torch.testing.assert_close(back.vertices, known.vertices, atol=1e-5, rtol=0)
    np.testing.assert_allclose(back.landmarks, known.landmarks, atol=1e-9)
    assert keyframe_cost(transform_map(known, TURN)) == pytest.approx(keyframe_cost(known), rel=0.02)


def test_the_joint_of_two_runs_is_found_by_poses_and_landmarks(solved):
    first, poses = solved
    stack = np.stack([poses[index] for index in range(9)])
    other = inverse(TURN).poses(stack)
    joint = align_submaps(
        first, seen_otherwise(first, TURN), records_of(range(9), stack), records_of(range(9), other)
    )
    assert joint.frames == 9
    assert joint.landmarks > 20
    assert degrees_between(joint.fit.similarity.R, TURN.R) < 0.1
    assert joint.fit.similarity.scale == pytest.approx(TURN.scale, rel=1e-3)
    np.testing.assert_allclose(joint.fit.similarity.translation, TURN.translation, atol=5e-3)


def test_landmarks_of_both_are_told_to_be_one(solved):
    known = solved[0].object_map
    other = seen_otherwise(solved[0], TURN).object_map
    names = np.argsort(np.random.default_rng(0).permutation(len(known.landmarks)))
    pairs = match_landmarks(known, transform_map(other, TURN), solved[0].camera)
    assert len(pairs) > 20
    assert np.mean(names[pairs[:, 0]] == pairs[:, 1]) > 0.9
    assert len(set(pairs[:, 0])) == len(set(pairs[:, 1])) == len(pairs)
    both = merge(known, transform_map(other, TURN), pairs, most=64)
    assert [view.index for view in both.keyframes] == sorted({view.index for view in both.keyframes})
    for view in both.keyframes:
        assert len(set(view.points.landmark.tolist())) == len(view.points)
        assert view.points.landmark.max(initial=-1) < len(both.landmarks)


def test_keyframes_of_the_second_part_join_with_its_landmarks_named_anew(solved):
    """The second part has later frames: half of the landmarks are the first's, half new."""
    first = solved[0].object_map
    later = tuple(
        replace(view, observation=replace(view.observation, index=view.index + 100))
        for view in first.keyframes
    )
    second = replace(first, keyframes=later)
    own = np.flatnonzero(~first.candidate)
    pairs = np.stack([own[::2], own[::2]], 1)
    both = merge(first, second, pairs, most=64)
    assert [view.index for view in both.keyframes] == [view.index for view in (*first.keyframes, *later)]
    for view, same in zip(both.keyframes, (*first.keyframes, *later), strict=True):
        places = {tuple(place) for place in both.landmarks[view.points.landmark][::5].round(9)}
        assert (
            places <= {tuple(place) for place in first.landmarks[same.points.landmark].round(9)}
            or np.isnan(both.landmarks[view.points.landmark]).any()
        )
    shared = set(both.keyframes[0].points.landmark) & set(
        both.keyframes[len(first.keyframes)].points.landmark
    )
    assert 0 < len(shared) < len(first.keyframes[0].points)


def test_features_are_those_of_the_first_part_s_space(solved):
    state = solved[0]
    space, encoder = state.feature_space, build_encoder(settings())
    other = replace(space, mean=space.mean + 0.1, components=space.components.flip(0) * 1.5)
    there = reproject_features(state.object_map, space, other, encoder)
    exact = reproject_features(there, other, space, encoder)
    encoded = reproject_features(
        there, None, space, encoder
    )  # as where a space does not keep all that was encoded
    for view, same, again, moved_view in zip(
        exact.keyframes, state.object_map.keyframes, encoded.keyframes, there.keyframes, strict=True
    ):
        inside = same.observation.mask > 0.5
        truth = same.observation.features[:, inside]
        torch.testing.assert_close(view.observation.features[:, inside], truth, atol=1e-4, rtol=0)
        error = (again.observation.features[:, inside] - truth).abs().mean()
        assert error < 0.2 * (moved_view.observation.features[:, inside] - truth).abs().mean()
        assert error < 0.06


def test_a_map_with_the_contrast_and_one_without_get_the_features_of_the_other_s_space(solved):
    state = solved[0]
    space, encoder = state.feature_space, build_encoder(settings())
    plain = reproject_features(state.object_map, space, space.with_contrast(), encoder)
    back = reproject_features(plain, space.with_contrast(), space, encoder)
    for view, marked, same in zip(back.keyframes, plain.keyframes, state.object_map.keyframes, strict=True):
        seen = same.observation
        torch.testing.assert_close(view.observation.features, seen.features, atol=1e-4, rtol=0)
        expected = space.with_contrast().add_contrast(seen.features, seen.image)
        torch.testing.assert_close(marked.observation.features, expected, atol=1e-4, rtol=0)


def test_what_is_seen_of_the_object_is_written_at_the_end_of_a_split_run_too(tmp_path):
    part, run = tmp_path / "part", tmp_path / "run"
    for folder in (
        part / layout.MASKS,
        part / layout.INITIAL_MASKS,
        run / layout.MASKS,
        run / layout.INITIAL_MASKS,
    ):
        folder.mkdir(parents=True)
    hand = np.zeros((8, 8), bool)
    hand[:4] = True
    write_initial_mask(part, 0, ~hand, hand)
    write_mask(layout.mask_path(part, 0), np.ones((8, 8), bool))
    merged_run._copy_masks(part, run, [0])
    write_visible_masks(run)
    np.testing.assert_array_equal(read_mask(layout.visible_mask_path(run, 0)), ~hand)


def test_beliefs_are_joined_into_one_that_explains_both(solved):
    state = solved[0]
    later = tuple(
        replace(view, observation=replace(view.observation, index=view.index + 100))
        for view in state.object_map.keyframes
    )
    second = replace(
        state, object_map=transform_map(replace(state.object_map, keyframes=later), inverse(TURN))
    )
    config = settings()
    whole, cost_ratio = merge_submap_states(
        [state, second], [Similarity.identity(), TURN], config.solver, build_encoder(config)
    )
    assert cost_ratio < 1.08  # parts joined at a wrong angle are beyond 1.1, see below
    assert len(whole.object_map.keyframes) == 2 * len(state.object_map.keyframes)
    first = {view.index: view.pose.matrix().numpy() for view in whole.object_map.keyframes}
    for view in state.object_map.keyframes:  # what shows the same has the same pose
        assert degrees_between(first[view.index][:3, :3], first[view.index + 100][:3, :3]) < 1.5


def test_parts_joined_at_a_wrong_angle_explain_worse_what_they_show(solved, monkeypatch):
    """The last brake. Of a clip as short as this one any angle is explained somehow, so the limit is lower here."""
    state = solved[0]
    later = tuple(
        replace(view, observation=replace(view.observation, index=view.index + 100))
        for view in state.object_map.keyframes
    )
    second = replace(state, object_map=replace(state.object_map, keyframes=later))
    config = settings()
    monkeypatch.setattr(merge_step, "MAX_COST_RATIO", 1.1)
    merge_submap_states([state, second], [Similarity.identity()] * 2, config.solver, build_encoder(config))
    for axis in "xy":
        wrong = Similarity(Rotation.from_euler(axis, 180, degrees=True).as_matrix(), 1.0, np.zeros(3))
        with pytest.raises(DisagreementError, match="as badly"):
            merge_submap_states(
                [state, second], [Similarity.identity(), wrong], config.solver, build_encoder(config)
            )


def test_a_part_with_another_lens_is_taken_through_the_first_s(solved):
    state, poses = solved
    wide = state.camera.zoom(0.7, "another")
    other = through_lens(state, wide)
    stack = np.stack([poses[index] for index in range(9)])
    stack[:, 2, 3] *= 0.7
    seen, records = by_lens(other, [replace(one, camera=(wide.fx, wide.fy, wide.cx, wide.cy))
                                    for one in records_of(range(9), stack)], state.camera)  # fmt: skip
    assert seen.camera == state.camera
    for index, record in enumerate(records):
        np.testing.assert_allclose(record.T_cam_obj, poses[index], atol=1e-6)
    for view, same in zip(seen.object_map.keyframes, state.object_map.keyframes, strict=True):
        torch.testing.assert_close(view.pose.translation, same.pose.translation)


def fit_of(first: np.ndarray, second: np.ndarray):
    return fit_similarity(first, second)


def test_poses_that_agree_are_joined():
    poses = turning(20)
    check_agreement(fit_of(poses, inverse(TURN).poses(poses)), radius=0.9)


@pytest.mark.parametrize("symmetry", [90, 180])
def test_a_symmetric_object_is_refused(symmetry):
    """Half of the overlap fits one side of the object, half another."""
    poses = turning(20)
    second = inverse(TURN).poses(poses)
    second[10:, :3, :3] = second[10:, :3, :3] @ Rotation.from_euler("y", symmetry, degrees=True).as_matrix()
    with pytest.raises(DisagreementError, match="rotations disagree"):
        check_agreement(fit_of(poses, second), radius=0.9)


def test_rotations_that_drift_apart_are_refused():
    poses = turning(30)
    drift = Rotation.from_euler("y", 2 * np.arange(30)[:, None], degrees=True).as_matrix()
    second = poses.copy()
    second[:, :3, :3] = poses[:, :3, :3] @ drift
    with pytest.raises(DisagreementError, match="rotations disagree"):
        check_agreement(fit_of(poses, second), radius=0.9)


def test_an_object_elsewhere_is_refused():
    poses = turning(20)
    second = poses.copy()
    second[:, :3, 3] += np.random.default_rng(0).normal(0, 0.8, (20, 3))
    with pytest.raises(DisagreementError, match=r"radius apart|how large"):
        check_agreement(fit_of(poses, second), radius=0.9)


def test_an_overlap_without_motion_says_that_the_size_is_open():
    poses = np.repeat(turning(1), 20, axis=0)
    noise = np.random.default_rng(0).normal(0, 0.01, (20, 3))
    second = poses.copy()
    second[:, :3, 3] += noise
    with pytest.raises(DisagreementError, match="hardly moves"):
        check_agreement(fit_of(poses, second), radius=0.9)


def test_an_overlap_that_neither_tracked_is_refused():
    poses = turning(20)
    lost = records_of(range(20), poses, Status.LOST)
    assert len(common_poses(records_of(range(20), poses), lost)[0]) == 0
    stand_in = SimpleNamespace(object_map=SimpleNamespace(radius=0.9))
    with pytest.raises(DisagreementError, match="0 frames"):
        align_submaps(stand_in, stand_in, records_of(range(20), poses), lost)


def test_frames_that_are_believed_count_before_doubtful_ones():
    poses = turning(20)
    first = records_of(range(12), poses) + records_of(range(12, 20), poses, Status.UNCERTAIN)
    assert len(common_poses(first, records_of(range(20), poses))[0]) == 12
    assert len(common_poses(first, records_of(range(9, 20), poses))[0]) == 11


def test_poses_that_are_no_numbers_are_left_out():
    poses = turning(20)
    broken = poses.copy()
    broken[3] = np.nan
    assert len(common_poses(records_of(range(20), poses), records_of(range(20), broken))[0]) == 19


def test_lenses_that_differ_are_named_where_parts_cannot_be_joined(monkeypatch):
    cameras = [Camera.from_fov(64, 48, fov) for fov in (45.0, 16.0)]
    told = [SimpleNamespace(camera=camera) for camera in cameras]

    def refuse(*given):
        raise DisagreementError("parts 1 and 2: they tell of two objects")

    monkeypatch.setattr(merge_step, "_try_alignment", refuse)
    monkeypatch.setattr(merge_step, "build_encoder", lambda config: None)
    monkeypatch.setattr(merge_step, "_read_submaps", lambda *given: ([], told))
    with pytest.raises(DisagreementError, match=r"two objects; .* 16 to 45 degrees.*--fov"):
        merge_step.merge_submaps(None, load_config(), None, Path())
    monkeypatch.setattr(merge_step, "_read_submaps", lambda *given: ([], [told[0], told[0]]))
    with pytest.raises(DisagreementError, match=r"two objects$"):
        merge_step.merge_submaps(None, load_config(), None, Path())
