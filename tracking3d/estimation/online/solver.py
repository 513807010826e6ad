"""The online solver: track fast, map when it pays, and join matched points with re-rendering."""

from __future__ import annotations

import time
from dataclasses import dataclass, replace

import numpy as np
import torch
from numpy.typing import NDArray

from tracking3d.config.models import PipelineConfig
from tracking3d.errors import InputError
from tracking3d.estimation.appearance import visible_texture
from tracking3d.estimation.estimate import FrameEstimate, ObjectModel, Status
from tracking3d.estimation.feature_space import FeatureSpace, feature_channels
from tracking3d.estimation.framing import mask_box, projected_box
from tracking3d.estimation.observation import Observation, observe
from tracking3d.estimation.online.belief import Belief, ObjectMap, View
from tracking3d.estimation.online.keypoints import Keypoints, detect, match
from tracking3d.estimation.online.mapping import (
    mask_weight,
    well_inside,
    nearest_views,
    pose_arrays,
    pose_of,
    project_points,
    refine_map,
    to_window,
    viewing_angle,
    window_of,
    with_landmarks,
)
from tracking3d.estimation.online.points import MOST_FOLLOWED, MOST_POINTS, FollowedPoints, follow, grey, new_corners
from tracking3d.estimation.online.pose_from_points import pose_from_points
from tracking3d.estimation.online.pose_refinement import (
    MatchedPoints,
    PoseFit,
    PoseWeights,
    refine_pose,
)
from tracking3d.estimation.online.recruits import MOST_CANDIDATES, recruit, surroundings
from tracking3d.estimation.online.start import by_turning, solve_start
from tracking3d.estimation.online.structure import motion_enough
from tracking3d.estimation.online.surface_fit import FitWeights
from tracking3d.estimation.shape import Shape
from tracking3d.estimation.start import first_translation, mask_ellipse, prototype_mesh
from tracking3d.features.protocol import FeatureEncoder
from tracking3d.frames import Frame, MaskEstimate
from tracking3d.geometry.camera import Camera, Window
from tracking3d.geometry.pose import Pose, extrapolate, rotation_angle
from tracking3d.rendering import BackProjection, TexelMap

MOTION = 0.03
_MOTION_STEP = 1.3
_DOUBTFUL_START = 0.25
_MOST_WAITING = 40
_FEWEST_WAITING = 12
_LASTING = 0.4
VERBOSE = False
REFINE_PASSES = 3
EDGE = 8.0
_ENOUGH_MATURE = 30


