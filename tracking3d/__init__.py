"""Track a rigid object in an ordinary RGB video: masks, 6DoF poses, a textured mesh, point correspondences.

Conventions: OpenCV camera axes (x right, y down, z forward); pixel (0, 0) is the centre of the top-left pixel;
``T_cam_obj`` maps object to camera coordinates; the scale is arbitrary.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from tracking3d.runtime.deferred_import import import_on_use
from tracking3d.runtime.moved_modules import find_moved_modules

__version__ = "0.1.0"

__all__ = [
    "Frame",
    "FrameEstimate",
    "ObjectModel",
    "PipelineConfig",
    "Prompt",
    "Session",
    "StageProgress",
    "Status",
    "Tracking",
    "TrackingResult",
    "__version__",
    "export_run",
    "listen_to_progress",
    "load_config",
    "track",
    "track_objects",
]

if TYPE_CHECKING:
    from tracking3d.config.loading import load_config
    from tracking3d.config.models import PipelineConfig
    from tracking3d.estimation.estimate import FrameEstimate, ObjectModel, Status
    from tracking3d.export.exporting import export_run
    from tracking3d.frames import Frame, Prompt
    from tracking3d.pipeline.result import TrackingResult
    from tracking3d.pipeline.track import Session, track, track_objects
    from tracking3d.pipeline.tracking import Tracking
    from tracking3d.runtime.progress import StageProgress, listen_to_progress

_HOME = {
    "Frame": "tracking3d.frames",
    "FrameEstimate": "tracking3d.estimation.estimate",
    "ObjectModel": "tracking3d.estimation.estimate",
    "PipelineConfig": "tracking3d.config.models",
    "Prompt": "tracking3d.frames",
    "Session": "tracking3d.pipeline.track",
    "StageProgress": "tracking3d.runtime.progress",
    "Status": "tracking3d.estimation.estimate",
    "Tracking": "tracking3d.pipeline.tracking",
    "TrackingResult": "tracking3d.pipeline.result",
    "export_run": "tracking3d.export.exporting",
    "listen_to_progress": "tracking3d.runtime.progress",
    "load_config": "tracking3d.config.loading",
    "track": "tracking3d.pipeline.track",
    "track_objects": "tracking3d.pipeline.track",
}


# `tracking3d --help` need not wait for torch.
__getattr__ = import_on_use(__name__, _HOME)

find_moved_modules()
