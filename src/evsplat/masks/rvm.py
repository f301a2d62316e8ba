"""Robust Video Matting (Lin et al., WACV 2022) from the user's own TorchScript file.

The network is GPL-3 and not part of evsplat; its published TorchScript is loaded as data. It takes
``(src, r1, r2, r3, r4, downsample_ratio)`` and gives ``[fgr, pha, r1, r2, r3, r4]``: the recurrent
states of one frame go into the next (None before the first).
"""

import os
import warnings
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from evsplat.capture import Frame, TrainingCapture
from evsplat.errors import WeightsError
from evsplat.pictures import shown
from evsplat.weights import MissingWeights, home_as_tilde, hub_folder, sha256_of

WEIGHTS_VARIABLE = "EVSPLAT_RVM"
"""Environment variable with the TorchScript file, or a folder that holds it."""
FILE = "rvm_mobilenetv3_fp32.torchscript"
OTHER_FILE = "rvm_resnet50_fp32.torchscript"
SOURCE = "https://github.com/PeterL1n/RobustVideoMatting/releases/tag/v1.0.0"
SIDE_PX = 512
"""The network's first stage sees the picture with its longer side no larger than this."""


class RobustVideoMatting:
    """The person as the network sees it, frame after frame."""

    name = "rvm"

    def __init__(
        self,
        capture: TrainingCapture,
        *,
        weights: Path | str | None = None,
        device: torch.device | str = "cpu",
    ) -> None:
        """``weights``: the TorchScript file or its folder; else looked for by `find_weights`.

        Raises:
            WeightsError: there is none, or it is not this network.
        """
        self._path = find_weights(weights)
        self._device = torch.device(device)
        self._model = _load(self._path, self._device)

    def masks(
        self, capture: TrainingCapture, frames: Sequence[Frame]
    ) -> Iterator[tuple[Frame, Float[Tensor, "H W"]]]:
        """The states begin anew with each camera and behind held-out frames."""
        asked = {frame.name for frame in frames}
        states: dict[str, list[Tensor | None]] = {}
        for frame in capture.frames:
            if frame.split != "train":
                states.clear()
                continue
            coded = shown(capture.image(frame), capture.transfer(frame))
            picture = coded.permute(2, 0, 1)[None].contiguous().to(self._device)
            ratio = min(1.0, SIDE_PX / max(picture.shape[2:]))
            before = states.get(frame.camera, [None] * 4)
            alpha, states[frame.camera] = self._step(picture, before, ratio)
            if frame.name in asked:
                yield frame, alpha

    def provenance(self) -> dict[str, Any]:
        """The file that was used."""
        return {"weights": self._path.name, "sha256": sha256_of(self._path)}

    def _step(
        self, picture: Float[Tensor, "1 3 H W"], states: list[Tensor | None], ratio: float
    ) -> tuple[Float[Tensor, "H W"], list[Tensor | None]]:
        expected = "RobustVideoMatting's [fgr, pha, r1, r2, r3, r4] of (src, r1, r2, r3, r4, ratio)"
        try:
            with torch.inference_mode():
                given = self._model(picture, *states, ratio)
        except RuntimeError as error:
            last = str(error).strip().splitlines()[-1]
            raise WeightsError(f"{self._path}: does not compute {expected} ({last}).") from error
        size = (1, 1, *picture.shape[2:])
        if not isinstance(given, (list, tuple)) or len(given) != 6 or given[1].shape != size:
            raise WeightsError(f"{self._path}: gives something else than {expected}.")
        return given[1][0, 0].float().cpu().clamp(0, 1), list(given[2:])


def find_weights(weights: Path | str | None = None) -> Path:
    """The TorchScript file: as given, from the environment variable, or in torch's cache."""
    named = weights or os.environ.get(WEIGHTS_VARIABLE)
    path = Path(named or hub_folder()).expanduser()
    for file in (path, path / FILE, path / OTHER_FILE):
        if file.is_file():
            return file
    if named:
        raise WeightsError(f"{path}: no such file, and no folder with {FILE}. {_advice()}")
    raise MissingWeights(f"RobustVideoMatting: no network. {_advice()}")


def _advice() -> str:
    return (
        f"Fetch {FILE} (15 MB, or {OTHER_FILE}, 103 MB) from {SOURCE} and give its place with "
        f"--weights or {WEIGHTS_VARIABLE}, or put it in {home_as_tilde(hub_folder())}."
    )


def _load(path: Path, device: torch.device) -> Any:
    try:
        with warnings.catch_warnings():
            # torch is giving TorchScript up, but the network is published in nothing better
            warnings.simplefilter("ignore", DeprecationWarning)
            return torch.jit.load(str(path), map_location=device).eval()
    except (RuntimeError, ValueError, OSError) as error:
        reason = str(error).strip().splitlines()[0]
        raise WeightsError(
            f"{path}: not a TorchScript file ({reason}). The .pth files hold weights only. "
            f"{_advice()}"
        ) from error
