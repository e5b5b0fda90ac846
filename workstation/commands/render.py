"""``impasto render``: pictures of a digital copy."""

from __future__ import annotations

from math import radians
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

if TYPE_CHECKING:
    from render.painter import Light
    from render.painting_node import Mode

ALL = "all"


def register(app: typer.Typer) -> None:
    """Add the command."""
    app.command("render")(render)


def render(
    copy: Annotated[Path, typer.Argument(metavar="COPY", help="Folder of a digital copy.")],
    out: Annotated[Path, typer.Option(help="PNG or EXR file; a folder with --mode or --view all.")],
    mode: Annotated[
        str, typer.Option(help="mesh, bump, relief, hybrid, adaptive, exact, bounded, or all.")
    ] = "adaptive",
    view: Annotated[
        str,
        typer.Option(
            help="near-, inshot- or far-, with grazing or front; 'az,el,dist' in degrees and mm; "
            "or all."
        ),
    ] = "inshot-front",
    size: Annotated[str, typer.Option(metavar="WxH", help="Picture size in pixels.")] = "1024x768",
    light: Annotated[
        str, typer.Option(help="'az,el' or 'az,el,dist' of the lamp, degrees and mm.")
    ] = "135,32",
    field_of_view: Annotated[
        float, typer.Option("--fov", help="Vertical field of view, degrees.")
    ] = 35.0,
    exposure: Annotated[float, typer.Option(help="Factor on the radiance, for PNG.")] = 1.0,
    sensitivity: Annotated[
        float, typer.Option("--k", help="K of the paper's eq. 2, for adaptive.")
    ] = 1.0,
    epsilon_min: Annotated[
        float, typer.Option(help="ε_min of eq. 2: below it a box is not drawn.")
    ] = 0.0005,
    epsilon_max: Annotated[
        float, typer.Option(help="ε_max of eq. 2: above it a box is opaque.")
    ] = 0.002,
    budget: Annotated[
        float, typer.Option(help="Parallax that bounded may leave, in pixels.")
    ] = 0.25,
    shadows: Annotated[
        bool, typer.Option("--shadows", help="Let the relief cast shadows on itself.")
    ] = False,
    json: Annotated[Path | None, typer.Option(metavar="FILE", help="Write figures here.")] = None,
) -> None:
    """Render a digital copy.

    Example:

        impasto render copy/ --mode relief --view inshot-grazing --out grazing.png
    """
    import time

    from fitting.copy_files import read_copy
    from render.adaptive import AdaptiveOptions
    from render.errors import RenderError
    from render.painter import Painter, RenderedImage
    from render.picture_files import check_picture_path, write_picture, write_picture_table
    from render.views import NamedView, parse_view
    from workstation.json_output import write_json
    from workstation.progress import progress

    width, height = parse_size(size)
    lamp, modes = parse_light(light), _parse_modes(mode)
    views = [str(name) for name in NamedView] if view == ALL else [view]
    single = ALL not in (mode, view)
    if single:
        check_picture_path(out)
    elif out.exists():
        raise RenderError(f"{out} exists already; choose another place, or remove it first")
    adaptive = AdaptiveOptions(K=sensitivity, epsilon_min=epsilon_min, epsilon_max=epsilon_max)
    loaded = read_copy(copy)
    angle = radians(field_of_view)
    cameras = {
        name: parse_view(name, loaded, aspect=width / height, field_of_view=angle) for name in views
    }
    figures = []
    with Painter() as painter, progress("rendering", total=len(modes) * len(views)) as steps:

        def paint(mode: Mode, view: str) -> RenderedImage:
            steps.begin(f"{mode} {view}")
            started = time.perf_counter()
            picture = painter.paint(
                loaded,
                cameras[view],
                mode=mode,
                width=width,
                height=height,
                light=lamp,
                adaptive=adaptive,
                budget_px=budget,
                shadows=shadows,
            )
            seconds = round(time.perf_counter() - started, 4)
            covered = float(picture.coverage.mean())
            figures.append(
                {"mode": str(mode), "view": view, "seconds": seconds, "covered_share": covered}
            )
            steps.advance()
            return picture

        if single:
            write_picture(paint(modes[0], views[0]), out, exposure=exposure)
        else:
            write_picture_table(paint, modes, views, out, exposure=exposure)
    typer.echo(str(out))
    write_json(json, figures)


def parse_mode(mode: str) -> Mode:
    """A mode by its name; another text is an error of usage."""
    from render.painting_node import Mode

    if mode not in list(Mode):
        raise typer.BadParameter(f"{mode!r} is none of {', '.join(Mode)}", param_hint="--mode")
    return Mode(mode)


def _parse_modes(mode: str) -> list[Mode]:
    from render.painting_node import Mode

    return list(Mode) if mode == ALL else [parse_mode(mode)]


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
