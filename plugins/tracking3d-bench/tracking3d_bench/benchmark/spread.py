"""How much estimates for the same video differ: on other processors, with next to no noise, from another first box.

What rounding or one grey level changes is not known better than that: a spread is the least that any figure of the
same sequences is uncertain by.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from fnmatch import fnmatch
from pathlib import Path

import numpy as np
from rich.markup import escape
from rich.table import Table

from tracking3d.errors import InputError
from tracking3d.results.files import write_atomic, writing
from tracking3d_bench.benchmark.pool import Listener
from tracking3d_bench.benchmark.results import ResultSet, figure
from tracking3d_bench.benchmark.sequences import Dataset
from tracking3d_bench.benchmark.spread_variants import UNCHANGED, Vary, computation_variants, input_variants
from tracking3d_bench.benchmark.suite import run_suite
from tracking3d_bench.benchmark.variant import Variant

CAUSAL = "causal "
"""Before a measure of the causal estimates; the others are of the final ones."""

MEASURES = {
    "causal iou_mean": ("IoU, causal", True),
    "iou_mean": ("IoU", True),
    "boundary_f_mean": ("boundary F", True),
    "causal rotation_error_mean_deg": ("rotation error, mean °, causal", False),
    "rotation_error_mean_deg": ("rotation error, mean °", False),
    "rotation_error_median_deg": ("rotation error, median °", False),
    "share_under_5_deg": ("rotation under 5°", True),
    "share_tracked": ("share called tracked", True),
    "share_lost": ("share called lost", False),
}
"""Measures that are printed: what tables call them, and whether more is better."""

LOST_DEGREES = 20.0
"""Median rotation error from which a sequence counts as lost, as it does if half of its frames are lost."""


@dataclass(frozen=True)
class Spread:
    """One measure under all variants."""

    sequence: str  # the sequence; empty for the mean over all of them
    measure: str  # its name in the scores
    values: dict[str, float]  # by label of the variant

    @property
    def mean(self) -> float:
        """Over the variants."""
        return float(np.mean(list(self.values.values())))

    @property
    def spread(self) -> float:
        """From the least to the most."""
        return max(self.values.values()) - min(self.values.values())

    @property
    def worst(self) -> tuple[str, float]:
        """The variant with the worst value, and that value."""
        pick = min if MEASURES[self.measure][1] else max
        label = pick(self.values, key=self.values.__getitem__)
        return label, self.values[label]


def run_spread(
    base: Variant,
    dataset: Dataset,
    out: Path,
    patterns: Sequence[str] = (),
    vary: Vary = Vary.COMPUTATION,
    processes: int = 1,
    listener: Listener = lambda outcome: None,
) -> tuple[list[ResultSet], dict[str, str]]:
    """Every variant on every sequence; what is left out on this processor, and why, is given beside the results.

    A variant whose every run failed is left out, too.

    Args:
        base: The settings and the initial masks.
        dataset: What to run on.
        out: Folder of the benchmark.
        patterns: Only variants that match any of them, beside the one as it is; all if there is none.
        vary: What differs between the variants.
        processes: Jobs at a time.
        listener: Called for every job.

    Raises:
        InputError: If a pattern matches nothing, or the source of masks of ``base`` does not exist.
    """
    variants, left_out = (
        computation_variants(base) if vary is Vary.COMPUTATION else (input_variants(base), {})
    )
    for pattern in patterns:
        if not any(fnmatch(one.label, pattern) for one in variants):
            raise InputError(
                f"There is no variant '{pattern}' here; choose from: {'; '.join(one.label for one in variants)}."
            )
    if patterns:
        wanted = (UNCHANGED, *patterns)
        variants = [one for one in variants if any(fnmatch(one.label, pattern) for pattern in wanted)]
    results = run_suite(variants, dataset, out, processes, listener)
    # Some kernels end a process only when it comes to an operation that this processor has not.
    for one in results[1:]:
        if not any(one.scores.values()):
            why = next(iter(one.errors.values()), None)
            left_out[one.label] = (
                f"every run failed: {why}" if why else "it means nothing for these sequences"
            )
    return [one for one in results if one.label not in left_out], left_out


def spreads(results: Sequence[ResultSet]) -> list[Spread]:
    """Every measure of every sequence, then its mean over the sequences that all variants ran.

    A sequence counts under the variants that ran it, at least two, unless one of them failed.

    Raises:
        InputError: If there is no such sequence.
    """
    found = []
    for measure in MEASURES:
        by_sequence = {name: _by_variant(results, name, measure) for name in results[0].scores}
        found += [Spread(name, measure, values) for name, values in by_sequence.items() if values]
        common = [values for values in by_sequence.values() if len(values) == len(results)]
        if common:
            means = {one.label: float(np.mean([values[one.label] for values in common])) for one in results}
            found.append(Spread("", measure, means))
    if not found:
        raise InputError("There is no sequence that all variants finished; see what they failed of above.")
    return found


def _by_variant(results: Sequence[ResultSet], name: str, measure: str) -> dict[str, float]:
    """A measure of a sequence by the variants that ran it; empty if one of them failed or there is only one."""
    ran = [one for one in results if name in one.scores]
    values = {one.label: value for one in ran if (value := _value(one, name, measure)) is not None}
    return values if 2 <= len(values) == len(ran) else {}


def _value(result: ResultSet, name: str, measure: str) -> float | None:
    scores = result.causal if measure.startswith(CAUSAL) else result.scores
    value = (scores.get(name) or {}).get(measure.removeprefix(CAUSAL))
    return None if value is None else float(value)


def flips(results: Sequence[ResultSet]) -> dict[str, list[str]]:
    """Sequences that are lost under some variants and tracked under others, with the labels of the former."""
    found = {}
    for name in results[0].scores:
        ran = {one.label: scores for one in results if (scores := one.scores.get(name, {})) != {}}
        if all(ran.values()):  # none failed
            lost = [label for label, scores in ran.items() if _is_lost(scores or {})]
            found[name] = lost if len(lost) < len(ran) else []
    return {name: labels for name, labels in found.items() if labels}


def _is_lost(scores: Mapping[str, float | None]) -> bool:
    rotation, called = scores.get("rotation_error_median_deg"), scores.get("share_lost")
    return (rotation is not None and rotation > LOST_DEGREES) or (called is not None and called >= 0.5)


def format_spreads(results: Sequence[ResultSet], title: str) -> list[Table]:
    """For the terminal: measures by sequence with mean, spread and worst, then the suite's means by variant."""
    found = spreads(results)
    by_sequence = Table(title=escape(title), title_justify="left")
    header, rows = _rows(found)
    for name in header:
        by_sequence.add_column(name, justify="left" if name in ("measure", "sequence", "under") else "right")
    for row in rows:
        by_sequence.add_row(*map(escape, row), style="bold" if row[1] == "mean" else None)
    by_variant = Table(title="Means over the sequences, by variant", title_justify="left")
    header, rows = _means(found)
    if not rows:
        return [by_sequence]
    for name in header:
        by_variant.add_column(name, justify="left" if name == "variant" else "right")
    for row in rows:
        by_variant.add_row(*map(escape, row))
    return [by_sequence, by_variant]


