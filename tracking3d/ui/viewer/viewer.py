"""The viewer: the followed runs, the current frame, and the threads that update both."""

from __future__ import annotations

import html
import io
import threading
import time
from bisect import bisect_left
from collections.abc import Callable, Sequence
from contextlib import redirect_stdout
from dataclasses import dataclass, field
from functools import partial
from typing import Any

import numpy as np
import viser
from numpy.typing import NDArray

from tracking3d.errors import Tracking3dError
from tracking3d.frames import Image
from tracking3d.results import layout
from tracking3d.results.drawing import Colour
from tracking3d.results.overlay import ObjectAxes
from tracking3d.ui.sentences import doubtful_ranges
from tracking3d.ui.viewer import first_look, timeline
from tracking3d.ui.viewer.correcting import Corrections
from tracking3d.ui.viewer.descriptions import about, describe_frame, list_doubtful_frames
from tracking3d.ui.viewer.followed_run import FollowedRun, landmarks_of_checkpoint
from tracking3d.ui.viewer.guarded_server import start_server
from tracking3d.ui.viewer.panel import SPEEDS, Panel
from tracking3d.ui.viewer.picture import axes_of, beside, draw_picture
from tracking3d.ui.viewer.scene import ObjectScene, set_up_space
from tracking3d.ui.web.access import Access
from tracking3d.video.any_frame import FrameImages

POLL = 0.5
"""Seconds between two looks at run folders that may grow."""
_DRAW_ANEW = 2.0  # seconds between two drawings of the path of a run that grows
_USUAL_RATE = 10.0  # frames a second if the source has no rate


@dataclass(eq=False)
class Video:
    """One RUN of the command line: a video, and its objects."""

    name: str  # what the viewer calls it
    runs: list[FollowedRun]  # the objects
    images: FrameImages | None  # gives the frames; None if they are not at hand
    axes: list[ObjectAxes | None] = field(default_factory=list)