@dataclass(frozen=True)
class OnlineSolver:
    """See the module; implements `tracking3d.estimation.solver.Solver` and `RefiningSolver`."""

    config: PipelineConfig
    camera: Camera
    encoder: FeatureEncoder
    fit: FitWeights = FitWeights()
    weights: PoseWeights = PoseWeights()
    prior: float = 20.0
    keyframe_angle: float = 8.0
    map_window: int = 12

    @property
    def device(self) -> torch.device:
        return torch.device(self.config.runtime.device)

    @property
    def _channels(self) -> int:
        return feature_channels(self.encoder, self.config.object.texture_channels)

    def init(self, frame: Frame, mask: MaskEstimate) -> tuple[Belief, FrameEstimate]:
        started = time.perf_counter()
        binary = mask.binary
        if binary is None or not binary.any():
            raise InputError(
                f"{frame.name or 'The first frame'} has no object: its mask is empty; give another box or mask."
            )
        ellipse = mask_ellipse(binary)
        translation = torch.tensor(first_translation(ellipse, self.camera), dtype=torch.float32)
        pose = Pose.identity(translation.to(self.device))
        shape = Shape.of(prototype_mesh(self.config.object, ellipse), self.config.object.flat, self.device)
        texels = TexelMap.of(shape.face_uvs, self.config.object.texture_size)
        known = ObjectMap(shape, texels, shape.rest, np.zeros((0, 3)), (), np.zeros(0, bool), self.config.runtime.renderer)
        image = grey(frame.image)
        belief = Belief(self.camera, known, None, (pose, frame.index), None, image, FollowedPoints.none())
        observation = self._observe(belief, frame, binary, pose)
        if True:
            space = FeatureSpace.of(observation.features, observation.mask, self._channels)
            belief = replace(belief, space=space)
            observation = replace(observation, features=space.project(observation.features))
        view = View(observation, binary, pose, FollowedPoints.none())
        known, view = self._named(known, view, image)
        known, view = self._with_candidates(known, view, image)
        answer = self._answer(frame, binary, pose, Status.UNCERTAIN, "the object has not moved enough yet", 0.3, started)
        answer = replace(answer, mask=binary)
        belief = replace(belief, known=known, followed=view.points, waiting=((view, answer),), due=MOTION)
        return belief, answer

    def _named(self, known: ObjectMap, view: View, image: NDArray[np.uint8]) -> tuple[ObjectMap, View]:
        """With landmarks at keypoints and corners."""
        inside = view.mask if view.mask is not None else known.silhouette(view.pose, self.camera)
        keypoints = detect(image, inside)
        taken = np.concatenate([view.points.pixel, keypoints.pixel])
        corners = new_corners(image, inside, taken, MOST_POINTS)
        return with_landmarks(known, self.camera, view, keypoints, corners)

    def _with_candidates(self, known: ObjectMap, view: View, image: NDArray[np.uint8]) -> tuple[ObjectMap, View]:
        """With corners beside the mask."""
        if view.mask is None:
            return known, view
        there = int(known.candidate[view.points.landmark].sum())
        corners = new_corners(image, surroundings(view.mask), view.points.pixel, MOST_CANDIDATES - there)
        names = len(known.landmarks) + np.arange(len(corners))
        points = FollowedPoints(
            np.concatenate([view.points.landmark, names]), np.concatenate([view.points.pixel, corners])
        )
        known = replace(
            known,
            landmarks=np.concatenate([known.landmarks, np.full((len(corners), 3), np.nan)]),
            candidate=np.concatenate([known.candidate, np.ones(len(corners), bool)]),
        )
        return known, replace(view, points=points)

    def step(self, state: Belief, frame: Frame, mask: MaskEstimate) -> tuple[Belief, FrameEstimate]:
        started = time.perf_counter()
        binary = mask.binary
        if binary is not None and not binary.any():
            binary = None
        image = grey(frame.image)
        if state.waiting is not None:
            return self._wait(state, frame, image, binary, started)
        return self._track(state, frame, image, binary, started)

    # --- start
    def _wait(
        self, state: Belief, frame: Frame, image: NDArray[np.uint8], mask: NDArray[np.bool_] | None, started: float
    ) -> tuple[Belief, FrameEstimate]:
        assert state.waiting is not None
        followed = follow(state.grey, image, state.followed)
        pose = state.last[0]
        observation = self._observe(state, frame, mask, pose)
        view = View(observation, mask, pose, followed, mask_weight=mask_weight(mask, followed.only(~state.known.candidate[followed.landmark])))
        known = state.known
        if len(followed) < 0.6 * MOST_POINTS:
            fake = replace(known, keyframes=tuple(v for v, _ in state.waiting))
            # landmarks of the waiting frames have no depth yet: matched by descriptor alone
            named, view = self._named_waiting(fake, view, image)
            known = replace(named, keyframes=())
        answer = self._answer(frame, mask, pose, Status.UNCERTAIN, "the object has not moved enough yet", 0.3, started)
        answer = replace(answer, mask=mask if mask is not None else np.zeros(frame.size, bool))
        waiting = (*state.waiting, (view, answer))
        belief = replace(state, known=known, waiting=waiting).moved(pose, frame.index, image, view.points)
        views = [v for v, _ in waiting if v.mask is not None]
        names, counts = np.unique(np.concatenate([v.points.landmark for v in views]), return_counts=True)
        names = names[~known.candidate[names]]
        from tracking3d.estimation.online.mapping import tracks_of
        motion = motion_enough(tracks_of(views, names)) if len(views) > 1 else 0.0
        if VERBOSE:
            print("motion", frame.index, round(motion, 3), len(view.points))
        if (motion < state.due and len(waiting) < _MOST_WAITING) or len(views) < 4:
            return belief, answer
        return self._begin(replace(belief, due=motion * _MOTION_STEP), answer, started)

    def _named_waiting(self, known: ObjectMap, view: View, image: NDArray[np.uint8]) -> tuple[ObjectMap, View]:
        inside = view.mask if view.mask is not None else np.ones(image.shape, bool)
        keypoints = detect(image, inside)
        label = np.full(len(keypoints), -1, np.int64)
        taken = set(view.points.landmark.tolist())
        if len(view.points) and len(keypoints):
            gap = np.linalg.norm(keypoints.pixel[:, None] - view.points.pixel[None], axis=2)
            label = np.where(gap.min(1) < 1.5, view.points.landmark[gap.argmin(1)], -1)
        for other in known.keyframes[::-1][:3]:
            if not len(other.keypoints):
                continue
            for a, b in match(keypoints, other.keypoints):
                name = int(other.keypoint_landmark[b])
                if label[a] < 0 and name >= 0 and name not in taken:
                    label[a] = name
                    taken.add(name)
        fresh = label < 0
        corners = new_corners(
            image, inside, np.concatenate([view.points.pixel, keypoints.pixel]), MOST_POINTS - len(view.points) - len(keypoints)
        )
        base = len(known.landmarks)
        label[fresh] = base + np.arange(fresh.sum())
        corner_names = base + fresh.sum() + np.arange(len(corners))
        own, first = np.unique(label, return_index=True)
        again = ~np.isin(own, view.points.landmark)
        points = FollowedPoints(
            np.concatenate([view.points.landmark, own[again], corner_names]).astype(np.int64),
            np.concatenate([view.points.pixel, keypoints.pixel[first][again], corners]),
        )
        landmarks = np.concatenate([known.landmarks, np.full((fresh.sum() + len(corners), 3), np.nan)])
        candidate = np.concatenate([known.candidate, np.zeros(len(landmarks) - len(known.landmarks), bool)])
        known = replace(known, landmarks=landmarks, candidate=candidate)
        return known, replace(view, points=points, keypoints=keypoints, keypoint_landmark=label)

    def _begin(self, state: Belief, answer: FrameEstimate, started: float) -> tuple[Belief, FrameEstimate]:
        assert state.waiting is not None
        views = [view for view, _ in state.waiting if view.mask is not None]
        starts = solve_start(state.known, self.camera, views, self.fit, self.prior, VERBOSE)
        if not starts or starts[0].bundle > _DOUBTFUL_START:
            lasting = np.isin(views[0].points.landmark, views[-1].points.landmark).mean()
            if len(state.waiting) < (_MOST_WAITING if lasting > _LASTING else _FEWEST_WAITING):
                return state, answer
            starts = sorted([*starts, *by_turning(state.known, self.camera, views[:: max(len(views) // 7, 1)][:8], self.fit, VERBOSE)], key=lambda start: start.cost)
        known = starts[0].known
        known = recruit(known, self.camera, list(range(len(known.keyframes))))
        known = refine_map(
            known, self.camera, list(range(len(known.keyframes))), weights=self.fit, prior=self.prior, rounds=3,
            bundle_iterations=20,
        )
        belief = replace(state, known=known, surface=known.surface(), waiting=None)
        # every waiting frame anew
        poses = {view.index: view.pose for view in known.keyframes}
        revised = []
        pose = known.keyframes[0].pose
        last_two = []
        for view, earlier in state.waiting:
            pose = poses.get(view.index, pose)
            fit = self._fit(belief, view, [pose], view.points) if view.index != known.keyframes[0].index else None
            pose = fit.pose if fit else pose
            last_two.append((pose, view.index))
            mask = known.silhouette(pose, self.camera)
            revised.append(replace(earlier, T_cam_obj=pose.matrix().numpy(), mask=mask, status=Status.TRACKED, reason="", confidence=0.6))
        belief = replace(belief, last=last_two[-1], before=last_two[-2])
        final = replace(revised[-1], revised=tuple(revised[:-1]), seconds=time.perf_counter() - started)
        return belief, final

    # --- tracking
    def _track(
        self, state: Belief, frame: Frame, image: NDArray[np.uint8], mask: NDArray[np.bool_] | None, started: float
    ) -> tuple[Belief, FrameEstimate]:
        last, last_index = state.last
        assert state.before is not None
        before, before_index = state.before
        steps = (frame.index - last_index) / max(last_index - before_index, 1)
        predicted = extrapolate(before, last, min(steps, 3.0))
        known = state.known
        guess = None
        position = known.landmarks[state.followed.landmark]
        if len(state.followed):
            shift = project_points(position, predicted, self.camera) - project_points(position, last, self.camera)
            shift = np.nan_to_num(shift)
            guess = (state.followed.pixel + shift).astype(np.float32)
        followed = follow(state.grey, image, state.followed, guess)
        observation = self._observe(state, frame, mask, predicted)
        view = View(observation, mask, predicted, followed, mask_weight=mask_weight(mask, followed.only(~state.known.candidate[followed.landmark])))
        candidates = {"velocity": predicted, "last": last}
        found = self._pnp(known, followed)
        if found is not None:
            candidates["points"] = found
        fits = {name: self._fit(state, view, [pose], followed) for name, pose in candidates.items()} if False else {}
        fit = self._fit(state, view, list(candidates.values()), followed)
        won = "prediction"
        doubtful = len(followed) < 20 or fit.points > 1.0 or fit.outline > 1.5
        if doubtful:
            inside = mask if mask is not None else np.ones(image.shape, bool)
            keypoints = detect(image, inside)
            for other in nearest_views(known.keyframes, fit.pose, 6):
                pairs = match(keypoints, other.keypoints)
                names = other.keypoint_landmark[pairs[:, 1]]
                pairs, names = pairs[names >= 0], names[names >= 0]
                matched = FollowedPoints(names, keypoints.pixel[pairs[:, 0]])
                pose = self._pnp(known, matched)
                if pose is None:
                    continue
                other_fit = self._fit(state, view, [pose], matched)
                if other_fit.appearance + self.weights.outline * other_fit.outline < fit.appearance + self.weights.outline * fit.outline:
                    fit, won = other_fit, "keyframe"
                    followed = matched
        followed = self._agreeing(known, fit.pose, followed, view)
        view = replace(view, pose=fit.pose, points=followed)
        belief = state.moved(fit.pose, frame.index, image, followed)
        silhouette = known.silhouette(fit.pose, self.camera)
        key = self._is_new(known, fit.pose)
        if key and mask is not None:
            known, view = self._named(known, view, image)
            known, view = self._with_candidates(known, view, image)
            known = replace(known, keyframes=(*known.keyframes, view))
            known = recruit(known, self.camera, window_of(len(known.keyframes), self.map_window))
            known = refine_map(
                known, self.camera, window_of(len(known.keyframes), self.map_window), weights=self.fit, prior=self.prior,
            )
            pose = known.keyframes[-1].pose
            belief = replace(belief, known=known, surface=known.surface(), last=(pose, frame.index), followed=known.keyframes[-1].points.spread(MOST_FOLLOWED, float(view.observation.window.side)))
            silhouette = known.silhouette(pose, self.camera)
        answer = self._answer(frame, mask, belief.last[0], Status.TRACKED, "", 0.5, started)
        answer = replace(
            answer, mask=silhouette, keyframe=bool(key), hypothesis=won, iterations=fit.iterations,
            losses={"features": fit.appearance, "outline": fit.outline, "points": fit.points, "followed": float(len(followed)), "mask": view.mask_weight},
        )
        return belief, answer

    # --- once more
    def refine(self, state: Belief) -> Belief:
        """All keyframes together, until nothing changes much."""
        known = state.known
        if state.waiting is not None or not known.keyframes:
            return state
        everything = list(range(len(known.keyframes)))
        for _ in range(REFINE_PASSES):
            known = recruit(known, self.camera, everything)
            known = refine_map(
                known, self.camera, everything, weights=self.fit, prior=self.prior, bundle_iterations=15, rounds=2
            )
        return replace(state, known=known, surface=known.surface(), before=None, followed=FollowedPoints.none())

    def revisit(
        self, state: Belief, frame: Frame, mask: MaskEstimate, T_cam_obj: NDArray[np.float64]
    ) -> tuple[Belief, FrameEstimate]:
        """A frame's pose once more, against the final map."""
        started = time.perf_counter()
        binary = mask.binary
        if binary is not None and not binary.any():
            binary = None
        known, image = state.known, grey(frame.image)
        own = next((view for view in known.keyframes if view.index == frame.index), None)
        causal = pose_of(T_cam_obj[:3, :3], T_cam_obj[:3, 3], known.vertices)
        starts = [causal]
        followed = follow(state.grey, image, state.followed) if len(state.followed) else state.followed
        if own is not None:
            starts.append(own.pose)
            new = ~np.isin(followed.landmark, own.points.landmark)
            followed = FollowedPoints(
                np.concatenate([own.points.landmark, followed.landmark[new]]),
                np.concatenate([own.points.pixel, followed.pixel[new]]),
            )
        if state.before is not None:
            starts.append(extrapolate(state.before[0], state.last[0], 1.0))
        found = self._pnp(known, followed)
        if found is not None:
            starts.append(found)
        view = View(
            self._observe(state, frame, binary, starts[-1]), binary, starts[-1], followed,
            mask_weight=mask_weight(binary, followed.only(~known.candidate[followed.landmark])),
        )  # fmt: skip
        fit = self._fit(state, view, starts, followed)
        followed = self._agreeing(known, fit.pose, followed, view)
        last = state.last if state.before is not None or own is None or frame.index else None
        belief = replace(
            state, before=state.last if last is not None else None, last=(fit.pose, frame.index), grey=image, followed=followed
        )
        answer = self._answer(frame, binary, fit.pose, Status.TRACKED, "", 0.5, started)
        answer = replace(
            answer, mask=known.silhouette(fit.pose, self.camera), refined=True,
            losses={"features": fit.appearance, "outline": fit.outline, "points": fit.points, "followed": float(len(followed)), "mask": view.mask_weight},
        )
        return belief, answer

    def _agreeing(self, known: ObjectMap, pose: Pose, followed: FollowedPoints, view: View) -> FollowedPoints:
        """Points that are where the pose says, or of which that is not known."""
        if not len(followed):
            return followed
        gap = np.linalg.norm(project_points(known.landmarks[followed.landmark], pose, self.camera) - followed.pixel, axis=1)
        young = known.sightings[followed.landmark] < 2
        scale = max(1.0, view.observation.window.side / 200)
        agrees = np.isnan(gap) | (gap < np.where(young, 16, 4) * scale)
        inside = well_inside(view.mask, known.silhouette(pose, self.camera), followed.pixel, EDGE * scale)
        return followed.only(agrees & (inside | known.candidate[followed.landmark]))

    def _is_new(self, known: ObjectMap, pose: Pose) -> bool:
        turned = min(
            np.degrees(float(rotation_angle(view.pose.quaternion, pose.quaternion))) for view in known.keyframes
        )
        return bool(turned > self.keyframe_angle)

    def _pnp(self, known: ObjectMap, points: FollowedPoints) -> Pose | None:
        position = known.landmarks[points.landmark]
        sound = np.isfinite(position).all(1)
        if sound.sum() < 6:
            return None
        found = pose_from_points(position[sound], points.pixel[sound].astype(np.float64), self.camera.K,
            threshold=3.0, seed=0)
        if found is None:
            return None
        return pose_of(found.R, found.t, known.vertices)

    def _fit(self, state: Belief, view: View, starts: list[Pose], points: FollowedPoints) -> PoseFit:
        assert state.surface is not None
        position = state.known.landmarks[points.landmark]
        sound = np.isfinite(position).all(1)
        # A landmark seen once lies where the shape was believed to be: with others at hand it is no witness.
        mature = sound & (state.known.sightings[points.landmark] >= 2)
        if mature.sum() >= _ENOUGH_MATURE:
            sound = mature
        matched = MatchedPoints(
            torch.from_numpy(position[sound]).to(state.surface.vertices),
            torch.from_numpy(to_window(view, points.pixel[sound])).to(state.surface.vertices),
        )
        weights = replace(self.weights, outline=self.weights.outline * view.mask_weight)
        if len(starts) > 1:
            first = [refine_pose(state.surface, view.observation, start, matched, weights, (0, 0)) for start in starts]
            starts = [min(first, key=lambda fit: fit.cost).pose]
        return refine_pose(state.surface, view.observation, starts[0], matched, weights)

    def _observe(
        self, belief: Belief, frame: Frame, mask: NDArray[np.bool_] | None, pose: Pose
    ) -> Observation:
        box = mask_box(mask) if mask is not None else projected_box(belief.known.vertices, self.camera, pose)
        if box is None:
            box = (0.0, 0.0, float(self.camera.width), float(self.camera.height))
        window = Window.around(box, self.config.window.margin, self.config.window.size)
        observation = observe(frame, mask, window, self.camera, self.encoder, self.device)
        if belief.space is None:
            return observation
        return replace(observation, features=belief.space.project(observation.features))

    def _answer(self, frame, mask, pose, status, reason, confidence, started) -> FrameEstimate:
        return FrameEstimate(
            index=frame.index, time=frame.time, T_cam_obj=pose.matrix().numpy(),
            mask=np.zeros(frame.size, bool), initial_mask=mask, status=status, reason=reason,
            confidence=confidence, seconds=time.perf_counter() - started,
        )

    def result(self, state: Belief) -> ObjectModel:
        known = state.known
        keyframes = known.keyframes or tuple(view for view, _ in state.waiting or ())
        size = known.texels.size
        seen = BackProjection(known.vertices.new_zeros(3, size, size), known.vertices.new_zeros(size, size))
        for view in keyframes:
            seen = seen + known.back_project(view.observation.image, view)
        texture, weight = visible_texture(seen)
        features = state.surface.texture if state.surface is not None else known.vertices.new_zeros(self._channels, size, size)
        return ObjectModel(
            known.vertices.double().cpu().numpy(), known.shape.faces.cpu().numpy(),
            known.shape.face_uvs.double().cpu().numpy(), texture, weight, features.permute(1, 2, 0).cpu().numpy(),
        )
