"""``impasto gallery``: a walk along a wall of framed copies."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from workstation.json_output import JsonOption, write_json
from workstation.view_options import BudgetOption, ModeOption, parse_mode, parse_size


def register(app: typer.Typer) -> None:
    """Add the command."""
    app.command("gallery")(gallery)


def gallery(
    copies: Annotated[
        list[Path],
        typer.Argument(metavar="COPY...", help="Folders of digital copies, from left to right."),
    ],
    out: Annotated[Path, typer.Option(help="Folder to make for the frames.")],
    frames: Annotated[int, typer.Option(min=1, help="Frames of the walk.")] = 120,
    size: Annotated[str, typer.Option(metavar="WxH", help="Frame size in pixels.")] = "1280x720",
    mode: ModeOption = "bounded",
    budget: BudgetOption = 0.25,
    exposure: Annotated[float, typer.Option(help="Factor on the radiance.")] = 1.0,
    video: Annotated[
        bool, typer.Option("--video", help="Write a video beside the frames.")
    ] = False,
    fps: Annotated[float, typer.Option(min=1, max=240, help="Of the video.")] = 24.0,
    json: JsonOption = None,
) -> None:
    """Render a walk along a wall of framed copies, each under a lamp of its own.

    Frames are frame_0001.png and on; the folder appears when all are there.

    Example:

        impasto gallery harbour/ portrait/ --out walk/ --frames 240 --video
    """
    import time
    from contextlib import ExitStack

    from acquisition.atomic_files import folder_in_progress
    from fitting.copy_files import read_copy
    from render.errors import RenderError
    from render.gallery import Gallery, Hanging
    from render.painter import Painter
    from render.picture_files import write_picture
    from render.video_files import video_file
    from workstation.copy_writing import copy_title
    from workstation.destinations import check_destinations
    from workstation.interruption import too_late_to_stop
    from workstation.progress import progress

    width, height = parse_size(size)
    shown = parse_mode(mode)
    check_destinations(*copies, makes={"--out": out}, writes={"--json": json})
    if out.exists():
        raise RenderError(f"{out} exists already; choose another place, or remove it first")
    room = Gallery(
        [Hanging(read_copy(copy), copy_title(copy)) for copy in copies],
        mode=shown,
        budget_px=budget,
    )
    figures = []
    film = None
    with (
        Painter() as painter,
        progress("walking", total=frames) as steps,
        folder_in_progress(out) as folder,
        ExitStack() as stack,
    ):
        if video:
            film = stack.enter_context(
                video_file(folder, "walk", width=width, height=height, fps=fps)
            )
        for number in range(frames):
            steps.begin(f"frame {number + 1}")
            started = time.perf_counter()
            share = number / (frames - 1) if frames > 1 else 0.5
            picture = room.paint(painter, share, width=width, height=height)
            file = f"frame_{number + 1:04d}.png"
            write_picture(picture, folder / file, exposure=exposure)
            if film is not None:
                film.add(picture.encoded(exposure=exposure))
            seconds = round(time.perf_counter() - started, 4)
            figures.append({"frame": file, "seconds": seconds})
            steps.advance()
        too_late_to_stop()
    write_json(json, {"frames": figures, "video": film.path.name if film else None})
    typer.echo(str(out))
