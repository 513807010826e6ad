"""What somebody else's project does with the library; never run, only checked: strictly, by mypy and by pyright."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict

import tracking3d
from tracking3d import (
    Frame,
    FrameEstimate,
    ObjectModel,
    PipelineConfig,
    Prompt,
    Session,
    Status,
    TrackingResult,
)
from tracking3d.errors import InputError, Tracking3dError
from tracking3d.export.options import ExportOptions
from tracking3d.frames import MaskEstimate
from tracking3d.pipeline.record import record, record_objects
from tracking3d.results.correspondences import PointTracks
from tracking3d.results.run_reader import RunReader
from tracking3d.trackers.prompts.corrections import Correction
from tracking3d.trackers.prompts.prompt import make_prompt
from tracking3d.video import open_source


def poses_of(video: Path) -> NDArray[np.float64]:
    """One call."""
    result: TrackingResult = tracking3d.track(video, box=(10, 20, 30, 40), refine=True, model="fine").result()
    masks: NDArray[np.bool_] = result.masks[0]
    statuses: tuple[Status, ...] = result.statuses
    model: ObjectModel = result.model
    tracks: tuple[PointTracks, ...] = result.tracks
    reader: RunReader = result.save("run", overwrite=True)
    done: Path = result.export("tum", "poses.txt", options=ExportOptions(object_size=0.2)).path
    print(
        masks.shape, statuses[0].value, result.about_shape, model.faces.shape, len(tracks), reader.state, done
    )
    return result.poses


def one_by_one(images: list[NDArray[np.uint8]], mask: NDArray[np.bool_], config: PipelineConfig) -> list[str]:
    """A loop."""
    with tracking3d.track(
        images, mask=mask, config=config, corrections=[Correction(3, box=(1, 2, 3, 4))], follow=[(3.0, 4.0)]
    ) as tracking:
        said = [f"{answer.index} {answer.status}: {answer.reason}" for answer in tracking]
    for first, second in tracking3d.track_objects(
        torch.zeros(3, 3, 40, 50), boxes=[(1, 2, 3, 4), (5, 6, 7, 8)]
    ):
        turned: NDArray[np.float64] = first.T_cam_obj @ second.T_cam_obj
        said.append(str(turned))
    return said


async def awaited(images: list[NDArray[np.uint8]]) -> FrameEstimate | None:
    """In an event loop."""
    last: FrameEstimate | None = None
    async for answer in tracking3d.track(images, box=(1, 2, 3, 4)):
        last = answer
        if answer.points is not None:
            print(answer.points.positions, answer.points.visible, answer.points.uncertainty)
    result = await tracking3d.track(images, box=(1, 2, 3, 4)).result_async()
    print(result.camera.fx)
    return last


def by_hand(image: NDArray[np.uint8]) -> ObjectModel:
    """Frame by frame."""
    first = Frame(0, image, time=0.0)
    prompt: Prompt = make_prompt(first, box=(1, 2, 3, 4))
    session = Session(tracking3d.load_config(overrides=["solver.local_window=8"]), prompt)
    try:
        estimate = session.step(first)
    except InputError as error:
        raise SystemExit(str(error)) from error
    except Tracking3dError:
        raise
    print(estimate.confidence, session.camera.K)
    return session.result()


def written(folder: Path) -> RunReader:
    """Run folders."""
    readers: list[RunReader] = record_objects(open_source("clip.mp4"), None, folder, boxes=[(1, 2, 3, 4)])
    print(readers[0].frames[0].T_cam_obj)
    tracking3d.export_run(folder, to="tum", out=folder / "poses.txt")
    return record(open_source("clip.mp4"), "config.yaml", folder, mask=Path("mask.png"))


class Mine:
    """A mask tracker of one's own."""

    class Options(BaseModel):
        """None."""

        model_config = ConfigDict(extra="forbid")

    @classmethod
    def from_options(cls, options: BaseModel) -> Mine:
        """Build it."""
        cls.Options.model_validate(options.model_dump())
        return cls()

    def init(self, frame: Frame, prompt: Prompt) -> MaskEstimate:
        """Start."""
        return MaskEstimate(np.ones(frame.size, np.float32))

    def step(self, frame: Frame) -> MaskEstimate:
        """Go on."""
        return MaskEstimate(None, reason="lost")
