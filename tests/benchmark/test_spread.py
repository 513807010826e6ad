"""The spread: one computation under conditions that should not matter, and how far its answers part."""

from __future__ import annotations

import json
import os
import platform
import re
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from tracking3d.config.loading import load_config
from tracking3d.errors import InputError
from tracking3d.frames import Frame, SkippedFrame
from tracking3d_bench.benchmark import spread, spread_variants, suite
from tracking3d_bench.benchmark.input_change import InputChange
from tracking3d_bench.benchmark.job import Job
from tracking3d_bench.benchmark.noisy_frames import NoisyFrames
from tracking3d_bench.benchmark.pool import JobOutcome
from tracking3d_bench.benchmark.processors import KERNELS, Kernels, detect_kernels
from tracking3d_bench.benchmark.results import ResultSet
from tracking3d_bench.benchmark.sequences import Dataset
from tracking3d_bench.benchmark.spread import (
    UNCHANGED,
    describe_flips,
    flips,
    format_spreads,
    run_spread,
    spreads,
    to_markdown,
    write_spreads,
)
from tracking3d_bench.benchmark.spread_variants import computation_variants, input_variants
from tracking3d_bench.benchmark.suite import run_suite
from tracking3d_bench.benchmark.variant import Variant

BASE = Variant(label="default", config=load_config(), masks="truth")


def result(label, **sequences):
    """Rotation error, IoU and share called lost by sequence; None for one that failed."""
    scores = {
        name: known
        and {"rotation_error_mean_deg": known[0], "rotation_error_median_deg": known[0], "iou_mean": known[1]}
        | {"share_lost": known[2]}
        for name, known in sequences.items()
    }
    return ResultSet(label, "smoke", scores, {}, {})


RESULTS = [
    result("as it is", box=(1.0, 0.9, 0.0), mug=(10.0, 0.8, 0.1), card=(3.0, 0.9, 0.0)),
    result("other", box=(2.0, 0.8, 0.0), mug=(40.0, 0.7, 0.1), card=(4.0, 0.9, 0.6)),
    result("third", box=(1.5, 0.95, 0.0), mug=(12.0, 0.8, 0.2), card=(3.5, 0.9, 0.1)),
]


@pytest.fixture
def kernels(monkeypatch):
    """A processor that takes Haswell's and AVX2's by itself, and cannot run SkylakeX's."""

    def pretended(environment):
        core = environment.get("OPENBLAS_CORETYPE", "Haswell")
        level = environment.get("ATEN_CPU_CAPABILITY", "avx2").upper()
        return None if core == "SkylakeX" else Kernels({"Zen": "Haswell"}.get(core, core), level)

    monkeypatch.setattr(spread_variants, "detect_kernels", pretended)


@pytest.mark.usefixtures("kernels")
def test_what_is_one_computation_is_run_once_and_what_cannot_be_run_is_named():
    variants, left_out = computation_variants(BASE)
    by_label = {one.label: one for one in variants}
    noisy = [f"one grey level of noise, seed {seed}" for seed in (1, 2)]
    assert list(by_label) == [
        UNCHANGED, "OpenBLAS Nehalem", "ATen default", "ATen avx512", "renderer torch", *noisy
    ]  # fmt: skip
    assert by_label["OpenBLAS Nehalem"].environment == {"OPENBLAS_CORETYPE": "Nehalem"}
    assert by_label["renderer torch"].config.runtime.renderer == "torch"
    assert [by_label[label].input.grey_noise for label in noisy] == [1, 2]
    assert {one.masks for one in variants} == {"truth"}
    assert left_out["OpenBLAS SkylakeX"] == "this processor cannot run them"
    assert left_out["OpenBLAS Zen"] == f"they are those of '{UNCHANGED}' (Haswell, AVX2)"
    assert set(left_out) == {"OpenBLAS Haswell", "OpenBLAS Zen", "OpenBLAS SkylakeX", "ATen avx2"}


@pytest.mark.usefixtures("kernels")
def test_the_renderer_that_is_chosen_anyway_is_no_variant():
    variants, _ = computation_variants(BASE.with_changes("torch", runtime__renderer="torch"))
    assert [one.label for one in variants if "renderer" in one.label] == ["renderer numba"]


@pytest.mark.usefixtures("kernels")
def test_patterns_choose_variants_and_what_is_compared_with_stays(monkeypatch, tmp_path):
    dataset = Dataset("smoke", 1, "clip", tmp_path, ("box",))

    def run_suite(variants, *rest):
        lost = {"ATen avx512": ResultSet("ATen avx512", "smoke", {"box": None}, {"box": "It crashed."}, {})}
        return [lost.get(one.label, result(one.label, box=(1.0, 0.9, 0.0))) for one in variants]

    monkeypatch.setattr(spread, "run_suite", run_suite)
    results, _ = run_spread(BASE, dataset, tmp_path, ["*Nehalem", "renderer*"])
    assert [one.label for one in results] == [UNCHANGED, "OpenBLAS Nehalem", "renderer torch"]
    results, left_out = run_spread(BASE, dataset, tmp_path)
    assert len(results) == 6 and left_out["ATen avx512"] == "every run failed: It crashed."
    with pytest.raises(InputError, match="no variant 'Zen' here; choose from: as it is; OpenBLAS Nehalem"):
        run_spread(BASE, dataset, tmp_path, ["Zen"])


