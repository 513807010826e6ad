"""``tracking3d model`` makes the model of a finished run as ``tracking3d run`` made it at its end."""

from __future__ import annotations

from pathlib import Path

import pytest

from tracking3d.results.files import write_image
from tracking3d.testing.synthesis.convex_clips import SyntheticSpec, synthesize

MESH = ("mesh.obj", "mesh.glb", "texture.png", "features.npz")


def mesh_of(run: Path) -> dict[str, bytes]:
    return {name: (run / name).read_bytes() for name in MESH}


@pytest.mark.parametrize(
    ("frames", "size", "step", "is_new"),
    [
        pytest.param(14, (160, 120), 4, True, id="the shape is new", marks=pytest.mark.slow),
        pytest.param(7, (120, 96), 5, False, id="there are too few frames for a new one"),
        pytest.param(5, (120, 96), 2, False, id="the object hardly turns", marks=pytest.mark.slow),
    ],
)
def test_a_finished_run_gets_the_same_mesh_again(call, tmp_path, frames, size, step, is_new):
    clip = synthesize(SyntheticSpec(frames=frames, size=size, supersample=1, degrees_per_frame=step))
    for index, image in enumerate(clip.images):
        (tmp_path / "frames").mkdir(exist_ok=True)
        write_image(tmp_path / "frames" / f"{index:03d}.png", image)
    run, box = tmp_path / "run", ",".join(map(str, clip.box))
    assert (
        call("run", tmp_path / "frames", "--box", box, "--no-report", "--quiet", "--out", run).exit_code == 0
    )
    before = mesh_of(run)
    assert (run / "online").is_dir() is is_new
    if is_new:  # what is made again does not depend on what was there; an online mesh that is final is kept
        for name in MESH:
            (run / name).write_bytes((run / "online" / name).read_bytes())
        assert mesh_of(run) != before
    assert call("model", run, "--quiet").exit_code == 0
    assert mesh_of(run) == before
