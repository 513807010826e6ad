"""What ``tracking3d bench render`` found out, for people."""

from __future__ import annotations

from typing import Any

from rich.table import Table


def format_times(report: dict[str, Any]) -> Table:
    """A row for each backend of what `benchmark` reports."""
    table = Table("backend")
    for title in ("forward [ms]", "backward [ms]", "total [ms]", "ratio to torch", "peak memory [MB]"):
        table.add_column(title, justify="right")
    for name, figures in report["backends"].items():
        memory = figures["peak_memory_mb"]
        table.add_row(
            name,
            *(f"{figures[part]:.1f}" for part in ("forward_ms", "backward_ms", "total_ms")),
            f"{figures['ratio_to_torch']:g}",
            "-" if memory is None else f"{memory:.0f}",
        )
    return table


def format_problem(report: dict[str, Any]) -> str:
    """One line: what was rendered, where, and by how many threads."""
    side, texture, machine = report["size"], report["texture"], report["machine"]
    threads = f"{report['threads']} thread{'s' if report['threads'] > 1 else ''}"
    where = machine["cpu"] if report["device"] == "cpu" else f"{report['device']}, {machine['cpu']}"
    return (
        f"{report['frames']} frames of {side} x {side} pixels, {report['faces']} faces, "
        f"{report['channels']} channels, {texture} x {texture} texels; {threads}; "
        f"{where} ({machine['cores']} cores), torch {machine['torch']}, numba {machine['numba'] or '-'}"
    )


def format_growth(growth: dict[str, dict[str, Any]]) -> Table:
    """The exponents of `measure_growth`: a row for what grows, a column for each backend."""
    table = Table("time grows with the power of")
    names = list(next(iter(growth.values()))["exponent"])
    for backend in names:
        table.add_column(backend, justify="right")
    for name, measured in growth.items():
        cells = (
            f"{measured['exponent'][backend]:.2f}"
            + ("" if measured["linear_or_better"][backend] else " (more than linear)")
            for backend in names
        )
        table.add_row(name, *cells)
    return table