@pytest.mark.usefixtures("kernels")
def test_a_variant_that_means_nothing_for_any_sequence_is_left_out(monkeypatch, tmp_path):
    def run_suite(variants, *rest):
        return [
            result(one.label, box=(1.0, 0.9, 0.0))
            if one.label == UNCHANGED
            else ResultSet(one.label, "smoke", {}, {}, {})
            for one in variants
        ]

    monkeypatch.setattr(spread, "run_suite", run_suite)
    results, left_out = run_spread(
        BASE, Dataset("smoke", 1, "clip", tmp_path, ("box",)), tmp_path, ["renderer*"]
    )
    assert [one.label for one in results] == [UNCHANGED]
    assert left_out["renderer torch"] == "it means nothing for these sequences"


def test_every_variant_has_runs_of_its_own(clips, tmp_path):
    def run_key(**change):
        return Job("clip", clips, "narrow", BASE.model_copy(update=change), tmp_path).run_key

    keys = [
        run_key(),
        run_key(environment={"OPENBLAS_CORETYPE": "Haswell"}),
        run_key(environment={"OPENBLAS_CORETYPE": "Nehalem"}),
        run_key(input=InputChange(grey_noise=1)),
        run_key(input=InputChange(grey_noise=2)),
        run_key(input=InputChange(first_frame=1)),
    ]
    assert len(set(keys)) == len(keys)
    assert run_key() == run_key(label="another")


@pytest.mark.slow
def test_a_process_tells_which_kernels_it_takes():
    usual = detect_kernels({})
    assert usual is not None
    plain = detect_kernels({"ATEN_CPU_CAPABILITY": "default"})
    assert plain == Kernels(usual.openblas, "DEFAULT")
    if not usual.openblas or platform.machine() not in ("x86_64", "AMD64"):
        pytest.skip("NumPy has no OpenBLAS for x86 here")
    # Every x86 processor of today runs these.
    assert detect_kernels(KERNELS["OpenBLAS Nehalem"]) == Kernels("Nehalem", usual.aten)


def test_changes_of_the_input_are_ten_and_the_first_variant_has_none():
    variants = input_variants(BASE)
    assert variants[0].label == UNCHANGED and variants[0].disturbance == ()
    assert len({one.model_dump_json(exclude={"label"}) for one in variants}) == len(variants) == 11


def test_only_what_means_something_for_a_sequence_is_run(clips, monkeypatch, tmp_path):
    """The clip `narrow` has a lens that is given anyway, and true masks that have no box to be moved."""
    ran = []

    def run_jobs(jobs, *rest):
        ran.extend(job.variant.label for job in jobs)
        return [JobOutcome(job, {"iou_mean": 1.0}, "") for job in jobs]

    monkeypatch.setattr(suite, "run_jobs", run_jobs)
    dataset = Dataset("real", None, "clip", clips, ("narrow",))
    results = run_suite(input_variants(BASE), dataset, tmp_path)
    assert len(results) == 11 and not any(one.errors for one in results)
    without = {one.label for one in results if not one.scores}
    assert without == {"lens given", "box moved by 2 pixels", "box grown by 4 %", *_too_short(clips)}
    assert ran == [one.label for one in results if one.scores]


def _too_short(clips):
    count = len(list((clips / "narrow/frames").iterdir()))
    return {f"first frame +{n}" for n in (1, 2, 3) if n + 1 >= count}


def test_noise_is_one_grey_level_its_own_in_every_frame_and_the_same_each_time():
    image = np.full((6, 8, 3), 100, np.uint8)
    image[0] = 0
    image[1] = 255
    source = Source([Frame(0, image), SkippedFrame(1, "torn"), Frame(2, image)])
    first, skipped, third = NoisyFrames(source, 7)
    assert skipped == SkippedFrame(1, "torn")
    difference = first.image.astype(int) - image
    assert set(np.unique(difference)) == {-1, 0, 1} and first.image.dtype == np.uint8
    assert (difference[0] >= 0).all() and (difference[1] <= 0).all()
    assert not np.array_equal(first.image, third.image)
    again = next(iter(NoisyFrames(source, 7)))
    assert np.array_equal(first.image, again.image)
    assert not np.array_equal(first.image, next(iter(NoisyFrames(source, 8))).image)
    noisy = NoisyFrames(source, 7)
    assert (noisy.name, noisy.count, noisy.fps, noisy.repeatable) == ("source", 3, None, True)
    assert (noisy.intrinsics, noisy.intrinsics_origin) == (None, "")


