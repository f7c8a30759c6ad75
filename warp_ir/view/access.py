"""What a view needs of the system, found out before anything is imported that takes time."""

import os
import socket
import sys

from warp_ir.scene import InputError

NO_DISPLAY = "no display to open a window on; --web shows it in a browser"


def check_display() -> None:
    """Finds out whether a window may be opened: on Linux that needs an X server, as Wayland's sessions have.

    Raises:
        InputError: There is no display.
    """
    if sys.platform.startswith("linux") and not os.environ.get("DISPLAY"):
        raise InputError(NO_DISPLAY)


def check_address(host: str, port: int) -> None:
    """Finds out whether a server can listen at an address.

    Raises:
        InputError: It cannot.
    """
    try:
        family = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM)[0][0]
        socket.create_server((host, port), family=family).close()
    except (OSError, OverflowError) as error:
        raise InputError(f"--web: {host}:{port} cannot be used: {getattr(error, 'strerror', error)}") from None
