"""The ``impasto`` command: one sub-command per module of :mod:`workstation.commands`.

Exit codes are stable: 0 done, 2 usage, 3 bad input, 4 device, 5 quality gate refused,
130 interrupted.
"""

from __future__ import annotations

import sys
from typing import NoReturn

import typer
from rich.console import Console

from devices.errors import DeviceError, ImpastoError
from workstation.interruption import was_requested, watch_for_interruption
from workstation.standard_streams import outlive_readers

EXIT_BAD_INPUT = 3
EXIT_INTERRUPTED = 130
# Of numba's message where the program was installed by somebody else, and there is no home.
_NO_PLACE_FOR_KERNELS = "no locator available"

app = typer.Typer(
    name="impasto",
    help="Digitise paintings with structured light and render the copies.",
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    rich_markup_mode="rich",
    context_settings={"help_option_names": ["-h", "--help"]},
)


def main() -> None:
    """Run the command line and end with the exit code of its outcome."""
    # Commands are registered on import; each keeps its heavy imports inside its function, so
    # that `impasto --help` stays quick.
    from workstation import commands

    commands.register(app)
    watch_for_interruption()
    outlive_readers()
    messages = Console(stderr=True, highlight=False, soft_wrap=True)
    try:
        # Typer hands some outcomes, interruption among them, back as an exit code.
        code = app(standalone_mode=False) or 0
        if code == EXIT_INTERRUPTED:
            raise KeyboardInterrupt
        sys.exit(code)
    except ImpastoError as error:
        # What a library makes of an interruption that strikes while it is loaded may come as one of
        # ours; of a device it says what could not be stopped.
        if was_requested() and not isinstance(error, DeviceError):
            _end_interrupted(messages, error)
        messages.print(f"[bold red]error:[/] {_escape(str(error))}")
        _print_notes(messages, error)
        sys.exit(error.exit_code)
    except (KeyboardInterrupt, typer.Abort) as interruption:
        _end_interrupted(messages, interruption)
    except typer.Exit as leave:
        sys.exit(leave.exit_code)
    except OSError as error:
        messages.print(f"[bold red]error:[/] {_escape(str(error))}")
        sys.exit(EXIT_BAD_INPUT)
    except Exception as error:
        # click's own usage errors know how to show themselves; anything else is a defect of ours.
        if hasattr(error, "show") and hasattr(error, "exit_code"):
            error.show()
            sys.exit(error.exit_code)
        if was_requested():
            _end_interrupted(messages, error)
        if isinstance(error, RuntimeError) and _NO_PLACE_FOR_KERNELS in str(error):
            messages.print(
                "[bold red]error:[/] compiled code can be kept neither beside the program nor in "
                "the home folder: name a folder for it that can be written to, by "
                "NUMBA_CACHE_DIR=DIR before the command"
            )
            sys.exit(EXIT_BAD_INPUT)
        raise


def _end_interrupted(messages: Console, error: BaseException) -> NoReturn:
    messages.print("[bold]interrupted[/]; nothing half-written was left behind")
    _print_notes(messages, error)
    sys.exit(EXIT_INTERRUPTED)


def _print_notes(messages: Console, error: BaseException) -> None:
    """What failed on the way out, such as a lamp that could not be put out."""
    for note in getattr(error, "__notes__", ()):
        messages.print(_escape(note))


def _escape(text: str) -> str:
    from rich.markup import escape

    return escape(text)


if __name__ == "__main__":
    main()
