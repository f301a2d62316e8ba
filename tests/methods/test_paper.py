"""Method `paper`: what it needs is asked for before anything is fitted."""

import json

import pytest

from evsplat.errors import EvsplatError
from evsplat.methods import avatar_parts

from ..small_model import built


@pytest.fixture
def nothing_fitted(monkeypatch):
    def fitted(*_):
        raise AssertionError("fitted before it was refused")

    monkeypatch.setattr(avatar_parts, "fit_skinning", fitted)


def test_a_capture_without_events_is_refused_before_minutes_of_fitting(
    tiny_capture, nothing_fitted
):
    capture = tiny_capture()
    described = json.loads((capture / "capture.json").read_text())
    described["events"] = None
    (capture / "capture.json").write_text(json.dumps(described))
    with pytest.raises(EvsplatError, match="method paper needs events.*event_weight=0"):
        built("paper", capture)


def test_missing_weights_of_a_perceptual_network_are_told_before_the_fit(
    tiny_capture, nothing_fitted, monkeypatch, tmp_path
):
    monkeypatch.setenv("TORCH_HOME", str(tmp_path))
    with pytest.raises(EvsplatError, match="(?i)lpips"):
        built("paper", tiny_capture(), "terms.perceptual=lpips_vgg")
