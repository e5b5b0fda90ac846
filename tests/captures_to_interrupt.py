"""Captures with a light arm, each in a process of its own, for a test to interrupt.

Reads addresses of serial ports, a line of them at a time; starts a capture on each, and writes its
process number; then waits for all of them, and writes number and exit code of each. The processes
are forked, so that modules are imported once.
"""

from __future__ import annotations

import itertools
import math
import os
import sys
import time

import numpy as np

from devices.deadline import Deadline
from devices.errors import ImpastoError
from devices.grbl import light_arm  # noqa: F401 - imported before the processes part
from devices.grbl.settings import GrblSettings
from devices.interfaces import ArmPose, CameraCapabilities, Frame, LightArm
from devices.rig import Rig
from workstation.interruption import watch_for_interruption

EXPOSURE_S = 0.05


class Camera:
    """A camera that sees a slope that the lamp lights, and noise."""

    capabilities = CameraCapabilities("slope", 32, 32, 255, (1e-3, 1.0))

    def __init__(self, arm: LightArm) -> None:
        self._arm = arm
        self._count = itertools.count(1)
        self._random = np.random.default_rng(os.getpid())

    def capture(self, exposure_s: float, *, deadline: Deadline | None = None) -> Frame:
        time.sleep(exposure_s)
        image = self._random.normal(10, 2, (32, 32))
        pose = self._arm.pose
        if self._arm.lamp_on and pose is not None:
            rows, cols = np.mgrid[:32, :32] - 15.5
            slope = math.cos(pose.azimuth) * cols + math.sin(pose.azimuth) * rows
            image += 100 * math.sin(pose.elevation) + 3 * slope
        ended, wall = time.monotonic(), time.time()
        number = next(self._count)
        levels = image.clip(0, 255).astype(np.uint8)
        return Frame(levels, number, exposure_s, exposure_s, ended, wall)

    def close(self) -> None:
        pass


def capture(address: str) -> None:
    """Home, and then capture under one light after another until interrupted."""
    arm = GrblSettings(port=address).open()
    low = arm.capabilities.limits.azimuth[0]
    with Rig(Camera(arm), arm=arm) as rig:
        rig.arm.home()
        for k in itertools.count():
            azimuth = low + math.radians(5 + 35 * (k % 2))
            rig.move_light(ArmPose(azimuth, math.radians(20 + 4 * (k % 5))))
            rig.switch_lamp(True)
            rig.capture(EXPOSURE_S)
            rig.capture(EXPOSURE_S)


def run(address: str) -> int:
    """Exit code of a capture, as the command line gives it."""
    try:
        watch_for_interruption()
        capture(address)
    except KeyboardInterrupt:
        return 130
    except ImpastoError as error:
        print(error, file=sys.stderr, flush=True)
        return error.exit_code
    return 0


def main() -> None:
    for line in sys.stdin:
        processes = []
        for address in line.split():
            process = os.fork()
            if process == 0:
                code = 1
                try:
                    code = run(address)
                finally:
                    os._exit(code)
            processes.append(process)
            print(process, flush=True)
        for process in processes:
            _, status = os.waitpid(process, 0)
            print(process, os.waitstatus_to_exitcode(status), flush=True)


if __name__ == "__main__":
    main()
