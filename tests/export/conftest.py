"""A run of a small untrained model, for all that leaves a run."""

from types import SimpleNamespace

import pytest

from evsplat.capture import load_capture
from evsplat.config import override
from evsplat.export import run as exporting
from evsplat.methods import compose, method_config
from evsplat.training.run import GaussianReconstruction

from ..seen import seen

SMALL = (
    "human.count=150",
    "deform.width=16",
    "deform.colour_width=16",
    "scene.backdrop_stride_px=4",
)


@pytest.fixture
def reconstruction(tiny_capture):
    capture = load_capture(tiny_capture())
    config = method_config("paper", override({}, (*SMALL, "deform.shadow_lights=2")), where="test")
    return capture, GaussianReconstruction(
        "paper", compose(config, seen(capture), 0, fit=False).model
    )


@pytest.fixture
def run(reconstruction, tmp_path, monkeypatch):
    """A folder that `load_run` takes for a run of a small untrained model."""
    capture, model = reconstruction
    path = tmp_path / "run"
    path.mkdir()
    loaded = SimpleNamespace(
        path=path, capture=capture, reconstruction=model, method="paper", iteration=7
    )
    monkeypatch.setattr(exporting, "load_run", lambda *_, **__: loaded)
    return loaded
