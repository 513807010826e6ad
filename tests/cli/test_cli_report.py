"""Every run ends with a report, however it ends; ``report`` and ``compare`` read what is there."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from tracking3d.errors import OutputError, PluginError
from tracking3d.results.run_reader import RunReader

BOX = ("--box", "20,10,20,20")
RUN = Path("runs/clip")


def test_a_run_ends_with_a_report_that_is_named(call, clip, script):
    result = call("run", clip, *BOX)
    assert result.exit_code == 0, result.output
    assert "runs/clip/report.html" in result.stdout
    assert "Frame by frame" in (RUN / "report.html").read_text(encoding="utf-8")


def test_a_run_without_report_writes_none(call, clip, script):
    assert call("run", clip, *BOX, "--no-report").exit_code == 0
    assert not (RUN / "report.html").exists()


@pytest.mark.parametrize(
    ("fault", "code", "state"),
    [(KeyboardInterrupt(), 130, "interrupted"), (PluginError("It fell over."), 2, "failed")],
)
def test_a_run_that_does_not_come_to_its_end_has_a_report_that_says_so(
    call, clip, script, fault, code, state
):
    script.faults[3] = fault
    assert call("run", clip, *BOX).exit_code == code
    assert RunReader(RUN).state == state
    assert f"The run is {state}" in (RUN / "report.html").read_text(encoding="utf-8")


@pytest.mark.parametrize(
    ("fault", "code"),
    [
        (OutputError("The disk is full."), 0),
        (RuntimeError("a fault"), 0),
        (ImportError("no Jinja"), 0),
        (KeyboardInterrupt(), 130),
    ],
)
def test_a_report_that_fails_takes_nothing_from_the_run(call, clip, script, monkeypatch, fault, code):
    def fail(*_):
        raise fault

    monkeypatch.setattr("tracking3d.ui.report.several.write_reports", fail)
    result = call("run", clip, *BOX)
    assert result.exit_code == code
    assert RunReader(RUN).state == "finished"
    [said] = [line for line in result.stderr.splitlines() if "report" in line]
    assert "Try again with `tracking3d report`" in said


def test_a_finished_run_that_was_killed_before_its_report_gets_one(call, clip, script):
    call("run", clip, *BOX, "--no-report")
    result = call("run", clip, *BOX, "--resume")
    assert result.exit_code == 0
    assert (RUN / "report.html").is_file()
    (RUN / "report.html").unlink()
    assert call("run", clip, *BOX, "--resume", "--no-report").exit_code == 0
    assert not (RUN / "report.html").exists()


def test_a_finished_run_that_lacks_a_file_gets_it_and_another_report(call, clip, script):
    call("run", clip, *BOX)
    (RUN / "contact_sheet.png").unlink()
    (RUN / "turntable.mp4").touch()
    (RUN / "report.html").write_text("out of date")
    result = call("run", clip, *BOX, "--resume")
    assert result.exit_code == 0
    assert (RUN / "contact_sheet.png").is_file()
    assert "nothing to resume" not in result.stdout
    assert "Frame by frame" in (RUN / "report.html").read_text(encoding="utf-8")


def test_a_run_of_which_nothing_is_missing_keeps_its_report(call, clip, script):
    call("run", clip, *BOX)
    (RUN / "turntable.mp4").write_bytes(b"there")
    (RUN / "report.html").write_text("as it was")
    result = call("run", clip, *BOX, "--resume")
    assert "nothing to resume" in result.stdout
    assert (RUN / "report.html").read_text() == "as it was"


def test_a_run_that_is_refused_leaves_the_report_of_the_earlier_one(call, clip, script):
    call("run", clip, *BOX)
    (RUN / "report.html").write_text("as it was")
    assert call("run", clip, *BOX).exit_code == 2
    assert (RUN / "report.html").read_text() == "as it was"


def test_overwriting_a_run_takes_its_report_away(call, clip, script):
    call("run", clip, *BOX)
    assert call("run", clip, *BOX, "--overwrite", "--no-report").exit_code == 0
    assert not (RUN / "report.html").exists()


def test_several_objects_have_a_report_each_and_a_page_of_links(call, clip, script):
    assert call("run", clip, *BOX, "--box", "30,5,10,30", "--quiet").output == ""
    for name in ("index.html", "object_0/report.html", "object_1/report.html"):
        assert (RUN / name).is_file()
    (RUN / "index.html").unlink()
    assert call("report", RUN).stdout.split() == [
        f"{RUN}/index.html",
        f"{RUN}/object_0/report.html",
        f"{RUN}/object_1/report.html",
    ]
    assert (RUN / "index.html").is_file()


def test_report_writes_that_of_a_run_that_is_there(call, clip, script):
    call("run", clip, *BOX, "--no-report")
    result = call("report", RUN)
    assert (result.exit_code, result.output.strip()) == (0, f"{RUN}/report.html")
    assert (RUN / "report.html").is_file()


def test_report_refuses_what_is_no_run(refused, tmp_path):
    assert "not a run folder" in refused("report", tmp_path)
    assert "not a run folder" in refused("report", tmp_path / "nowhere")


def test_compare_prints_tables_json_and_a_page(call, clip, script):
    for size in (64, 96):
        call("run", clip, *BOX, "--size", size, "--out", f"run{size}", "--no-report")
    result = call("compare", "run64", "run96", "--out", "differ.html")
    assert result.exit_code == 0, result.output
    for word in ("crop.size", "64", "96", "mask IoU, mean", "1.000", "tracked", "solve", "differ.html"):
        assert word in result.stdout
    assert "Settings that differ" in Path("differ.html").read_text(encoding="utf-8")
    told = json.loads(call("compare", "run64", "run96", "--json").stdout)
    assert told["settings"] == {"crop.size": ["64", "96"]}
    assert told["differences"][0]["by_frame"]["iou"] == [1.0] * 5


def test_compare_says_what_is_not_finished_or_of_another_length(call, clip, script):
    call("run", clip, *BOX, "--out", "whole", "--no-report")
    script.faults[3] = KeyboardInterrupt()
    call("run", clip, *BOX, "--out", "part", "--no-report")
    said = " ".join(call("compare", "whole", "part").stderr.split())
    assert "part is interrupted: 3 frames have an estimate." in said
    assert "they are compared in the 3 frames that both have" in said


@pytest.mark.parametrize(
    ("folders", "words"),
    [
        (("whole",), "two run folders or more"),
        (("whole", "nowhere"), "not a run folder"),
        (("whole", "clip"), "run"),
    ],
)
def test_compare_refuses_in_a_sentence(call, refused, clip, script, folders, words):
    call("run", clip, *BOX, "--out", "whole", "--no-report")
    assert words in refused("compare", *folders)


def test_a_page_that_cannot_be_written_is_said(call, refused, clip, script):
    call("run", clip, *BOX, "--out", "whole", "--no-report")
    assert "nowhere/page.html" in refused("compare", "whole", "whole", "--out", "nowhere/page.html")