class Viewer:
    """Shows runs in the browser until it is closed.

    Args:
        videos: What to show.
        access: Where to listen, and whom to serve.
        port: The port, or the next one that is free; 0 for any.
        corrections: Lets the runs be corrected.

    Raises:
        PluginError: If this version of viser cannot be guarded.
        InputError: If a run is damaged.
    """

    def __init__(self, videos: Sequence[Video], access: Access, port: int, corrections: Corrections) -> None:
        self._videos, self._corrections = list(videos), corrections
        self._runs = [run for video in videos for run in video.runs]
        for run in self._runs:
            run.look_again()
        self._changed = threading.Condition()
        self._wanted, self._shown, self._again = 0, -1, True
        self._playing = self._over = False
        self._indices: list[int] = []
        self._fault = ""
        live = any(run.going_on for run in self._runs)
        self._server = start_server(access, port)
        self.address = access.address(self._server.get_port())
        set_up_space(self._server)
        self._panel = Panel(self._server, len(videos), live, any(run.refined for run in self._runs))
        self._scenes = [
            ObjectScene(self._server, run, number, self.go_to) for number, run in enumerate(self._runs)
        ]
        self._take_news(draw=True)
        self._listen()
        self._threads = [
            threading.Thread(target=work, name=f"viewer {work.__name__}", daemon=True)
            for work in (self._draw, self._follow, self._advance)
        ]
        for thread in self._threads:
            thread.start()

    def go_to(self, index: int) -> None:
        """Show the frame ``index``, or the nearest one that has an estimate."""
        self._panel.slider.value = int(index)
        self._want(index)

    def close(self) -> None:
        """Stop serving."""
        with self._changed:
            self._over = True
            self._changed.notify_all()
        for thread in self._threads:
            thread.join(5)
        self._corrections.close()
        with redirect_stdout(io.StringIO()):  # it says so
            self._server.stop()

    def _want(self, index: int | None = None) -> None:
        with self._changed:
            self._wanted, self._again = self._wanted if index is None else int(index), True
            self._changed.notify_all()

    def _listen(self) -> None:
        panel = self._panel
        panel.slider.on_update(self._slid)
        panel.play.on_click(lambda _: self._play_or_pause())
        panel.steps.on_click(lambda event: self._step(event.target.value))
        panel.quantity.on_update(lambda _: self._redraw_timeline())
        panel.look.on_click(lambda _: self._look_through())
        boxes = [*panel.layers.values(), panel.axes, panel.probability]
        boxes += [panel.mesh, panel.path, panel.here, panel.landmarks, panel.still]
        for box in boxes:
            box.on_update(lambda _: self._want())
        keys: dict[str, tuple[str, Callable[[], None]]] = {
            "P": ("Play or pause", self._play_or_pause),
            "N": ("Next uncertain or lost frame", partial(self._step, "▶▶")),
            "B": ("Previous uncertain or lost frame", partial(self._step, "◀◀")),
        }
        for key, (label, act) in keys.items():
            self._server.gui.add_command(label, hotkey=key).on_trigger(partial(_ignoring_the_event, act))

    def _slid(self, event: Any) -> None:
        """The slider was moved: by a person, who then no longer wants the newest frame, or by this program."""
        if event.client_id is not None and self._panel.follow.value:
            self._panel.follow.value = False
        self._want(self._panel.slider.value)

    def _play_or_pause(self) -> None:
        if not self._indices:
            return
        at_end = self._wanted >= self._indices[-1]
        with self._changed:
            self._playing = not self._playing
            self._changed.notify_all()
        self._panel.play_or_pause(self._playing)
        if self._playing:
            self._panel.follow.value = False
            if at_end:
                self.go_to(self._indices[0])

    def _step(self, way: str) -> None:
        if not self._indices:
            return
        place = bisect_left(self._indices, self._wanted)
        if way in ("◀", "▶"):
            step = 1 if way == "▶" else -1
            self.go_to(self._indices[min(max(place + step, 0), len(self._indices) - 1)])
            return
        starts = sorted(
            {one.first for run in self._runs for one in doubtful_ranges(list(run.frames.values()))}
        )
        found = [start for start in starts if (start > self._wanted if way == "▶▶" else start < self._wanted)]
        if found:
            self.go_to(found[0] if way == "▶▶" else found[-1])

    def _advance(self) -> None:
        """Go on through the frames while the video plays; frames are left out if drawing is slower."""
        while not self._over:
            with self._changed:
                self._changed.wait_for(lambda: self._playing or self._over)
            started, place = time.monotonic(), bisect_left(self._indices, self._wanted)
            wanted = self._wanted
            while self._playing and not self._over:
                time.sleep(0.02)
                if self._wanted != wanted:  # somebody went elsewhere: on from there
                    started, place, wanted = (
                        time.monotonic(),
                        bisect_left(self._indices, self._wanted),
                        self._wanted,
                    )
                rate = self._rate() * SPEEDS[self._panel.speed.value]
                reached = min(place + int((time.monotonic() - started) * rate), len(self._indices) - 1)
                if self._indices[reached] != wanted:
                    wanted = self._indices[reached]
                    self.go_to(wanted)
                if reached == len(self._indices) - 1:
                    self._playing = False
                    self._panel.play_or_pause(False)

    def _rate(self) -> float:
        rates = [run.description.get("fps") for run in self._runs]
        return next(
            (float(rate) for rate in rates if isinstance(rate, int | float) and 0 < rate < 1e3), _USUAL_RATE
        )

    def _draw(self) -> None:
        """Draw the frame that is wanted; those that were wanted while another was drawn are left out."""
        while True:
            with self._changed:
                self._changed.wait_for(lambda: self._again or self._over)
                if self._over:
                    return
                index, self._again = self._wanted, False
            try:
                self._draw_frame(self._nearest(index))
            except Exception as error:  # a damaged file must not end the viewer
                self._fault = f"<p>Frame {index} cannot be drawn: {html.escape(str(error))}</p>"

    def _draw_frame(self, index: int) -> None:
        panel = self._panel
        pictures: dict[FollowedRun, Image] = {}
        drawn: list[Image] = []
        for video in self._videos:
            image = video.images.image(index) if video.images is not None else None
            fits = image is not None and _fits(image, video.runs[0])
            picture = draw_picture(
                image if fits else None, video.runs, index, panel.shown, video.axes, self._colours(video)
            )
            pictures.update(dict.fromkeys(video.runs, picture))
            drawn.append(picture)
        with self._server.atomic():
            panel.picture.image = beside(drawn, [video.name for video in self._videos])
            for scene, picture in zip(self._scenes, pictures.values(), strict=True):
                scene.go_to(index, picture[::2, ::2], panel.still.value)
                scene.show(panel.mesh.value, panel.path.value, panel.here.value, panel.landmarks.value)
            told = "".join(
                describe_frame(run, run.frames.get(index), timeline.colour_of(number, len(self._runs)))
                for number, run in enumerate(self._runs)
            )
            self._offer_correction(index)
            panel.told.content = (
                f'<div class="told" data-frame="{index}" style="font-size:12px;line-height:1.4;margin:4px 12px">'
                f"frame {index}{told}{self._fault}</div>{timeline.cursor(index, *self._ends())}"
            )
        self._shown = index

    def _follow(self) -> None:
        """Look whether the runs have grown."""
        drawn, waiting = time.monotonic(), False
        while not self._over:
            with self._changed:
                self._changed.wait_for(lambda: self._over, timeout=POLL)
            if self._over:
                return
            try:
                news = [run.look_again() for run in self._runs]
            except Tracking3dError as error:
                self._fault = f"<p>{html.escape(str(error))}</p>"
                self._want()
                continue
            self._offer_correction(self._shown)
            waiting = waiting or any(news)
            going_on = any(run.going_on for run in self._runs)
            if waiting and (time.monotonic() - drawn > _DRAW_ANEW or not going_on):
                waiting, drawn = False, time.monotonic()
                self._take_news(draw=True)
            elif any(news):
                self._take_news(draw=False)

    def _colours(self, video: Video) -> list[Colour]:
        """Colours of the objects' outlines, those of their curves, if a video has several objects."""
        if len(video.runs) < 2:
            return []
        colours = timeline.RUN_COLOURS
        return [colours[self._runs.index(run) % len(colours)] for run in video.runs]

    def _offer_correction(self, index: int) -> None:
        offered = self._corrections.offer(max(index, 0))
        if offered != self._panel.correct.content:
            self._panel.correct.content = offered

    def _take_news(self, draw: bool) -> None:
        self._indices = sorted({index for run in self._runs for index in run.frames})
        first, last = self._ends()
        panel = self._panel
        panel.slider.min, panel.slider.max = first, max(last, first + 1)
        if any(run.refined for run in self._runs):
            panel.show_causal()
        panel.probability.visible = any((run.folder / layout.PROBABILITIES).is_dir() for run in self._runs)
        offered = tuple(timeline.quantities(self._runs))
        if offered != tuple(panel.quantity.options):
            panel.quantity.options = offered
        if draw:
            self._draw_scene()
            panel.doubts.content = list_doubtful_frames(self._runs)
            panel.about.content = "".join(about(run) for run in self._runs)
        self._redraw_timeline()
        if panel.follow.value and self._indices:
            self.go_to(last)
        elif self._wanted < first:
            self.go_to(first)

    def _draw_scene(self) -> None:
        any_landmarks = False
        for scene in self._scenes:
            scene.draw_again()
        places = first_look.stack_objects([first_look.radius_of(scene.box) for scene in self._scenes])
        for scene, run, place in zip(self._scenes, self._runs, places, strict=True):
            scene.place = np.array([0.0, place, 0.0])
            # From the state of a run that goes on: the final refinement may scale and turn the object.
            points = None if run.refined else landmarks_of_checkpoint(run.folder)
            scene.draw_landmarks(points)
            any_landmarks = any_landmarks or points is not None
        look_from_aside(
            self._server, self._scenes, len(self._videos) > 1
        )  # who is looking already is left where they are
        self._panel.landmarks.visible = any_landmarks
        for video in self._videos:
            video.axes = [axes_of(run) for run in video.runs]

    def _redraw_timeline(self) -> None:
        drawn = timeline.draw_timeline(self._runs, self._panel.quantity.value, *self._ends())
        self._panel.timeline.content = drawn
        self._want()

    def _ends(self) -> tuple[int, int]:
        return (self._indices[0], self._indices[-1]) if self._indices else (0, 1)

    def _nearest(self, index: int) -> int:
        if not self._indices:
            return index
        place = bisect_left(self._indices, index)
        near = self._indices[max(place - 1, 0) : place + 1]
        return min(near, key=lambda one: abs(one - index))

    def _look_through(self) -> None:
        record = self._runs[0].frames.get(self._nearest(self._wanted))
        if record is not None and np.isfinite(record.T_cam_obj).all():
            # The picture, and frusta of frames near by, would stand before the model.
            self._panel.here.value = self._panel.path.value = False
            T_world_cam = np.eye(4) if self._panel.still.value else np.linalg.inv(record.T_cam_obj)
            camera = record.through(self._runs[0].camera)
            look_through(self._server, T_world_cam, camera.fov, camera.width / camera.height)


