"""The paper's Tables 1 to 5 and its figure on keyframes, and the runs that are compared with them.

If the real dataset is absent, the rows run on a synthetic suite: each initial tracker is then the true masks
degraded to the mean IoU that the paper gives for it.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from fnmatch import fnmatch
from pathlib import Path
from typing import Any

from tracking3d.errors import InputError
from tracking3d.plugins import FEATURES, list_plugins
from tracking3d_bench.benchmark import paper_numbers
from tracking3d_bench.benchmark.paper_numbers import Published
from tracking3d_bench.benchmark.variant import DEGRADED, Variant

Plan = dict[str, "Variant | str"]
"""What is run, by name; a text says why it cannot be."""

DEEP = "s2dnet"
"""The feature encoder used for the paper's S2DNet."""


@dataclass(frozen=True)
class TableRow:
    """One row of a table."""

    label: str  # its name
    paper: Published | None = None  # what the paper prints there, if anything
    plan: str = ""  # name of its run in the plan; empty if there are only the paper's figures
    initial: bool = False  # whether it shows the initial masks of that run, not its estimates


@dataclass(frozen=True)
class Table:
    """A table of the paper and how to fill our column."""

    name: str  # its name on the command line
    title: str  # what it is
    source: str  # its place in the paper
    dataset: str  # layout of the real dataset
    rows: tuple[TableRow, ...]  # its rows
    # what is run: from the settings to start with, whether the data are synthetic, and folders of initial masks by
    # tracker
    plan: Callable[[Variant, bool, Mapping[str, Path]], Plan]
    note: str = ""  # what a reader has to know to compare the columns
    measure: str = "iou_mean"  # the measure in the columns
    sequences: tuple[str, ...] = ()  # patterns of the synthetic sequences that are fit for it
    sample: int = 0  # so many sequences of the real dataset are drawn, with a fixed seed; 0 for all

    def only(self, patterns: Sequence[str]) -> Table:
        """The table with the rows that match any of the patterns, all if there is no pattern.

        Raises:
            InputError: If a pattern matches nothing.
        """
        for pattern in patterns:
            if not any(fnmatch(row.label, pattern) for row in self.rows):
                labels = "; ".join(row.label for row in self.rows)
                raise InputError(f"Table {self.name} has no row '{pattern}'; choose from: {labels}.")
        chosen = (
            row for row in self.rows if not patterns or any(fnmatch(row.label, one) for one in patterns)
        )
        return replace(self, rows=tuple(chosen))


def _start_from(base: Variant, label: str, iou: float, synthetic: bool, given: Path | None) -> Variant | str:
    """``base`` from the masks of the tracker ``label``: its own if given, similar ones on synthetic data."""
    if given is not None:
        return base.with_changes(label, masks=str(given))
    if synthetic:
        return base.with_changes(label, masks=f"{DEGRADED}{iou:g}")
    return f"needs the masks of {label}: --initial {label.lower()}=DIR"


def deep(base: Variant, label: str, **settings: Any) -> Variant | str:
    """``base`` with deep features and other settings, or why that cannot be."""
    known = (info for info in list_plugins() if (info.group, info.name) == (FEATURES, DEEP))
    if not any(info.status == "ok" for info in known):
        return f"needs the feature encoder {DEEP}, which is not installed"
    return base.with_changes(label, features={"name": DEEP}, **settings)


def _cdtb(base: Variant, synthetic: bool, initial: Mapping[str, Path]) -> Plan:
    plan: Plan = {
        name: _start_from(base, name, paper_numbers.CDTB[name].value, synthetic, initial.get(name.lower()))
        for name in ("CSR-DCF", "D3S", "OSTrack")
    }
    tracked = base.with_changes("csrt of this package", masks="tracker", tracker={"name": "csrt"})
    plan["csrt"] = tracked
    if not synthetic and "csr-dcf" not in initial:
        plan["CSR-DCF"] = tracked
    return plan


def _in_hand(base: Variant, synthetic: bool, initial: Mapping[str, Path]) -> Plan:
    iou = paper_numbers.IN_HAND["OSTrack"].value
    return {"OSTrack": _start_from(base, "OSTrack", iou, synthetic, initial.get("ostrack"))}


