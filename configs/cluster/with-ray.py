"""Videos over a Ray cluster from a program of one's own, where `tracking3d batch` does not fit.

    ray job submit --address http://HEAD:8265 --working-dir . -- python with-ray.py videos.csv /data/runs

``videos.csv`` has the columns ``video``, ``box`` (x,y,width,height); the folder of runs is one that all nodes see.
"""

from __future__ import annotations

import csv
import sys
from pathlib import Path

Box = tuple[float, float, float, float]


def track(video: str, box: Box, folder: str) -> str:
    """Track one video; what a lost worker had done is gone on with."""
    from tracking3d.pipeline.record import record
    from tracking3d.video import open_source

    record(open_source(video), None, Path(folder), box=box, resume=True)
    return folder


def read_videos(table: Path) -> list[tuple[str, Box]]:
    """The videos and their boxes, the largest file first: it takes longest and is not to begin last."""
    rows: list[tuple[str, Box]] = []
    with table.open(newline="", encoding="utf-8") as file:
        for row in csv.DictReader(file):
            x, y, width, height = (float(side) for side in row["box"].split(","))
            rows.append((row["video"], (x, y, width, height)))
    return sorted(rows, key=lambda row: Path(row[0]).stat().st_size, reverse=True)


def main(table: str, out: str) -> None:
    """Track all; name those that came to nothing."""
    import ray

    ray.init(address="auto")
    remote = ray.remote(num_cpus=1, memory=2 * 10**9, max_retries=3)(track)
    waiting = {}
    for video, box in read_videos(Path(table)):
        waiting[remote.remote(video, box, str(Path(out) / Path(video).stem))] = video
    failed = 0
    while waiting:
        [done], _ = ray.wait(list(waiting))
        video = waiting.pop(done)
        try:
            print(ray.get(done), flush=True)
        except ray.exceptions.RayError as error:
            failed += 1
            print(f"{video} came to nothing: {error}", file=sys.stderr, flush=True)
    sys.exit(failed > 0)


if __name__ == "__main__":
    main(*sys.argv[1:3])
