"""What the user names becomes videos with prompts, settings and names; what is wrong is said with its place."""

from __future__ import annotations

import importlib.util
import json
import shutil
from pathlib import Path

import fsspec
import numpy as np
import pytest
from recorded_runs import write_frames
from small_videos import BOX, write_video

from tracking3d.batch.listing import NO_PROMPT, dataset_jobs, list_jobs
from tracking3d.batch.storage import absolute, join_path, local
from tracking3d.config.loading import load_config
from tracking3d.errors import InputError
from tracking3d.results.files import write_mask
from tracking3d.testing.synthesis.convex_clips import SyntheticSpec, synthesize, write_clip
from tracking3d_bench.benchmark.sequences import open_dataset


def jobs_of(place, configure=lambda row: load_config()):
    return {job.name: job for job in list_jobs(str(place), configure)}


def test_videos_of_a_folder_have_their_place_for_a_name_and_the_files_beside_them_for_prompts(videos):
    write_mask(videos / "masked.png", np.eye(4, dtype=bool))
    write_video(videos / "masked.mp4")
    write_video(videos / "told.mp4")
    (videos / "told.mp4.json").write_text(json.dumps({"box": [[1, 2, 3, 4], "5,6,7,8"], "start_frame": 1}))
    write_frames(videos / "images", 2)
    (videos / "images.box").write_text(BOX)
    jobs = jobs_of(videos)
    assert set(jobs) == {"one", "in/two", "masked", "told", "images"}
    assert jobs["one"].box == (BOX,) and jobs["one"].video == str(videos / "one.mp4")
    assert jobs["masked"].mask == (str(videos / "masked.png"),)
    assert jobs["told"].box == ("1,2,3,4", "5,6,7,8") and jobs["told"].start_frame == 1
    assert jobs["told"].objects == 2
    assert jobs["images"].video == str(videos / "images")
    assert all(not job.fault for job in jobs.values())
    assert jobs["one"].size == (videos / "one.mp4").stat().st_size


def test_a_video_that_nothing_is_said_of_is_a_fault_of_its_own(videos):
    (videos / "one.box").unlink()
    jobs = jobs_of(videos)
    assert jobs["one"].fault == NO_PROMPT and not jobs["in/two"].fault
    alone = jobs_of(videos, lambda row: load_config(tracker={"name": "precomputed", "path": str(videos)}))
    assert not alone["one"].fault


def test_a_pattern_names_videos(videos):
    assert set(jobs_of(videos / "*.mp4")) == {"one"}
    assert set(jobs_of(videos / "**" / "*.mp4")) == {"one", "in/two"}
    with pytest.raises(InputError, match="contains no video"):
        jobs_of(videos / "*.avi")


def test_videos_that_differ_in_their_suffix_keep_it(videos):
    shutil.copy(videos / "one.mp4", videos / "one.mov")
    assert set(jobs_of(videos)) == {"one.mp4", "one.mov", "in/two"}


def test_no_run_folder_lies_within_another_or_among_the_logs(videos):
    write_video(videos / "in.mp4")
    write_video(videos / "logs.mp4")
    assert set(jobs_of(videos)) == {"one", "in.mp4", "in/two", "logs.mp4"}
    (videos / "jobs.csv").write_text("video,name\none.mp4,a\nin/two.mp4,a/b\n")
    with pytest.raises(InputError, match="inside another"):
        jobs_of(videos / "jobs.csv")


ROWS = [
    {"video": "one.mp4", "box": BOX, "fov": 50.0},
    {"video": "in/two.mp4", "points": "40,30+ 2,2-", "settings": "solver.iterations=3; runtime.seed=7"},
]


@pytest.mark.parametrize("suffix", [".csv", ".jsonl", ".parquet"])
def test_tables_of_all_kinds_say_the_same(videos, suffix):
    table = videos / f"jobs{suffix}"
    if suffix == ".csv":
        table.write_text("video,box,fov,points,settings\n"
                         f'one.mp4,"{BOX}",50.0,,\n'
                         'in/two.mp4,,,"40,30+ 2,2-",solver.iterations=3; runtime.seed=7\n')  # fmt: skip
    elif suffix == ".jsonl":
        table.write_text("".join(json.dumps(row) + "\n" for row in ROWS))
    else:
        pyarrow = pytest.importorskip("pyarrow", reason="the extra export is not installed")
        from pyarrow import parquet

        parquet.write_table(
            pyarrow.Table.from_pylist([{**ROWS[0], "points": None, "settings": None}, ROWS[1]]), table
        )
    asked = []
    jobs = jobs_of(table, lambda row: asked.append(row) or load_config())
    assert set(jobs) == {"one", "in/two"}
    assert jobs["one"].box == (BOX,) and jobs["one"].video == str(videos / "one.mp4")
    assert jobs["in/two"].points == ("40,30+ 2,2-",)
    assert asked[0].fov == 50.0 and asked[1].fov is None
    assert asked[1].settings == ("solver.iterations=3", "runtime.seed=7")


