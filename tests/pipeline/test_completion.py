"""A finished run that was killed before its final shape gets it when it is resumed."""

from __future__ import annotations

import json
from pathlib import Path
from types import SimpleNamespace

import pytest
from scipy.spatial.transform import Rotation

from tracking3d.config.models import PipelineConfig
from tracking3d.estimation.estimate import Status
from tracking3d.pipeline import record
from tracking3d.results import layout
from tracking3d.results.run_writer import PICTURES

VIDEO = SimpleNamespace(name="a video", repeatable=True)


@pytest.fixture
def made(monkeypatch) -> list[Path]:
    """The folders whose shape is made; their frames turn by 44 degrees."""
    folders: list[Path] = []
    poses = [Rotation.from_euler("y", 4 * n, degrees=True).as_matrix() for n in range(12)]
    frames = [
        SimpleNamespace(T_cam_obj=R, refined=True, status=Status.TRACKED, free_axis=None) for R in poses
    ]
    monkeypatch.setattr(
        record,
        "RunReader",
        lambda folder: SimpleNamespace(
            frames=frames, description=json.loads((folder / layout.RUN).read_text())
        ),
    )
    monkeypatch.setattr(record, "make_final_shape", lambda folder, *_: folders.append(folder))
    return folders


@pytest.mark.parametrize(
    ("shape", "notes", "again"),
    [
        ("auto", {}, True),
        ("auto", {"shape": "It is better."}, False),
        ("fine", {}, True),
        ("fast", {}, False),
    ],
)
def test_a_shape_that_was_not_made_is_made(tmp_path, made, shape, notes, again):
    for name in (*layout.MESH_FILES, *PICTURES):
        (tmp_path / name).write_bytes(b"there")
    (tmp_path / layout.RUN).write_text(json.dumps({"state": "finished", **notes}))
    config = PipelineConfig.model_validate({"object": {"shape": shape}})
    record.complete_run(tmp_path, config, VIDEO)
    assert made == ([tmp_path] if again else [])
