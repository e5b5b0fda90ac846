"""The ``impasto`` command, and whether the lamp of its simulated arm is lit when it has ended.

``python -m workstation.benchmarks.watched_lamp FILE WORDS…`` runs the command with its words and at
its end, however it ends, writes to the file what the lamp truly is.
"""

from __future__ import annotations

import atexit
import signal
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from devices.simulated.light_arm import ArmMechanism

LIT, DARK = "lit", "dark"


def main() -> None:
    """Run the command in this process."""
    # As the command itself does before it loads a library that starts threads, which inherit it.
    signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT, signal.SIGTERM, signal.SIGHUP})
    from devices.simulated.light_arm import ArmMechanism

    file = Path(sys.argv.pop(1))
    arms: list[ArmMechanism] = []
    made = ArmMechanism.__init__

    def remember(self: ArmMechanism, *given: Any, **named: Any) -> None:
        made(self, *given, **named)
        arms.append(self)

    ArmMechanism.__init__ = remember  # type: ignore[method-assign]
    atexit.register(lambda: file.write_text(LIT if any(arm.lamp_on for arm in arms) else DARK))
    from workstation.command_line import main as impasto

    impasto()


if __name__ == "__main__":
    main()
