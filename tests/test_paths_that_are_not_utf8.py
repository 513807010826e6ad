"""Names of files that are not UTF-8: native code that would end the process never gets them as text."""

from __future__ import annotations

import json
import os
import sys

import pytest
from forked import forked_script

pytestmark = pytest.mark.skipif(sys.platform != "linux", reason="only Linux has names that are no text")

NAME = os.fsdecode(b"caf\xe9")  # as a camera with Latin-1 names writes it

DRAWN = """
import sys
import numpy as np
from tracking3d.results import drawing
image = np.zeros((40, 900, 3), np.uint8)
text = f"{sys.argv[1]}.mp4 cannot be read"
assert drawing.text_width(text, 12) == drawing.text_width("caf?.mp4 cannot be read", 12)
assert drawing.shorten(text, 12, 100).startswith("caf")
drawing.draw_text(image, text, 0, 30, 12, drawing.INK)
print(image.any())
"""

DEPTH = """
import sys
from pathlib import Path
import cv2, numpy as np
from tracking3d_bench.datasets.truth import DepthFile
from tracking3d.errors import InputError
file = Path(sys.argv[1])
for content in (cv2.imencode(".png", np.full((3, 4), 500, np.uint16))[1].tobytes(), b"", b"no image"):
    file.write_bytes(content)
    try:
        print(DepthFile(file, 0.01).read().max())
    except InputError as error:
        print("refused")
file.unlink()
try:
    DepthFile(file, 0.01).read()
except InputError as error:
    print("refused")
"""

BOX_NETWORK = """
import sys
from pathlib import Path
from tracking3d.errors import InputError
from tracking3d.trackers.onnx.boxes import vit_boxes
file = Path(sys.argv[1])
file.write_bytes(b"no network")
try:
    vit_boxes(file)
except InputError as error:
    print("refused")
"""


@pytest.mark.parametrize(
    ("script", "printed"),
    [
        (DRAWN, ["True"]),
        (DEPTH, ["5.0", "refused", "refused", "refused"]),
        (BOX_NETWORK, ["refused"]),
    ],
    ids=["text in a picture", "depth image", "network of OpenCV"],
)
def test_opencv_gets_no_text_that_ends_the_process(tmp_path, monkeypatch, script, printed):
    monkeypatch.chdir(tmp_path)
    ended = forked_script(tmp_path, script, NAME)
    assert (ended.returncode, ended.stdout.splitlines()) == (0, printed), ended.stderr


FAILING = """
import sys
from pathlib import Path
from recorded_runs import estimate_of, frame_of, model, open_run
from dataclasses import replace
from tracking3d.estimation.estimate import Status
with open_run(Path("run")) as writer:
    for index in range(3):
        estimate = estimate_of(index)
        if index == 1:
            estimate = replace(estimate, status=Status.LOST, reason=f"ValueError: no such file: {sys.argv[1]}")
        writer.write(estimate, frame_of(index))
    writer.finish(model(), "finished")
from tracking3d.ui.report.several import write_reports
write_reports([Path("run")])
"""


def test_a_reason_that_quotes_such_a_path_reaches_every_file_of_a_run(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    ended = forked_script(tmp_path, FAILING, NAME)
    assert ended.returncode == 0, ended.stderr
    assert (tmp_path / "run/overlay.mp4").stat().st_size
    for file in ("run.json", "frames.jsonl", "report.html"):
        (tmp_path / "run" / file).read_bytes().decode("utf-8")
    lines = (tmp_path / "run/frames.jsonl").read_text().splitlines()
    assert any(NAME in json.loads(line)["reason"] for line in lines)
