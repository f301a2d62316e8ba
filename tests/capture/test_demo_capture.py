"""The capture that ships with the package: whole, small and free."""

from pathlib import Path

import numpy as np
import torch

from evsplat.capture import load_capture


def test_demo_is_small_and_carries_its_licences(demo_capture_path: Path) -> None:
    files = [path for path in demo_capture_path.rglob("*") if path.is_file()]
    assert sum(path.stat().st_size for path in files) <= 8_000_000
    text = (demo_capture_path / "LICENSE.txt").read_text()
    for words in ("CC0", "MIT License", "Xue Bin Peng", "LAAS-CNRS", "scikit-image"):
        assert words in text


def test_demo_has_all_truth_of_its_source(demo_capture_path: Path, captures_root: Path) -> None:
    demo = load_capture(demo_capture_path)
    source = load_capture(captures_root / "man_dance_hard_256")
    assert len(demo.frames) == len(source.frames) == 31
    assert [view.frame for view in demo.novel_views] == [v.frame for v in source.novel_views]
    for frame in demo.frames[::10]:
        assert torch.equal(demo.image(frame), source.image(frame.name))
        assert torch.equal(demo.sharp(frame), source.sharp(frame.name))
    assert demo.events is not None and source.events is not None
    rounded = demo.provenance["events"]["time_quantum_us"]
    ours = demo.events.between(*demo.events.time_range_us)
    theirs = source.events.between(*source.events.time_range_us)
    assert len(ours) == len(theirs)
    assert np.abs(ours.t - theirs.t).max() <= rounded // 2
    assert np.array_equal(demo.body_file.poses, source.body_file.poses)
