"""Trees of dataclasses and arrays: what comes back is what was kept, and each array is written once."""

from __future__ import annotations

import json
import math
from dataclasses import dataclass, fields, is_dataclass, replace
from enum import StrEnum
from typing import Any

import numpy as np
import pytest
import torch
from large_arrays import memory_stays_below, write_zeros

from tracking3d import Frame, Session, load_config
from tracking3d.errors import InputError
from tracking3d.frames import SkippedFrame
from tracking3d.results import layout
from tracking3d.results.checkpoint import serialization
from tracking3d.results.checkpoint.folder import Checkpoint
from tracking3d.results.checkpoint.progress import JournalEntry, RunProgress, checksum
from tracking3d.results.checkpoint.serialization import INLINE, NotSerializableError, TreeFolder
from tracking3d.testing.synthesis.convex_clips import SyntheticSpec, synthesize
from tracking3d.trackers.prompts.prompt import make_prompt


class Colour(StrEnum):
    RED = "red"


@dataclass(frozen=True, eq=False)
class Leaf:
    values: Any
    colour: Colour = Colour.RED


@dataclass(frozen=True, eq=False)
class Branch:
    leaves: tuple[Leaf, ...]
    about: Any = None


CLASSES = (Leaf, Branch, Colour)
LARGE = np.random.default_rng(0).random((40, 30)).astype(np.float32)


def again(folder, tree: Any) -> Any:
    """As another process finds it."""
    return TreeFolder(folder, CLASSES).read(json.loads(TreeFolder(folder, CLASSES).text(tree)))


def files(folder) -> list[str]:
    return sorted(path.name for path in folder.glob("*.npz"))


def assert_same(mine: Any, other: Any, where: str = "") -> None:
    """The same types, shapes, layouts and bits."""
    if is_dataclass(other):
        assert type(mine) is type(other), where
        for one in fields(other):
            assert_same(getattr(mine, one.name), getattr(other, one.name), f"{where}.{one.name}")
    elif isinstance(other, torch.Tensor) and other.layout == torch.sparse_coo:
        assert mine.is_coalesced() and torch.equal(mine.to_dense(), other.to_dense()), where
    elif isinstance(other, torch.Tensor):
        assert (mine.dtype, mine.shape) == (other.dtype, other.shape), where
        order = [sorted(range(one.ndim), key=one.stride().__getitem__) for one in (mine, other)]
        assert order[0] == order[1] or min(other.shape) == 1, where
        assert_same(mine.numpy(), other.numpy(), where)
    elif isinstance(other, np.ndarray):
        assert (mine.dtype, mine.shape) == (other.dtype, other.shape), where
        assert mine.tobytes() == other.tobytes(), where
    elif isinstance(other, dict):
        assert list(mine) == list(other), where
        for key in other:
            assert_same(mine[key], other[key], f"{where}.{key}")
    elif isinstance(other, tuple | list):
        assert type(mine) is type(other) and len(mine) == len(other), where
        for number, (one, another) in enumerate(zip(mine, other, strict=True)):
            assert_same(one, another, f"{where}[{number}]")
    else:
        assert type(mine) is type(other), where
        assert mine == other or (math.isnan(mine) and math.isnan(other)), where


@pytest.mark.parametrize(
    "value",
    [
        None,
        True,
        -3,
        0.1,
        math.nan,
        -math.inf,
        'a "text" with ünicode',
        Colour.RED,
        (1, [2, (3,)], ()),
        {"a": 1, 7: (2.5,)},
        np.arange(6, dtype=np.int64).reshape(2, 3),
        np.array([np.nan, -0.0, np.inf], np.float32),
        np.zeros((0, 2), np.float32),
        np.array(3.5),
        LARGE,
        LARGE > 0.5,
        (LARGE > 0.5).astype(np.float32),
        -np.zeros((40, 30), np.float32),
        LARGE.T,
        torch.tensor([1.0, 2.0]),
        torch.tensor(LARGE),
        torch.tensor(LARGE).T,
        torch.rand(3, 20, 21).permute(1, 2, 0).contiguous().permute(2, 0, 1),
        torch.eye(40).to_sparse_coo().coalesce(),
        Branch((Leaf(LARGE), Leaf(torch.tensor(LARGE), Colour.RED)), {"x": (Leaf(1),)}),
    ],
    ids=lambda value: type(value).__name__,
)
def test_what_comes_back_is_what_was_kept(tmp_path, value):
    expected = np.ascontiguousarray(value) if isinstance(value, np.ndarray) and value.ndim else value
    assert_same(again(tmp_path, value), expected)


