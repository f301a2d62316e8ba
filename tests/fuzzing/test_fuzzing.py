"""A share of benchmarks/fuzz.py: damaged files of the cheap kinds are read rightly or refused."""

from collections import Counter
from pathlib import Path

import pytest

from .inputs import Folder, rng_of
from .readers import READERS

CHEAP = {
    **{"json": 60, "settings": 20, "arrays": 60, "pickles": 60, "points": 60, "poses": 10},
    **{"motions": 20, "keypoints": 30, "camera paths": 40, "pictures": 40, "weights": 30},
    **{"event files": 20, "captures": 4},
    **{"import video": 6, "import davis": 6, "import folder": 6},
}
"""Inputs by reader; training, data sets, runs and benches take too long here."""


@pytest.mark.parametrize("name", CHEAP)
def test_damaged_files_are_read_rightly_or_refused(tmp_path: Path, name: str) -> None:
    (tmp_path / "sound").mkdir()
    READERS[name].write(tmp_path / "sound")
    folder = Folder(READERS[name], tmp_path / "sound", tmp_path / "copy")
    folder.check_sound()
    found = Counter(folder.attempt(rng_of(name, 7, number)) for number in range(CHEAP[name]))
    assert found["refused"] > 0
