"""Corrections from the viewer: pages to draw on, and the process that computes.

The process is our own program with a folder that the viewer was opened on; all that comes from the network is what was
drawn, as numbers that were checked.
"""

from __future__ import annotations

import html
import sys
import tempfile
import threading
from collections.abc import Sequence
from functools import partial
from pathlib import Path
from subprocess import DEVNULL, Popen, TimeoutExpired
from typing import IO

from pydantic import ValidationError

from tracking3d.config.models import PipelineConfig
from tracking3d.errors import InputError, Tracking3dError
from tracking3d.results import layout
from tracking3d.results.files import write_mask
from tracking3d.ui.picker.correction import CorrectionPage, DrawnCorrection
from tracking3d.ui.picker.server import PageProgress
from tracking3d.ui.picker.session import PickingSession
from tracking3d.ui.viewer.followed_run import FollowedRun
from tracking3d.ui.web.access import Access
from tracking3d.video import parse_selection
from tracking3d.video.any_frame import FrameImages
from tracking3d.video.source import within

PORT = 8100
"""Where the first page listens, or the next port that is free."""
_PATIENCE = 20.0  # seconds for a process to write what it has when it is stopped


class RunCorrection:
    """One run that can be corrected.

    Args:
        run: The run.
        images: Its frames.
        source: The video, if it is not where the run found it.
        access: Where the page listens, and whom it serves.
    """

    def __init__(
        self, run: FollowedRun, images: FrameImages | None, source: str | None, access: Access
    ) -> None:
        self.run, self._images, self._source, self._access = run, images, source, access
        self._page: CorrectionPage | None = None
        self._process: Popen[bytes] | None = None
        self._errors: IO[bytes] | None = None
        self._frame = 0
        self._ended = PageProgress()
        self._busy = threading.RLock()

    @property
    def why_not(self) -> str:
        """Why the run cannot be corrected here, in a sentence; empty if it can."""
        run, prompt = self.run, self.run.description.get("prompt")
        if run.going_on:
            return "The run is not finished; it can be corrected afterwards."
        if self._images is None:
            return "The video of the run was not found; open the viewer with --source."
        if not isinstance(prompt, dict) or "first_frame" not in prompt:
            return "The run.json of the run names no prompt; run the video again."
        if not getattr(self._images, "repeatable", True):
            return "The run is from a camera, whose frames were not stored."
        tracker = run.description.get("config", {}).get("tracker")
        if isinstance(tracker, dict) and tracker.get("name") == "precomputed":
            return "The masks of the run are precomputed; replace the wrong mask there."
        return ""

    def why_not_frame(self, index: int) -> str:
        """Why this frame of a run that can be corrected cannot be, in a sentence; empty if it can."""
        if index not in self.run.frames:
            return f"The run has no estimate for frame {index}."
        if index == self.run.description["prompt"]["first_frame"]:
            return f"The object was given in frame {index}; correct another frame, or run again with a better prompt."
        return ""

    def port(self) -> int:
        """Where its page is served, from the first call on.

        Raises:
            Tracking3dError: If it cannot be.
        """
        if self._page is None:
            assert self._images is not None
            frames = sorted(self.run.frames)
            selection = self.run.description.get("selection")
            try:
                config = PipelineConfig.model_validate(self.run.description["config"])
            except (KeyError, ValidationError) as error:
                raise InputError("The settings of the run are from another version of tracking3d.") from error
            indices = within(parse_selection(selection), frames[-1] + 1) if frames else range(1)
            session = PickingSession(self.run.name, self._images, indices, config)
            self._page = CorrectionPage(
                session,
                self.run.name,
                partial(self.run.mask, kind="refined"),
                self.begin,
                self.progress,
                self._access,
                PORT,
            )
        return self._page.port

    def begin(self, drawn: DrawnCorrection) -> None:
        """Correct the run by what was drawn, in a process of its own.

        Raises:
            InputError: If that cannot be done, or one goes on.
            OutputError: If the mask cannot be written.
        """
        with self._busy:
            if self.why_not:
                raise InputError(self.why_not)
            if self.progress().running:
                raise InputError("A correction is in progress; wait for it to finish.")
            if why := self.why_not_frame(drawn.frame):
                raise InputError(why)
            if drawn.mask is not None:
                what = str(self.run.folder.resolve() / layout.DRAWN)
                write_mask(Path(what), drawn.mask)
            else:
                what = ",".join(f"{side:g}" for side in drawn.box or ())
            command = [sys.executable, "-m", "tracking3d", "correct", str(self.run.folder.resolve())]
            command += [f"{drawn.frame}:{what}", "--quiet"]
            command += ["--source", self._source] if self._source else []
            self._errors = tempfile.TemporaryFile()  # noqa: SIM115 (until the process has ended)
            self._frame = drawn.frame
            self._process = Popen(command, stdin=DEVNULL, stdout=DEVNULL, stderr=self._errors)

    def progress(self) -> PageProgress:
        """How far it is."""
        with self._busy:
            if self._process is not None and self._process.poll() is not None:
                self._ended = self._end(self._process.returncode)
                self._process = None
            if self._process is None:
                return self._ended
        stage, total = self.run.folder / layout.CORRECTING, max(len(self.run.frames), 1)
        done, again = (
            min(_lines_in(path), total)
            for path in (stage / layout.FRAMES, stage / layout.REFINING / layout.FRAMES)
        )
        if not done:
            return PageProgress(True, f"Correcting frame {self._frame}: starting …")
        progress = f"{again} of {total} refined" if again else f"{done} of {total} frames estimated"
        share = (done + again) / (2 * total if self.run.refined else total)
        return PageProgress(True, f"Correcting frame {self._frame}: {progress}.", share=min(share, 1.0))

    def close(self) -> None:
        """Stop serving; a correction that goes on is stopped, and can go on by the command."""
        if self._page is not None:
            self._page.close()
        if self._process is not None and self._process.poll() is None:
            self._process.terminate()
            try:
                self._process.wait(_PATIENCE)
            except TimeoutExpired:
                self._process.kill()
                self._process.wait()
        with self._busy:
            self.progress()  # lets go of what belongs to a process that has ended

    def _end(self, code: int) -> PageProgress:
        assert self._errors is not None
        self._errors.seek(0)
        lines = self._errors.read(1 << 16).decode("utf-8", "replace").splitlines()
        self._errors.close()
        (self.run.folder / layout.DRAWN).unlink(missing_ok=True)
        if code == 0:
            return PageProgress(sentence=f"Frame {self._frame} is corrected.")
        message = next(
            (line for line in lines if line.startswith("error: ")), "error: the correction was stopped."
        )
        return PageProgress(
            sentence=f"The correction failed and the run is unchanged: {message.removeprefix('error: ')}",
            failed=True,
        )


