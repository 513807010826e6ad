"""The page of a batch: whole without its script, sorted and filtered with it, and safe whatever videos are called."""

from __future__ import annotations

import pytest
from browser import open_page

from tracking3d.batch import running
from tracking3d.batch.folder import BatchProgress, Failure
from tracking3d.batch.running import write_overview
from tracking3d.batch.summary import COLUMNS


def row(run: str, confidence: float | None, lost: int = 0) -> dict[str, object]:
    return {name: kind() for name, kind in COLUMNS.items()} | {
        "run": run,
        "confidence": confidence,
        "lost": lost,
        "frames": 5,
    }


ROWS = [row("day/b", 0.9), row("day/a", 0.2, lost=3), row("night/c", None)]


def written(folder, rows=ROWS, failures=(), pictures=None) -> str:
    write_overview(str(folder), BatchProgress("finished", len(rows)), rows, pictures or {}, failures)
    return (folder / "index.html").read_text()


def test_names_and_reasons_are_text_whatever_is_in_them(tmp_path):
    failure = Failure("<b>x", "x", "<script>alert(1)</script>", 1, False, "")
    page = written(tmp_path, [row("<img src=x>", 0.5)], [failure])
    assert "<img src=x>" not in page and "<script>alert" not in page and "&lt;script&gt;" in page


def test_of_very_many_runs_the_most_doubtful_have_pictures(tmp_path, monkeypatch):
    monkeypatch.setattr(running, "MOST_PICTURES", 2)
    pictures = {"day/a": "QUFB", "day/b": "QkJC", "night/c": "Q0ND"}
    page = written(tmp_path, pictures=pictures)
    assert ["QUFB" in page, "QkJC" in page, "Q0ND" in page] == [True, False, True]


@pytest.mark.slow
def test_runs_are_sorted_and_filtered(tmp_path):
    written(tmp_path)
    with open_page(f"file://{tmp_path}/index.html") as page:

        def shown() -> list[str]:
            return page.locator("table.runs tbody tr:visible a").all_inner_texts()

        assert shown() == ["day/a", "day/b", "night/c"]
        page.click("th button:text('Confidence')")
        assert shown() == ["night/c", "day/a", "day/b"]
        page.click("th button:text('Confidence')")
        assert shown() == ["day/b", "day/a", "night/c"]
        page.fill("#filter", "day")
        assert shown() == ["day/b", "day/a"] and page.inner_text("#shown") == "2 of 3 runs"
        page.check("#lost")
        assert shown() == ["day/a"]
        page.fill("#most", "0.1")
        assert shown() == []
