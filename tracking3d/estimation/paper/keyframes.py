"""Which frames stay in the optimization (paper section 3.4, "Keyframe selection criteria").

All criteria are judged again after every joint optimization (in preset ``paper`` that is every frame), so a
keyframe can fall out.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import torch

from tracking3d.config.solvers import KeyframeConfig
from tracking3d.geometry.pose import Pose, rotation_angle


@dataclass(frozen=True, eq=False)
class KeyframeCandidate:
    """A keyframe, or the current frame, as it stands after the optimization."""

    pose: Pose  # its pose now
    silhouette_loss: float  # L_S of this frame alone
    appearance_loss: float  # L_F of this frame alone


def select_keyframes(
    candidates: Sequence[KeyframeCandidate], object_size: float, tau: float, config: KeyframeConfig
) -> list[int]:
    """Positions of the candidates that are keyframes from now on.

    Args:
        candidates: The keyframes so far in order of time, then the current frame.
        object_size: Diameter of the object in object units.
        tau: Convergence threshold of the appearance loss.
        config: The criteria.
    """
    limit = config.features or tau
    kept: list[int] = []
    for position, candidate in enumerate(candidates):
        anchor = config.keep_first and position == 0
        consistent = candidate.silhouette_loss < config.silhouette and candidate.appearance_loss < limit
        latest = candidates[kept[-1]].pose if kept else None
        if anchor or (
            consistent and (latest is None or is_new_view(latest, candidate.pose, object_size, config))
        ):
            kept.append(position)
    if config.keep_first and len(kept) > config.maximum:
        return thin_out(kept, config.maximum)
    return kept[-config.maximum :]


def is_new_view(latest: Pose, pose: Pose, object_size: float, config: KeyframeConfig) -> bool:
    """Whether the object moved or turned enough since the latest keyframe."""
    moved = float(torch.linalg.vector_norm(pose.translation - latest.translation))
    turned = math.degrees(float(rotation_angle(latest.quaternion, pose.quaternion)))
    return moved > config.translation * object_size or turned > config.rotation


def thin_out(kept: list[int], maximum: int) -> list[int]:
    """Half the most recent, half spread evenly over the older ones; the first always stays."""
    recent = kept[len(kept) - maximum // 2 :]
    older = kept[: len(kept) - maximum // 2]
    count = maximum - len(recent)
    chosen = [older[round(i * (len(older) - 1) / max(count - 1, 1))] for i in range(count)]
    return sorted(set(chosen) | set(recent))
