import socket
import sys
import urllib.request

import pytest

from tdf_jax._internal.errors import InputError
from tdf_jax.viewer import local_server
from tdf_jax.viewer.local_server import HOST, address, serving, shared_address


def test_a_missing_extra_is_named(monkeypatch):
    monkeypatch.setitem(sys.modules, "viser", None)
    with pytest.raises(InputError, match=r"tdf view: viser is not installed; .*pip install 'tdf_jax\[viewer\]'"):
        local_server.viser_of("tdf view")


def test_a_server_listens_on_this_machine_alone_and_stops(capsys):
    pytest.importorskip("viser", reason="the extra 'viewer' is not installed")
    with serving("tdf view", 0) as server:
        assert server.get_host() == HOST == "127.0.0.1"
        port = server.get_port()
        assert address(server) == f"http://127.0.0.1:{port}" and port > 0
        with urllib.request.urlopen(address(server), timeout=5) as page:
            assert b"<html" in page.read()
        with pytest.raises(InputError, match=rf"port {port} cannot be used .*--port, or --port 0 for any"):
            with serving("tdf view", port):
                pass
    with pytest.raises(OSError):
        socket.create_connection((HOST, port), 5)
    assert capsys.readouterr().out == ""


@pytest.mark.parametrize("port", [-1, 70000])
def test_no_port_is_refused(port):
    pytest.importorskip("viser", reason="the extra 'viewer' is not installed")
    with pytest.raises(InputError, match=f"--port is {port}; expected a whole number from 0 to 65535"):
        with serving("tdf view", port):
            pass


def test_a_relay_that_does_not_answer_is_named():
    class Server:
        def request_share_url(self, verbose):
            return None

    with pytest.raises(InputError, match="--share got no link"):
        shared_address("tdf view", Server())
