"""Kernels are compiled once, kept on disk, and compiled again where that does not work.

Every test starts processes of its own, with a folder of their own for what they keep.
"""

from __future__ import annotations

import importlib.util
import json
import logging
import os
import shutil
import site
import subprocess
import sys
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path

import numba
import pytest
from forked import Ended, forked_script

import tracking3d
from tracking3d.rendering.kernels.compilation import Kernel, _announced, kernel

RENDER = """
import json, logging
logging.basicConfig(format="%(levelname)s of %(name)s: %(message)s")
import torch, tracking3d
from tracking3d.rendering import rasterize
screen = torch.tensor([[[0.0, 0.0], [0.0, 9.0], [9.0, 0.0]]])
drawn = rasterize(screen, torch.ones(1, 3), torch.tensor([[0, 1, 2]]), (10, 10), "numba")
print(json.dumps([tracking3d.__file__, drawn.face_index.tolist(), drawn.pixels.tolist()]))
"""
ANNOUNCED = "WARNING of tracking3d.rendering: Compiling kernels for this processor takes some seconds; "


@dataclass(frozen=True)
class Said:
    """What a process printed and logged."""

    answer: list[object]
    log: str


class Processes:
    """Start processes that render a triangle with the kernels of a copy of the package.

    Args:
        folder: Where to put the copy.
        cache: ``NUMBA_CACHE_DIR``.
        home: Home directory, below which Numba looks for a folder as well.
    """

    def __init__(self, folder: Path, cache: Path, home: Path) -> None:
        self.package = folder / "tracking3d"
        source = Path(tracking3d.__file__).parent
        shutil.copytree(source, self.package, ignore=shutil.ignore_patterns("__pycache__"))
        kept = {key: value for key, value in os.environ.items() if not key.startswith(("NUMBA_", "XDG_"))}
        self.environment = {
            **kept,
            "NUMBA_CACHE_DIR": str(cache),
            "HOME": str(home),
            "USERPROFILE": str(home),
            "LOCALAPPDATA": str(home),
            "PYTHONUSERBASE": site.getuserbase(),  # packages may be installed in the true home
            "PYTHONDONTWRITEBYTECODE": "1",
            "PYTHONPATH": str(folder),
        }

    def start(self) -> subprocess.Popen[str]:
        return subprocess.Popen(
            [sys.executable, "-c", RENDER],
            env=self.environment,
            cwd=self.package.parent,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
        )

    def end(self, process: subprocess.Popen[str]) -> Said:
        out, log = process.communicate(timeout=120)
        assert process.returncode == 0, log
        origin, *answer = json.loads(out)
        assert Path(origin).is_relative_to(self.package)
        return Said(answer, log)

    def run(self) -> Said:
        return self.end(self.start())


EXPECTED = [
    [[[0 if x + y <= 9 else -1 for x in range(10)] for y in range(10)]],
    [10 * y + x for y in range(10) for x in range(10) if x + y <= 9],
]


@pytest.fixture
def cache(tmp_path: Path) -> Path:
    return tmp_path / "cache"


@pytest.fixture
def processes(cache: Path, tmp_path: Path) -> Processes:
    return Processes(tmp_path / "installed", cache, tmp_path)


def files_in(cache: Path) -> list[Path]:
    return [path for path in cache.rglob("*") if path.is_file()]


SMALL = """
from tracking3d.rendering.kernels.compilation import kernel

@kernel("float64(float64)")
def twice(value):
    return 2 * value
"""


def small_kernel(file: Path) -> Kernel:
    """The kernel as a process that has just started finds it."""
    _announced.clear()
    spec = importlib.util.spec_from_file_location("small_kernel", file)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module.twice


def test_a_kernel_is_compiled_once_and_kept_and_that_is_told_once(tmp_path, cache, monkeypatch, caplog):
    monkeypatch.setattr(numba.config, "CACHE_DIR", str(cache))
    file = tmp_path / "small.py"
    file.write_text(SMALL)
    with caplog.at_level(logging.WARNING):
        assert small_kernel(file)(1.5) == 3
        assert len({path.parent for path in files_in(cache)}) == 1
        assert caplog.messages == [f"{ANNOUNCED.partition(': ')[2]}the result is kept."]
        assert small_kernel(file)(2.5) == 5
        assert len(caplog.messages) == 1
        file.write_text(SMALL.replace("2 *", "10 *"))
        assert small_kernel(file)(1.5) == 15
        assert len(caplog.messages) == 2


@pytest.mark.slow
def test_the_first_process_announces_itself_once_and_the_second_is_silent(processes, cache):
    first = processes.run()
    assert first.answer == EXPECTED
    assert len({path.parent for path in files_in(cache)}) == 1
    assert first.log == f"{ANNOUNCED}the result is kept.\n"
    second = processes.run()
    assert second.answer == EXPECTED
    assert second.log == ""


def unwritable(tmp_path: Path) -> Processes:
    """Nowhere to keep anything: all folders that Numba tries lie below a regular file."""
    wall = tmp_path / "wall"
    wall.write_text("a file, and no folder")
    processes = Processes(tmp_path / "installed", wall / "cache", wall / "home")
    (processes.package / "rendering" / "kernels" / "__pycache__").write_text("a file, and no folder")
    return processes


@pytest.mark.slow
def test_where_no_folder_can_be_written_every_process_compiles_and_says_so(tmp_path):
    processes = unwritable(tmp_path)
    for _ in range(2):
        said = processes.run()
        assert said.answer == EXPECTED
        assert said.log == f"{ANNOUNCED}no folder can be written to keep the result in.\n"


