"""A share of benchmarks/fuzz.py: damaged recordings are read rightly or refused."""

import resource
from collections import Counter
from pathlib import Path

import numpy as np
import pytest

from . import encoders, mutations
from .helpers import random_stream

SEEDS = mutations.seeds(encoders, random_stream(0, 300))
MEMORY_BYTES = 1 << 30


@pytest.mark.parametrize("name", SEEDS)
def test_sound_recording_is_read(tmp_path: Path, name: str) -> None:
    path = tmp_path / ("e.bag" if name == "bag" else "e")
    path.write_bytes(SEEDS[name][1])
    assert mutations.outcome(path, SEEDS[name][0], repair=False) == "read"


@pytest.mark.parametrize("name", SEEDS)
def test_damaged_recording_is_read_rightly_or_refused(tmp_path: Path, name: str) -> None:
    """Within a gigabyte beyond what the tests already take."""
    format, data = SEEDS[name]
    path = tmp_path / ("e.bag" if name == "bag" else "e")
    rng = np.random.default_rng(len(name))
    pages = int(Path("/proc/self/statm").read_text().split()[0])
    before = resource.getrlimit(resource.RLIMIT_AS)
    limit = pages * resource.getpagesize() + MEMORY_BYTES
    resource.setrlimit(resource.RLIMIT_AS, (limit, before[1]))
    try:
        results: Counter[str] = Counter()
        for _ in range(60):
            path.write_bytes(mutations.damaged(data, rng))
            results[mutations.outcome(path, format, repair=bool(rng.random() < 0.5))] += 1
    finally:
        resource.setrlimit(resource.RLIMIT_AS, before)
    assert results["refused"] >= 5, results
