"""What a GigE Vision camera tells without being taken over: whether it is in use or out of reach.

Source: GigE Vision 2.0: READREG command of its control protocol, control channel privilege
register. Routes: ``/proc/net/route`` of Linux.
"""

from __future__ import annotations

import ipaddress
import socket
import struct
from pathlib import Path

from devices.aravis.library import FIREWALL_HINT

_PORT = 3956
_KEY, _ACKNOWLEDGE, _READREG, _READREG_ACK = 0x42, 0x01, 0x0080, 0x0081
_PRIVILEGE = 0x0A00
_ANSWER_S = 0.5
_ROUTES = Path("/proc/net/route")


def connection_problem(address: str, *, port: int = _PORT) -> str | None:
    """Why a camera that was discovered cannot be controlled; None if nothing forbids it.

    Parameters
    ----------
    address : str
        IPv4.
    port : int
    """
    problem = subnet_problem(address, _routes())
    if problem is not None:
        return problem
    try:
        privilege = _read_register(address, _PRIVILEGE, port)
    except OSError:
        return f"no answer from {address}; {FIREWALL_HINT}"
    if privilege:
        return "another program controls it; close that one (it may take seconds to let go)"
    return None


def subnet_problem(address: str, routes: str) -> str | None:
    """Whether packets to a camera would leave through a gateway, and what to do then.

    Parameters
    ----------
    address : str
    routes : str
        Content of ``/proc/net/route``; empty if it is not known.
    """
    target = int(ipaddress.IPv4Address(address))
    if ipaddress.IPv4Address(address).is_loopback or not routes:
        return None
    best: tuple[int, int] | None = None
    for line in routes.splitlines()[1:]:
        fields = line.split()
        if len(fields) < 8:
            continue
        network, gateway, mask = (socket.ntohl(int(fields[column], 16)) for column in (1, 2, 7))
        if target & mask == network and (best is None or mask > best[0]):
            best = mask, gateway
    if best is not None and best[1] == 0:
        return None
    return (
        f"its address {address} is in another subnet than this computer's network cards; give the "
        "card an address of the camera's subnet, or the camera another one (arv-tool-0.8)"
    )


def _routes() -> str:
    try:
        return _ROUTES.read_text()
    except OSError:
        return ""


def _read_register(address: str, register: int, port: int) -> int:
    """Value of a register, which may be asked for without controlling the camera."""
    request = struct.pack(">BBHHHI", _KEY, _ACKNOWLEDGE, _READREG, 4, 1, register)
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as link:
        link.settimeout(_ANSWER_S)
        link.connect((address, port))
        link.send(request)
        answer = link.recv(64)
    status, kind, _, number = struct.unpack(">HHHH", answer[:8].ljust(8, b"\0"))
    if (status, kind, number) != (0, _READREG_ACK, 1) or len(answer) < 12:
        raise OSError(f"answer {answer.hex()} to READREG")
    return int.from_bytes(answer[8:12], "big")
