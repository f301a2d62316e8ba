"""A run of a small untrained model, for all that leaves a run."""

from types import SimpleNamespace

import pytest
import torch

from evsplat.capture import load_capture
from evsplat.export import run as exporting
from evsplat.training.reconstruction import GaussianReconstruction

from ..small_model import built


@pytest.fixture
def reconstruction(tiny_capture):
    capture = load_capture(tiny_capture())
    settings = ("human.count=150", "scene.backdrop_stride_px=4", "lamps=2")
    model = built("evsplat", capture, *settings).model
    generator = torch.Generator().manual_seed(0)
    with torch.no_grad():  # colours that tell a person from its negative
        model.gaussians.colour_logits.normal_(generator=generator)
    return capture, GaussianReconstruction("evsplat", model)


@pytest.fixture
def run(reconstruction, tmp_path, monkeypatch):
    """A folder that `load_run` takes for a run of a small untrained model."""
    capture, model = reconstruction
    path = tmp_path / "run"
    path.mkdir()
    loaded = SimpleNamespace(
        path=path, capture=capture, reconstruction=model, method="evsplat", iteration=7
    )
    monkeypatch.setattr(exporting, "opened", lambda *_, **__: loaded)
    return loaded
