"""Hundreds of malformed inputs: each is used or refused in a sentence, in time, and no finished frame is lost.

``TRACKING3D_FUZZ_SEED`` chooses other cases than the usual ones, and ``pytest -k 'images-17]'`` repeats one.
"""

from __future__ import annotations

import os
from collections.abc import Callable

import pytest
from fuzzed_answers import answers
from fuzzed_command_lines import command_lines
from fuzzed_images import images
from fuzzed_library_calls import library_calls
from fuzzed_masks import masks
from fuzzed_meshes import meshes
from fuzzed_networks import networks
from fuzzed_processes import processes
from fuzzed_run_folders import run_folders
from fuzzed_videos import videos
from fuzzed_yaml import yaml_files
from judging import Case, generator, judged

SEED = int(os.environ.get("TRACKING3D_FUZZ_SEED", "13"))

DOMAINS: dict[str, tuple[Callable[[Case], None], int]] = {
    "command line": (command_lines, 110),
    "library": (library_calls, 110),
    "videos": (videos, 60),
    "images": (images, 70),
    "masks": (masks, 70),
    "meshes": (meshes, 50),
    "yaml": (yaml_files, 80),
    "run folders": (run_folders, 80),
    "answers": (answers, 50),
    "networks": (networks, 30),
    "processes": (processes, 12),
}
"""What generates the cases of each domain, and how many there are."""

CASES = [(domain, number) for domain, (_, count) in DOMAINS.items() for number in range(count)]


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore")
@pytest.mark.parametrize(("domain", "number"), CASES, ids=lambda part: str(part).replace(" ", "_"))
def test_nothing_malformed_ends_in_a_traceback_hangs_or_loses_a_frame(
    domain, number, material, tmp_path, monkeypatch
):
    monkeypatch.chdir(tmp_path)
    case = Case(generator(SEED, domain, number), material, tmp_path)
    with judged(case, f"{domain}-{number}", SEED):
        DOMAINS[domain][0](case)


def test_there_are_at_least_500_cases():
    assert len(CASES) >= 500
