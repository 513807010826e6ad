"""The mask tracker of one object, started at its prompt, and again in every frame with a later prompt."""

from __future__ import annotations

from dataclasses import replace
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from tracking3d.config.models import PluginChoice
from tracking3d.frames import Frame, MaskEstimate, Prompt, mask_iou_or_none
from tracking3d.plugins import TRACKERS, build_plugin, plugin_label
from tracking3d.plugins.guard import GuardedTracker, PluginFailure
from tracking3d.runtime.stage_times import in_stage
from tracking3d.trackers.crops import box_of

if TYPE_CHECKING:
    from tracking3d.trackers.segment.network import ObjectNetwork

_NOTHING = MaskEstimate(None, 0.0, "the object has not been prompted yet")

STRAYED = 0.5
"""If the IoU of the tracker's own mask and the prompt is below this, it tracks something else and is restarted."""


class PromptedTracker:
    """A mask tracker and the prompts that it starts from.

    Frames that come from before the first one are tracked backwards from it: the tracker is then started once more
    on the first frame. If a frame has a prompt of its own, the tracker is set on that: re-anchored if it can be
    and still is on the object, since what it has learnt is worth keeping; else started again.

    Of a tracker that cannot tell, the network of `segment` is asked what is in front of the object.

    Without a prompt, a tracker that knows no mask by itself waits until the object is prompted: the solver,
    that has found it, by `correct`, or the user. Until then it estimates nothing.

    Args:
        choice: The tracker of the configuration.
        prompt: The object in the first frame; None takes the tracker's own first mask, or waits.

    Raises:
        PluginError: If it is unknown or broken.
    """

    def __init__(self, choice: PluginChoice, prompt: Prompt | None) -> None:
        self._choice, self._prompt = choice, prompt
        self._tracker = self._new()
        self._first: Frame | None = None
        self._backwards = False
        self.restarted = False
        """Whether it was started more than once, or not on the first frame's prompt."""
        self.waits = prompt is None and choice.name != "precomputed"
        """Whether the object has not been prompted yet."""

    def start(self, frame: Frame) -> MaskEstimate:
        """Start on the first frame.

        Raises:
            PluginError: If the tracker fails.
        """
        self._first = frame
        return (
            _NOTHING
            if self.waits
            else self._with_occluder(frame, self._tracker.init(frame, self._first_prompt))
        )

    def step(self, frame: Frame, prompt: Prompt | None = None) -> MaskEstimate:
        """Estimate for the next frame; with a prompt, which says what the object is in it, by that.

        Raises:
            PluginError: If the tracker fails.
        """
        assert self._first is not None
        if self.waits:
            return _NOTHING if prompt is None else self._with_occluder(frame, self._start_on(frame, prompt))
        if frame.index < self._first.index and not self._backwards:
            self._backwards = True
            self._restart()
            self._tracker.init(self._first, self._first_prompt)
        estimate = self._tracker.step(frame) if prompt is None else self._correct_by(frame, prompt)
        return self._with_occluder(frame, estimate)

    def _with_occluder(self, frame: Frame, estimate: MaskEstimate) -> MaskEstimate:
        """The estimate with what is in front of the object; of a tracker that cannot tell, the network says it."""
        if estimate.occluder is not None or (mask := estimate.found) is None:
            return estimate
        with in_stage("track"):
            return replace(estimate, occluder=self._network.occluder(frame.image, mask))

    @cached_property
    def _network(self) -> ObjectNetwork:
        from tracking3d.trackers.segment.network import ObjectNetwork  # slow to import

        return ObjectNetwork()

    def announce(self, coming: Frame | None) -> None:
        """Let the tracker begin with the frame that it is asked for next, see `GuardedTracker.announce`.

        Raises:
            PluginError: If the tracker fails.
        """
        assert self._first is not None
        if (
            not self.waits and coming is not None and coming.index > self._first.index
        ):  # else it may be another tracker's
            self._tracker.announce(coming)

    def _correct_by(self, frame: Frame, prompt: Prompt) -> MaskEstimate:
        other = self._new()
        estimate = other.init(frame, prompt)
        try:
            own = self._tracker.step(frame).found
        except PluginFailure:
            own = None
        mask = estimate.found
        common = None if mask is None else mask_iou_or_none(mask, own)
        if mask is not None and self.can_correct and common is not None and common >= STRAYED:
            self._tracker.correct(frame, mask)
        else:
            self._tracker, self.restarted = other, True
        return estimate

    @property
    def can_skip(self) -> bool:
        """Whether it need not be asked in every frame, see `tracking3d.trackers.protocol.SparingTracker`."""
        return self._tracker.can_skip and not self.waits

    def skip(self, frame: Frame, mask: NDArray[np.bool_]) -> None:
        """Tell the tracker where the object is in the next frame, ``mask`` ``(H, W)``, in place of ``step``.

        Raises:
            PluginError: If the tracker fails.
        """
        self._tracker.skip(frame, mask)

    @property
    def can_correct(self) -> bool:
        """Whether the tracker can be re-anchored, see `tracking3d.trackers.protocol.CorrectableTracker`."""
        return self._tracker.can_correct or self.waits

    def correct(self, frame: Frame, mask: NDArray[np.bool_]) -> None:
        """Re-anchor the tracker on ``mask`` ``(H, W)`` in ``frame``, the latest one; one that waits begins there.

        Raises:
            PluginError: If the tracker fails.
        """
        box = box_of(mask)
        if not self.waits:
            self._tracker.correct(frame, mask)
        elif box is not None:
            self._start_on(frame, Prompt(box, mask))

    @property
    def can_resume(self) -> bool:
        """Whether its memory can be saved; not if it was started twice, as one first frame does not describe that."""
        return self._tracker.can_resume and not (self.restarted or self.waits)

    def state(self) -> Any:
        """Its memory; None if it cannot be saved.

        Raises:
            PluginError: If the tracker fails.
        """
        return self._tracker.state() if self.can_resume else None

    def restore(self, first: Frame, state: Any) -> None:
        """Give it its memory back.

        Raises:
            PluginError: If the tracker fails.
        """
        self._first = first
        self._tracker.restore(first, self._first_prompt, state)

    @property
    def _first_prompt(self) -> Prompt:
        assert self._first is not None
        height, width = self._first.size
        return self._prompt or Prompt((0.0, 0.0, float(width), float(height)))

    def _start_on(self, frame: Frame, prompt: Prompt) -> MaskEstimate:
        self._prompt, self._first = prompt, frame
        self.waits, self.restarted = False, True
        return self._tracker.init(frame, prompt)

    def _restart(self) -> None:
        self._tracker, self.restarted = self._new(), True

    def _new(self) -> GuardedTracker:
        return GuardedTracker(build_plugin(TRACKERS, self._choice), plugin_label(TRACKERS, self._choice.name))