def _coin(base: Variant, synthetic: bool, initial: Mapping[str, Path]) -> Plan:
    iou = paper_numbers.COIN["Coin tracking"].value
    start = _start_from(base, "Coin tracking", iou, synthetic, initial.get("coin tracking"))
    if isinstance(start, str):
        return dict.fromkeys(("RGB", "RGB, flat prior", "S2DNet", "S2DNet, flat prior"), start)
    return {
        "RGB": start.with_changes("RGB"),
        "RGB, flat prior": start.with_changes("RGB, flat prior", object__flat=True),
        "S2DNet": deep(start, "S2DNet"),
        "S2DNet, flat prior": deep(start, "S2DNet, flat prior", object__flat=True),
    }


FLAT: dict[str, dict[str, Any]] = {"": {}, ", flat prior": {"object__flat": True}}
"""The flat prior off and on, by what a row's label ends with."""

LOSSES: dict[str, dict[str, Any]] = {
    "no L_F": {"solver__weights__features": 0.0},
    "no L_S, overlap": {"solver__weights__silhouette": 1e-6, "solver__weights__distance": 1e6},
    "no L_S, distance": {"solver__weights__distance": 0.0},
    "no L_M": {"solver__weights__motion": 0.0},
    "no L_L": {"solver__weights__laplacian": 0.0},
    "no L_T": {"solver__weights__total_variation": 0.0},
    "L_T as in the paper": {"solver__weights__total_variation": 0.001},
}
"""Settings that switch a loss off, by row. `distance` is relative to `silhouette`, so that its own share stays."""


def _ablation_start(base: Variant, synthetic: bool, initial: Mapping[str, Path]) -> Variant | str:
    if base.config.solver.name != "paper":
        return "changes settings of the solver paper: --preset rerendering"
    iou = paper_numbers.ABLATION["initial masks (OSTrack)"].value
    return _start_from(base, "OSTrack", iou, synthetic, initial.get("ostrack"))


def _ablation(base: Variant, synthetic: bool, initial: Mapping[str, Path]) -> Plan:
    start = _ablation_start(base, synthetic, initial)
    if isinstance(start, str):
        return dict.fromkeys(("RGB", "S2DNet", *LOSSES), start)
    return {
        "RGB": start.with_changes("RGB"),
        "S2DNet": deep(start, "S2DNet"),
        **{label: start.with_changes(label, **settings) for label, settings in LOSSES.items()},
    }


def _keyframes(base: Variant, synthetic: bool, initial: Mapping[str, Path]) -> Plan:
    start = _ablation_start(base, synthetic, initial)
    if isinstance(start, str):
        return {str(count): start for count in paper_numbers.KEYFRAMES}
    return {
        str(count): start.with_changes(str(count), solver__keyframes__maximum=count)
        for count in paper_numbers.KEYFRAMES
    }


def _bop(base: Variant, synthetic: bool, initial: Mapping[str, Path]) -> Plan:
    iou = paper_numbers.CDTB["OSTrack"].value
    plan: Plan = {
        "csrt": base.with_changes("csrt", masks="tracker", tracker={"name": "csrt"}),
        "OSTrack": _start_from(base, "OSTrack", iou, synthetic, initial.get("ostrack")),
    }
    plan["truth"] = base.with_changes("true masks", masks="truth")
    return plan


def _features(base: Variant, synthetic: bool, initial: Mapping[str, Path]) -> Plan:
    iou = paper_numbers.CDTB["OSTrack"].value
    starts: dict[str, Variant | str] = {
        name: base.with_changes(name, masks="tracker", tracker={"name": name}) for name in ("csrt", "flow")
    }
    starts["OSTrack"] = _start_from(base, "OSTrack", iou, synthetic, initial.get("ostrack"))
    starts["true masks"] = base.with_changes("true masks", masks="truth")
    plan: Plan = {}
    for name, start in starts.items():
        for prior, settings in FLAT.items():
            for features in ("RGB", "S2DNet"):
                label = f"{name}, {features}{prior}"
                if isinstance(start, str):
                    plan[label] = start
                elif features == "RGB":
                    plan[label] = start.with_changes(label, features={"name": "rgb"}, **settings)
                else:
                    plan[label] = deep(start, label, **settings)
    return plan


