"""A line for every cell that ends, and one that says how far the bench is."""

import sys
import threading
import time
from collections.abc import Sequence
from typing import Any

from tqdm import tqdm

from evsplat.benching.cell import FAILED, Cell
from evsplat.benching.folder import BenchFolder
from evsplat.benching.plan import Plan

_REFRESH_S = 1.0
_REASON_LENGTH = 200


class Progress:
    """Prints to stderr; a context manager."""

    def __init__(self, plan: Plan, todo: Sequence[Cell], folder: BenchFolder) -> None:
        self._titles = {row.name: row.shown for row in plan.suite.rows}
        self._total, self._ended, self._failed = len(todo), 0, 0
        self._trained, self._to_train = 0, sum(cell.trains for cell in todo)
        self._started = time.monotonic()
        suite, done = plan.suite, len(plan.cells) - len(todo)
        _say(
            f"suite {suite.name}: {_count(len(plan.sources), 'capture')} x "
            f"{_count(len(suite.rows), 'row')} x {_count(len(suite.seeds), 'seed')}; "
            f"{_count(len(todo), 'cell')} to do, {done} done before; logs in {folder.path / 'logs'}"
        )
        for sentence in plan.missing.values():
            _say(sentence)
        self._bar = tqdm(
            total=len(todo),
            bar_format="{n_fmt}/{total_fmt} cells |{bar:24}| {elapsed}{postfix}",
            disable=not sys.stderr.isatty(),
            dynamic_ncols=True,
        )
        self._over = threading.Event()
        self._beat = threading.Thread(target=self._refresh, daemon=True)
        self._beat.start()

    def __enter__(self) -> "Progress":
        return self

    def __exit__(self, *_: object) -> None:
        self._over.set()
        self._beat.join()
        self._bar.close()

    def ended(self, cell: Cell, record: dict[str, Any]) -> None:
        """Tell what came of a cell."""
        self._ended += 1
        if record["status"] == FAILED:
            self._failed += 1
            self._to_train -= cell.trains  # it took no time that tells of the others'
            what = f"failed: {record['reason'][:_REASON_LENGTH]}"
        else:
            self._trained += cell.trains
            figures = record["protocols"]["standard"]
            psnr = [figures[region]["psnr"] for region in ("full", "person_crop", "person_mask")]
            shown = " / ".join("–" if value is None else f"{value:.2f}" for value in psnr)
            what = f"{shown} dB (full / crop / mask), {record['seconds'] / 60:.1f} min"
        place = f"{cell.capture.name} · {self._titles[cell.row]} · seed {cell.seed}"
        _say(f"[{self._ended}/{self._total}{self._left()}] {place}: {what}")
        self._bar.set_postfix_str(f"{self._failed} failed{self._left()}", refresh=False)
        self._bar.update()

    def _left(self) -> str:
        """Expected time to the end, by the cells that train; empty before the first of them."""
        if not self._trained:
            return ""
        elapsed = time.monotonic() - self._started
        minutes = elapsed / self._trained * (self._to_train - self._trained) / 60
        return f", {minutes:.0f} min left"

    def _refresh(self) -> None:
        while not self._over.wait(_REFRESH_S):
            self._bar.refresh()


def _count(number: int, what: str) -> str:
    return f"{number} {what}" + ("s" if number != 1 else "")


def _say(text: str) -> None:
    tqdm.write(text, file=sys.stderr)
