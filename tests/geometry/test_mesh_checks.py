"""Meshes that nothing can be computed with are refused in a sentence, wherever one is read."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import trimesh

from tracking3d.errors import InputError
from tracking3d.geometry import mesh_checks
from tracking3d.geometry.mesh_checks import what_is_wrong
from tracking3d.geometry.prototypes import from_file
from tracking3d_bench.datasets.truth import MeshFile
from tracking3d_bench.synthesis.mesh_files import load_solid
from tracking3d_bench.synthesis.spec import SequenceSpec

VERTICES = "v 0 0 0\nv 1 0 0\nv 0 1 0\nv 0 0 1\n"
FACES = "f 1 2 3\nf 1 2 4\nf 1 3 4\nf 2 3 4\n"
BAD = {
    "far": (VERTICES.replace("1 0 0", "1e300 0 0") + FACES, "has a vertex at 1e\\+300, which is too far out"),
    "no number": (VERTICES.replace("1 0 0", "nan 0 0") + FACES, "not finite"),
    "infinite": (VERTICES.replace("1 0 0", "inf 0 0") + FACES, "not finite"),
    "no faces": (VERTICES, ""),
    "a point": (VERTICES.replace("1", "0") + FACES, "all its vertices at one point"),
    "tiny": (VERTICES.replace("1", "1e-300") + FACES, "all its vertices at one point"),
    "out of range": (VERTICES + "f 1 2 9\n", ""),
}
READERS = {
    "prototype": from_file,
    "truth": lambda path: MeshFile(path).read(),
    "synthesis": lambda path: load_solid(path, SequenceSpec()),
}


@pytest.mark.parametrize("reader", READERS)
@pytest.mark.parametrize("fault", BAD)
def test_a_bad_mesh_is_refused_by_its_name(tmp_path, fault, reader):
    text, sentence = BAD[fault]
    file: Path = tmp_path / "mine.obj"
    file.write_text(text)
    with pytest.raises(InputError, match=rf"mine\.obj'? .*{sentence}") as caught:
        READERS[reader](file)
    assert "\n" not in str(caught.value)


def test_a_good_mesh_is_not():
    assert what_is_wrong(trimesh.creation.icosphere(1)) == ""


def test_faces_of_vertices_that_are_not_there_and_too_many_faces_are_wrong(monkeypatch):
    ball = trimesh.creation.icosphere(1)
    beyond = trimesh.Trimesh(ball.vertices, ball.faces, process=False)
    beyond.faces = np.where(ball.faces == 3, 99, ball.faces)
    assert "has faces of vertices that it has not (100 of 42)" in what_is_wrong(beyond)
    monkeypatch.setattr(mesh_checks, "MOST_FACES", 10)
    assert "has 80 faces, and more than 10 are too many" in what_is_wrong(ball)
