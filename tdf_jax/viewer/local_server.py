"""The server of the viewer: at this machine's own address, unless a link is asked for."""

import contextlib
import io
import socket
from collections.abc import Iterator
from typing import Any

from tdf_jax._internal import checks
from tdf_jax._internal.errors import InputError
from tdf_jax._internal.extras import from_extra

HOST, PORT = "127.0.0.1", 8080


def viser_of(function: str) -> Any:
    """The module viser.

    Args:
        function: name that the error message begins with.

    Raises:
        InputError: it is not installed.
    """
    return from_extra(function, "viser", "viewer")


@contextlib.contextmanager
def serving(function: str, port: int = PORT) -> Iterator[Any]:
    """A `viser.ViserServer` that this machine alone can reach; it is stopped after the block.

    Args:
        function: name that error messages begin with.
        port: port of the address; 0 for any that is free.

    Raises:
        InputError: viser is not installed, or the port is taken or none that a user may have.
    """
    viser = viser_of(function)
    checks.count(function, "--port", port, 0, 65535)
    try:
        with socket.socket(socket.AF_INET, socket.SOCK_STREAM) as probe:
            probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            probe.bind((HOST, port))
    except OSError as error:
        raise InputError(
            f"{function}: port {port} cannot be used ({error.strerror}); expected a free one: give another with "
            "--port, or --port 0 for any"
        ) from None
    with _quiet():
        server = viser.ViserServer(host=HOST, port=port, label="tdf view", verbose=False)
    server.gui.configure_theme(show_logo=False, show_share_button=False)
    server.gui.main_panel.dock_right()  # beside the scene, not over it
    server.gui.set_panel_label("tdf view")
    try:
        yield server
    finally:
        with _quiet():
            server.stop()


def _quiet() -> contextlib.AbstractContextManager:
    """Leave out what viser prints whatever `verbose` says: the command's own output is the address."""
    return contextlib.redirect_stdout(io.StringIO())


def address(server: Any) -> str:
    """Where a browser finds a server."""
    return f"http://{HOST}:{server.get_port()}"


def shared_address(function: str, server: Any) -> str:
    """A public link to a server, through the relay of viser's authors: whoever has it sees and moves everything.

    Args:
        function: name that the error message begins with.
        server: the server.

    Raises:
        InputError: the relay does not answer.
    """
    link = server.request_share_url(verbose=False)
    if link is None:
        raise InputError(f"{function}: --share got no link, because the relay does not answer; drop it")
    return link
