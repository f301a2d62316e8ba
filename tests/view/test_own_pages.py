"""The viewer talks to its own page and to no other, and junk costs it a line."""

import asyncio
import gzip
import logging
from pathlib import Path
from urllib.request import Request, urlopen

import pytest

viser = pytest.importorskip("viser", reason="needs the extra view: pip install 'evsplat[view]'")

import msgspec  # noqa: E402
import websockets  # noqa: E402
from websockets.exceptions import ConnectionClosed, InvalidStatus  # noqa: E402

from evsplat.view.own_pages import log_in_a_line, own_pages_alone, refusal  # noqa: E402
from evsplat.view.panel import plain  # noqa: E402


@pytest.mark.parametrize(
    ("origin", "host", "listens_at", "opened"),
    [
        ("http://localhost:8080", "localhost:8080", "127.0.0.1", True),
        ("http://127.0.0.1:8080", "127.0.0.1:8080", "127.0.0.1", True),
        ("http://[::1]:8080", "[::1]:8080", "::1", True),
        (None, "127.0.0.1:8080", "127.0.0.1", True),  # a program
        ("http://LocalHost:9000", "localhost:9000", "127.0.0.1", True),  # through ssh -L
        ("http://evil.example", "127.0.0.1:8080", "127.0.0.1", False),
        ("http://localhost:3000", "localhost:8080", "127.0.0.1", False),  # another page of ours
        ("http://localhost:8080.evil.example", "localhost:8080", "127.0.0.1", False),
        ("null", "localhost:8080", "127.0.0.1", False),  # a page in a sandbox
        ("", "localhost:8080", "127.0.0.1", False),
        # its name leads here
        ("http://evil.example:8080", "evil.example:8080", "127.0.0.1", False),
        ("http://localhost.evil.example", "localhost.evil.example", "127.0.0.1", False),
        ("http://lab-7:8080", "lab-7:8080", "0.0.0.0", True),
        ("http://evil.example", "lab-7:8080", "0.0.0.0", False),
        ("http://[", "[", "127.0.0.1", False),
    ],
)
def test_a_page_may_talk_to_where_it_comes_from(origin, host, listens_at, opened):
    why = refusal([] if origin is None else [origin], [host], listens_at)
    assert (why is None) == opened


def test_a_request_with_two_hosts_or_two_origins_is_refused():
    assert refusal([], [], "127.0.0.1") and refusal([], ["localhost", "localhost"], "127.0.0.1")
    assert refusal(["http://localhost", "http://evil.example"], ["localhost"], "127.0.0.1")


@pytest.fixture(name="server", scope="module")
def _server():
    with own_pages_alone("127.0.0.1"):
        server = viser.ViserServer("127.0.0.1", 18750, verbose=False)
    log_in_a_line(server.get_event_loop())
    server.gui.add_slider("x", 0.0, 1.0, 0.1, 0.5)
    yield server
    server.stop()


def connected(server, **headers):
    return websockets.connect(
        f"ws://127.0.0.1:{server.get_port()}",
        subprotocols=[f"viser-v{viser.__version__}"],
        max_size=None,
        **headers,
    )


def test_the_page_of_another_site_cannot_open_the_socket(server):
    own = f"http://127.0.0.1:{server.get_port()}"

    async def visit(origin):
        async with connected(server, origin=origin) as socket:
            return len(await asyncio.wait_for(socket.recv(), 10))

    assert asyncio.run(visit(own)) > 0
    for origin in ("http://evil.example", "null", own + "0"):
        with pytest.raises(InvalidStatus) as refused:
            asyncio.run(visit(origin))
        assert refused.value.response.status_code == 403


JUNK = [
    "text",
    b"",
    b"\xff" * 100,
    msgspec.msgpack.encode([1, 2]),
    msgspec.msgpack.encode({"type": "NoSuchMessage"}),
    msgspec.msgpack.encode({"type": "GuiUpdateMessage", "uuid": 7, "updates": []}),
    msgspec.msgpack.encode({"type": "GuiUpdateMessage", "uuid": "x", "updates": {"value": {}}}),
    msgspec.msgpack.encode({"type": "ViewerCameraMessage", "fov": "wide"}),
]


@pytest.mark.parametrize("junk", JUNK, ids=range(len(JUNK)))
def test_junk_costs_one_line(server, caplog, capfd, junk):
    async def send():
        async with connected(server) as socket:
            await socket.send(junk)
            try:
                for _ in range(20):
                    await asyncio.wait_for(socket.recv(), 0.5)
            except (TimeoutError, ConnectionClosed):
                pass

    with caplog.at_level(logging.INFO):
        asyncio.run(send())
    said = [record.getMessage() for record in caplog.records if record.levelno > logging.INFO]
    assert len(said) <= 1 and all("\n" not in line for line in said)
    assert "Traceback" not in "".join(capfd.readouterr())
    asyncio.run(_still_there(server))


async def _still_there(server):
    async with connected(server) as socket:
        assert await asyncio.wait_for(socket.recv(), 10)


@pytest.mark.parametrize("packed", [True, False])
def test_the_page_looks_for_its_server_while_it_is_seen(server, packed):
    """Also where another window has the focus; what else the page is stays as viser has it."""
    encoding = {"Accept-Encoding": "gzip" if packed else "identity"}
    address = f"http://127.0.0.1:{server.get_port()}/"
    with urlopen(Request(address, headers=encoding)) as answer:
        page = answer.read()
        assert int(answer.headers["Content-Length"]) == len(page)
    page = gzip.decompress(page) if packed else page
    before, _, rest = page.partition(b"<script>")
    script, _, after = rest.partition(b"</script>")
    assert b"document.hasFocus = " in script and b"visibilitychange" in script
    build = Path(viser.__file__).parent / "client" / "build" / "index.html"
    assert before + after == build.read_bytes()


def test_a_connection_that_speaks_no_http_is_quiet(server, caplog):
    async def knock():
        reader, writer = await asyncio.open_connection("127.0.0.1", server.get_port())
        writer.write(b"\x16\x03\x01junk\r\n\r\n")
        await writer.drain()
        await asyncio.wait_for(reader.read(), 10)
        writer.close()

    asyncio.run(knock())
    assert [record for record in caplog.records if record.exc_info] == []


def test_a_name_is_no_markdown_and_no_html():
    assert plain("walk 3") == "walk 3"
    assert not set(plain("<script>alert(1)</script>**[x](y)`{z}")) & set("<>*[]()`{}")
