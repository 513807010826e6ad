"""Scores as a table to print, with what they mean."""

from __future__ import annotations

from rich.table import Table

from tracking3d.evaluation.score import Scores
from tracking3d.runtime.stage_times import STAGES

ROWS: tuple[tuple[str, str, str], ...] = (
    ("frames", "frames", ""),
    ("frames_missing", "of them without an answer", ""),
    ("frames_lost", "of them called lost", ""),
    ("share_lost", "lost or without an answer", " of frames"),
    ("iou_initial_mean", "IoU of the initial masks, mean", ""),
    ("iou_mean", "IoU of the answers, mean", ""),
    ("iou_gain_percent", "gain over the initial masks", " %"),
    ("share_own_masks", "answers that are not the initial mask handed back", " of frames"),
    ("share_worse_than_initial", "worse than the initial mask", " of frames"),
    ("boundary_f_initial_mean", "boundary F of the initial masks, mean", ""),
    ("boundary_f_mean", "boundary F of the answers, mean", ""),
    ("rotation_error_mean_deg", "rotation error, mean", "°"),
    ("rotation_error_median_deg", "rotation error, median", "°"),
    ("rotation_error_max_deg", "rotation error, largest", "°"),
    ("rotation_error_anchored_median_deg", "anchored at the first frame, median", "°"),
    ("rotation_error_consecutive_median_deg", "from frame to frame, median", "°"),
    ("share_under_5_deg", "rotation error under 5°", " of frames"),
    ("rotation_auc_20_deg", "the same, averaged over limits up to 20°", " of frames"),
    ("rotation_error_return_deg", "rotation error on return to the first view", "°"),
    ("translation_error_median_percent", "translation error, median", " % of the distance"),
    ("points_average_jaccard", "points: average Jaccard", ""),
    ("points_delta_average", "points: share within 1 to 16 px", ""),
    ("points_occlusion_accuracy", "points: visibility right", ""),
    ("points_corrected_average_jaccard", "points corrected by images: average Jaccard", ""),
    ("points_corrected_delta_average", "points corrected by images: share within 1 to 16 px", ""),
    ("points_corrected_occlusion_accuracy", "points corrected by images: visibility right", ""),
    ("bop_ar", "BOP average recall", ""),
    ("bop_ar_vsd", "of it VSD", ""),
    ("bop_ar_mssd", "of it MSSD", ""),
    ("bop_ar_mspd", "of it MSPD", ""),
    ("chamfer_percent", "Chamfer distance", " % of the diameter"),
    ("shape_f_score", "F-score of the shape at 2 %", ""),
    ("shape_f_score_seen", "the same of what was seen", ""),
    ("shape_f_score_fine", "F-score of the shape at 1 %", ""),
    ("shape_f_score_fine_seen", "the same of what was seen", ""),
    ("shape_f_score_fitted", "at 2 %, seen, size and place fitted", ""),
    ("shape_f_score_fine_fitted", "at 1 %, seen, size and place fitted", ""),
    ("shape_accuracy_percent", "from the shape to the true one", " % of the diameter"),
    ("shape_completeness_percent", "from the true shape to it", " % of the diameter"),
    ("shape_normals", "cosine between normals", ""),
    ("shape_genus_error", "handles too many or too few", ""),
    ("confidence_calibration_error", "calibration error of the confidence", ""),
    ("confidence_auc", "confidence tells right from wrong, area under the curve", ""),
    ("lost_precision", "frames called lost that are", ""),
    ("lost_recall", "lost frames that are called so", ""),
    ("vot_f_score", "VOT long-term F-score", ""),
    ("seconds_per_frame", "seconds a frame, mean", " s"),
    *((f"seconds_{stage}", f"of it {stage}", " s") for stage in STAGES),
    ("seconds_per_frame_median", "seconds a frame, median", " s"),
    ("peak_memory_mb", "most memory held", " MB"),
    ("memory_growth_mb", "more held in the second half than in the first", " MB"),
)
"""Measure, label and unit."""

ALWAYS = 16  # rows that are shown though unknown: what a tracker is asked first


def format_scores(scores: Scores) -> Table:
    """The figures as a table; of the rarer measures only those that are known."""
    table = Table(box=None, show_header=False, pad_edge=False)
    table.add_column("measure")
    table.add_column("value", justify="right", style="bold")
    for number, (measure, label, unit) in enumerate(ROWS):
        value = getattr(scores, measure)
        if value is not None or number < ALWAYS or measure == "seconds_per_frame":
            table.add_row(_label(measure, label, scores), _text(value, unit))
    return table


def _label(measure: str, label: str, scores: Scores) -> str:
    """The label; of points it says which they are where there are two kinds."""
    if measure.startswith("points_") and scores.points_corrected_delta_average is not None:
        return label.replace("points:", "points by the mesh alone:")
    return label


def _text(value: float | int | None, unit: str) -> str:
    if value is None:
        return "unknown"
    if isinstance(value, int):
        return f"{value}{unit}"
    return f"{value:.{1 if unit[:2] == ' %' or unit == ' MB' else 3}f}{unit}"
