"""Results of other tools, as `tracking3d_bench.datasets.answers.Answers`; one module per format."""

from __future__ import annotations

from tracking3d_bench.datasets.readers.bop_csv import answers_from_bop_csv
from tracking3d_bench.datasets.readers.colmap import answers_from_colmap
from tracking3d_bench.datasets.readers.masks import answers_from_masks
from tracking3d_bench.datasets.readers.recognition import ANSWER_FORMATS, read_answers, recognise_format
from tracking3d_bench.datasets.readers.tapvid import answers_from_tapvid
from tracking3d_bench.datasets.readers.tum import answers_from_tum

__all__ = [
    "ANSWER_FORMATS",
    "answers_from_bop_csv",
    "answers_from_colmap",
    "answers_from_masks",
    "answers_from_tapvid",
    "answers_from_tum",
    "read_answers",
    "recognise_format",
]
