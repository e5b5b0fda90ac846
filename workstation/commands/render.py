"""``impasto render``: pictures of a digital copy."""

from __future__ import annotations

from math import radians
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from workstation.json_output import JsonOption, write_json
from workstation.view_options import (
    BudgetOption,
    FieldOfViewOption,
    LightOption,
    ShadowsOption,
    parse_light,
    parse_mode,
    parse_size,
)

if TYPE_CHECKING:
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
    light: LightOption = "135,32",
    field_of_view: FieldOfViewOption = 35.0,
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
    budget: BudgetOption = 0.25,
    shadows: ShadowsOption = False,
    json: JsonOption = None,
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
    from workstation.destinations import check_destinations
    from workstation.interruption import too_late_to_stop
    from workstation.progress import progress

    width, height = parse_size(size)
    lamp, modes = parse_light(light), _parse_modes(mode)
    views = [str(name) for name in NamedView] if view == ALL else [view]
    single = ALL not in (mode, view)
    check_destinations(
        copy,
        makes={} if single else {"--out": out},
        writes={"--json": json} | ({"--out": out} if single else {}),
    )
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
            if len(figures) == len(modes) * len(views):
                too_late_to_stop()
            return picture

        if single:
            write_picture(paint(modes[0], views[0]), out, exposure=exposure)
        else:
            write_picture_table(paint, modes, views, out, exposure=exposure)
    write_json(json, figures)
    typer.echo(str(out))


def _parse_modes(mode: str) -> list[Mode]:
    from render.painting_node import Mode

    return list(Mode) if mode == ALL else [parse_mode(mode)]
