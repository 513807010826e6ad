"""Library calls with arguments of every type: used, or refused by their name in a sentence."""

from __future__ import annotations

import itertools
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import torch
from damaging import pick, word
from judging import Case
from PIL import Image

import tracking3d
from tracking3d import Frame, PipelineConfig, Prompt, Session
from tracking3d.frames import SkippedFrame
from tracking3d.pipeline.record import record, record_objects
from tracking3d.results.correspondences import track_points
from tracking3d.results.run_reader import RunReader
from tracking3d.trackers.prompts.prompt import make_prompt
from tracking3d.video import LatestFrames, open_source

FRAMES: dict[str, Callable[[Case], Any]] = {
    "sound": lambda case: list(case.material.clip.images),
    "one array": lambda case: case.material.clip.images,
    "generator": lambda case: (image for image in case.material.clip.images),
    "frames": lambda case: [Frame(n, image) for n, image in enumerate(case.material.clip.images)],
    "skipped": lambda case: [SkippedFrame(0, "x"), *case.material.clip.images],
    "none usable": lambda case: [SkippedFrame(0, "x")],
    "path": lambda case: case.material.folder / "images",
    "text": lambda case: str(case.material.folder / "clip.mp4"),
    "word": lambda case: word(case.random),
    "bytes": lambda case: b"frames",
    "none": lambda case: None,
    "number": lambda case: 3,
    "empty": lambda case: [],
    "capture": lambda case: cv2.VideoCapture(),
    "one image": lambda case: case.material.clip.images[0],
    "float": lambda case: case.material.clip.images / 255.0,
    "half": lambda case: case.material.clip.images.astype(np.float16),
    "grey": lambda case: case.material.clip.images[..., 0],
    "grey images": lambda case: list(case.material.clip.images[..., 0]),
    "alpha": lambda case: np.concatenate([case.material.clip.images, case.material.clip.images[..., :1]], -1),
    "channels first": lambda case: case.material.clip.images.transpose(0, 3, 1, 2),
    "tensor": lambda case: torch.from_numpy(case.material.clip.images.copy()),
    "float tensor": lambda case: torch.rand(3, 3, 48, 64),
    "grad tensor": lambda case: torch.rand(3, 48, 64, 3, requires_grad=True),
    "pillow": lambda case: [Image.fromarray(image) for image in case.material.clip.images],
    "lists": lambda case: [[[1, 2, 3]]],
    "objects": lambda case: [object(), {}],
    "a dictionary": lambda case: {"a": case.material.clip.images[0]},
    "set": lambda case: {1, 2},
    "class": lambda case: list,
    "sizes": lambda case: [case.material.clip.images[0], case.material.clip.images[1][:40]],
    "tiny": lambda case: np.zeros((3, 1, 1, 3), np.uint8),
    "later none": lambda case: [case.material.clip.images[0], None],
    "later text": lambda case: [case.material.clip.images[0], "frame.png"],
    "ragged": lambda case: [case.material.clip.images[0], [[1], [1, 2]]],
    "source": lambda case: open_source(case.material.folder / "images"),
    "frame of none": lambda case: [Frame(0, None)],
    "frame of text": lambda case: [Frame("0", case.material.clip.images[0])],
    "big endian": lambda case: case.material.clip.images.astype(">u2"),
    "masked": lambda case: np.ma.masked_array(case.material.clip.images, False),
}

