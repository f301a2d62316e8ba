"""``export html``: the recording as a page of moving Gaussians, played by viser offline."""

import contextlib
import io
import logging
import math
from pathlib import Path
from typing import Any

import torch
from tqdm import tqdm

from evsplat.body import up_axis
from evsplat.body.rotations import quaternion_to_matrix
from evsplat.capture import load_body_track
from evsplat.errors import ConfigError
from evsplat.export.cloud import SplatCloud, cloud_of
from evsplat.export.gaussians import instant_of
from evsplat.files import write_text
from evsplat.methods.reconstruction import Parts
from evsplat.training.run import Run
from evsplat.wording import counted

logger = logging.getLogger(__name__)

_ENLARGED = 32.0
"""viser keeps covariances in 16 bits, too few for square metres of millimetre-sized Gaussians: they
are stored 32 times as large, and the scene is shrunk."""
_WINDOW_PX = 720
"""Pictures of a window so high show Gaussians as wide as training saw them."""


def export_clip(run: Run, path: Path, parts: Parts, camera: str | None, fps: float) -> Path:
    """Write the whole recording as a page that plays from disk, and return it.

    Colours are those that the camera of ``instant_of`` sees. The scene is stored once, with the
    shadow that it has in the middle of the recording.
    """
    try:
        import viser
    except ImportError:
        raise ConfigError(
            "An html clip needs the package viser; get it with: pip install 'evsplat[view]'."
        ) from None
    capture, source = run.capture, run.reconstruction.at_any_size()
    track = load_body_track(capture)
    transfer = capture.transfer(capture.frames[0])
    middle = instant_of(capture, time_s=None, frame=None, camera=camera)
    mids = sorted(frame.mid_us for frame in capture.frames)
    count = 1 + int((mids[-1] - mids[0]) * fps / 1e6)
    times = [mids[0] + round(k * 1e6 / fps) for k in range(count)]
    with contextlib.redirect_stdout(io.StringIO()):  # viser's address, at which nobody looks
        server = viser.ViserServer(host="127.0.0.1", port=0, verbose=False)
    view = middle.camera
    factor = max(1.0, _WINDOW_PX / view.height)
    window = view.resized(round(factor * view.width), round(factor * view.height))
    try:
        server.gui.configure_theme(dark_mode=True)
        server.gui.main_panel.dock_right()
        server.scene.set_up_direction(tuple(up_axis(track).tolist()))
        # The reader orbits about a place as far as the person.
        away = view.project(track.vertices(middle.time_us))[1].mean()
        ahead = view.center() + view.world_to_camera[2, :3] * away
        server.initial_camera.position = tuple(view.center().tolist())
        server.initial_camera.look_at = tuple(ahead.tolist())
        server.initial_camera.fov = 2 * math.atan(view.height / 2 / float(view.K[1, 1]))
        if parts != "human":
            layers = source.elsewhere().splats(window, [middle.time_us], parts=parts)
            _show(server, "/scene", cloud_of(layers[-1]).shown(transfer))
        serializer = server.get_scene_serializer()
        handle = None
        for time in tqdm(times if parts != "scene" else times[:1], desc="clip", unit="picture"):
            if parts != "scene":
                layers = source.splats(window, [time], parts="human")
                person = cloud_of(layers[0]).shown(transfer)
                handle = _show(server, "/person", person, handle)
            serializer.insert_sleep(1 / fps)
        page = serializer.as_html(dark_mode=True)
    finally:
        with contextlib.redirect_stdout(io.StringIO()):
            server.stop()
    write_text(path, page)
    logger.info(
        "%s, %g per second, colours as camera %s sees them; metres, axes of the capture.",
        counted(len(times), "picture"),
        fps,
        middle.camera_name,
    )
    return path


def _show(server: Any, name: str, cloud: SplatCloud, handle: Any = None) -> Any:
    """Put a cloud into the scene, or in the place of the one that ``handle`` shows."""
    quaternions = torch.from_numpy(cloud.quaternions)
    axes = (quaternion_to_matrix(quaternions) * torch.from_numpy(cloud.scales)[:, None]).numpy()
    axes *= _ENLARGED
    values = {
        "centers": cloud.means * _ENLARGED,
        "covariances": axes @ axes.transpose(0, 2, 1),
        "rgbs": cloud.rgb.clip(0, 1),
        "opacities": cloud.opacities[:, None],
    }
    if handle is None:
        return server.scene.add_gaussian_splats(name, **values, scale=1 / _ENLARGED)
    handle.set_gaussians(**values)
    return handle