def test_the_same_array_comes_back_as_the_same_array(tmp_path):
    one, other = again(tmp_path, (LARGE, LARGE.copy(), LARGE))[::2]
    assert one is other
    assert len(files(tmp_path)) == 2


def test_what_has_not_changed_is_not_written_again(tmp_path):
    kept = TreeFolder(tmp_path, CLASSES)
    old, new = Leaf(LARGE), Leaf(LARGE + 1)
    kept.text(Branch((old,)))
    kept.tidy()
    first = files(tmp_path)
    kept.text(Branch((old, new)))
    kept.tidy()
    assert first < files(tmp_path) and len(files(tmp_path)) == 2
    kept.text(Branch((replace(new),)))
    kept.tidy()
    assert files(tmp_path) == files(tmp_path)[-1:] != first, "what nobody names any more is gone"


def test_after_reading_only_what_is_new_is_written(tmp_path):
    text = TreeFolder(tmp_path, CLASSES).text(Branch((Leaf(LARGE), Leaf(torch.tensor(LARGE)))))
    later = TreeFolder(tmp_path, CLASSES)
    tree = later.read(json.loads(text))
    before = files(tmp_path)
    later.text(replace(tree, about=1))
    assert files(tmp_path) == before


def test_strangers_are_removed_and_never_taken_for_ones_own(tmp_path):
    text = TreeFolder(tmp_path, CLASSES).text(LARGE)
    (tmp_path / "00000001.npz").write_bytes(b"half of an array")
    later = TreeFolder(tmp_path, CLASSES)
    assert_same(later.read(json.loads(text)), LARGE)
    later.remove_orphans()
    assert files(tmp_path) == ["00000000.npz"]


