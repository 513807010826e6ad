"""Conformance checks of mask trackers."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from tracking3d.frames import Box, Frame, MaskEstimate, Prompt
from tracking3d.plugins.guard import mask_fault
from tracking3d.testing.plugins import allow_refusal, expect_success, factory_of, random_state
from tracking3d.trackers.crops import box_of
from tracking3d.trackers.protocol import MaskTracker

Size = tuple[int, int]
"""``(height, width)`` in pixels."""


@dataclass(frozen=True, eq=False)
class Clip:
    """Frames with the true mask ``(H, W)`` bool of the first."""

    frames: tuple[Frame, ...]
    mask: NDArray[np.bool_]

    @property
    def box(self) -> Box:
        """The box around the mask."""
        box = box_of(self.mask)
        assert box is not None
        return box

    def prompt(self, with_mask: bool) -> Prompt:
        """The object in the first frame, with its mask or with a box alone."""
        return Prompt(self.box, self.mask.copy() if with_mask else None)


def moving_disc(size: Size, count: int, seed: int = 0) -> Clip:
    """A warm disc that drifts two pixels a frame over a cool background.

    Args:
        size: Of the frames.
        count: Number of frames.
        seed: Other seeds give other textures and another way.
    """
    height, width = size
    random = np.random.default_rng(seed)
    background = _texture(random, size, (20, 60, 90), (90, 150, 220))
    surface = _texture(random, size, (150, 60, 10), (250, 150, 60))
    radius = min(size) // 5
    shift = -2 if seed % 2 else 2
    rows, columns = np.mgrid[:height, :width]
    frames, masks = [], []
    for index in range(count):
        centre = width // 2 - shift * count // 2 + shift * index
        mask = (rows - height // 2) ** 2 + (columns - centre) ** 2 < radius**2
        shifted = np.roll(surface, shift * index, axis=1)
        image = np.where(mask[..., None], shifted, background)
        frames.append(Frame(index, image, index / 10, f"frame {index}"))
        masks.append(mask)
    return Clip(tuple(frames), masks[0])


def plain_frames(size: Size, grey: int, count: int) -> tuple[Frame, ...]:
    """Frames of one grey value, such as a covered or a dazzled camera gives."""
    return tuple(
        Frame(index, np.full((*size, 3), grey, np.uint8), index / 10, f"frame {index}")
        for index in range(count)
    )


def _texture(
    random: np.random.Generator, size: Size, low: tuple[int, int, int], high: tuple[int, int, int]
) -> NDArray[np.uint8]:
    noise = cv2.GaussianBlur(random.random((*size, 3)), (0, 0), 1.5)
    noise = (noise - noise.min()) / (noise.max() - noise.min())
    return (np.array(low) + noise * (np.array(high) - np.array(low))).round().astype(np.uint8)


SIZES: tuple[Size, ...] = ((90, 120), (131, 97))
"""``(height, width)`` of the clips: one wide, one tall, odd numbers among them."""

_TINY: Size = (9, 12)


def check_tracker(
    tracker: type[Any] | Callable[[], MaskTracker] | MaskTracker,
    *,
    sizes: Sequence[Size] = SIZES,
    frames: int = 4,
    **options: Any,
) -> None:
    """Check that a mask tracker keeps to its protocol, `tracking3d.trackers.protocol.MaskTracker`.

    It is run on short clips of a moving disc, prompted by a mask and by a box: shapes, types and ranges of the
    estimates, equal estimates when repeated and next to another tracker of its kind, and unchanged frames, prompts and
    returned estimates. Then on what a pipeline can meet: frames that turn black or white, tiny frames and objects,
    boxes at the border, blank first frames. Those it may refuse when it starts, by a `tracking3d.errors.InputError` of
    one sentence; once started it must return an estimate for every frame.

    Args:
        tracker: The plug-in's class, a function that builds one, or a tracker.
        sizes: ``(height, width)`` of the clips, for a tracker that does not take every size.
        frames: Frames of each clip; at least 2.
        options: The plug-in's own options, where ``tracker`` is its class.

    Raises:
        AssertionError: If it does not; the sentence says what was expected.
    """
    build = factory_of(tracker, ("init", "step"), options)
    for size in sizes:
        clip = moving_disc(size, frames)
        for with_mask in (True, False):
            _check_answers(build, clip, with_mask)
    clip = moving_disc(sizes[0], frames)
    _check_repeatable(build, clip)
    _check_independent(build, clip, moving_disc(sizes[0], frames, seed=1))
    for grey in (0, 255):
        blank = plain_frames(sizes[0], grey, 2)
        _check_hostile(build, blank, clip.prompt(False), f"a first frame of grey value {grey}")
        later = (*clip.frames[:2], *blank)
        _check_hostile(build, later, clip.prompt(True), f"a clip that turns to grey value {grey}")
    for name, prompt in _odd_prompts(clip).items():
        _check_hostile(build, clip.frames[:2], prompt, name)
    tiny = moving_disc(_TINY, 2)
    for with_mask in (True, False):
        _check_hostile(
            build, tiny.frames, tiny.prompt(with_mask), f"frames of {_TINY[1]} x {_TINY[0]} pixels"
        )


def _run(tracker: MaskTracker, clip: Clip, what: str) -> list[MaskEstimate]:
    """Every estimate, checked, and copied as it was when it was given."""
    answers = []
    for position, frame in enumerate(clip.frames):
        answer = _ask(tracker, frame, None if position else clip.prompt(True), f"{what}, frame {position}")
        answers.append(_copy_estimate(answer))
    return answers


def _ask(tracker: MaskTracker, frame: Frame, prompt: Prompt | None, what: str) -> MaskEstimate:
    """One estimate, to be given and valid; with a prompt for the first frame."""
    with expect_success(what):
        answer = tracker.step(frame) if prompt is None else tracker.init(frame, prompt)
    return _check_estimate(answer, frame, what)


def _check_estimate(answer: Any, frame: Frame, what: str) -> MaskEstimate:
    fault = mask_fault(answer, frame.size)
    assert not fault, f"{what}: {fault}."
    assert isinstance(answer.reason, str), f"{what}: the reason is {answer.reason!r} instead of text."
    assert answer.mask is not None or answer.reason, f"{what}: an estimate without a mask must give a reason."
    assert answer.mask is None or answer.mask.dtype == np.float32, (
        f"{what}: the mask is of {answer.mask.dtype} instead of float32."
    )
    checked: MaskEstimate = answer
    return checked


def _copy_estimate(answer: MaskEstimate) -> MaskEstimate:
    mask = None if answer.mask is None else answer.mask.copy()
    occluder = None if answer.occluder is None else answer.occluder.copy()
    return MaskEstimate(mask, answer.score, answer.reason, occluder)


def _check_answers(build: Callable[[], MaskTracker], clip: Clip, with_mask: bool) -> None:
    """The estimates on an easy clip, and that nothing given or taken is changed."""
    height, width = clip.mask.shape
    what = f"{width} x {height} pixels, prompted by a {'mask' if with_mask else 'box'}"
    prompt = clip.prompt(with_mask)
    images = [frame.image.copy() for frame in clip.frames]
    tracker = build()
    given, copies = [], []
    for position, frame in enumerate(clip.frames):
        step = f"{what}, frame {position}"
        given.append(_ask(tracker, frame, None if position else prompt, step))
        copies.append(_copy_estimate(given[-1]))
        assert np.array_equal(frame.image, images[position]), (
            f"{step}: the tracker has changed the frame's image; draw on a copy."
        )
    first = copies[0].binary
    assert first is not None and first.any(), f"{what}: the first frame's mask must show the object."
    assert prompt.mask is None or np.array_equal(prompt.mask, clip.mask), (
        f"{what}: the tracker has changed the prompt's mask; work on a copy."
    )
    for position, (answer, copy) in enumerate(zip(given, copies, strict=True)):
        assert _same(answer, copy), (
            f"{what}: the estimate for frame {position} was changed while later frames were tracked; return "
            "a new array."
        )


def _check_repeatable(build: Callable[[], MaskTracker], clip: Clip) -> None:
    """The same frames give the same estimates, whatever the global random generators hold."""
    runs = []
    for seed in (1, 2):
        with random_state(seed):
            runs.append(_run(build(), clip, "a repeated run"))
    for position, (once, again) in enumerate(zip(*runs, strict=True)):
        assert _same(once, again), (
            f"Two runs on the same frames differ at frame {position}; take random seeds from the options, "
            "and reset the state in init."
        )


def _check_independent(build: Callable[[], MaskTracker], clip: Clip, other: Clip) -> None:
    """A tracker next to another one gives the same estimates as alone: no shared state, no look-ahead."""
    first, second = build(), build()
    if first is second:  # one tracker was given, which cannot be in two clips at once
        alone = _run(first, clip, "a clip")
        _run(first, other, "another clip")
        beside = _run(first, clip, "the first clip again")
    else:
        alone = _run(build(), clip, "a clip alone")
        beside = []
        for position, (frame, distraction) in enumerate(zip(clip.frames, other.frames, strict=True)):
            what = f"two trackers side by side, frame {position}"
            beside.append(_copy_estimate(_ask(first, frame, None if position else clip.prompt(True), what)))
            _ask(second, distraction, None if position else other.prompt(True), what)
    for position, (once, again) in enumerate(zip(alone, beside, strict=True)):
        assert _same(once, again), (
            f"The estimate for frame {position} depends on other clips tracked before or at the same time; "
            "keep all state in the tracker instance, and reset it in init."
        )


def _check_hostile(
    build: Callable[[], MaskTracker], frames: Sequence[Frame], prompt: Prompt, what: str
) -> None:
    """It may refuse to start, in one sentence; once started it must return estimates."""
    tracker = build()
    started = False
    with allow_refusal(what):
        _check_estimate(tracker.init(frames[0], prompt), frames[0], f"{what}, frame 0")
        started = True
    for position, frame in enumerate(frames[1:] if started else (), start=1):
        _ask(tracker, frame, None, f"{what}, frame {position}")


def _odd_prompts(clip: Clip) -> dict[str, Prompt]:
    height, width = clip.mask.shape
    pixel = np.zeros_like(clip.mask)
    pixel[height // 2, width // 2] = True
    x, y, w, h = clip.box
    return {
        "a box in the upper left corner": Prompt((0.0, 0.0, w, h)),
        "a box in the lower right corner": Prompt((width - w, height - h, w, h)),
        "a box as large as the frame": Prompt((0.0, 0.0, float(width), float(height))),
        "a box with fractions of pixels": Prompt((x + 0.3, y + 0.6, w - 1.1, h - 1.2)),
        "a box of one pixel": Prompt((width // 2, height // 2, 1.0, 1.0)),
        "a box without a size": Prompt((x, y, 0.0, 0.0)),
        "a mask of one pixel": Prompt((width // 2, height // 2, 1.0, 1.0), pixel),
        "an empty mask": Prompt((x, y, w, h), np.zeros_like(clip.mask)),
    }


def _same(a: MaskEstimate, b: MaskEstimate) -> bool:
    if (a.mask is None) != (b.mask is None) or a.score != b.score:
        return False
    return a.mask is None or b.mask is None or np.array_equal(a.mask, b.mask)