def to_markdown(results: Sequence[ResultSet], title: str) -> str:
    """The same tables in Markdown, and which sequences flip."""
    found = spreads(results)
    parts = [title]
    for header, rows in (_rows(found), _means(found)):
        if not rows:
            continue
        lines = [header, ["---"] * len(header), *rows]
        parts.append("\n".join(f"| {' | '.join(line)} |" for line in lines))
    parts.append(describe_flips(results))
    return "\n\n".join(parts) + "\n"


def describe_flips(results: Sequence[ResultSet]) -> str:
    """A sentence about what is tracked here and lost there."""
    flipped = flips(results)
    if not flipped:
        return "No sequence is tracked under one variant and lost under another."
    lines = (f"{name} (lost {', '.join(labels)})" for name, labels in flipped.items())
    return f"Tracked under one variant and lost under another: {'; '.join(lines)}."


def write_spreads(
    results: Sequence[ResultSet], left_out: Mapping[str, str], title: str, file: Path
) -> list[Path]:
    """Write ``file`` with the suffixes ``.md`` and ``.json``, all values in the latter; returns both.

    Raises:
        OutputError: If they cannot be written.
    """
    with writing(file.parent):
        file.parent.mkdir(parents=True, exist_ok=True)
    document = {
        "title": title,
        "left_out": dict(left_out),
        "flips": flips(results),
        "spreads": [
            asdict(one) | {"mean": one.mean, "spread": one.spread, "worst": one.worst}
            for one in spreads(results)
        ],
    }
    texts = {".md": to_markdown(results, title), ".json": json.dumps(document, indent=1) + "\n"}
    files = [file.with_name(file.name + suffix) for suffix in texts]
    for path, text in zip(files, texts.values(), strict=True):
        write_atomic(path, text.encode())
    return files


def _rows(found: Sequence[Spread]) -> tuple[list[str], list[list[str]]]:
    rows = []
    for one in found:
        label, worst = one.worst
        figures = (_fine(value, one.measure) for value in (one.mean, one.spread, worst))
        rows.append([MEASURES[one.measure][0], one.sequence or "mean", *figures, label])
    return ["measure", "sequence", "mean", "spread", "worst", "under"], rows


def _means(found: Sequence[Spread]) -> tuple[list[str], list[list[str]]]:
    of_suite = [one for one in found if not one.sequence]
    labels = of_suite[0].values if of_suite else {}
    rows = [[label, *(_fine(one.values[label], one.measure) for one in of_suite)] for label in labels]
    return ["variant", *(MEASURES[one.measure][0] for one in of_suite)], rows


def _fine(value: float, measure: str) -> str:
    """Degrees with two digits, as differences are shown here."""
    return f"{value:.2f}" if measure.endswith("_deg") else figure(value, measure)
