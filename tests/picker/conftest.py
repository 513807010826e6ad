"""A picker of a folder of pictures, whose tracker takes what it is given."""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import pytest

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))  # recorded_runs, raw_requests, browser

from recorded_runs import write_frames

from tracking3d.cli.options import configure as configured
from tracking3d.config.loading import load_config
from tracking3d.frames import MaskEstimate
from tracking3d.ui.picker import session as session_module
from tracking3d.ui.picker.correction import command_of, save_outcome, settings_as_yaml
from tracking3d.ui.picker.server import Picker
from tracking3d.ui.picker.session import ChosenSettings, PickingSession, SettingsMenu
from tracking3d.ui.web.access import Access
from tracking3d.video import open_source
from tracking3d.video.any_frame import frame_images


class TakesWhatItIsGiven:
    def init(self, frame, prompt):
        mask = np.zeros(frame.size, np.float32) if prompt.mask is None else prompt.mask.astype(np.float32)
        if prompt.mask is None:
            x, y, width, height = (round(side) for side in prompt.box)
            mask[y : y + height, x : x + width] = 1
        return MaskEstimate(mask)


@pytest.fixture
def session(tmp_path, monkeypatch) -> PickingSession:
    monkeypatch.setattr(session_module, "build_plugin", lambda group, choice: TakesWhatItIsGiven())
    source = str(write_frames(tmp_path / "clip", 6))
    return PickingSession(source, frame_images(open_source(source)), range(0, 6), load_config())


@pytest.fixture
def picker(session, tmp_path):
    folder = tmp_path / "out"

    def save(picked):
        save_outcome(picked, session.config, folder, session.source)
        return command_of(picked, folder, session.source, None), settings_as_yaml(session.config)

    picker = Picker(session, save, Access(), 0)
    yield picker
    picker.close()


@pytest.fixture
def menu() -> SettingsMenu:
    """The settings of a page whose command line said ``--quality draft``."""

    def configure(chosen: ChosenSettings):
        given = {
            "tracker": {"name": chosen.tracker},
            "features": chosen.features,
            "camera": {"fov": chosen.fov},
        }
        return configured(None, None, None, chosen.quality, chosen.model, **given)

    return SettingsMenu(ChosenSettings(quality="draft"), configure)


@pytest.fixture
def picker_with_settings(session, picker, menu) -> Picker:
    """A picker whose page offers settings."""
    session.config, session.menu = menu.configure(menu.chosen), menu
    return picker