BOXES: dict[str, Callable[[Case], Any]] = {
    "sound": lambda case: case.material.clip.box,
    "sound list": lambda case: list(case.material.clip.box),
    "array": lambda case: np.array(case.material.clip.box),
    "tensor": lambda case: torch.tensor(case.material.clip.box),
    "text": lambda case: case.material.box,
    "texts": lambda case: tuple("abcd"),
    "nan": lambda case: (float("nan"), 0, 5, 5),
    "huge": lambda case: (1e308, 1e308, 1e308, 1e308),
    "integers": lambda case: (10**400, 0, 5, 5),
    "outside": lambda case: (500, 500, 10, 10),
    "negative": lambda case: (-20, -20, 60, 60),
    "flat": lambda case: (5, 5, 0, 5),
    "three": lambda case: (1, 2, 3),
    "five": lambda case: (1, 2, 3, 4, 5),
    "number": lambda case: 5,
    "nested": lambda case: ((1, 2), (3, 4)),
    "dictionary": lambda case: {"x": 1, "y": 2, "w": 3, "h": 4},
    "complex": lambda case: (1j, 2, 3, 4),
    "booleans": lambda case: (True, True, True, True),
    "nothings": lambda case: (None, None, None, None),
    "empty": lambda case: (),
    "word": lambda case: word(case.random),
    "sliver": lambda case: (1e-9, 1e-9, 1e-9, 1e-9),
}

MASKS: dict[str, Callable[[Case], Any]] = {
    "sound": lambda case: case.material.clip.masks[0],
    "numbers": lambda case: case.material.clip.masks[0].astype(np.uint8) * 255,
    "floats": lambda case: case.material.clip.masks[0].astype(float),
    "nan": lambda case: np.full((48, 64), np.nan),
    "tensor": lambda case: torch.from_numpy(case.material.clip.masks[0].copy()),
    "lists": lambda case: case.material.clip.masks[0].tolist(),
    "text": lambda case: "mask.png",
    "path": lambda case: case.material.folder / "mask.png",
    "no file": lambda case: Path("nowhere.png"),
    "folder": lambda case: case.material.folder,
    "other size": lambda case: case.material.clip.masks[0][:20],
    "three": lambda case: case.material.clip.masks,
    "colour": lambda case: case.material.clip.images[0],
    "empty": lambda case: np.zeros((48, 64), bool),
    "full": lambda case: np.ones((48, 64), bool),
    "no pixels": lambda case: np.zeros((0, 0), bool),
    "number": lambda case: 7,
    "objects": lambda case: np.full((48, 64), None),
    "texts": lambda case: np.full((48, 64), "x"),
    "complex": lambda case: np.full((48, 64), 1j),
    "ragged": lambda case: [[1], [1, 2]],
    "dictionary": lambda case: {},
    "one pixel": lambda case: np.pad(np.ones((1, 1), bool), ((5, 42), (5, 58))),
}

CONFIGS: dict[str, Callable[[Case], Any]] = {
    "sound": lambda case: case.material.config,
    "file": lambda case: case.material.folder / "tiny.yaml",
    "text": lambda case: str(case.material.folder / "tiny.yaml"),
    "dictionary": lambda case: {"crop": {"size": 32}},
    "number": lambda case: 5,
    "class": lambda case: PipelineConfig,
    "no file": lambda case: "nowhere.yaml",
    "folder": lambda case: case.material.folder,
    "video": lambda case: case.material.folder / "clip.mp4",
    "section": lambda case: case.material.config.crop,
    "list": lambda case: [],
    "word": lambda case: word(case.random),
}


def library_calls(case: Case) -> None:
    """One call with one to three odd arguments."""
    call = pick(
        case.random, [_track, _track, _track_objects, _record, _record_objects, _session, _open, _read]
    )
    call(case)


def _given(case: Case, kinds: dict[str, Callable[[Case], Any]], what: str, odd: float = 0.5) -> Any:
    name = pick(case.random, list(kinds)) if case.random.random() < odd else next(iter(kinds))
    case.story.append(f"{what} {name}")
    return kinds[name](case)


def _prompt(case: Case) -> dict[str, Any]:
    """A box, a mask, sometimes both or neither."""
    chance = case.random.random()
    prompt: dict[str, Any] = {}
    if chance < 0.5 or chance > 0.93:
        prompt["box"] = _given(case, BOXES, "box")
    if chance >= 0.5:
        prompt["mask"] = _given(case, MASKS, "mask")
    return {} if 0.9 < chance < 0.93 else prompt


def _config(case: Case) -> Any:
    return _given(case, CONFIGS, "config", odd=0.2)


