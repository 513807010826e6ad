"""Groups of options: a command takes frozen dataclasses, the command line has one option for each of their fields."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, ClassVar

import pytest
import typer
from typer.testing import CliRunner

from tracking3d.cli import app
from tracking3d.cli.options import Quiet, general, grouped


@dataclass(frozen=True)
class Shape:
    size: Annotated[int, typer.Option(help="Side.")]
    names: Annotated[list[str] | None, typer.Option("--name", help="Names.")] = None


@dataclass(frozen=True)
class Paint:
    colour: Annotated[str, typer.Option(help="Colour.")] = "red"


@dataclass(frozen=True)
class Lens:
    PANEL: ClassVar = general.CAMERA

    fov: Annotated[float | None, general.KeyOption("camera.fov", "DEGREES")] = None
    tracker: Annotated[str | None, general.KeyOption("tracker", "NAME", rich_help_panel="Other")] = None
    flat: Annotated[bool | None, general.KeyOption("object.flat", None, "--flat")] = None
    out: Annotated[str, typer.Option(help="Where.")] = ""


def called(*words: str) -> tuple[object, ...]:
    """What a command with two groups is called with."""
    received = []

    @grouped
    def draw(
        target: Annotated[str, typer.Argument()], shape: Shape, paint: Paint, quiet: Quiet = False
    ) -> None:
        received.append((target, shape, paint, quiet))

    program = typer.Typer()
    program.command()(draw)
    assert CliRunner().invoke(program, list(words)).exit_code == 0
    return received[0]


def test_options_arrive_in_their_groups():
    words = ("page", "--size", "3", "--name", "a", "--name", "b", "--colour", "blue", "--quiet")
    assert called(*words) == ("page", Shape(3, ["a", "b"]), Paint("blue"), True)


def test_options_left_out_have_the_defaults_of_the_fields():
    assert called("page", "--size", "3") == ("page", Shape(3, None), Paint("red"), False)


def test_a_field_without_a_default_is_a_required_option():
    @grouped
    def draw(shape: Shape) -> None:
        raise AssertionError("called without its required option")

    program = typer.Typer()
    program.command()(draw)
    result = CliRunner().invoke(program, [])
    assert result.exit_code == 2
    assert "--size" in result.output


def test_two_options_of_one_name_are_refused():
    def draw(paint: Paint, colour: Annotated[str, typer.Option()] = "") -> None: ...

    with pytest.raises(TypeError, match=r"^draw has two options named colour\.$"):
        grouped(draw)


def commands(command, path: str = "tracking3d"):
    if not hasattr(command, "commands"):
        yield path, command
        return
    for name in command.list_commands(None):
        yield from commands(command.get_command(None, name), f"{path} {name}")


SHARED = {
    **dict.fromkeys(("--config", "--preset", "--quality", "--model", "--set"), general.SETTINGS),
    **dict.fromkeys(("--fov", "--intrinsics"), general.CAMERA),
    "--out": general.OUTPUT,
    "--frames": general.VIDEO,
    "--jobs": general.PERFORMANCE,
    "--workers": general.PERFORMANCE,
}


@pytest.mark.parametrize("command", ["run", "pick", "batch run", "evaluate suite", "evaluate table"])
def test_an_option_stands_in_the_same_panel_in_every_command(command):
    found = dict(commands(typer.main.get_command(app)))[f"tracking3d {command}"]
    shared = [parameter for parameter in found.params if parameter.opts[0] in SHARED]
    assert shared
    for parameter in shared:
        assert parameter.rich_help_panel == SHARED[parameter.opts[0]], parameter.opts[0]


def test_an_option_that_sets_a_key_has_its_description_and_the_panel_of_its_group():
    @grouped
    def draw(lens: Lens) -> None: ...

    program = typer.Typer()
    program.command()(draw)
    fov, tracker, *_ = typer.main.get_command(program).params
    assert fov.help == "Vertical field of view in degrees."  # the first sentence of two
    assert (fov.rich_help_panel, tracker.rich_help_panel) == (general.CAMERA, "Other")


def test_options_that_set_keys_are_collected_by_section():
    assert general.settings_of(Lens(fov=40.0, flat=True), Paint()) == {
        "camera": {"fov": 40.0},
        "tracker": None,
        "object": {"flat": True},
    }
