"""The tracker for the VOT toolkit's protocols ``trax`` and ``traxpython``.

It is started by ``python -m tracking3d_bench.vot.trax_server``.

Written against vot-trax 4.0.2. Unlike the ``python`` protocol of toolkit 0.9.0 it takes masks as first regions.
"""

from __future__ import annotations

import argparse
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from tracking3d.errors import Tracking3dError
from tracking3d.estimation.estimate import FrameEstimate
from tracking3d.video.image_file import read_image
from tracking3d_bench.vot.regions import prompt_of
from tracking3d_bench.vot.sessions import ObjectSessions, configuration


def main(arguments: list[str] | None = None) -> None:
    """Serve the toolkit until it disconnects; errors are reported to it."""
    parser = argparse.ArgumentParser(prog="python -m tracking3d_bench.vot.trax_server", description=__doc__)
    parser.add_argument("--config", help="a YAML file of the pipeline")
    parser.add_argument("--preset", help="name of a preset; by default that in TRACKING3D_PRESET")
    parser.add_argument("--set", default="", help="section.key=value items with spaces between")
    options = parser.parse_args(arguments)

    from trax import Image, Region, Server, TraxStatus

    formats = [Region.MASK, Region.RECTANGLE, Region.POLYGON]
    with Server(formats, [Image.PATH], tracker_name="tracking3d", multiobject=True) as server:
        try:
            config = configuration(options.config, options.preset, options.set)
            sessions = ObjectSessions(config)
            while (request := server.wait()).type in (TraxStatus.INITIALIZE, TraxStatus.FRAME):
                if request.type == TraxStatus.INITIALIZE:
                    sessions = ObjectSessions(config)
                image = read_image(Path(request.image["color"].path()))
                prompts = [partial(_prompt, region) for region, _ in request.objects or ()]
                server.status([_status(estimate) for estimate in sessions.step(image, prompts)])
        except Tracking3dError as error:
            server.quit(str(error))


def _prompt(region: Any, frame: Any) -> Any:
    from trax import Region

    if region.type == Region.RECTANGLE:
        return prompt_of(tuple(region.bounds()), frame)
    if region.type == Region.POLYGON:
        return prompt_of([tuple(point) for point in region], frame)
    return prompt_of(region.array(), frame, region.offset())


def _status(estimate: FrameEstimate) -> tuple[Any, dict[str, float]]:
    from trax.region import Mask

    mask = np.ascontiguousarray(estimate.mask, dtype=np.uint8)
    return Mask.create(mask), {"confidence": float(estimate.confidence)}


if __name__ == "__main__":
    main()