def test_small_arrays_have_no_file(tmp_path):
    TreeFolder(tmp_path, CLASSES).text(Leaf(np.zeros(INLINE // 8 - 1)))
    assert not files(tmp_path)


@pytest.mark.parametrize("value", [object(), {1, 2}, np.array([object()]), RunProgress(), Leaf])
def test_what_nobody_has_named_is_refused(tmp_path, value):
    with pytest.raises(NotSerializableError):
        TreeFolder(tmp_path, CLASSES).text(value)


@pytest.mark.parametrize(
    "node",
    [
        {"class": "Path", "fields": {}},
        {"class": "Leaf", "fields": {"nonsense": 1}},
        {"enum": "Colour", "value": "blue"},
        {"array": "<f4", "shape": [3], "file": "00000009.npz"},
        {"array": "|O", "shape": [1], "data": "AAAAAAAAAAA="},
        {"nothing": "known"},
    ],
)
def test_what_was_tampered_with_is_no_tree(tmp_path, node):
    with pytest.raises(ValueError):
        TreeFolder(tmp_path, CLASSES).read(node)


@pytest.mark.parametrize("kind", ["array", "sparse"])
@pytest.mark.parametrize(
    "name", ["../00000000.npz", "/etc/00000000.npz", "notes.npz", "link", 7, None, ["00000000.npz"]]
)
def test_only_arrays_of_the_state_are_read_and_none_is_removed_elsewhere(tmp_path, name, kind):
    inner = tmp_path / ".state"
    inner.mkdir()
    np.savez(tmp_path / "00000000.npz", array=LARGE, index=np.zeros((1, 1), int), value=np.zeros(1))
    (inner / "00000007.npz").symlink_to(tmp_path / "00000000.npz")
    place = "00000007.npz" if name == "link" else name
    node = {
        "array": {"array": "<f4", "shape": [40, 30], "file": place},
        "sparse": {"sparse": {"file": place}, "size": [3]},
    }
    folder = TreeFolder(inner, CLASSES)
    with pytest.raises(ValueError, match="no file of this state"):
        folder.read(node[kind])
    folder.tidy()
    assert (tmp_path / "00000000.npz").is_file()


@pytest.mark.parametrize(("name", "count"), [("array", 2**27), ("bits", 2**30), ("bits", 2**22)])
def test_the_arrays_of_a_tree_take_little_more_than_their_files(tmp_path, monkeypatch, name, count):
    monkeypatch.setattr(serialization, "MOST_COMPRESSED", 2**20)
    write_zeros(tmp_path / "00000000.npz", **{name: (count // 8 if name == "bits" else count,)})
    with memory_stays_below(2**22), pytest.raises(ValueError, match="more memory than those of a state"):
        TreeFolder(tmp_path, CLASSES).read({"array": "|u1", "shape": [count], "file": "00000000.npz"})


def test_many_small_files_of_large_arrays_are_counted_together(tmp_path, monkeypatch):
    monkeypatch.setattr(serialization, "MOST_COMPRESSED", 2**20)
    nodes = []
    for number in range(4):
        write_zeros(tmp_path / f"{number:08d}.npz", array=(2**19,))
        nodes.append({"array": "|u1", "shape": [2**19], "file": f"{number:08d}.npz"})
    assert len(TreeFolder(tmp_path, CLASSES).read(nodes[:2])) == 2
    with pytest.raises(ValueError, match="more memory than those of a state"):
        TreeFolder(tmp_path, CLASSES).read(nodes)


@pytest.mark.parametrize("value", [LARGE, np.zeros((64, 80)), np.zeros((300, 400), bool)])
def test_compressed_arrays_as_earlier_versions_wrote_them_come_back(tmp_path, value):
    text = TreeFolder(tmp_path, CLASSES).text(value)
    path = tmp_path / "00000000.npz"
    with np.load(path) as arrays:
        np.savez_compressed(path, **dict(arrays))
    assert_same(TreeFolder(tmp_path, CLASSES).read(json.loads(text)), value)


@pytest.mark.parametrize("shape", [[10**12], [-5], [2**40, 2**40]])
def test_bits_are_as_many_as_the_state_says(tmp_path, shape):
    np.savez(tmp_path / "00000000.npz", bits=np.zeros(9, np.uint8))
    with pytest.raises(ValueError, match="another array than was saved"):
        TreeFolder(tmp_path, CLASSES).read({"array": "|b1", "shape": shape, "file": "00000000.npz"})


def test_a_damaged_array_is_told(tmp_path):
    text = TreeFolder(tmp_path, CLASSES).text(LARGE)
    path = tmp_path / "00000000.npz"
    path.write_bytes(path.read_bytes()[:2000])
    with pytest.raises(ValueError):
        TreeFolder(tmp_path, CLASSES).read(json.loads(text))


@pytest.mark.slow
@pytest.mark.parametrize(("preset", "frames"), [("default", 7), ("rerendering", 3)])
def test_in_every_frame_what_is_kept_is_the_solvers_state(tmp_path, preset, frames):
    clip = synthesize(SyntheticSpec(frames=frames, size=(96, 72), supersample=1, degrees_per_frame=5))
    config = load_config(
        preset=preset,
        overrides=[
            "crop.size=32",
            "object.frequency=2",
            "object.texture_size=32",
            "camera.fov=45",
            "tracker.name=flow",
        ],
    )
    first = Frame(0, clip.images[0])
    session = Session(config, make_prompt(first, mask=clip.masks[0]))
    checkpoint = Checkpoint(tmp_path, session.state_classes)
    for index, image in enumerate(clip.images):
        session.step(Frame(index, image))
        taken = JournalEntry(index, checksum(image), 0.5, "so", True, "")
        checkpoint.note(taken)
        checkpoint.save(RunProgress(last=index, lines=10 * index), session.state_dict())
        kept = Checkpoint(tmp_path, session.state_classes).read()
        assert_same(kept.session, session.state_dict())
        assert (kept.progress.last, kept.progress.lines, kept.taken[index]) == (index, 10 * index, taken)
    named = set(files(tmp_path / layout.STATE))
    text = (tmp_path / layout.STATE / layout.STATE_FILE).read_text()
    assert all(name in text for name in named), "nothing is left that is not needed"


def test_the_journal_ends_where_the_state_says(tmp_path):
    checkpoint = Checkpoint(tmp_path, ())
    checkpoint.note(SkippedFrame(0, "torn"))
    checkpoint.note(JournalEntry(1, 5))
    checkpoint.save(RunProgress(last=1), {})
    journal = tmp_path / layout.STATE / layout.JOURNAL
    with journal.open("ab") as file:
        file.write(b'{"index": 2, "pict')
    again = Checkpoint(tmp_path, ())
    kept = again.read()
    assert (list(kept.taken), kept.skipped) == ([1], (SkippedFrame(0, "torn"),))
    again.note(JournalEntry(2, 6))
    again.save(RunProgress(last=2), {})
    assert list(Checkpoint(tmp_path, ()).read().taken) == [1, 2]
    journal.write_bytes(journal.read_bytes()[:20])
    with pytest.raises(InputError, match="too short"):
        Checkpoint(tmp_path, ()).read()
