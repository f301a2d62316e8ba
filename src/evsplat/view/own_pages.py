"""Who may talk to the viewer: the page that it serves itself, and no other page of the browser.

A browser lets any page open a websocket to this machine, and says whose page it is (RFC 6455,
section 10.2).
"""

import asyncio
import ipaddress
import logging
import threading
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from http import HTTPStatus
from typing import Any
from urllib.parse import urlsplit

import websockets.asyncio.server

from evsplat.view.page_messages import MOST_BYTES, check_message
from evsplat.view.served_page import found_when_seen
from evsplat.wording import in_a_line

logger = logging.getLogger(__name__)

_one_at_a_time = threading.Lock()


def refusal(origins: Sequence[str], hosts: Sequence[str], listens_at: str) -> str | None:
    """Why a websocket is refused, by the headers Origin and Host; None where it may be opened.

    A page's origin is to be the address that it asks for. Programs that are no browsers name no
    origin. Where only this machine may come, the address is to be this machine's: a page elsewhere
    may have its own name lead here.
    """
    if len(hosts) != 1:
        return "a request without one Host"
    asked = hosts[0].lower()
    if _is_loopback(listens_at) and not _is_loopback(_name(asked)):
        return f"a request for {asked[:80]}"
    if any(urlsplit(origin).netloc.lower() != asked for origin in origins):
        return f"a page of {', '.join(origins)[:80]}"
    return None


@contextmanager
def own_pages_alone(listens_at: str) -> Iterator[None]:
    """Servers of websockets that are started in the block refuse other pages.

    Their own finds them again when it is seen (`found_when_seen`). Messages that are none of it
    (`check_message`) end their connection with one line in the log. viser has no setting for any
    of it.
    """
    module: Any = websockets.asyncio.server
    serve = module.serve
    silent = logging.getLogger(f"{__name__}.handshakes")
    silent.setLevel(logging.CRITICAL)

    def guarded(handler: Any, *arguments: Any, process_request: Any = None, **rest: Any) -> Any:
        def judged(connection: Any, request: Any) -> Any:
            headers = request.headers
            if headers.get_all("Upgrade"):
                why = refusal(headers.get_all("Origin"), headers.get_all("Host"), listens_at)
                if why is not None:
                    logger.warning("The viewer refused %s.", why)
                    return connection.respond(HTTPStatus.FORBIDDEN, f"Refused: {why}.\n")
            answer = process_request(connection, request) if process_request else None
            return None if answer is None else found_when_seen(answer)

        rest["logger"], rest["max_size"] = silent, MOST_BYTES
        return serve(_said_in_a_line(handler), *arguments, process_request=judged, **rest)

    with _one_at_a_time:
        module.serve = guarded
        try:
            yield
        finally:
            module.serve = serve


def log_in_a_line(loop: asyncio.AbstractEventLoop) -> None:
    """Have the tasks of a loop that fail say so in one line each."""

    def failed(_: asyncio.AbstractEventLoop, context: dict[str, Any]) -> None:
        error = context.get("exception")
        logger.warning("The viewer could not follow a message (%s).", in_a_line(error or context))

    loop.call_soon_threadsafe(loop.set_exception_handler, failed)


def _said_in_a_line(handler: Any) -> Any:
    async def handled(connection: Any) -> None:
        receive = connection.recv

        async def received(*arguments: Any, **options: Any) -> Any:
            message = await receive(*arguments, **options)
            check_message(message)
            return message

        connection.recv = received
        try:
            await handler(connection)
        except Exception as error:
            logger.warning(
                "The viewer closed a connection: no message of its page (%s).", in_a_line(error)
            )
            logger.debug("", exc_info=True)
            await connection.close(1003)

    return handled


def _name(host: str) -> str:
    """The name or address in ``name:port`` or ``[address]:port``."""
    try:
        return urlsplit(f"//{host}").hostname or ""
    except ValueError:
        return ""


def _is_loopback(host: str) -> bool:
    if host == "localhost" or host.endswith(".localhost"):
        return True
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return False