def emptied(path: Path) -> None:
    path.write_bytes(b"")


def garbled(path: Path) -> None:
    path.write_bytes(b"\x07garbage" * 100)


def halved(path: Path) -> None:
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])


@pytest.mark.slow
@pytest.mark.parametrize(
    ("pattern", "spoil"),
    [("*.nbi", emptied), ("*.nbi", halved), ("*.nbc", garbled), ("*.nbc", halved), ("*.nb?", garbled)],
)
def test_a_cache_that_cannot_be_read_is_no_obstacle(pattern, spoil: Callable[[Path], None], processes, cache):
    processes.run()
    spoilt = list(cache.rglob(pattern))
    assert spoilt
    for path in spoilt:
        spoil(path)
    said = processes.run()
    assert said.answer == EXPECTED
    assert said.log.startswith(ANNOUNCED) and said.log.count("\n") == 1


@pytest.mark.slow
def test_a_cache_that_cannot_be_read_is_made_again(processes, cache):
    processes.run()
    for path in files_in(cache):
        garbled(path)
    assert "the result is kept in" in processes.run().log
    assert processes.run() == Said(EXPECTED, "")


@pytest.mark.slow
def test_a_result_that_cannot_be_written_is_announced_once(processes, cache):
    processes.run()
    for path in cache.rglob("*.nbc"):
        path.unlink()
        path.mkdir()
    said = processes.run()
    assert said.answer == EXPECTED
    assert said.log.startswith(ANNOUNCED) and said.log.count("\n") == 1


@pytest.mark.slow
def test_missing_code_is_made_again(processes, cache):
    processes.run()
    for path in cache.rglob("*.nbc"):
        path.unlink()
    assert "the result is kept in" in processes.run().log
    assert processes.run() == Said(EXPECTED, "")


@pytest.mark.slow
def test_code_older_than_the_kernels_source_is_made_again(processes, cache):
    processes.run()
    for path in files_in(cache):
        os.utime(path, (1e9, 1e9))
    assert "the result is kept in" in processes.run().log
    assert processes.run() == Said(EXPECTED, "")


@pytest.mark.slow
@pytest.mark.parametrize("before", ["nothing", "old code", "damaged code"])
def test_four_processes_that_start_at_once_agree(before, processes, cache):
    if before != "nothing":
        processes.run()
    for path in files_in(cache):
        if before == "old code":
            os.utime(path, (1e9, 1e9))
        else:
            garbled(path)
    started = [processes.start() for _ in range(4)]
    assert all(processes.end(process).answer == EXPECTED for process in started)
    if before != "damaged code":
        assert processes.run() == Said(EXPECTED, "")


TOGETHER = """
import sys, time
import numba
from pathlib import Path
numba.config.CACHE_DIR = ""
sys.path.insert(0, sys.argv[1])
import only_kernel
Path(sys.argv[2]).touch()
while not all(Path(other).exists() for other in sys.argv[2:]):
    time.sleep(0.001)
assert only_kernel.twice(1.5) == 3
"""


def test_of_two_processes_that_need_a_kernel_at_once_one_compiles_it(tmp_path):
    (tmp_path / "only_kernel.py").write_text(SMALL)
    ready = [tmp_path / "ready_a", tmp_path / "ready_b"]

    def need_kernel(order: list[Path]) -> Ended:
        folder = order[0].with_suffix(".outputs")
        folder.mkdir()
        return forked_script(folder, TOGETHER, tmp_path, *order)

    with ThreadPoolExecutor(2) as both:
        ended = list(both.map(need_kernel, [ready, ready[::-1]]))
    assert [one.returncode for one in ended] == [0, 0], ended
    assert sum(one.stderr.count("Compiling kernels") for one in ended) == 1


@pytest.mark.slow
def test_a_fault_of_the_kernel_itself_is_raised():
    def wrong(value):  # type: ignore[no-untyped-def]
        return value.no_such_thing

    with pytest.raises(Exception, match="no_such_thing"):
        Kernel(wrong, "float64(float64)")(1.0)


@pytest.mark.slow
def test_a_kernel_takes_what_it_was_compiled_for_and_nothing_else():
    @kernel("float64(float64)")
    def twice(value):  # type: ignore[no-untyped-def]
        """Twice as much."""
        return 2 * value

    assert twice.__name__ == "twice" and twice.__doc__ == "Twice as much."
    assert twice(1.5) == 3.0
    with pytest.raises(TypeError, match="No matching definition"):
        twice("1.5")


SUM = """
from tracking3d.rendering.kernels.compilation import kernel

@kernel("float64(float64, float64)")
def summed(a, b):
    return a + b
"""


def test_a_kernel_is_loaded_ahead_where_it_is_kept_and_compiled_only_when_it_is_called(tmp_path, monkeypatch):
    monkeypatch.delenv("NUMBA_CACHE_DIR", raising=False)
    (tmp_path / "sums.py").write_text(SUM)

    def imported():
        spec = importlib.util.spec_from_file_location("sums", tmp_path / "sums.py")
        module = importlib.util.module_from_spec(spec)
        spec.loader.exec_module(module)
        return module.summed

    first = imported()
    assert not first.load()
    assert first(1.0, 2.0) == 3.0 and first.load()
    again = imported()
    assert again.load() and again(1.0, 2.0) == 3.0
