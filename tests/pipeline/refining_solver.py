"""A solver that answers at once: causally with the initial mask shifted by a pixel, refined with that mask itself."""

from __future__ import annotations

from dataclasses import replace
from typing import ClassVar

import numpy as np
import trimesh

from tracking3d.estimation.estimate import FrameEstimate, ObjectModel, Status
from tracking3d.estimation.solver import RefiningSolver
from tracking3d.frames import Frame, MaskEstimate


class CausalSolver:
    """``T_cam_obj`` holds the frame's index in its x; ``faults`` raises in ``step`` of a frame."""

    faults: ClassVar[dict[int, BaseException]] = {}

    def __init__(self, config, camera, encoder) -> None:
        self.encoder = encoder

    def init(self, frame: Frame, mask: MaskEstimate):
        return 0, self._answer(frame, mask)

    def step(self, state: int, frame: Frame, mask: MaskEstimate):
        if frame.index in self.faults:
            raise self.faults[frame.index]
        return state + 1, self._answer(frame, mask)

    @staticmethod
    def restart_backwards(state: int, frame: Frame, number: int, T_cam_obj) -> int:
        return state

    @staticmethod
    def trust_mask(state: int, frame: Frame, mask) -> int:
        return state

    def result(self, state: int) -> ObjectModel:
        sphere = trimesh.creation.icosphere(1)
        texture = np.full((4, 4, 3), 50, np.uint8)
        uvs = np.full((*sphere.faces.shape, 2), 0.5)
        return ObjectModel(
            np.asarray(sphere.vertices),
            sphere.faces,
            uvs,
            texture,
            np.ones((4, 4), np.float32),
            texture / 255,
        )

    def _answer(self, frame: Frame, mask: MaskEstimate) -> FrameEstimate:
        T = np.eye(4)
        T[:3, 3] = frame.index, 0, 3
        binary = mask.binary
        assert binary is not None
        shifted = np.roll(binary, 1, axis=0)
        return FrameEstimate(
            frame.index,
            frame.time,
            T,
            shifted,
            binary,
            Status.UNCERTAIN,
            "causal",
            0.5,
            keyframe=frame.index % 2 == 0,
            seconds=0.25,
            hypothesis="last pose",
        )


class StandInSolver(CausalSolver, RefiningSolver):
    """Can refine: the mesh is then twice as large, and a revisited pose is the causal one, one further away."""

    revisit_faults: ClassVar[dict[int, BaseException]] = {}
    seen: ClassVar[list[tuple[int, MaskEstimate]]] = []

    def refine(self, state: int) -> int:
        return -1

    def refine_frame(self, state: int, frame: Frame, mask: MaskEstimate, T_cam_obj):
        assert state < 0
        self.seen.append((frame.index, mask))
        if frame.index in self.revisit_faults:
            raise self.revisit_faults[frame.index]
        T = T_cam_obj.copy()
        T[2, 3] += 1
        estimate = self._answer(frame, mask)
        return state - 1, replace(
            estimate,
            T_cam_obj=T,
            mask=estimate.initial_mask,
            status=Status.TRACKED,
            reason="",
            confidence=0.9,
            keyframe=False,
        )

    def result(self, state: int) -> ObjectModel:
        model = super().result(state)
        return replace(model, vertices=model.vertices * (2 if state < 0 else 1))
