"""Options that nearly every command has."""

from __future__ import annotations

import inspect
import math
from collections.abc import Callable, Iterator
from copy import copy
from dataclasses import MISSING, fields, is_dataclass
from functools import wraps
from pathlib import Path
from typing import Annotated, Any, get_args, get_type_hints

import typer
from pydantic.fields import FieldInfo
from typer.models import OptionInfo

from tracking3d.config.models import OnlineConfig, PipelineConfig, PromptSection
from tracking3d.errors import InputError

PROMPT = "Prompt"
VIDEO = "Video"
DATA = "Data"
TRACKING = "Tracking"
CAMERA = "Camera"
SETTINGS = "Settings"
OUTPUT = "Output"
PERFORMANCE = "Performance"

_PROMPT = FieldInfo(annotation=PromptSection)  # the section that only `run` reads


Debug = Annotated[bool, typer.Option("--debug", help="Show the traceback of an error.")]
Quiet = Annotated[bool, typer.Option("--quiet", "-q", help="Print errors only.")]
AsJson = Annotated[bool, typer.Option("--json", help="Print JSON only.")]
Run = Annotated[Path, typer.Argument(metavar="RUN", help="Run folder.")]
RunOrParent = Annotated[
    Path, typer.Argument(metavar="RUN", help="Run folder, or the folder that holds those of several objects.")
]
Video = Annotated[
    str | None,
    typer.Option(
        "--source",
        metavar="VIDEO",
        help="Path of the video, if it has moved since the run.",
        rich_help_panel=VIDEO,
    ),
]
Sequences = Annotated[
    list[str] | None,
    typer.Option(
        "--sequence",
        metavar="PATTERN",
        help="Use only sequences whose name matches; may be repeated.",
        rich_help_panel=DATA,
    ),
]


class KeyOption(OptionInfo):
    """An option that sets a key of the configuration, whose description begins with the help of the option.

    Args:
        path: ``section.key``, or the section alone where its plug-in is chosen.
        metavar: What stands for the value in the help.
        names: Names of the option, if the parameter does not have its name.
        more: Further arguments of typer's `Option`.
    """

    def __init__(self, path: str, metavar: str | None = None, *names: str, **more: Any) -> None:
        self.section, _, self.key = path.partition(".")
        field = PipelineConfig.model_fields.get(self.section, _PROMPT)
        if self.key:
            model = OnlineConfig if self.section == "solver" else field.annotation
            field = model.model_fields[self.key]  # type: ignore[union-attr] # sections are models
        sentence = (field.description or "").partition(". ")[0].rstrip(".")
        super().__init__(default=..., param_decls=names, metavar=metavar, help=f"{sentence}.", **more)


def settings_of(*groups: Any) -> dict[str, Any]:
    """What the settings among the options of groups give, by section and key; None where an option is left out."""
    given: dict[str, Any] = {}
    for group in groups:
        for name, hint in get_type_hints(type(group), include_extras=True).items():
            for option in get_args(hint):
                if isinstance(option, KeyOption) and option.key:
                    given.setdefault(option.section, {})[option.key] = getattr(group, name)
                elif isinstance(option, KeyOption):
                    given[option.section] = getattr(group, name)
    return given


def numbers(text: str, count: int, option: str, form: str) -> tuple[float, ...]:
    """Read ``count`` finite numbers that are separated by commas.

    Raises:
        InputError: The text is anything else; the sentence names the ``option`` and its ``form``.
    """
    try:
        values = tuple(float(part) for part in text.split(","))
    except ValueError:
        values = ()
    if len(values) != count or not all(map(math.isfinite, values)):
        count_in_words = "a number" if count == 1 else f"{count} numbers"
        raise InputError(f"{option} '{text}' is not {count_in_words}; write it as {form}.")
    return values


def _check_quality(value: str | None) -> str | None:
    from tracking3d.config.loading import check_quality

    return None if value is None else check_quality(value)


def _check_model(value: str | None) -> str | None:
    from tracking3d.config.loading import check_model

    return None if value is None else check_model(value)


def model_option(**more: Any) -> Any:
    """The option ``--model``; ``more`` are further arguments of typer's `Option`."""
    return typer.Option(
        "--model",
        metavar="auto|none|fast|fine",
        callback=_check_model,
        help="Final mesh: none keeps the online texture, fast re-textures from the video, fine also reconstructs the "
        "shape, auto does so where it can.",
        **more,
    )


Quality = Annotated[
    str | None,
    typer.Option(
        metavar="draft|good|best",
        callback=_check_quality,
        help="Trade speed for quality: chooses tracker, resolution, refinement and final mesh together.",
        rich_help_panel=SETTINGS,
    ),
]
Model = Annotated[str | None, model_option(show_default="auto", rich_help_panel=SETTINGS)]


def grouped(command: Callable[..., None]) -> Callable[..., None]:
    """Make a command that typer understands of one that takes groups of options.

    Args:
        command: A function whose parameters are options, or dataclasses whose fields are ``Annotated`` options; the
            class variable ``PANEL`` of such a group is the heading in the help of those that name none.

    Returns:
        The command with one parameter per option. It builds the groups and calls ``command``.

    Raises:
        TypeError: Two options have the same name.
    """
    hints = get_type_hints(command, include_extras=True)
    groups = {name: hint for name, hint in hints.items() if is_dataclass(hint) and isinstance(hint, type)}
    parameters: list[inspect.Parameter] = []
    for parameter in inspect.signature(command).parameters.values():
        if parameter.name in groups:
            parameters += _field_parameters(groups[parameter.name])
        else:
            parameters.append(
                parameter.replace(annotation=hints[parameter.name], kind=inspect.Parameter.KEYWORD_ONLY)
            )
    names = [parameter.name for parameter in parameters]
    if repeated := {name for name in names if names.count(name) > 1}:
        raise TypeError(f"{command.__name__} has two options named {', '.join(sorted(repeated))}.")

    @wraps(command)
    def call(**values: Any) -> None:
        for name, group in groups.items():
            values[name] = group(**{field.name: values.pop(field.name) for field in fields(group)})
        command(**values)

    call.__signature__ = inspect.Signature(parameters)  # type: ignore[attr-defined] # what typer reads
    return call


def _field_parameters(group: type) -> Iterator[inspect.Parameter]:
    hints = get_type_hints(group, include_extras=True)
    for field in fields(group):
        kind, option = get_args(hints[field.name])
        option = copy(option)
        option.rich_help_panel = option.rich_help_panel or getattr(group, "PANEL", None)
        default = inspect.Parameter.empty if field.default is MISSING else field.default
        annotation = Annotated.__class_getitem__((kind, option))  # type: ignore[attr-defined]
        yield inspect.Parameter(
            field.name, inspect.Parameter.KEYWORD_ONLY, default=default, annotation=annotation
        )
