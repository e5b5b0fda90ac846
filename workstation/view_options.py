"""Options of the commands that show a copy, and how their texts are read."""

from __future__ import annotations

from math import radians
from typing import TYPE_CHECKING, Annotated

import typer

if TYPE_CHECKING:
    from render.painter import Light
    from render.painting_node import Mode

ModeOption = Annotated[
    str, typer.Option(help="mesh, bump, relief, hybrid, adaptive, exact or bounded.")
]
LightOption = Annotated[
    str, typer.Option(help="'az,el' or 'az,el,dist' of the lamp, degrees and mm.")
]
FieldOfViewOption = Annotated[float, typer.Option("--fov", help="Vertical field of view, degrees.")]
BudgetOption = Annotated[float, typer.Option(help="Parallax that bounded may leave, in pixels.")]
ShadowsOption = Annotated[
    bool, typer.Option("--shadows", help="Let the relief cast shadows on itself.")
]


def parse_mode(mode: str) -> Mode:
    """A mode by its name; another text is an error of usage."""
    from render.painting_node import Mode

    if mode not in list(Mode):
        raise typer.BadParameter(f"{mode!r} is none of {', '.join(Mode)}", param_hint="--mode")
    return Mode(mode)


def parse_light(light: str) -> Light:
    """The lamp of ``az,el`` or ``az,el,dist`` in degrees and mm; else an error of usage."""
    from render.painter import Light
    from render.views import parse_numbers

    numbers = parse_numbers(light, 2) or parse_numbers(light, 3)
    if numbers is None:
        raise typer.BadParameter(f"{light!r} is not az,el or az,el,dist", param_hint="--light")
    return Light(
        azimuth=radians(numbers[0]),
        elevation=radians(numbers[1]),
        distance_mm=numbers[2] if len(numbers) == 3 else None,
    )


def parse_size(size: str) -> tuple[int, int]:
    """Width and height of ``WIDTHxHEIGHT``; another text is an error of usage."""
    parts = size.lower().split("x")
    if len(parts) != 2 or not all(part.isdecimal() and int(part) > 0 for part in parts):
        raise typer.BadParameter(f"{size!r} is not WIDTHxHEIGHT", param_hint="--size")
    return int(parts[0]), int(parts[1])
