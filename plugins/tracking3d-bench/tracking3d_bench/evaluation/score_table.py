"""Scores as a printed table with labels."""

from __future__ import annotations

from rich.table import Table

from tracking3d.runtime.stage_times import STAGES
from tracking3d_bench.evaluation.score import Scores

ROWS: tuple[tuple[str, str, str], ...] = (
    ("frames", "frames", ""),
    ("frames_missing", "of them without an estimate", ""),
    ("frames_lost", "of them with status lost", ""),
    ("share_lost", "lost or without an estimate", " of frames"),
    ("iou_initial_mean", "IoU of the initial masks, mean", ""),
    ("iou_mean", "IoU of the estimates, mean", ""),
    ("iou_gain_percent", "gain over the initial masks", " %"),
    ("share_own_masks", "estimates that are not the unchanged initial mask", " of frames"),
    ("share_worse_than_initial", "worse than the initial mask", " of frames"),
    ("boundary_f_initial_mean", "boundary F of the initial masks, mean", ""),
    ("boundary_f_mean", "boundary F of the estimates, mean", ""),
    ("rotation_error_mean_deg", "rotation error, mean", "°"),
    ("rotation_error_median_deg", "rotation error, median", "°"),
    ("rotation_error_max_deg", "rotation error, largest", "°"),
    ("rotation_error_anchored_median_deg", "aligned at the first frame, median", "°"),
    ("rotation_error_consecutive_median_deg", "from frame to frame, median", "°"),
    ("share_under_5_deg", "rotation error below 5°", " of frames"),
    ("rotation_auc_20_deg", "the same, averaged over thresholds up to 20°", " of frames"),
    ("rotation_error_return_deg", "rotation error at the return to the first view", "°"),
    ("translation_error_median_percent", "translation error, median", " % of the distance"),
    ("points_average_jaccard", "points: average Jaccard", ""),
    ("points_delta_average", "points: share within 1 to 16 px", ""),
    ("points_occlusion_accuracy", "points: visibility accuracy", ""),
    ("points_corrected_average_jaccard", "points corrected by images: average Jaccard", ""),
    ("points_corrected_delta_average", "points corrected by images: share within 1 to 16 px", ""),
    ("points_corrected_occlusion_accuracy", "points corrected by images: visibility accuracy", ""),
    ("bop_ar", "BOP average recall", ""),
    ("bop_ar_vsd", "its VSD part", ""),
    ("bop_ar_mssd", "its MSSD part", ""),
    ("bop_ar_mspd", "its MSPD part", ""),
    ("chamfer_percent", "Chamfer distance", " % of the diameter"),
    ("shape_f_score", "F-score of the shape at 2 %", ""),
    ("shape_f_score_seen", "the same for the seen surface", ""),
    ("shape_f_score_fine", "F-score of the shape at 1 %", ""),
    ("shape_f_score_fine_seen", "the same for the seen surface", ""),
    ("shape_f_score_fitted", "at 2 %, seen surface, scale and position fitted", ""),
    ("shape_f_score_fine_fitted", "at 1 %, seen surface, scale and position fitted", ""),
    ("shape_accuracy_percent", "mean distance from the shape to the true one", " % of the diameter"),
    ("shape_completeness_percent", "mean distance from the true shape to the shape", " % of the diameter"),
    ("shape_normals", "cosine between normals", ""),
    ("shape_genus_error", "difference in genus", ""),
    ("confidence_calibration_error", "calibration error of the confidence", ""),
    ("confidence_auc", "confidence separates right from wrong, area under the ROC curve", ""),
    ("lost_precision", "precision of status lost", ""),
    ("lost_recall", "recall of lost frames", ""),
    ("vot_f_score", "VOT long-term F-score", ""),
    ("seconds_per_frame", "seconds per frame, mean", " s"),
    *((f"seconds_{stage}", f"stage {stage}", " s") for stage in STAGES),
    ("seconds_per_frame_median", "seconds per frame, median", " s"),
    ("peak_memory_mb", "peak memory", " MB"),
    ("memory_growth_mb", "growth of memory from the first to the second half", " MB"),
)
"""Measure, label and unit."""

ALWAYS = 16  # rows that are shown though unknown: what a tracker is asked first


def format_scores(scores: Scores) -> Table:
    """The scores as a table; less common measures only if they are known."""
    table = Table(box=None, show_header=False, pad_edge=False)
    table.add_column("measure")
    table.add_column("value", justify="right", style="bold")
    for number, (measure, label, unit) in enumerate(ROWS):
        value = getattr(scores, measure)
        if value is not None or number < ALWAYS or measure == "seconds_per_frame":
            table.add_row(_label(measure, label, scores), _text(value, unit))
    return table


def _label(measure: str, label: str, scores: Scores) -> str:
    """The label; labels of points say which kind they are if there are two kinds."""
    if measure.startswith("points_") and scores.points_corrected_delta_average is not None:
        return label.replace("points:", "points from the mesh alone:")
    return label


def _text(value: float | int | None, unit: str) -> str:
    if value is None:
        return "unknown"
    if isinstance(value, int):
        return f"{value}{unit}"
    return f"{value:.{1 if unit[:2] == ' %' or unit == ' MB' else 3}f}{unit}"
