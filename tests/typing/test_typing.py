"""A consumer's project passes the type checkers, as strict as they can be.

The package's own ``mypy`` looks at `consumer.py` too; here it is done as somebody else would, with nothing set.
"""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

CONSUMER = Path(__file__).with_name("consumer.py")
ROOT = Path(__file__).resolve().parents[2]
WRONG = """
import tracking3d

def wrong() -> int:
    return tracking3d.track("clip.mp4", box=(1, 2, 3, 4), model="prettiest").result()
"""


def checked_by_mypy(file: Path, cache: Path) -> subprocess.CompletedProcess[str]:
    """Only what the consumer sees of the package counts; that the package itself is right is another check."""
    return subprocess.run(
        [sys.executable, "-m", "mypy", "--strict", "--config-file=", f"--cache-dir={cache}", "--follow-imports=silent",
         "--no-error-summary", str(file)],
        capture_output=True, text=True, cwd=file.parent, env={**os.environ, "MYPYPATH": str(ROOT)},
    )  # fmt: skip


@pytest.mark.slow
def test_a_consumer_passes_mypy(tmp_path):
    cache = ROOT / ".mypy_cache" / "consumer"
    result = checked_by_mypy(CONSUMER, cache)
    assert (result.stdout, result.returncode) == ("", 0)
    (tmp_path / "wrong.py").write_text(WRONG, encoding="utf-8")
    result = checked_by_mypy(tmp_path / "wrong.py", cache)
    assert "[arg-type]" in result.stdout
    assert "[return-value]" in result.stdout


@pytest.mark.slow
def test_a_consumer_passes_pyright(tmp_path):
    if not (shutil.which("node") and _pyright("--version", cwd=tmp_path).returncode == 0):
        pytest.skip("pyright is not installed, or cannot start here (it needs node)")
    (tmp_path / "pyrightconfig.json").write_text(
        f'{{"typeCheckingMode": "strict", "extraPaths": ["{ROOT}"], "include": ["."]}}', encoding="utf-8"
    )
    shutil.copy(CONSUMER, tmp_path)
    result = _pyright("--pythonpath", sys.executable, cwd=tmp_path)
    assert result.returncode == 0, result.stdout
    (tmp_path / "wrong.py").write_text(WRONG, encoding="utf-8")
    result = _pyright("--pythonpath", sys.executable, cwd=tmp_path)
    assert "reportArgumentType" in result.stdout


def _pyright(*arguments: str, cwd: Path) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, "-m", "pyright", *arguments]
    return subprocess.run(command, capture_output=True, text=True, cwd=cwd, env=os.environ)
