"""``impasto render``: pictures of a digital copy."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

ALL = "all"


def register(app: typer.Typer) -> None:
    """Add the command."""
    app.command("render")(render)


def render(
    copy: Annotated[Path, typer.Argument(metavar="COPY", help="Folder of a digital copy.")],
    out: Annotated[Path, typer.Option(help="PNG or EXR file; a folder with --mode or --view all.")],
    mode: Annotated[
        str, typer.Option(help="mesh, bump, relief, hybrid, adaptive, or all.")
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
    exposure: Annotated[float, typer.Option(help="Factor on the radiance, for PNG.")] = 1.0,
    sensitivity: Annotated[
        float, typer.Option("--k", help="K of the paper's eq. 2, for adaptive.")
    ] = 1.0,
    json: Annotated[Path | None, typer.Option(metavar="FILE", help="Write figures here.")] = None,
) -> None:
    """Render a digital copy.

    Example:

        impasto render copy/ --mode relief --view inshot-grazing --out grazing.png
    """
    import time

    from acquisition.atomic_files import folder_in_progress
    from fitting.copy_files import read_copy
    from render.adaptive import AdaptiveOptions
    from render.errors import RenderError
    from render.painter import Light, Painter, RenderedImage
    from render.painting_node import Mode
    from render.picture_files import write_contact_sheet, write_picture
    from render.views import NamedView, parse_numbers, parse_view
    from workstation.json_output import write_json
    from workstation.progress import progress

    width, height = _parse_size(size)
    angles = parse_numbers(light, 2) or parse_numbers(light, 3)
    if angles is None:
        raise typer.BadParameter(f"{light!r} is not az,el or az,el,dist", param_hint="--light")
    radians = [angle * 3.141592653589793 / 180 for angle in angles[:2]]
    lamp = Light(
        azimuth=radians[0],
        elevation=radians[1],
        distance_mm=angles[2] if len(angles) == 3 else None,
    )
    if mode != ALL and mode not in list(Mode):
        raise typer.BadParameter(f"{mode!r} is none of {', '.join(Mode)}", param_hint="--mode")
    modes = list(Mode) if mode == ALL else [Mode(mode)]
    views = [str(name) for name in NamedView] if view == ALL else [view]
    single = mode != ALL and view != ALL
    if single and out.suffix.lower() not in (".png", ".exr"):
        raise RenderError(f"{out}: pictures are written as .png or .exr")
    loaded = read_copy(copy)
    adaptive = AdaptiveOptions(K=sensitivity)
    figures = []
    pictures: dict[tuple[Mode, str], RenderedImage] = {}
    with Painter() as painter, progress("rendering", total=len(modes) * len(views)) as steps:
        for one_mode in modes:
            for one_view in views:
                steps.begin(f"{one_mode} {one_view}")
                camera = parse_view(one_view, loaded, aspect=width / height)
                started = time.perf_counter()
                picture = painter.paint(
                    loaded,
                    camera,
                    mode=one_mode,
                    width=width,
                    height=height,
                    light=lamp,
                    adaptive=adaptive,
                )
                figures.append(
                    {
                        "mode": str(one_mode),
                        "view": one_view,
                        "seconds": round(time.perf_counter() - started, 4),
                        "covered_share": float(picture.coverage.mean()),
                    }
                )
                pictures[one_mode, one_view] = picture
                steps.advance()
    if single:
        write_picture(pictures[modes[0], views[0]], out, exposure=exposure)
    else:
        if out.exists():
            raise RenderError(f"{out} exists already; choose another place, or remove it first")
        with folder_in_progress(out) as folder:
            for (one_mode, one_view), picture in pictures.items():
                write_picture(picture, folder / f"{one_mode}_{one_view}.png", exposure=exposure)
            table = [[pictures[m, v].encoded(exposure=exposure) for v in views] for m in modes]
            write_contact_sheet(table, [str(m) for m in modes], views, folder / "contact.png")
    typer.echo(str(out))
    write_json(json, figures)


def _parse_size(size: str) -> tuple[int, int]:
    parts = size.lower().split("x")
    if len(parts) != 2 or not all(part.isdigit() and int(part) > 0 for part in parts):
        raise typer.BadParameter(f"{size!r} is not WIDTHxHEIGHT", param_hint="--size")
    return int(parts[0]), int(parts[1])
