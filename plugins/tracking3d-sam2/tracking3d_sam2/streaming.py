"""The video predictor of the package ``sam2``, one frame at a time.

The predictor expects a folder with all frames. It only looks at the frame that it segments and at its own memory,
so that it can be given one more frame in every step; what it remembers of old frames is dropped.
"""

from __future__ import annotations

import tempfile
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import PIL.Image
import torch
from numpy.typing import NDArray

from tracking3d.frames import Box, Image

_OBJECT = 1
_MEAN, _DEVIATION = (0.485, 0.456, 0.406), (0.229, 0.224, 0.225)  # of ImageNet, as the package has them


class StreamingPredictor:
    """A video predictor that is given its frames one by one.

    Args:
        predictor: ``SAM2VideoPredictor`` of the package, ready to run.
        memory: Frames without a prompt that it remembers.
    """

    def __init__(self, predictor: Any, memory: int) -> None:
        self._predictor, self._memory = predictor, memory
        self._state: dict[str, Any] | None = None
        self._count = 0

    @property
    def is_started(self) -> bool:
        """Whether there is an object to follow."""
        return self._state is not None

    @torch.inference_mode()
    def start(self, image: Image, box: Box, mask: NDArray[np.bool_] | None) -> NDArray[np.float32]:
        """Begin with a box ``(x, y, w, h)`` or a mask in the first frame; logits ``(H, W)`` of the object in it."""
        with tempfile.TemporaryDirectory() as folder:
            cv2.imwrite(str(Path(folder) / "00000.jpg"), cv2.cvtColor(image, cv2.COLOR_RGB2BGR))
            self._state = self._predictor.init_state(folder)
        self._state["images"] = {0: self._view(image)}
        self._state["cached_features"] = {}  # of the compressed image
        self._count = 1
        if mask is not None:
            found = self._predictor.add_new_mask(self._state, 0, _OBJECT, mask)
        else:
            x, y, width, height = box
            corners = np.array([x, y, x + width, y + height], np.float32)
            found = self._predictor.add_new_points_or_box(self._state, 0, _OBJECT, box=corners)
        self._propagate(0)
        return _logits(found)

    @torch.inference_mode()
    def step(self, image: Image) -> NDArray[np.float32]:
        """Logits ``(H, W)`` of the object in the next frame."""
        assert self._state is not None
        index = self._count
        self._state["images"] = {index: self._view(image)}
        self._state["num_frames"] = self._count = index + 1
        logits = _logits(self._propagate(index))
        self._forget(index - self._memory)
        return logits

    @torch.inference_mode()
    def correct(self, mask: NDArray[np.bool_]) -> None:
        """Take ``mask`` ``(H, W)`` as that of the last frame."""
        assert self._state is not None
        index = self._count - 1
        self._predictor.add_new_mask(self._state, index, _OBJECT, mask)
        self._propagate(index)

    def _propagate(self, index: int) -> tuple[Any, ...]:
        """Run the predictor over one frame; prompts in it enter its memory."""
        found = list(self._predictor.propagate_in_video(self._state, index, 0))
        return tuple(found[0])

    def _forget(self, oldest: int) -> None:
        """Drop what is remembered of frames before ``oldest`` that were not prompted."""
        assert self._state is not None
        outputs = [*self._state["output_dict_per_obj"].values(), self._state.get("output_dict", {})]
        for one in outputs:
            kept = one.get("non_cond_frame_outputs", {})
            for index in [index for index in kept if index < oldest]:
                del kept[index]

    def _view(self, image: Image) -> torch.Tensor:
        """``(3, S, S)``: the frame as the package's loader gives it to its network."""
        side = self._predictor.image_size
        small = np.asarray(PIL.Image.fromarray(image).resize((side, side)), np.float32) / 255
        normal = (small - np.float32(_MEAN)) / np.float32(_DEVIATION)
        return torch.from_numpy(normal.transpose(2, 0, 1).copy())


def _logits(found: tuple[Any, ...]) -> NDArray[np.float32]:
    """The only object's ``(H, W)`` of what the predictor gives: frame, objects, ``(1, 1, H, W)``."""
    logits: torch.Tensor = found[2]
    return logits[0, 0].float().cpu().numpy()
