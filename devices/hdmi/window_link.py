"""The parent's end of the pipe to the process that owns the window.

Commands are lines of text, answers lines of JSON; pictures lie in shared memory. The other process
leads a session of its own, so that an interrupt from the keyboard reaches this one only.
"""

from __future__ import annotations

import contextlib
import json
import os
import select
import subprocess
import sys
import tempfile
import threading
from pathlib import Path
from typing import Any

from devices import errors
from devices.deadline import Deadline
from devices.errors import DeviceError, DeviceLostError, DeviceTimeoutError

_PACKAGES = Path(__file__).resolve().parents[2]
_LAST_WORDS = 2000


class WindowLink:
    """A process that owns a window, or lists screens.

    Parameters
    ----------
    request : dict
        What it is to do.
    display : str, optional
        X display; by default that of the session.
    memory : int, optional
        File descriptor of the memory that pictures lie in.
    alive_every_s : float, optional
        How often to send a sign of life.
    """

    def __init__(
        self,
        request: dict[str, Any],
        *,
        display: str | None = None,
        memory: int | None = None,
        alive_every_s: float | None = None,
    ) -> None:
        self._last_words = tempfile.TemporaryFile()  # noqa: SIM115 - closed with the process
        self._pending = b""
        self._lock = threading.Lock()
        self._over = threading.Event()
        self._process = subprocess.Popen(
            [sys.executable, "-m", "devices.hdmi.window_process", json.dumps(request)],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=self._last_words,
            env=_environment(display),
            pass_fds=() if memory is None else (memory,),
            start_new_session=True,
        )
        if alive_every_s is not None:
            threading.Thread(target=self._stay_alive, args=(alive_every_s,), daemon=True).start()

    @property
    def pid(self) -> int:
        """Number of the process."""
        return self._process.pid

    @property
    def running(self) -> bool:
        """Whether the process is there."""
        return self._process.poll() is None

    def send(self, command: str) -> None:
        """Give a command.

        Raises
        ------
        DeviceLostError
            The process has ended.
        """
        assert self._process.stdin is not None
        try:
            with self._lock:
                self._process.stdin.write(f"{command}\n".encode())
                self._process.stdin.flush()
        except (BrokenPipeError, ValueError):
            raise self._lost() from None

    def receive(self, deadline: Deadline) -> dict[str, Any]:
        """The next answer.

        Raises
        ------
        DeviceError
            The process reports an error.
        DeviceTimeoutError
            No answer in time.
        DeviceLostError
            The process has ended.
        """
        assert self._process.stdout is not None
        stream = self._process.stdout.fileno()
        while b"\n" not in self._pending:
            if not select.select([stream], [], [], deadline.remaining_s)[0]:
                raise DeviceTimeoutError("the projector's window did not answer in time")
            part = os.read(stream, 65536)
            if not part:
                raise self._lost()
            self._pending += part
        line, self._pending = self._pending.split(b"\n", 1)
        answer: dict[str, Any] = json.loads(line)
        if "error" in answer:
            raise getattr(errors, answer["kind"], DeviceError)(answer["error"])
        return answer

    def end(self, *, within_s: float) -> None:
        """Ask the process to end, and see to it that it does."""
        with contextlib.suppress(DeviceLostError):
            self.send("close")
        with contextlib.suppress(subprocess.TimeoutExpired):
            self._process.wait(within_s)
        self.kill()

    def kill(self) -> None:
        """End the process at once; its window goes with it. Harmless when it has ended."""
        self._over.set()
        self._process.kill()
        self._process.wait()
        for stream in (self._process.stdin, self._process.stdout, self._last_words):
            assert stream is not None
            with self._lock, contextlib.suppress(BrokenPipeError):
                stream.close()

    def _stay_alive(self, every_s: float) -> None:
        while not self._over.wait(every_s):
            try:
                self.send("alive")
            except DeviceLostError:
                return

    def _lost(self) -> DeviceLostError:
        with contextlib.suppress(subprocess.TimeoutExpired):
            self._process.wait(1.0)
        return DeviceLostError(
            f"the projector's window is gone (its process ended with "
            f"{self._process.returncode}): {self._read_last_words() or 'no message'}; open the "
            "projector again"
        )

    def _read_last_words(self) -> str:
        if self._last_words.closed:
            return ""
        end = self._last_words.seek(0, os.SEEK_END)
        self._last_words.seek(max(0, end - _LAST_WORDS))
        lines = self._last_words.read().decode(errors="replace").strip().splitlines()
        return lines[-1] if lines else ""


def _environment(display: str | None) -> dict[str, str]:
    """The environment of this process, but with a window system."""
    environment = {
        name: value
        for name, value in os.environ.items()
        if name not in ("PYGLET_HEADLESS", "PYOPENGL_PLATFORM")
    }
    if display is not None:
        environment["DISPLAY"] = display
    path = environment.get("PYTHONPATH")
    environment["PYTHONPATH"] = os.pathsep.join([str(_PACKAGES), *([path] if path else [])])
    return environment
