"""Whether a short training is worth anything: held-out pictures of the demo capture."""

from pathlib import Path

import pytest
import torch

from evsplat.capture import load_capture
from evsplat.methods.trivial import MedianBackground, NearestFrame
from evsplat.similarity import psnr
from evsplat.training import load_run, train


@pytest.mark.slow
def test_a_short_training_beats_both_trivial_answers_in_full_frame_and_on_the_person(
    demo_capture_path: Path, tmp_path: Path
) -> None:
    train(
        demo_capture_path,
        out=tmp_path / "run",
        iterations=10,
        # What no picture shows is filled in tests/models/discs/test_fill.py.
        overrides=(
            "human.count=2500",
            "densify.max_human=2500",
            "scene.prefit_steps=40",
            "fill=0",
        ),
    )
    capture = load_capture(demo_capture_path)
    sources = {
        "trained": load_run(tmp_path / "run").reconstruction,
        "median": MedianBackground(capture),
        "nearest": NearestFrame(capture),
    }
    full = {name: [] for name in sources}
    person = {name: [] for name in sources}
    for frame in capture.test_frames:
        truth, mask = capture.sharp(frame), capture.mask(frame) > 0.5
        for name, source in sources.items():
            picture = source.render(capture.camera(frame), [frame.mid_us]).rgb[0].clamp(0, 1)
            full[name].append(psnr(picture, truth))
            person[name].append(psnr(picture, truth, mask=mask))
    for values in (full, person):
        mean = {name: float(torch.tensor(scores).mean()) for name, scores in values.items()}
        assert mean["trained"] > max(mean["median"], mean["nearest"]), mean