def test_mean_spread_and_worst_case_of_a_sequence_and_of_the_suite():
    found = {(one.sequence, one.measure): one for one in spreads(RESULTS)}
    box = found["box", "rotation_error_mean_deg"]
    assert (box.mean, box.spread, box.worst) == (1.5, 1.0, ("other", 2.0))
    assert found["box", "iou_mean"].worst == ("other", 0.8)  # less is worse
    mean = found["", "rotation_error_mean_deg"]
    assert mean.values == pytest.approx({"as it is": 14 / 3, "other": 46 / 3, "third": 17 / 3})
    assert mean.spread == pytest.approx(32 / 3)


def test_what_one_variant_did_not_finish_is_compared_under_none():
    failed = [*RESULTS[:2], result("third", box=(1.0, 0.9, 0.0), mug=None, card=None)]
    assert {one.sequence for one in spreads(failed)} == {"box", ""}
    assert flips(failed) == {}
    with pytest.raises(InputError, match="no sequence that all variants finished"):
        spreads([RESULTS[0], result("none", box=None, mug=None, card=None)])


def test_a_sequence_counts_under_the_variants_that_mean_something_for_it():
    some = [*RESULTS[:2], result("lens given", box=(9.0, 0.5, 0.0))]
    found = {(one.sequence, one.measure): one for one in spreads(some)}
    assert found["box", "rotation_error_mean_deg"].worst == ("lens given", 9.0)
    assert set(found["mug", "rotation_error_mean_deg"].values) == {"as it is", "other"}
    assert found["", "rotation_error_mean_deg"].values == {"as it is": 1.0, "other": 2.0, "lens given": 9.0}
    assert flips(some) == {"mug": ["other"], "card": ["other"]}


def test_causal_estimates_are_compared_too():
    causal = {"box": {"iou_mean": 0.6}}
    pair = [replace(one, causal=causal) for one in RESULTS[:2]]
    [found] = [one for one in spreads(pair) if (one.sequence, one.measure) == ("box", "causal iou_mean")]
    assert found.mean == 0.6


def test_a_sequence_flips_if_it_is_lost_under_some_variants_only():
    assert flips(RESULTS) == {"mug": ["other"], "card": ["other"]}  # by its rotation; by what was called
    assert "mug (lost other); card (lost other)" in describe_flips(RESULTS)
    everywhere = [result(label, mug=(90.0, 0.1, 1.0)) for label in ("a", "b")]
    assert flips(everywhere) == {}
    assert describe_flips(everywhere) == "No sequence is tracked under one variant and lost under another."


def test_tables_and_files_hold_the_same_figures(tmp_path):
    text = to_markdown(RESULTS, "smoke, masks truth")
    assert "| rotation error, mean ° | mug | 20.67 | 30.00 | 40.00 | other |" in text
    assert re.search(r"\| third \| 0.883 \| 5.67 \|", text)
    assert len(format_spreads(RESULTS, "title")) == 2
    files = write_spreads(
        RESULTS, {"OpenBLAS Zen": "absent"}, "smoke, masks truth", tmp_path / "a" / "spread"
    )
    assert [file.name for file in files] == ["spread.md", "spread.json"]
    assert files[0].read_text() == text
    document = json.loads(files[1].read_text())
    assert document["left_out"] == {"OpenBLAS Zen": "absent"} and document["flips"]["mug"] == ["other"]
    [mug] = [one for one in document["spreads"] if (one["sequence"], one["measure"]) == ("mug", "iou_mean")]
    assert mug["spread"] == pytest.approx(0.1) and mug["values"]["other"] == 0.7


@pytest.mark.slow
def test_the_command_prints_the_spread_of_a_short_sequence(tmp_path):
    command = [sys.executable, "-c", "from tracking3d.cli import main; main()", "evaluate", "spread", "smoke"]
    options = ["--sequence", "box*", "--masks", "truth", "--out", "bench", "--jobs", "2", "--set"]
    found = subprocess.run(
        [*command, *options, "crop.size=64"], cwd=tmp_path, capture_output=True, text=True,
        env={**os.environ, "NUMBA_NUM_THREADS": "1"},
    )  # fmt: skip
    assert found.returncode == 0, found.stderr
    assert "rotation error, mean" in found.stdout and "renderer torch" in found.stdout
    assert Path(tmp_path, "bench/tables/spread-smoke-truth.md").is_file()


class Source(list):
    """Frames in a list."""

    name, fps, intrinsics, intrinsics_origin, repeatable = "source", None, None, "", True
    count = 3
