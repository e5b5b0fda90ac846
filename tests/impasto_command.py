"""The ``impasto`` command for tests, in a process of its own, but without a second of imports.

A process that has imported what commands need is forked for each command. Nothing else runs in it:
no kernel, no picture, no thread that a fork would lose. Tests of starting up, of signals and of
missing packages start the command itself.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
from functools import cache
from pathlib import Path
from tempfile import TemporaryDirectory

IMPASTO = Path(sys.executable).parent / "impasto"
_ROOT = Path(__file__).parents[1]
_TIMED_OUT = -1


def impasto(
    *arguments: object, cwd: Path | None = None, timeout: float = 300
) -> subprocess.CompletedProcess[str]:
    """Run a command line to its end."""
    words = list(map(str, arguments))
    process = _process()
    assert process.stdin is not None
    assert process.stdout is not None
    with TemporaryDirectory() as folder:
        job = {
            "words": words,
            "folder": folder,
            "cwd": str(cwd or Path.cwd()),
            "environment": dict(os.environ),
            "timeout": timeout,
        }
        print(json.dumps(job), file=process.stdin, flush=True)
        code = int(process.stdout.readline())
        texts = [(Path(folder) / name).read_text() for name in ("out", "err")]
    if code == _TIMED_OUT:
        raise subprocess.TimeoutExpired(["impasto", *words], timeout, *texts)
    return subprocess.CompletedProcess(["impasto", *words], code, *texts)


@cache
def _process() -> subprocess.Popen[str]:
    """The process that is forked; it ends with this one, which holds its other end."""
    return subprocess.Popen(
        [sys.executable, "-P", __file__],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
        cwd=_ROOT,
    )


def _serve() -> None:
    import signal

    _import_what_commands_need()
    for line in sys.stdin:
        job = json.loads(line)
        child = os.fork()
        if child == 0:
            _become(job)
        signal.signal(signal.SIGALRM, lambda *_: os.kill(child, signal.SIGKILL))  # noqa: B023
        signal.setitimer(signal.ITIMER_REAL, job["timeout"])
        _, status = os.waitpid(child, 0)
        late = signal.setitimer(signal.ITIMER_REAL, 0)[0] == 0
        print(_TIMED_OUT if late else os.waitstatus_to_exitcode(status), flush=True)


def _import_what_commands_need() -> None:
    from importlib import import_module
    from pkgutil import iter_modules

    import workstation
    from workstation import commands

    for package in (workstation, commands):
        for module in iter_modules(package.__path__, f"{package.__name__}."):
            if not module.ispkg:
                import_module(module.name)
    import_module("render.painter")


def _become(job: dict) -> None:
    """Run one command line; never returns."""
    code = 1
    try:
        os.setpgid(0, 0)
        os.chdir(job["cwd"])
        os.environ.clear()
        os.environ.update(job["environment"])
        files = [open(Path(job["folder"]) / name, "w") for name in ("out", "err")]  # noqa: SIM115
        with open(os.devnull) as nothing:
            os.dup2(nothing.fileno(), 0)
        for number, file in enumerate(files, 1):
            os.dup2(file.fileno(), number)
        sys.stdin, sys.argv = open(0, closefd=False), ["impasto", *job["words"]]  # noqa: SIM115
        from workstation.command_line import main

        try:
            main()
        except SystemExit as leave:
            code = leave.code if isinstance(leave.code, int) else int(leave.code is not None)
        sys.stdout.flush()
        sys.stderr.flush()
    except BaseException:
        import traceback

        traceback.print_exc()
        sys.stderr.flush()
    finally:
        os._exit(code)


if __name__ == "__main__":
    _serve()
