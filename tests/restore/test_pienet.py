"""PIE-Net as a restorer: the package's network, loaded whole."""

import importlib.util

import numpy as np
import pytest
import torch

from evsplat.capture import load_capture
from evsplat.cli import main
from evsplat.errors import DataError, WeightsError
from evsplat.events import EventStream
from evsplat.restore import pienet
from evsplat.weights import MissingWeights, sha256_of

from ..seen import seen

needs_package = pytest.mark.skipif(
    importlib.util.find_spec(pienet.PACKAGE) is None, reason=f"needs {pienet.INSTALL}"
)


def _stream(seed: int, count: int, width: int, height: int) -> EventStream:
    rng = np.random.default_rng(seed)
    return EventStream(
        t=np.sort(rng.integers(0, 40_000, count)),
        x=rng.integers(0, width, count).astype(np.uint16),
        y=rng.integers(0, height, count).astype(np.uint16),
        p=rng.choice(np.array([-1, 1], np.int8), count),
    )


@needs_package
def test_every_trained_weight_is_used(tiny_capture) -> None:
    """The package's own loader leaves out 12 of them; its published count is without them."""
    network = pienet.PieNet(seen(tiny_capture()))
    state = torch.load(network.weights, "cpu", weights_only=True)
    loaded = network.network.state_dict()
    assert set(loaded) == set(state)
    assert all(torch.equal(loaded[key], state[key]) for key in state)
    assert sum(value.numel() for value in network.network.parameters()) == 171_121


@needs_package
def test_windows_build_on_each_other_until_reset(tiny_capture) -> None:
    network = pienet.PieNet(seen(tiny_capture()))
    windows = [_stream(seed, 4000, 48, 40) for seed in range(3)]
    first = [network.step(window, 40, 48) for window in windows]
    assert all(picture.shape == (40, 48) for picture in first)
    assert all(0 <= float(picture.min()) <= float(picture.max()) <= 1 for picture in first)
    network.reset()
    again = [network.step(window, 40, 48) for window in windows]
    assert all(torch.equal(a, b) for a, b in zip(first, again, strict=True))
    network.reset()
    assert not torch.equal(network.step(windows[2], 40, 48), first[2])
    with pytest.raises(DataError, match="48x16.*20 pixels"):
        network.step(windows[0], 16, 48)


@needs_package
def test_the_command_writes_a_capture_that_says_what_made_it(tiny_capture, tmp_path, capsys):
    path = tiny_capture(width=64, height=48)
    out = tmp_path / "out"
    assert main(["restore", str(path), "--with", "pienet", "--out", str(out)]) == 0
    made = load_capture(out).provenance["restored"]
    assert made["with"] == "pienet" and made["package"] == "event-pienet 1.1.3"
    assert made["sha256"] == sha256_of(pienet.find_weights())
    assert main(["restore", str(path), "--with", "pienet", "--contrast-threshold", "1", "1"]) == 2
    assert "means nothing to --with pienet" in capsys.readouterr().err


@needs_package
def test_moving_people_get_sharper(captures_root) -> None:
    """A person's edges come back: correlation of fine detail with the truth's, not brightness."""
    capture = load_capture(captures_root / "man_dance_hard_256")
    training = seen(capture)
    restored = pienet.PieNet(training).restore(training, training.train_frames)
    gains = []
    for index, (frame, picture) in enumerate(restored):
        mask = capture.mask(frame) > 0.5
        fine = [_fine(p)[mask] for p in (picture, capture.image(frame), capture.sharp(frame))]
        corr = [torch.corrcoef(torch.stack((part, fine[2])))[0, 1] for part in fine[:2]]
        gains.append(float(corr[0] - corr[1]))
        if index == 3:
            break
    assert np.mean(gains[2:]) > 0.15


def _fine(picture: torch.Tensor) -> torch.Tensor:
    grey = picture.mean(-1)[None, None]
    return (grey - torch.nn.functional.avg_pool2d(grey, 9, 1, 4))[0, 0]


def test_without_the_package_one_sentence_says_how_to_get_it(
    tiny_capture, tmp_path, monkeypatch, capsys
) -> None:
    monkeypatch.setattr(pienet, "PACKAGE", "no_such_package_pie_net")
    with pytest.raises(MissingWeights, match="pip install --no-deps event-pienet"):
        pienet.find_weights()
    arguments = ["restore", str(tiny_capture()), "--with", "pienet", "--out", str(tmp_path / "o")]
    assert main(arguments) == 2
    assert "event-pienet" in capsys.readouterr().err
    assert not (tmp_path / "o").exists()


@needs_package
def test_another_version_of_the_weights_is_refused(tiny_capture, tmp_path, monkeypatch) -> None:
    state = torch.load(pienet.find_weights(), "cpu", weights_only=True)
    state.pop(next(iter(state)))
    torch.save(state, tmp_path / "model.pth")
    monkeypatch.setattr(pienet, "find_weights", lambda: tmp_path / "model.pth")
    with pytest.raises(WeightsError, match="event-pienet==1.1.3"):
        pienet.PieNet(seen(tiny_capture()))
