"""The controls: the video with its timeline on the left, layers and uncertain frames on the right."""

from __future__ import annotations

import numpy as np
import viser

from tracking3d.frames import Image
from tracking3d.ui.viewer import timeline
from tracking3d.ui.viewer.picture import LAYERS, Shown

VIDEO_WIDTH, VIDEOS_WIDTH = 560, 720
"""Pixels of the panel with the video, or with several."""
SPEEDS = {"¼ x": 0.25, "½ x": 0.5, "1 x": 1.0, "2 x": 2.0, "4 x": 4.0}
_SIZES = """<style>
img[src^="blob:"] { max-height: min(70vh, 100vh - 310px); margin: 0 auto; }
@media (max-width: 36em) {
  .mantine-Paper-root[style*="position: fixed"],
  .mantine-Paper-root[style*="position: fixed"] [style*="width: 20em"] { width: 100% !important; }
  .mantine-Paper-root[style*="position: fixed"] { max-height: 74% !important; }
  body:has([style*="width: 20em"] > div > [style*="grid-template-rows: 1fr"])
    div[style*="flex-grow: 1; height: 100%"] { height: 26% !important; }
  img[src^="blob:"] { max-height: 42vh; }
}
</style>"""
"""The picture with timeline, slider and Play under it fits the window, and on a phone it is larger than the model.
Viser's panel on a phone leaves a strip next to it and hides the middle of the model. If a version of viser is made
otherwise, this says nothing."""
_STEPS = ("◀◀", "◀", "▶", "▶▶")
_STEP_HINT = "Previous uncertain or lost frame, previous frame, next frame, next uncertain or lost frame."


class Panel:
    """The widgets; `tracking3d.ui.viewer.viewer.Viewer` gives them their meaning.

    Args:
        server: Shows them.
        videos: How many stand side by side.
        live: Whether a run may still grow.
        causal: Whether there are causal estimates besides refined ones.
    """

    def __init__(self, server: viser.ViserServer, videos: int, live: bool, causal: bool) -> None:
        self._gui = gui = server.gui
        gui.configure_theme(control_width="large", dark_mode=True, show_logo=False, show_share_button=False)
        gui.set_panel_label("tracking3d")
        # The video is in viser's own panel, which a phone shows open; there the others are a tap away.
        blank: Image = np.full((9, 16, 3), 40, np.uint8)
        self.picture = gui.add_image(blank, format="jpeg", jpeg_quality=85)
        gui.add_html(_SIZES)
        self.timeline = gui.add_html("")
        self.slider = gui.add_slider(timeline.SLIDER, 0, 1, 1, 0)
        self.play = gui.add_button("Play", hint="Key P.")
        self.steps = gui.add_button_group("go to", _STEPS, hint=_STEP_HINT)
        self.told = gui.add_html("")
        gui.main_panel.dock_left()
        gui.main_panel.set_width(VIDEO_WIDTH if videos == 1 else VIDEOS_WIDTH)
        panel = gui.add_panel()
        with panel.add_tab("Show"):
            self._add_choices(causal)
            self.follow = gui.add_checkbox(
                "newest frame", live, visible=live, hint="Follow the run while it grows."
            )
        with panel.add_tab("Problems"):
            self.doubts = gui.add_html("")
        with panel.add_tab("Correct"):
            self.correct = gui.add_html("")
        with panel.add_tab("Run"):
            self.about = gui.add_html("")
        panel.dock_right()
        panel.set_width(330)

    def _add_choices(self, causal: bool) -> None:
        gui = self._gui
        self.quantity = gui.add_dropdown("plot", timeline.PLAIN_QUANTITIES)
        self.speed = gui.add_dropdown("speed", tuple(SPEEDS), initial_value="1 x")
        names = {
            "initial": "initial mask",
            "causal": "causal mask",
            "refined": "refined mask" if causal else "mask",
        }
        with gui.add_folder("Video"):
            self.layers = {
                layer: gui.add_checkbox(names[layer], layer != "causal", visible=causal or layer != "causal")
                for layer in LAYERS
            }
            self.legend = gui.add_html(_legend(names if causal else {**names, "causal": ""}))
            self.axes = gui.add_checkbox("axes", True)
            self.probability = gui.add_checkbox(
                "probability",
                False,
                visible=False,
                hint="Probability of the object: yellow is high, blue is low.",
            )
        with gui.add_folder("3D view"):
            self.mesh = gui.add_checkbox("model", True)
            self.path = gui.add_checkbox("camera path", True, hint="Click a frustum to go to its frame.")
            self.here = gui.add_checkbox(
                "current frame", True, hint="The image of the current frame at its camera pose."
            )
            self.landmarks = gui.add_checkbox("landmarks", True, visible=False)
            self.still = gui.add_checkbox(
                "fixed camera", False, hint="Move the object instead of the camera."
            )
            self.look = gui.add_button("Look through the camera")

    def show_causal(self) -> None:
        """Show that there are causal estimates besides refined ones."""
        if not self.layers["causal"].visible:
            self.layers["causal"].visible = True
            self.layers["refined"].label = "refined mask"
            self.legend.content = _legend({"initial": "initial", "causal": "causal", "refined": "refined"})

    @property
    def shown(self) -> Shown:
        """What is to be drawn into the video."""
        chosen = frozenset(layer for layer, box in self.layers.items() if box.value)
        return Shown(chosen, self.axes.value, self.probability.value)

    def play_or_pause(self, playing: bool) -> None:
        """What the button says."""
        self.play.label = "Pause" if playing else "Play"


def _legend(names: dict[str, str]) -> str:
    parts = [
        f'<span style="color:rgb{LAYERS[layer]}">▬</span> {name}' for layer, name in names.items() if name
    ]
    return f'<div style="font-size:11px;margin:0 12px">{" &nbsp; ".join(parts)}</div>'
