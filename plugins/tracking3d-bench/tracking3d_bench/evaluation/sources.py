"""Estimates of any origin: our run folders, and the formats of others."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from tracking3d.errors import InputError
from tracking3d.results import layout
from tracking3d_bench.datasets.answers import Answers
from tracking3d_bench.datasets.readers import read_answers
from tracking3d_bench.datasets.run_answers import answers_of_run
from tracking3d_bench.datasets.truth import Truth

RUN_FOLDER = "run"
A_RUN_FOLDER = "a run folder"
"""What messages call one."""


def open_answers(
    path: Path,
    truth: Truth,
    form: str | None = None,
    *,
    refined: bool = True,
    offset: int = 0,
    **options: Any,
) -> tuple[Answers, str]:
    """Read estimates for the clip that ``truth`` is about.

    Args:
        path: A run folder, or what `tracking3d_bench.datasets.readers.read_answers` reads.
        truth: The clip.
        form: ``run`` or a format of `read_answers`; recognised if None.
        refined: For a run folder: take the estimates of the final refinement if there are any, else the causal ones.
        offset: For a run folder: its frame ``i`` is frame ``i + offset`` of the clip.
        options: Options of that format, such as ``of`` of a trajectory; a run folder has none.

    Returns:
        The estimates, and what they were read as, in words.

    Raises:
        InputError: If there is nothing that can be read, or nothing of this clip.
    """
    known_to_be_other = form not in (None, RUN_FOLDER)
    looks_like_a_run = (path / layout.RUN).exists() or not path.exists()
    if form == RUN_FOLDER or (looks_like_a_run and not known_to_be_other):
        if options:
            raise InputError(
                f"{path} is a run folder, which has no option {next(iter(options))}; leave it out."
            )
        return answers_of_run(path, truth, refined=refined, offset=offset), A_RUN_FOLDER
    if not refined:
        raise InputError(f"{path} is no run folder, so it has no causal answers; leave --answers out.")
    if offset:
        raise InputError(f"{path} is no run folder, whose frames --offset shifts; leave it out.")
    return read_answers(path, truth, form, **options)
