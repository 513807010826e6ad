"""``tracking3d evaluate peer``: another system's answers on the same clip, by the same measures."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from tracking3d.cli.options import Debug
from tracking3d.errors import InputError

PEERS = ("colmap",)


def peer(
    system: Annotated[str, typer.Argument(metavar="SYSTEM", help="colmap.")],
    model: Annotated[Path, typer.Argument(metavar="MODEL", help="Its text or binary model of the clip.")],
    truth: Annotated[Path, typer.Option(metavar="CLIP", help="Clip with frames/, masks/ and poses.json.")],
    as_json: Annotated[bool, typer.Option("--json", help="Print JSON only.")] = False,
    debug: Debug = False,
) -> None:
    """Score what another system made of the clip in CLIP; frames that it has no pose for count as lost.

    COLMAP runs by itself, on the clip's frames with the object's masks; MODEL is the folder it wrote.
    """
    if system not in PEERS:
        raise InputError(f"The system '{system}' is unknown; choose one of {', '.join(PEERS)}.")
    from tracking3d.cli.evaluate.answers import score_answers

    score_answers(model, truth, form=system, as_json=as_json, debug=debug)
