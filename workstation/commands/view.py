"""``impasto view``: a digital copy in a window."""

from __future__ import annotations

from math import radians
from pathlib import Path
from typing import Annotated

import typer

from workstation.json_output import JsonOption, write_json
from workstation.view_options import (
    BudgetOption,
    FieldOfViewOption,
    LightOption,
    ModeOption,
    ShadowsOption,
    parse_light,
    parse_mode,
    parse_size,
)


def register(app: typer.Typer) -> None:
    """Add the command."""
    app.command("view")(view)


def view(
    copy: Annotated[Path, typer.Argument(metavar="COPY", help="Folder of a digital copy.")],
    mode: ModeOption = "bounded",
    view: Annotated[
        str,
        typer.Option(
            help="near-, inshot- or far-, with grazing or front; or 'az,el,dist' in degrees and mm."
        ),
    ] = "inshot-front",
    size: Annotated[str, typer.Option(metavar="WxH", help="Window size in pixels.")] = "1024x768",
    light: LightOption = "135,32",
    field_of_view: FieldOfViewOption = 35.0,
    exposure: Annotated[float, typer.Option(help="Factor on the radiance.")] = 1.0,
    budget: BudgetOption = 0.25,
    shadows: ShadowsOption = False,
    json: JsonOption = None,
) -> None:
    """Look at a digital copy in a window.

    Keys change mode, light, error budget and shadows, the mouse moves the view; the window says
    which. It needs an X display with OpenGL 4.1.

    Example:

        impasto view copy/ --mode bounded --light 150,20 --shadows
    """
    from render.windows import draw_in_windows
    from workstation.destinations import check_destinations

    check_destinations(copy, writes={"--json": json})
    draw_in_windows()
    from fitting.copy_files import read_copy
    from render.viewer import PaintingViewer
    from render.viewer_state import ViewerState
    from render.views import parse_view
    from workstation.interruption import stop_if_requested

    width, height = parse_size(size)
    state = ViewerState(
        mode=parse_mode(mode),
        light=parse_light(light),
        budget_px=budget,
        shadows=shadows,
        exposure=exposure,
    )
    loaded = read_copy(copy)
    camera = parse_view(view, loaded, aspect=width / height, field_of_view=radians(field_of_view))
    with PaintingViewer(
        loaded,
        camera,
        state,
        width=width,
        height=height,
        title=f"{copy} - Impasto",
        between_frames=stop_if_requested,
    ) as window:
        window.run()
    write_json(json, window.figures())