def _track(case: Case) -> None:
    frames, prompt, config = _given(case, FRAMES, "frames"), _prompt(case), _config(case)
    case.call("track", lambda: list(tracking3d.track(frames, config=config, **prompt)))


def _track_objects(case: Case) -> None:
    frames, config = _given(case, FRAMES, "frames"), _config(case)
    boxes = pick(case.random, [[], None, 5, (5, 5, 20, 20), "box", [_given(case, BOXES, "box")] * 2])
    masks = pick(case.random, [(), None, "mask", case.material.clip.masks[0], [_given(case, MASKS, "mask")]])
    case.story.append(f"boxes {boxes!r:.60} masks {type(masks)}")
    case.call(
        "track_objects",
        lambda: list(tracking3d.track_objects(frames, boxes=boxes, masks=masks, config=config)),
    )


def _source(case: Case) -> Any:
    frames = _given(case, FRAMES, "frames", odd=0.4)
    if case.random.random() < 0.15:
        return frames
    return open_source(frames)


def _record(case: Case) -> None:
    prompt, config = _prompt(case), _config(case)
    folder = pick(
        case.random, [case.folder / "out"] * 4 + [None, 5, str(case.folder / "out"), case.folder / "a\nb"]
    )
    case.story.append(f"folder {folder!r}")
    case.call("record", lambda: record(_source(case), config, folder, **prompt))


def _record_objects(case: Case) -> None:
    config = _config(case)
    boxes = [_given(case, BOXES, "box") for _ in range(2)]
    case.call(
        "record_objects", lambda: record_objects(_source(case), config, case.folder / "out", boxes=boxes)
    )


def _session(case: Case) -> None:
    config = _config(case)
    first = Frame(0, case.material.clip.images[0])
    prompts = [make_prompt(first, box=case.material.clip.box)] * 3
    prompts += [None, (10, 8, 20, 20), Prompt((10, 8, 20, 20)), Prompt(None), Prompt((1, 2)), "box", first]
    prompts += [Prompt((0, 0, 5, 5), np.zeros((3, 3), bool)), Prompt((float("nan"),) * 4)]
    prompt = pick(case.random, prompts)
    intrinsics = pick(
        case.random, [None, None, (50, 50, 32, 24), (0, 0, 0, 0), (1, 2), "x", 5, (float("nan"),) * 4]
    )
    frames = _given(case, FRAMES, "frames")
    case.story.append(f"prompt {prompt!r:.60} intrinsics {intrinsics!r}")

    def session() -> None:
        one = Session(config, prompt, intrinsics)
        for number, image in enumerate(
            itertools.islice(frames, 3) if hasattr(frames, "__iter__") else [frames]
        ):
            wrapped = case.random.random() < 0.8
            one.step(Frame(number, image) if wrapped else image)
        one.result()

    case.call("Session", session)


def _open(case: Case) -> None:
    frames = _given(case, FRAMES, "frames")
    selection = pick(case.random, [None, None, word(case.random), 5, ("1", "2"), slice(0, 2), range(2)])
    rate = pick(case.random, [None, 15, 0, -1, "x", float("nan"), float("inf"), 1e308])
    live = case.random.random() < 0.3
    case.story.append(f"selection {selection!r:.60} rate {rate!r} live {live}")

    def read() -> None:
        source = open_source(frames, selection)
        for frame in LatestFrames(source, rate=rate) if live else source:
            assert frame is not None

    case.call("open_source", read)


def _read(case: Case) -> None:
    folder = pick(case.random, [case.material.folder / "run"] * 3 + [case.material.folder, Path("nowhere")])
    frame = pick(case.random, [0, 1, -1, 10**30])
    xy = pick(case.random, [[(30, 20)], [(30, 20), (1.5, 2)], [(float("nan"), 2)], [(1e308, 2)], [(-5, -5)]])
    case.story.append(f"folder {folder} frame {frame!r} xy {xy!r}")

    def read() -> None:
        reader = RunReader(folder)
        track_points(reader, frame=frame, xy=xy)

    case.call("track_points", read)
