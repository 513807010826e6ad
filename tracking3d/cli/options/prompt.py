"""Options for the prompt: what the object is, and in which frame."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated

import typer

from tracking3d.cli.options.general import PROMPT
from tracking3d.errors import InputError

Box = Annotated[
    list[str] | None,
    typer.Option(
        metavar="X,Y,W,H|FILE",
        help="Box around the object in the first frame, in pixels, or a file in VOT's region format; repeat for "
        "several objects.",
        rich_help_panel=PROMPT,
    ),
]
BoxFormat = Annotated[
    str | None,
    typer.Option(
        metavar="xywh|xyxy",
        help="How boxes are written: X,Y,WIDTH,HEIGHT, the default, or X1,Y1,X2,Y2.",
        rich_help_panel=PROMPT,
    ),
]
Mask = Annotated[
    list[Path] | None,
    typer.Option(
        metavar="FILE[@N|@all]",
        help="Mask image of the object in the first frame; @N picks object N of an indexed image. Repeat for several "
        "objects.",
        rich_help_panel=PROMPT,
    ),
]
Points = Annotated[
    list[str] | None,
    typer.Option(
        metavar="'X,Y+ X,Y-'",
        help="Points in the first frame, + on the object and - on the background; repeat for several objects.",
        rich_help_panel=PROMPT,
    ),
]
Masks = Annotated[
    Path | None,
    typer.Option(
        metavar="DIR|FILE[@N]",
        help="Masks of all frames: a folder, video, .npz, COCO .json or VOT .txt. The first mask is the prompt. "
        "Images with alpha bring their own.",
        rich_help_panel=PROMPT,
    ),
]
KnownObject = Annotated[
    str | None,
    typer.Option(
        "--object",
        metavar="RUN|MESH",
        help="Known object: an earlier run or a mesh file. A box or mask is optional then.",
        rich_help_panel=PROMPT,
    ),
]
Extend = Annotated[
    bool,
    typer.Option(
        "--extend",
        help="Track the object by itself, and make its model from this video and that of --object RUN.",
        rich_help_panel=PROMPT,
    ),
]
StartFrame = Annotated[
    int | None,
    typer.Option(
        metavar="N",
        help="Frame of the prompt, if not the first; tracking runs forwards and backwards from it.",
        rich_help_panel=PROMPT,
    ),
]
Correct = Annotated[
    list[str] | None,
    typer.Option(
        metavar="FRAME:BOX|MASK|POINTS",
        help="Prompt in a later frame; the mask tracker restarts from it. May be repeated.",
        rich_help_panel=PROMPT,
    ),
]


@dataclass(frozen=True)
class PromptOptions:
    """What the objects are: at most one of ``box``, ``mask`` and ``points``, or what makes them unnecessary."""

    box: Box = None
    box_format: BoxFormat = None
    mask: Mask = None
    points: Points = None
    masks: Masks = None
    known: KnownObject = None
    extend: Extend = False
    start_frame: StartFrame = None
    correct: Correct = None

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