def _with_gain(published: Mapping[str, Published], names: tuple[str, ...]) -> tuple[TableRow, ...]:
    rows = []
    for name in names:
        rows += [
            TableRow(name, published[name], name, initial=True),
            TableRow(f"{name} + ours", published[f"{name} + ours"], name),
        ]
    return tuple(rows)


TABLES: dict[str, Table] = {
    table.name: table
    for table in (
        Table(
            "cdtb",
            "Segmentation accuracy by initial tracker",
            "Table 1",
            "cdtb",
            (
                *_with_gain(paper_numbers.CDTB, ("CSR-DCF", "D3S", "OSTrack")),
                TableRow("csrt of this package", None, "csrt", initial=True),
                TableRow("csrt of this package + ours", None, "csrt"),
            ),
            _cdtb,
        ),
        Table(
            "inhand",
            "In-hand object manipulation",
            "Table 2",
            "inhand",
            (
                TableRow("OSVOS", paper_numbers.IN_HAND["OSVOS"]),
                *_with_gain(paper_numbers.IN_HAND, ("OSTrack",)),
                TableRow("BackFlow (RGB-D)", paper_numbers.IN_HAND["BackFlow (RGB-D)"]),
            ),
            _in_hand,
            note="The paper runs S2DNet features here, we run those of the configuration.",
        ),
        Table(
            "coin",
            "Flat objects: features and flat prior",
            "Table 3",
            "coin",
            (
                TableRow("Coin tracking", paper_numbers.COIN["Coin tracking"], "RGB", initial=True),
                *(TableRow(name, paper_numbers.COIN[name], name) for name in list(paper_numbers.COIN)[1:]),
            ),
            _coin,
            sequences=("*card*",),
        ),
        Table(
            "ablation",
            "Every loss switched off in turn",
            "Table 4",
            "cdtb",
            (
                TableRow(
                    "initial masks (OSTrack)",
                    paper_numbers.ABLATION["initial masks (OSTrack)"],
                    "RGB",
                    initial=True,
                ),
                TableRow("RGB", paper_numbers.ABLATION["RGB"], "RGB"),
                TableRow("S2DNet", paper_numbers.ABLATION["S2DNet"], "S2DNet"),
                *(TableRow(label, paper_numbers.ABLATION.get(label), label) for label in LOSSES),
            ),
            _ablation,
            note="The paper's rows without a loss use S2DNet features, ours those of the configuration.",
            sample=16,
        ),
        Table(
            "features",
            "RGB against deep features, with and without the flat prior, by initial tracker",
            "after Tables 1, 3 and 4",
            "cdtb",
            tuple(
                row
                for name in ("csrt", "flow", "OSTrack", "true masks")
                for row in (
                    TableRow(f"{name}, initial masks", None, f"{name}, RGB", initial=True),
                    *(
                        TableRow(label, None, label)
                        for prior in FLAT
                        for label in (f"{name}, RGB{prior}", f"{name}, S2DNet{prior}")
                    ),
                )
            ),
            _features,
            note="Add `--preset paper` for the published recipe.",
            sample=16,
        ),
        Table(
            "bop",
            "6DoF pose: average recall of VSD, MSSD and MSPD",
            "Table 5",
            "tudl",
            (
                *(TableRow(name, row) for name, row in paper_numbers.TUD_L.items() if name != "ours"),
                TableRow("ours, csrt", None, "csrt"),
                TableRow("ours, OSTrack", paper_numbers.TUD_L["ours"], "OSTrack"),
                TableRow("ours, true masks", None, "truth"),
            ),
            _bop,
            note="All but ours are given the 3D model and were trained; ours are aligned by one similarity on frame 0.",
            measure="bop_ar",
        ),
        Table(
            "keyframes",
            "Influence of the number of keyframes",
            "the figure on keyframes",
            "cdtb",
            tuple(TableRow(str(count), row, str(count)) for count, row in paper_numbers.KEYFRAMES.items()),
            _keyframes,
            note="The paper uses S2DNet features, we those of the configuration.",
            sample=16,
        ),
    )
}
"""The tables by name."""