def test_rows_of_one_video_are_one_job_with_several_objects(videos):
    table = videos / "jobs.csv"
    table.write_text('video,box,mask\none.mp4,"1,2,3,4",\none.mp4,"5,6,7,8; 9,9,9,9",\none.mp4,,m.png\n')
    [job] = jobs_of(table).values()
    assert job.box == ("1,2,3,4", "5,6,7,8", "9,9,9,9") and job.mask == (str(videos / "m.png"),)
    assert job.objects == 4


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("video,bx\none.mp4,1\n", ["Line 2 of", "'bx'", "did you mean 'box'"]),
        ("video,fov\none.mp4,wide\n", ["Line 2 of", "fov"]),
        ("box\n1\n", ["Line 2 of", "video"]),
        ("video,box\n", ["has no rows"]),
        ("video\none.mp4,more\n", ["more values than there are columns"]),
        ("video,name\none.mp4,../away\n", ["'../away'"]),
        ("video,name\none.mp4,.work\n", ["'.work'"]),
        ("video,name\none.mp4,x\ntwo.mp4,x\n", ["one.mp4", "two.mp4", "column name"]),
    ],
)
def test_what_is_wrong_with_a_table_is_said_with_its_place(videos, text, words):
    (videos / "jobs.csv").write_text(text)
    with pytest.raises(InputError) as error:
        jobs_of(videos / "jobs.csv")
    assert all(word in str(error.value) for word in words)


@pytest.mark.parametrize(
    "text",
    [
        "[1]",
        "[" * 100_000,
        '{"box": "1,2,3,4\\u0000"}',
        '{"name": "\\ud800"}',
        '{"split": 1' + 400 * "0" + "}",
    ],
)
def test_what_is_wrong_with_a_file_beside_a_video_is_said(videos, text):
    (videos / "one.json").write_text(text)
    with pytest.raises(InputError, match=r"one\.json"):
        jobs_of(videos)


def test_settings_that_cannot_be_are_the_fault_of_their_row_alone(videos):
    def configure(row):
        return load_config(overrides=row.settings)

    (videos / "one.json").write_text(json.dumps({"box": BOX, "settings": {"solver.nothing": 1}}))
    jobs = jobs_of(videos, configure)
    assert "nothing" in jobs["one"].fault and not jobs["in/two"].fault


def test_places_elsewhere_are_listed_too(videos):
    files = fsspec.filesystem("memory")
    files.put(str(videos), "/listed", recursive=True)
    try:
        jobs = jobs_of("memory://listed")
        assert set(jobs) == {"one", "in/two"}
        assert jobs["in/two"].box == (BOX,) and local(jobs["in/two"].video) is None
        files.pipe_file("/listed/jobs.csv", b'video,box\none.mp4,"1,1,2,2"\n')
        assert jobs_of("memory://listed/jobs.csv")["one"].video == "memory://listed/one.mp4"
    finally:
        files.rm("/listed", recursive=True)


def test_a_storage_that_is_not_installed_names_its_extra():
    if importlib.util.find_spec("s3fs"):
        pytest.skip("the extra s3 is installed")
    with pytest.raises(InputError, match=r"tracking3d\[s3\]"):
        jobs_of("s3://bucket/folder")


def test_a_sequence_of_a_dataset_brings_its_box_and_camera(tmp_path):
    clip = synthesize(SyntheticSpec(frames=2, size=(64, 48), supersample=1))
    write_clip(tmp_path / "a", clip.images, clip.masks, clip.T_cam_obj, clip.camera, source="test", note="")
    [job] = dataset_jobs(open_dataset("real", tmp_path, tmp_path, 1), load_config())
    assert job.name == "a" and len(job.box) == 1 and job.sequence == ("clip", str(tmp_path), "a")
    assert job.config.camera.intrinsics == pytest.approx(
        (clip.camera.fx, clip.camera.fy, clip.camera.cx, clip.camera.cy)
    )


def test_places_mean_the_same_everywhere(monkeypatch, tmp_path):
    monkeypatch.chdir(tmp_path)
    assert absolute("a/b.mp4") == str(tmp_path / "a/b.mp4")
    assert absolute("b.mp4", "s3://bucket/a") == "s3://bucket/a/b.mp4"
    assert absolute("s3://bucket/b.mp4", "/a") == "s3://bucket/b.mp4"
    assert absolute(f"file://{tmp_path}/b.mp4") == str(tmp_path / "b.mp4")
    assert join_path("gs://bucket/a", "b", "c") == "gs://bucket/a/b/c"
    assert join_path("a", "b") == str(Path("a/b"))
