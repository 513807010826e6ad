"""Which folder a run may be written into, and what of it is replaced: nothing outside of it, nothing of others."""

from __future__ import annotations

import json
import os
import shutil
from pathlib import Path

import pytest

from tracking3d.errors import OutputError
from tracking3d.results import layout
from tracking3d.results.layout import object_folders
from tracking3d.results.overwrite import check_output_folder, clear_run_folder
from tracking3d.results.run_reader import RunReader


@pytest.fixture
def elsewhere(tmp_path) -> Path:
    """A folder of the user's with a mask in it."""
    folder = tmp_path / "elsewhere"
    folder.mkdir()
    (folder / "000000.png").write_bytes(b"mine")
    return folder


@pytest.fixture(scope="module")
def short(make_turning_sphere):
    """A clip of one frame."""
    return make_turning_sphere(1)


@pytest.fixture(scope="module")
def recorded(short, write_run, tmp_path_factory) -> Path:
    """Its run, written once."""
    folder = tmp_path_factory.mktemp("recorded")
    write_run(folder, short, with_model=False)
    return folder


def link(path: Path, target: Path, folder: bool = True) -> None:
    try:
        path.symlink_to(target, target_is_directory=folder)
    except OSError:
        pytest.skip("this system makes no symbolic links")


@pytest.mark.parametrize(
    "inner", ["masks", "initial_masks", "causal", "prompts", ".state", ".refining", "parts"]
)
def test_overwriting_does_not_follow_a_linked_folder(tmp_path, elsewhere, short, recorded, start_run, inner):
    run = tmp_path / "run"
    shutil.copytree(recorded, run, dirs_exist_ok=True)
    if (run / inner).exists():
        (run / inner).rename(tmp_path / "moved")
    link(run / inner, elsewhere)
    with start_run(run, short, overwrite=True) as writer:
        writer.write(short.estimates[0], short.frames[0])
    assert {path.name: path.read_bytes() for path in elsewhere.iterdir()} == {"000000.png": b"mine"}
    assert not (run / inner).is_symlink()
    assert len(RunReader(run).frames) == 1 and (run / "masks" / "000000.png").is_file()


def test_overwriting_does_not_follow_a_folder_linked_within_another(tmp_path, elsewhere, recorded):
    shutil.copytree(recorded, tmp_path / "run", dirs_exist_ok=True)
    (tmp_path / "run" / "causal").mkdir()
    link(tmp_path / "run" / "causal" / "masks", elsewhere)
    clear_run_folder(tmp_path / "run", overwrite=True)
    assert (elsewhere / "000000.png").read_bytes() == b"mine"


@pytest.mark.parametrize("name", ["frames.jsonl", "run.json", "overlay.mp4", ".run.json.part", "mesh.obj"])
@pytest.mark.parametrize("there", [True, False])
def test_overwriting_does_not_write_through_a_linked_file(tmp_path, short, recorded, start_run, name, there):
    run, mine = tmp_path / "run", tmp_path / "mine"
    shutil.copytree(recorded, run, dirs_exist_ok=True)
    description = (run / "run.json").read_bytes()
    if there:
        mine.write_bytes(description)
    (run / name).unlink(missing_ok=True)
    link(run / name, mine, folder=False)
    if name == "run.json" and not there:
        with pytest.raises(OutputError, match="not a readable run folder"):
            start_run(run, short, overwrite=True)
    else:
        with start_run(run, short, overwrite=True) as writer:
            writer.write(short.estimates[0], short.frames[0])
        assert len(RunReader(run).frames) == 1 and not (run / name).is_symlink()
    assert mine.exists() == there
    assert not there or mine.read_bytes() == description


def test_a_linked_run_folder_itself_is_one(tmp_path, short, recorded, start_run):
    shutil.copytree(recorded, tmp_path / "disk", dirs_exist_ok=True)
    link(tmp_path / "run", tmp_path / "disk")
    start_run(tmp_path / "run", short, overwrite=True).finish(None, "interrupted")
    assert (tmp_path / "run").is_symlink() and RunReader(tmp_path / "disk").frames == []


@pytest.mark.parametrize("overwrite", [False, True])
def test_the_root_of_a_file_system_is_never_written_to(tmp_path, monkeypatch, short, start_run, overwrite):
    root = Path(tmp_path.anchor)
    monkeypatch.chdir(root)
    link(tmp_path / "link", root)
    made = []
    monkeypatch.setattr(Path, "mkdir", lambda self, *given, **named: made.append(self))
    for folder in (root, root / "tmp" / "..", Path(), tmp_path / "link"):
        with pytest.raises(OutputError, match="is the root of a file system; give a folder in it"):
            start_run(folder, short, overwrite=overwrite)
        with pytest.raises(OutputError, match="is the root of a file system"):
            object_folders(folder, 2)
    assert not made and not (root / layout.FRAMES).exists()


@pytest.mark.parametrize(
    "name", ["notes.txt", "photos/cup.jpg", "masks/mine.png", "object_x/a", "index.html"]
)
def test_a_folder_of_other_files_needs_to_be_confirmed(tmp_path, short, start_run, name):
    mine = tmp_path / name
    mine.parent.mkdir(exist_ok=True)
    mine.write_text("mine")
    with pytest.raises(OutputError, match=r"holds .*, which is no part of a run; .* pass overwrite=True"):
        start_run(tmp_path, short)
    assert [path for path in tmp_path.rglob("*") if path.is_file()] == [mine]
    start_run(tmp_path, short, overwrite=True).finish(None, "interrupted")
    assert mine.read_text() == "mine" and RunReader(tmp_path).state == "interrupted"


def test_what_a_run_and_its_surroundings_leave_is_no_obstacle(tmp_path):
    for name in ("masks", "initial_masks", "causal/masks", ".state", "picked", "parts/part_0", "object_0"):
        (tmp_path / name).mkdir(parents=True)
    for name in ("picked/object_0.png", "picked.json", "picked.yaml", ".DS_Store", "Thumbs.db", "index.html"):
        (tmp_path / name).write_text("of a run, or of the system")
    with pytest.raises(OutputError, match="holds causal"):  # with something of an unknown name in it
        (tmp_path / "causal" / "notes.txt").write_text("mine")
        check_output_folder(tmp_path, overwrite=False)
    (tmp_path / "causal" / "notes.txt").unlink()
    (tmp_path / "causal" / "masks").rmdir()
    check_output_folder(tmp_path, overwrite=False)
    check_output_folder(tmp_path / "does not exist", overwrite=False)


def test_an_earlier_run_and_files_next_to_it_are_not_asked_about_twice(tmp_path, recorded):
    shutil.copytree(recorded, tmp_path, dirs_exist_ok=True)
    (tmp_path / "notes.txt").write_text("mine")
    (tmp_path / "export").mkdir()
    check_output_folder(tmp_path, overwrite=False)
    with pytest.raises(OutputError, match="already holds a run"):
        clear_run_folder(tmp_path, overwrite=False)
    assert json.loads((tmp_path / "run.json").read_text())["state"] == "finished"


@pytest.mark.skipif(os.name == "nt", reason="symbolic links that lead in a circle are POSIX")
def test_links_that_lead_in_a_circle_are_one_sentence(tmp_path, short, start_run):
    link(tmp_path / "a", tmp_path / "b")
    link(tmp_path / "b", tmp_path / "a")
    with pytest.raises(OutputError, match="choose another folder"):
        start_run(tmp_path / "a", short)
