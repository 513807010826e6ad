"""Options for the prompt: what the object is, and in which frame."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, ClassVar

import typer

from tracking3d.cli.options.general import PROMPT, KeyOption
from tracking3d.errors import InputError

BoxFormat = Annotated[str | None, KeyOption("prompt.box_format", "xywh|xyxy", rich_help_panel=PROMPT)]


@dataclass(frozen=True)
class PromptOptions:
    """What the objects are: at most one of ``box``, ``mask`` and ``points``, or what makes them unnecessary."""

    PANEL: ClassVar = PROMPT

    box: Annotated[list[str] | None, KeyOption("prompt.box", "X,Y,W,H|FILE")] = None
    box_format: BoxFormat = None
    mask: Annotated[list[Path] | None, KeyOption("prompt.mask", "FILE[@N|@all]")] = None
    points: Annotated[list[str] | None, KeyOption("prompt.points", "'X,Y+ X,Y-'")] = None
    masks: Annotated[
        Path | None,
        typer.Option(
            metavar="DIR|FILE[@N]",
            help="Masks of all frames: a folder, video, .npz, COCO .json or VOT .txt. The first mask is the prompt. "
            "Images with alpha bring their own.",
        ),
    ] = None
    known: Annotated[
        str | None,
        typer.Option(
            "--object",
            metavar="RUN|MESH",
            help="Known object: an earlier run or a mesh file. A box or mask is optional then.",
        ),
    ] = None
    extend: Annotated[
        bool,
        typer.Option(
            "--extend",
            help="Track the object by itself, and make its model from this video and that of --object RUN.",
        ),
    ] = False
    start_frame: Annotated[int | None, KeyOption("prompt.start_frame", "N")] = None
    correct: Annotated[list[str] | None, KeyOption("prompt.correct", "FRAME:BOX|MASK|POINTS")] = None

    def completed_from(self, config: Path | None) -> PromptOptions:
        """The same, with what the section ``prompt`` of a configuration file gives if the options do not.

        Raises:
            InputError: More than one kind of prompt is given, the format of boxes is unknown, or the file cannot be
                read.
        """
        from tracking3d.config.loading import load_prompt
        from tracking3d.trackers.prompts.boxes import check_box_format

        in_file = load_prompt(config)
        given = self
        if not (self.box or self.mask or self.points or self.masks):
            given = replace(
                self,
                box=list(in_file.box),
                mask=[Path(file) for file in in_file.mask],
                points=list(in_file.points),
            )
        if sum(map(bool, (given.box, given.mask, given.points))) > 1:
            raise InputError("Give only one of --box, --mask and --points.")
        start_frame = in_file.start_frame if self.start_frame is None else self.start_frame
        if start_frame is not None and start_frame < 0:
            raise InputError(f"--start-frame {start_frame} is not a frame index; frames count from 0.")
        return replace(
            given,
            box_format=check_box_format(self.box_format or in_file.box_format or "xywh"),
            start_frame=start_frame,
            correct=self.correct or list(in_file.correct),
        )
