"""``tracking3d evaluate peer``: score the estimates of another system on the same clip, by the same measures."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from tracking3d.cli.options import AsJson, Debug
from tracking3d.errors import InputError
from tracking3d_bench.cli.evaluate.options import Truth

PEERS = ("colmap",)


def peer(
    system: Annotated[str, typer.Argument(metavar="SYSTEM", help="Name of the system: colmap.")],
    model: Annotated[
        Path, typer.Argument(metavar="MODEL", help="The system's model of the clip, as text or binary.")
    ],
    truth: Truth,
    as_json: AsJson = False,
    debug: Debug = False,
) -> None:
    """Score what another system estimated on the clip in CLIP; frames without a pose count as lost.

    Run COLMAP yourself, on the clip's frames with the masks of the object; MODEL is the folder that it wrote.
    """
    if system not in PEERS:
        raise InputError(f"The system '{system}' is unknown; choose one of {', '.join(PEERS)}.")
    from tracking3d_bench.cli.evaluate.answers import score_answers

    score_answers(model, truth, form=system, as_json=as_json, debug=debug)
