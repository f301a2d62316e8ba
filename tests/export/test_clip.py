"""The page that plays: what viser is given."""

import re
from dataclasses import replace

import numpy as np
import pytest

from evsplat.export import clip, export_run
from evsplat.export.cloud import cloud_of
from evsplat.models.smoothing import widened

from .clouds import covariances, random_cloud

pytest.importorskip("viser", reason="needs the extra view")

pytestmark = pytest.mark.filterwarnings("error::DeprecationWarning")


def test_the_recording_becomes_one_page(run, monkeypatch, capfd):
    recorder = run.capture.camera(run.capture.frames[5])
    run.reconstruction = replace(run.reconstruction, recorders=(recorder,))
    shown = []
    show = clip._show

    def watched(server, name, cloud, handle=None):
        handle = show(server, name, cloud, handle)
        # 16 bits of covariance, of Gaussians down to a third of a millimetre.
        size = clip._ENLARGED
        want = size**2 * covariances(cloud.quaternions, cloud.scales)
        error = np.abs(np.array(handle.covariances) - want).max((1, 2))
        assert (error / want.max((1, 2))).max() < 2e-3
        np.testing.assert_allclose(np.array(handle.centers) / size, cloud.means, atol=1e-6)
        shown.append((name, cloud))
        return handle

    monkeypatch.setattr(clip, "_show", watched)
    page = export_run(run.path, "html", fps=10)
    assert page == run.path / "exports" / "clip.html"
    names = [name for name, _ in shown]
    # 0.36 s at 10 pictures per second.
    assert names == ["/scene"] + 4 * ["/person"]
    capture = run.capture
    times = [capture.frames[0].mid_us + 100_000 * k for k in range(4)]
    camera = capture.camera(capture.frames[5])
    for time, (_, cloud) in zip(times, shown[1:], strict=True):
        (person,) = run.reconstruction.splats(camera, [time], parts="human")
        np.testing.assert_allclose(cloud.means, person.means[0].detach(), atol=1e-6)
        # As wide as in the recorded picture, of which a pixel is many of the window's.
        factor = 720 / camera.height
        larger = camera.resized(round(factor * camera.width), 720)
        wide = widened(person, run.reconstruction.low_pass, larger, [camera])
        np.testing.assert_allclose(cloud.scales, cloud_of(wide).scales, rtol=1e-4)
        assert (cloud.scales > cloud_of(person).scales).all()
    text = page.read_text(encoding="utf-8")
    (data,) = re.findall(r'__VISER_EMBED_DATA__="([^"]*)"', text)
    assert len(data) > 10_000
    assert capfd.readouterr().out == ""


def test_small_gaussians_keep_their_shape(monkeypatch):
    viser = pytest.importorskip("viser")
    cloud = random_cloud(np.random.default_rng(0), 50)
    cloud.scales[:] = np.exp(np.random.default_rng(1).uniform(np.log(3e-4), np.log(0.1), (50, 3)))
    server = viser.ViserServer(host="127.0.0.1", port=0, verbose=False)
    try:
        handle = clip._show(server, "/person", cloud)
        seen = np.array(handle.covariances) / clip._ENLARGED**2
    finally:
        server.stop()
    want = covariances(cloud.quaternions, cloud.scales)
    assert (np.abs(seen - want).max((1, 2)) / want.max((1, 2))).max() < 2e-3