def _lines_in(path: Path) -> int:
    """The number of lines of a file; 0 if it does not exist."""
    try:
        return path.read_bytes().count(b"\n")
    except OSError:
        return 0


class Corrections:
    """Those of all runs that are shown.

    Args:
        each: The runs.
        access: Whom their pages serve.
    """

    def __init__(self, each: Sequence[RunCorrection], access: Access) -> None:
        self._each, self._access = each, access

    def offer(self, index: int) -> str:
        """Links to correct a frame of each run and the progress of corrections, as HTML."""
        return (
            '<div style="font-size:12px;line-height:1.5;margin:4px 12px"><p>If the tracker follows the wrong thing, '
            "mark the object in that frame. All frames that depend on it are then re-estimated. "
            "The run stays unchanged until that is done.</p>"
            f"{''.join(self._offer(one, index) for one in self._each)}</div>"
        )

    def close(self) -> None:
        """Stop all of it."""
        for one in self._each:
            one.close()

    def _offer(self, one: RunCorrection, index: int) -> str:
        name = f"<b>{html.escape(one.run.name)}</b>: " if len(self._each) > 1 else ""
        now = one.progress()
        note = f"<br>{html.escape(now.sentence)}" if now.sentence else ""
        if now.running:
            share = "" if now.share is None else f' value="{now.share:.3f}"'
            bar = f'<progress max="1"{share} style="width:100%"></progress>'
            return f"<p>{name}{html.escape(now.sentence)}<br>{bar}</p>"
        if why := one.why_not or one.why_not_frame(index):
            return f"<p>{name}{html.escape(why)}{note}</p>"
        try:
            port = one.port()
        except Tracking3dError as error:
            return f"<p>{name}{html.escape(str(error))}{note}</p>"
        address = f"{self._access.address(port)}#frame={index}"
        # The browser may know this machine by another name than the address that was printed.
        here = "this.href=this.href.replace(/\\/\\/[^/]*:/, '//'+location.hostname+':')"
        return (
            f'<p>{name}<a class="correct" target="_blank" rel="noopener" href="{html.escape(address)}" '
            f'onclick="{html.escape(here)}" style="color:inherit;font-weight:600">Correct frame {index} …</a>{note}</p>'
        )
