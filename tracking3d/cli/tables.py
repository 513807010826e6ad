"""Tables on the standard output."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from rich.console import Console
from rich.markup import escape
from rich.table import Table


def print_table(table: Table) -> None:
    """Print a table as wide as the terminal; in a file or a pipe as wide as it has to be."""
    console = Console()
    if not console.is_terminal:
        console = Console(width=10_000)
    console.print(table)


def print_figures(title: str, figures: Mapping[str, Any]) -> None:
    """Print names and figures in two columns; None is a dash."""
    table = Table(title=escape(title), show_header=False, title_justify="left")
    for name, value in figures.items():
        table.add_row(escape(name), escape(format_value(value)))
    print_table(table)


def format_value(value: Any) -> str:
    """A figure as tables show it."""
    if value is None:
        return "-"
    return f"{value:.3f}" if isinstance(value, float) else str(value)