def _ignoring_the_event(act: Callable[[], None], event: object) -> None:
    act()


def _fits(image: Image, run: FollowedRun) -> bool:
    height, width = image.shape[:2]
    return abs(width / height - run.camera.width / run.camera.height) < 0.01


def look_from_aside(server: viser.ViserServer, scenes: Sequence[ObjectScene], narrow: bool = False) -> None:
    """Where a browser looks from at first: as the cameras saw the objects, but from aside, and so near that
    they fill the view.

    Browsers that are open stay where they are; their button that resets the view takes them there.

    Args:
        server: Serves the browsers.
        scenes: What is to be in view.
        narrow: Whether the panel is wide, since it shows several videos, and leaves a narrow view.
    """
    aside = first_look.aside_of(scenes[0].path)
    places = np.concatenate([scene.place + first_look.corners_of(scene.box) for scene in scenes])
    camera = server.initial_camera
    camera.look_at, distance = first_look.frame_object(
        places, aside, first_look.NARROW if narrow else first_look.ASPECT
    )
    camera.position = camera.look_at + distance * aside
    camera.fov = first_look.FOV


def look_through(
    server: viser.ViserServer, T_world_cam: NDArray[np.floating], fov: float, aspect: float
) -> None:
    """Move every browser's view to a camera, with its whole field of view.

    Args:
        server: Serves the browsers.
        T_world_cam: ``(4, 4)`` from the camera to the scene.
        fov: Its vertical field of view in degrees.
        aspect: Width of its picture through its height.
    """
    rotation = viser.transforms.SO3.from_matrix(T_world_cam[:3, :3])
    for client in server.get_clients().values():
        with client.atomic():
            client.camera.position, client.camera.wxyz = T_world_cam[:3, 3], rotation.wxyz
            wider = max(1.0, aspect / client.camera.aspect)  # what the panels leave may be narrow
            client.camera.fov = float(2 * np.arctan(wider * np.tan(np.radians(fov) / 2)))
