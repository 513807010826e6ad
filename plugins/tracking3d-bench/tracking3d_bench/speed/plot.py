"""Pictures of how the time of one iteration grows with the problem. Needs matplotlib, which is optional."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

from tracking3d.errors import InputError, OutputError

if TYPE_CHECKING:
    from matplotlib.figure import Figure

FORMATS = (".svg", ".png", ".pdf")
_LABELS = {
    "pixels": "pixels of a frame",
    "faces": "faces of the mesh",
    "frames": "frames",
    "channels": "channels (150 x 150 texels)",
}


def check_plot(path: Path) -> None:
    """Make sure that a plot can be written there, before the measurements that it is to show.

    Raises:
        InputError: If the format is not known or matplotlib is missing.
        OutputError: If there is no such folder.
    """
    if path.suffix.lower() not in FORMATS:
        raise InputError(f"--plot {path} has no known format; let it end with .svg, .png or .pdf")
    try:
        import matplotlib  # noqa: F401
    except ImportError as error:
        raise InputError(
            "--plot needs matplotlib; install it with: pip install 'tracking3d[plots]'"
        ) from error
    if not path.parent.is_dir():
        raise OutputError(f"--plot {path} cannot be written: there is no folder {path.parent}; make it first")


def plot_growth(growth: dict[str, dict[str, Any]], path: Path) -> None:
    """Draw a panel for each range of `measure_growth`: times, their exponents, and a dashed line of slope 1.

    Args:
        growth: From `measure_growth`.
        path: What to write; its suffix is one of `FORMATS`.

    Raises:
        OutputError: If it cannot be written.
    """
    # The figure draws on no screen: pyplot, which would choose one, is not involved.
    from matplotlib.figure import Figure

    figure = Figure(figsize=(8, 6), layout="constrained")
    panels = figure.subplots(2, 2, sharey=True)
    for panel, (name, measured) in zip(panels.flat, growth.items(), strict=True):
        _draw(panel, measured)
        panel.set_xlabel(_LABELS[name])
    for panel in panels[:, 0]:
        panel.set_ylabel("one iteration [ms]")
    handles, labels = panels[0, 0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside upper center", ncols=len(labels), frameon=False)
    save_figure(figure, path)


def save_figure(figure: Figure, path: Path) -> None:
    """Write a matplotlib figure so that equal figures give equal files.

    Raises:
        OutputError: If it cannot be written.
    """
    from matplotlib import rc_context

    metadata = {".svg": {"Date": None, "Creator": None}, ".pdf": {"CreationDate": None}}.get(
        path.suffix.lower()
    )
    try:
        with rc_context({"svg.hashsalt": "tracking3d"}):
            figure.savefig(path, dpi=150, metadata=metadata)
    except OSError as error:
        raise OutputError(f"--plot {path} cannot be written: {error.strerror}") from error


def _draw(panel: Any, measured: dict[str, Any]) -> None:
    values = measured["values"]
    for backend, times in measured["total_ms"].items():
        [line] = panel.loglog(values, times, marker="o", markersize=4, label=backend)
        power = measured["exponent"][backend]
        panel.annotate(
            f"{power:.2f}",
            (values[-1], times[-1]),
            xytext=(6, 0),
            textcoords="offset points",
            verticalalignment="center",
            color=line.get_color(),
        )
    last = max(times[-1] for times in measured["total_ms"].values())
    panel.loglog(
        values,
        [last * value / values[-1] for value in values],
        linestyle="--",
        linewidth=1,
        color="grey",
        label="linear",
    )
    panel.set_xticks(values, [str(value) for value in values], fontsize="small")
    panel.minorticks_off()
    panel.grid(alpha=0.3)
    panel.yaxis.set_major_formatter("{x:g}")
    panel.margins(x=0.18)  # room for the exponents
