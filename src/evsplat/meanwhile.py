"""Work on a thread of its own while the caller goes on: files are written while more is drawn."""

from collections import deque
from collections.abc import Callable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import contextmanager
from typing import Any

from evsplat.disk import uninterrupted

_MOST_WAITING = 8


@contextmanager
def meanwhile() -> Iterator[Callable[..., None]]:
    """Give ``do(work, *arguments)``, which has work done on one thread, in the order of the calls.

    Behind a few that wait the caller waits too, so that memory does not grow. Whatever was handed
    over is done by the end of the block, whoever stops it, once or twice. The first error of the
    work comes out of a later call, or of the end of the block.
    """
    worker = ThreadPoolExecutor(1, thread_name_prefix="meanwhile")
    waiting: deque[Future[object]] = deque()

    def do(work: Callable[..., object], *arguments: Any) -> None:
        if len(waiting) == _MOST_WAITING:
            waiting.popleft().result()
        waiting.append(worker.submit(work, *arguments))

    try:
        yield do
        for one in waiting:
            one.result()
    finally:
        with uninterrupted():
            worker.shutdown()
