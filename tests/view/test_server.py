"""Where the viewer listens."""

import socket

import pytest

pytest.importorskip("viser", reason="needs the extra view: pip install 'evsplat[view]'")

from evsplat.errors import ConfigError  # noqa: E402
from evsplat.view.server import _free_port  # noqa: E402


def test_a_port_in_use_gives_way_to_a_later_one():
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        port = taken.getsockname()[1]
        found = _free_port("127.0.0.1", port)
        assert port < found <= port + 20
    assert _free_port("127.0.0.1", port) == port


@pytest.mark.parametrize(
    ("host", "port", "named"),
    [("127.0.0.1", 0, "--port 0"), ("no.such.host.invalid", 8080, "no.such.host.invalid")],
)
def test_an_address_that_cannot_be_had_is_named(host, port, named):
    with pytest.raises(ConfigError, match=named):
        _free_port(host, port)
