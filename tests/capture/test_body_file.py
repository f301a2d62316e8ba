"""Damaged body files end in one sentence, whatever was damaged."""

import numpy as np
import pytest

from evsplat.errors import DataError
from evsplat.untrusted.arrays import read_plain_npz


@pytest.mark.parametrize("seed", range(4))
def test_damage_is_a_sentence_or_plain_arrays(seed, tmp_path):
    rng = np.random.default_rng(seed)
    path = tmp_path / "body.npz"
    np.savez(path, times_us=np.arange(5), poses=rng.normal(size=(5, 3, 3)), model="rig")
    whole = path.read_bytes()
    refused = 0
    for _ in range(300):
        damaged = bytearray(whole)
        for place in rng.integers(0, len(whole), rng.integers(1, 6)):
            damaged[place] = rng.integers(0, 256)
        path.write_bytes(damaged[: rng.integers(1, len(whole)) if rng.random() < 0.3 else None])
        try:
            arrays = read_plain_npz(path)
        except DataError as error:
            refused += 1
            assert str(path) in str(error) and "\n" not in str(error)
        else:
            assert all(array.dtype != object for array in arrays.values())
    assert refused > 100
