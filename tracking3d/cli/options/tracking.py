"""Options for the tracker, the features and the shape model."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import typer

from tracking3d.cli.options.panels import TRACKING
from tracking3d.errors import InputError

Tracker = Annotated[
    str | None,
    typer.Option(
        metavar="NAME",
        help="Mask tracker; `tracking3d plugins` lists them. auto takes the best one at hand.",
        show_default="auto",
        rich_help_panel=TRACKING,
    ),
]
Features = Annotated[
    str | None, typer.Option(metavar="NAME", help="Feature encoder.", rich_help_panel=TRACKING)
]
Flat = Annotated[
    bool, typer.Option("--flat", help="The object is planar, like a card.", rich_help_panel=TRACKING)
]
TrustMasks = Annotated[
    bool,
    typer.Option(
        "--trust-masks",
        help="The masks of all frames (--masks) are right, for example drawn by hand: keep them.",
        rich_help_panel=TRACKING,
    ),
]
Prototype = Annotated[
    str | None,
    typer.Option(
        metavar="NAME|MESH",
        help="Initial shape: sphere, ellipsoid or a mesh file.",
        rich_help_panel=TRACKING,
    ),
]
FinalRefine = Annotated[
    bool | None,
    typer.Option(
        "--final-refine/--no-final-refine",
        help="After the last frame, re-estimate every frame with the final model; causal estimates are kept too.",
        show_default=False,
        rich_help_panel=TRACKING,
    ),
]
OnPluginFailure = Annotated[
    str | None,
    typer.Option(
        metavar="continue|stop",
        help="If a plug-in fails after the first frame: continue with the last mask, or stop.",
        rich_help_panel=TRACKING,
    ),
]
Seed = Annotated[
    int | None, typer.Option(metavar="N", help="Random seed of the run.", rich_help_panel=TRACKING)
]


@dataclass(frozen=True)
class TrackingOptions:
    """How the object is tracked."""

    tracker: Tracker = None
    features: Features = None
    flat: Flat = False
    trust_masks: TrustMasks = False
    prototype: Prototype = None
    final_refine: FinalRefine = None
    on_plugin_failure: OnPluginFailure = None
    seed: Seed = None

    def tracker_settings(self, masks: Path | None) -> dict[str, str | int | None]:
        """The section ``tracker`` of the configuration.

        Args:
            masks: Value of ``--masks``, which selects the tracker ``precomputed``.

        Raises:
            InputError: ``--masks`` is given together with another tracker.
        """
        if masks is None:
            return {"name": self.tracker}
        if self.tracker not in (None, "precomputed", "auto"):
            raise InputError(
                f"--masks uses the tracker 'precomputed'; leave out --tracker {self.tracker} or --masks."
            )
        from tracking3d.trackers.mask_images import split_object

        path, number = split_object(masks)
        return {"name": "precomputed", "path": str(path), "object": number}
