"""Tables on the standard output."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from rich.console import Console
from rich.markup import escape
from rich.table import Table


def print_table(table: Table) -> None:
    """Print a table: in a terminal at its width, in a file or a pipe as wide as the table needs."""
    console = Console()
    if not console.is_terminal:
        console = Console(width=10_000)
    console.print(table)


def print_figures(title: str, figures: Mapping[str, Any]) -> None:
    """Print names and figures in two columns; None is shown as a dash."""
    table = Table(title=escape(title), show_header=False, title_justify="left")
    for name, value in figures.items():
        table.add_row(escape(name), escape(format_value(value)))
    print_table(table)


def format_value(value: Any) -> str:
    """Format a figure for a table."""
    if value is None:
        return "-"
    return f"{value:.3f}" if isinstance(value, float) else str(value)
