"""RobustVideoMatting's calling convention, on a made-up TorchScript network that keeps score."""

from collections.abc import Callable
from pathlib import Path

import pytest
import torch
from torch import Tensor, nn

from evsplat.capture import load_capture
from evsplat.errors import WeightsError
from evsplat.masks import mask_capture
from evsplat.masks.rvm import FILE, RobustVideoMatting, find_weights

from ..seen import seen

Factory = Callable[..., Path]
pytestmark = pytest.mark.filterwarnings("ignore:.torch.jit:DeprecationWarning")


class Counting(nn.Module):
    """The signature of the published network; alpha is the share of frames seen so far.

    Each state is a picture-sized map that grows by its own step per frame: a state that is lost,
    swapped or shared shows in the mask.
    """

    def forward(
        self,
        src: Tensor,
        r1: Tensor | None,
        r2: Tensor | None,
        r3: Tensor | None,
        r4: Tensor | None,
        downsample_ratio: float = 1.0,
        segmentation_pass: bool = False,
    ) -> list[Tensor]:
        shape = [src.shape[0], 1, src.shape[2], src.shape[3]]
        r1 = torch.zeros(shape) if r1 is None else r1
        r2 = torch.zeros(shape) if r2 is None else r2
        r3 = torch.zeros(shape) if r3 is None else r3
        r4 = torch.zeros(shape) if r4 is None else r4
        in_order = (r2 == 2 * r1) & (r3 == 3 * r1) & (r4 == 4 * r1)
        pha = torch.where(in_order, (r1 + downsample_ratio) / 100.0, torch.ones(shape))
        # brightness of the red channel, so that a wrong channel order or range shows too
        pha = pha + 0.5 * src[:, :1]
        return [src, pha, r1 + 1, r2 + 2, r3 + 3, r4 + 4]


class OldStyle(nn.Module):
    """Another network altogether."""

    def forward(self, src: Tensor) -> Tensor:
        return src


def save_network(network: nn.Module, path: Path) -> Path:
    torch.jit.save(torch.jit.script(network), str(path))
    return path


def test_states_of_one_frame_go_into_the_next(tiny_capture: Factory, tmp_path: Path) -> None:
    capture = seen(tiny_capture(frames=14))
    masker = RobustVideoMatting(capture, weights=save_network(Counting(), tmp_path / FILE))
    found = list(masker.masks(capture, capture.train_frames[2:]))
    assert [frame.index for frame, _ in found] == [2, 3, 4, 5, 6, 10, 11, 12, 13]
    for frame, mask in found:
        red = capture.image(frame)[..., 0]
        # held-out frames are not seen, and the states begin anew behind them
        number = frame.index + 1 if frame.index < 7 else frame.index - 9
        torch.testing.assert_close(mask, number / 100 + 0.5 * red)


def test_large_pictures_are_downsampled_inside(tiny_capture: Factory, tmp_path: Path) -> None:
    capture = seen(tiny_capture(frames=10, width=1024, height=96))
    masker = RobustVideoMatting(capture, weights=save_network(Counting(), tmp_path / FILE))
    frame, mask = next(iter(masker.masks(capture, capture.train_frames)))
    torch.testing.assert_close(mask, 0.5 / 100 + 0.5 * capture.image(frame)[..., 0])


def test_a_capture_gets_its_masks(tiny_capture: Factory, tmp_path: Path, monkeypatch) -> None:
    monkeypatch.setenv("EVSPLAT_RVM", str(tmp_path))
    save_network(Counting(), tmp_path / FILE)
    path = tiny_capture()
    made = load_capture(mask_capture(path, tmp_path / "masked", method="rvm"))
    assert made.provenance["masks"]["weights"] == FILE
    expected = 0.04 + 0.5 * made.image("0003")[..., 0]
    assert (made.mask("0003") - expected).abs().max() < 0.003


def test_a_missing_file_is_named_with_its_size_and_place(tmp_path: Path, monkeypatch) -> None:
    monkeypatch.delenv("EVSPLAT_RVM", raising=False)
    monkeypatch.setenv("TORCH_HOME", str(tmp_path / "torch"))
    for weights in (None, tmp_path / "nothing", tmp_path):
        with pytest.raises(WeightsError) as caught:
            find_weights(weights)
        for words in (FILE, "15 MB", "github.com/PeterL1n", "EVSPLAT_RVM", "checkpoints"):
            assert words in str(caught.value)
    cached = tmp_path / "torch" / "hub" / "checkpoints" / FILE
    cached.parent.mkdir(parents=True)
    assert find_weights(save_network(Counting(), cached)) == cached
    assert find_weights() == cached


def test_other_files_are_refused(tiny_capture: Factory, tmp_path: Path) -> None:
    path, out = tiny_capture(), tmp_path / "masked"
    (tmp_path / "rvm_mobilenetv3.pth").write_bytes(b"PK\x03\x04 weights")
    with pytest.raises(WeightsError, match="not a TorchScript file"):
        mask_capture(path, out, method="rvm", weights=tmp_path / "rvm_mobilenetv3.pth")
    other = save_network(OldStyle(), tmp_path / "other.torchscript")
    with pytest.raises(WeightsError, match="does not compute RobustVideoMatting"):
        mask_capture(path, out, method="rvm", weights=other)
    assert not out.exists()
