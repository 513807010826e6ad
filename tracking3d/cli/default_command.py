"""Command groups with a default: ``evaluate ANSWERS`` is short for ``evaluate answers ANSWERS``."""

from __future__ import annotations

from typing import Any

from typer.core import TyperGroup


class WithDefault(TyperGroup):
    """A group whose default command need not be named."""

    default: str

    def parse_args(self, ctx: Any, args: list[str]) -> list[str]:
        """Insert the default command if the first word names none."""
        if args and args[0] not in self.commands and args[0] not in ("--help", "--debug"):
            args = [self.default, *args]
        return super().parse_args(ctx, args)

    def resolve_command(self, ctx: Any, args: list[str]) -> Any:
        """The command that the first word names, or the default one."""
        return super().resolve_command(ctx, args if args[0] in self.commands else [self.default, *args])
