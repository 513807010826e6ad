"""Makes the picture of docs/method.md: what happens to a video, stage by stage.

The stages are listed here; each names the page of docs/method/ that describes it.

$ python docs/images/data_flow.py
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

PICTURE = Path(__file__).with_suffix(".svg")

WIDTH, HEIGHT = 1000, 408
BOX_HEIGHT = 48
SOLVER = (330, 66, 470, 206)
"""The frame around the stages of the solver: x, y, width and height in pixels."""

STYLE = """
  text { font: 13px ui-sans-serif, system-ui, Helvetica, Arial, sans-serif; fill: #fff; text-anchor: middle }
  .what { font-size: 11px; fill-opacity: .85 }
  .note { font-size: 12px; fill: #808a94 }
  path { fill: none; stroke: #808a94; stroke-width: 1.6; marker-end: url(#tip) }
  .back { stroke-dasharray: 5 4 }
  rect { rx: 6 }
  .solver { fill: #808a94; fill-opacity: .12; stroke: #808a94; stroke-opacity: .6 }
  marker path { fill: #808a94; stroke: none; marker-end: none }
"""


@dataclass(frozen=True)
class Stage:
    """One box of the picture.

    Attributes:
        name: What the stage is called.
        what: What it produces, in a few words.
        x: Left edge in pixels.
        y: Top edge in pixels.
        width: In pixels.
        colour: Of the box.
        page: The page in docs/method/ that describes it; None if it is described elsewhere.
    """

    name: str
    what: str
    x: int
    y: int
    width: int
    colour: str
    page: str | None = None

    def drawn(self) -> str:
        """The box with its two lines of text."""
        middle = self.x + self.width / 2
        return (
            f'<rect x="{self.x}" y="{self.y}" width="{self.width}" height="{BOX_HEIGHT}" fill="{self.colour}"/>'
            f'<text x="{middle:g}" y="{self.y + 21}">{self.name}</text>'
            f'<text class="what" x="{middle:g}" y="{self.y + 37}">{self.what}</text>'
        )


INPUT, ONLINE, MASKS, FINAL, FILES = "#3a6ea5", "#2b7a78", "#6a4c93", "#b5651d", "#444f5a"

STAGES = (
    Stage("video", "frames, prompt", 8, 100, 98, FILES),
    Stage("mask tracker", "initial mask", 126, 100, 96, INPUT, "masks"),
    Stage("features", "crop, points", 240, 100, 76, INPUT, "features"),
    Stage("initialization", "first map", 352, 100, 124, ONLINE, "initialization"),
    Stage("tracking", "pose, confidence", 526, 100, 116, ONLINE, "tracking"),
    Stage("mapping", "keyframes, shape", 670, 100, 114, ONLINE, "mapping"),
    Stage("atlas", "maps, merging", 348, 202, 132, ONLINE, "atlas"),
    Stage("relocalization", "pose without prediction", 512, 202, 144, ONLINE, "relocalization"),
    Stage("masks", "fused mask", 846, 100, 110, MASKS, "masks"),
    Stage("run folder", "estimates, one a frame", 828, 312, 146, FILES),
    Stage("final refinement", "all frames again", 610, 312, 148, FINAL, "refinement"),
    Stage("reconstruction", "final mesh, texture", 410, 312, 140, FINAL, "reconstruction"),
    Stage("exports", "mesh, poses, points", 204, 312, 146, FILES),
)
"""From the video to the exports."""

ARROWS = (
    "M106 124H122",
    "M222 124H236",
    "M316 124H348",
    "M476 124H522",
    "M642 124H666",
    "M574 148V198",
    "M594 202V152",
    "M512 226H484",
    "M414 202V152",
    "M800 124H842",
    "M901 148V308",
    "M828 336H762",
    "M610 336H554",
    "M410 336H354",
)
"""Where the data goes."""

LOOPS = ("M901 100V34H174V96", "M57 148V388H684V364")
"""What goes back to an earlier stage, or is read again."""

NOTES = (
    (538, 28, "feedback: a reliable fused mask corrects the mask tracker"),
    (565, 88, "solver online"),
    (556, 178, "lost"),
    (616, 178, "found"),
    (381, 178, "new side"),
    (372, 403, "the frames, read again after the last one"),
)
"""Text beside the arrows: x, y, words."""


def picture() -> str:
    """The data flow as SVG."""
    x, y, width, height = SOLVER
    head = f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {WIDTH} {HEIGHT}" width="{WIDTH}" height="{HEIGHT}">'
    tip = (
        '<defs><marker id="tip" viewBox="0 0 8 8" refX="6" refY="4" markerWidth="6" markerHeight="6" '
        'orient="auto"><path d="M0 0L8 4L0 8z"/></marker></defs>'
    )
    return "\n".join(
        [
            head,
            "<title>The data flow of tracking3d, from the video to the exports</title>",
            f"<style>{STYLE}</style>",
            tip,
            f'<rect class="solver" x="{x}" y="{y}" width="{width}" height="{height}"/>',
            *(f'<path d="{way}"/>' for way in ARROWS),
            *(f'<path class="back" d="{way}"/>' for way in LOOPS),
            *(stage.drawn() for stage in STAGES),
            *(f'<text class="note" x="{x}" y="{y}">{words}</text>' for x, y, words in NOTES),
            "</svg>",
            "",
        ]
    )


if __name__ == "__main__":
    PICTURE.write_text(picture(), encoding="utf-8")
