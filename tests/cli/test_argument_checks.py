"""A mistake in the arguments is answered at once: nothing that is slow to import, such as torch, is imported before."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import argument_checks
import numpy as np
import pytest
from PIL import Image
from recorded_runs import write_run

from tracking3d.geometry.camera import Camera
from tracking3d.testing.synthesis.convex_clips import write_clip

BOX = "run clip --box 1,2,20,20 "
MISTAKES = (
    "run clip --box 1,2,3",
    "run clip --box a,b,c,d",
    "run clip --box 1,2,-3,4",
    "run clip --box 1,2,3,4 --box-format xywy",
    "run clip --box 1,2,3,4 --mask mask.png",
    "run clip --mask absent.png",
    "run clip --masks absent",
    "run clip --points 3,4",
    "run clip --points 3,4-",
    "run clip --object absent",
    "run clip",
    "run absent --box 1,2,3,4",
    "run ftp://host/clip.mp4 --box 1,2,3,4",
    BOX + "--frames 9:1",
    BOX + "--fps 0",
    BOX + "--start-frame -1",
    BOX + "--correct 3",
    BOX + "--correct x:1,2,3,4",
    BOX + "--tracker edgetam",
    BOX + "--features sift",
    BOX + "--preset absent",
    BOX + "--quality worst",
    BOX + "--config absent.yaml",
    BOX + "--set solver.nothing=1",
    BOX + "--set window.size=0",
    BOX + "--fov 0",
    BOX + "--distortion fish:1,2,3,4",
    BOX + "--camera absent.yaml",
    BOX + "--intrinsics 1,2",
    BOX + "--prototype absent.obj",
    BOX + "--workers 2",
    BOX + "--split x",
    BOX + "--model finest",
    BOX + "--overwrite --resume",
    BOX + "--no-such-option",
    "pick absent",
    "pick clip --tracker edgetam",
    "pick clip --preset absent",
    "view absent",
    "correct run 3",
    "correct run 1:1,2,3",
    "correct absent 1:1,2,3,4",
    "correct run 1:1,2,3,4 --box-format xywy",
    "points absent --frame 0 --xy 3,4",
    "points run --frame 0 --xy 3",
    "points run --frame 0",
    "points run --frame 0 --xy 3,4 --csv absent/points.csv",
    "model absent",
    "export absent --to tum",
    "export run --to usd",
    "export run --to gltf",
    "export run --to tum --xy 3,4",
    "export run --to tum --xy 3",
    "export run",
    "report absent",
    "compare absent run",
    "batch absent --out runs",
    "batch clips.csv --out runs --sequence a",
    "batch clips.csv --out runs --tracker edgetam",
    "batch clips.csv --out runs --split x",
    "batch clips.csv --out runs --box-format xywy",
    "batch twice.csv --out runs",
    "batch status absent",
    "calibrate absent",
    "calibrate clip --board absent",
    "calibrate clip --squares 3",
    "calibrate board --out board.txt",
    "evaluate run --truth absent",
    "evaluate absent --truth truth",
    "evaluate run --truth truth --option raster",
    "evaluate peer absent run --truth truth",
    "evaluate suite absent --out scores",
    "evaluate suite real --masks absent --out scores",
    "evaluate suite real --preset absent --out scores",
    "evaluate table absent --out scores",
    "evaluate compare absent.json absent.json",
    "evaluate spread absent --out scores",
    "evaluate model absent",
    "models get absent",
    "models get u2netp --mirror http://[",
    "models verify absent",
    "plugins new 1x",
    "plugins new mine --kind absent",
    "config show --preset absent",
    "config show --tracker edgetam",
    "config path absent",
    "config validate absent.yaml",
    "synth --out made --disturb noise",
    "synth --out made --size 1",
    "synth --out made --suite absent",
    "demo --size 1",
    "bench live absent",
    "bench masks absent",
    "bench track absent",
)


@pytest.fixture(scope="module")
def ends(tmp_path_factory: pytest.TempPathFactory) -> dict[str, dict]:
    """How the command lines end."""
    folder = tmp_path_factory.mktemp("mistakes")
    (folder / "clip").mkdir()
    for index in range(2):
        Image.fromarray(np.zeros((48, 64, 3), np.uint8)).save(folder / "clip" / f"{index}.png")
    Image.fromarray(np.full((48, 64), 255, np.uint8)).save(folder / "mask.png")
    images, masks = [np.zeros((48, 64, 3), np.uint8)] * 2, [np.ones((48, 64), bool)] * 2
    write_clip(
        folder / "truth", images, masks, [np.eye(4)] * 2, Camera.from_fov(64, 48), source="a test", note=""
    )
    write_run(folder / "run", 2)
    (folder / "clips.csv").write_text('video,box\nclip,"1,2,20,20"\n')
    (folder / "twice.csv").write_text('video,box,box\nclip,"1,2,20,20",\n')
    done = subprocess.run(
        [sys.executable, Path(argument_checks.__file__)],
        input=json.dumps([line.split() for line in MISTAKES]),
        cwd=folder,
        capture_output=True,
        text=True,
        check=True,
    )
    return dict(zip(MISTAKES, json.loads(done.stdout), strict=True))


@pytest.mark.parametrize("line", MISTAKES)
def test_a_mistake_is_refused_before_anything_slow_is_imported(ends, line):
    end = ends[line]
    assert end["imported"] == []
    assert end["code"] == 2, end["said"]
    assert end["said"].startswith("error: ")
