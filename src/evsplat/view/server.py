"""The web server of the viewer."""

import contextlib
import errno
import io
import logging
import signal
import socket
import threading
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import viser

from evsplat.body import up_axis
from evsplat.errors import ConfigError, DataError
from evsplat.film.plan import recorded_by
from evsplat.training.run import Run
from evsplat.training_sign import is_training
from evsplat.view.camera import forward, vertical_fov
from evsplat.view.client import Client, view_of
from evsplat.view.compositor import Compositor
from evsplat.view.own_pages import log_in_a_line, own_pages_alone
from evsplat.view.panel import SPEEDS, Panel, plain
from evsplat.view.request import Playback, ViewRequest
from evsplat.view.scheduler import RenderScheduler
from evsplat.view.viewed_run import RunFollower, ViewedRun, load_newest, yield_to_training

logger = logging.getLogger(__name__)

_PORTS_TRIED = 20
_ALL_INTERFACES = ("", "0.0.0.0", "::")


class _Server(viser.ViserServer):
    """viser's, which opens no tunnel to the internet when a browser asks for one."""

    def request_share_url(self, verbose: bool = True) -> str | None:
        return None


class Viewer:
    """Serves one run, or two to compare, until it is closed."""

    def __init__(self, runs: list[Run], *, host: str, port: int) -> None:
        self.viewed = [ViewedRun(run, name) for run, name in zip(runs, _names(runs), strict=True)]
        main, *others = self.viewed
        self.capture = main.capture
        self.compositor = Compositor(main, {other.name: other for other in others})
        track = main.track(None).to("cpu")
        transl = track.at([frame.mid_us for frame in self.capture.train_frames])[1]
        # The view turns about where the person was.
        self.pivot = (track.body.rest_joints[0] + transl).mean(0).double().numpy()
        up = up_axis(track).double().numpy()
        self.scheduler = RenderScheduler()
        self.port = _free_port(host, port)
        banner = contextlib.redirect_stdout(io.StringIO())
        with banner, own_pages_alone(host):
            self.server = _Server(host, self.port, label="evsplat", verbose=False)
        log_in_a_line(self.server.get_event_loop())
        self.port = self.server.get_port()
        self.address = _address(host, self.port)
        self._set_scene(up)
        self._clients: dict[int, Client] = {}
        self.server.on_client_connect(self._connected)
        self.server.on_client_disconnect(self._disconnected)
        self.scheduler.start()
        submit = self.scheduler.submit
        self._followers = [
            RunFollower(viewed, submit, lambda: bool(self._clients), self._reloaded)
            for viewed in self.viewed
        ]

    def close(self) -> None:
        """Stop following, drawing and serving."""
        for follower in self._followers:
            follower.stop()
        self.scheduler.close()
        with contextlib.redirect_stdout(io.StringIO()):
            self.server.stop()

    def _reloaded(self) -> None:
        self._summary.content = _summary(self.viewed)
        self.scheduler.redraw()

    def _set_scene(self, up: np.ndarray) -> None:
        server, first = self.server, self.capture.frames[0]
        server.scene.set_up_direction(tuple(up.tolist()))
        camera = self.capture.camera_at(first.camera, first.mid_us)
        centre = camera.center().double().numpy()
        start = server.initial_camera
        start.position = centre
        start.look_at = centre + forward(camera) * max(0.5, (self.pivot - centre) @ forward(camera))
        start.up = up
        start.fov = vertical_fov(camera)
        server.gui.configure_theme(
            dark_mode=True,
            show_logo=False,
            show_share_button=False,
            control_width="medium",
            brand_color=(38, 124, 160),
        )
        server.gui.main_panel.dock_right()
        self._summary = server.gui.add_markdown(_summary(self.viewed))

    async def _connected(self, handle: viser.ClientHandle) -> None:
        frames = recorded_by(self.capture, None)
        first, last = frames[0].mid_us, frames[-1].mid_us
        request = ViewRequest(**view_of(handle.camera), time_us=first)
        playback = Playback(first, last, first, speed=SPEEDS["1/5"])
        client = Client(handle, self.compositor, self.scheduler, request, playback)
        Panel(client, self.pivot).look_through(frames[0].camera)
        self._clients[handle.client_id] = client
        self.scheduler.add(client)

    async def _disconnected(self, handle: viser.ClientHandle) -> None:
        client = self._clients.pop(handle.client_id, None)
        if client is not None:
            client.disconnected = True
            self.scheduler.remove(client)


def serve(paths: Sequence[Path | str], host: str, port: int, device: str) -> None:
    """Do the work of `evsplat.view.view_run`."""
    folders = [Path(path) for path in paths]
    _free_port(host, port)  # what cannot be had is refused before a run is waited for and loaded
    following = any(map(is_training, folders))
    if following:
        # The training's GPU, if it has one, is not to be shared.
        device = "cpu" if device == "auto" else device
        print("The run is being trained; the view follows it.", flush=True)
    runs = [load_newest(path, device) for path in folders]
    captures = [loaded.capture.path.resolve() for loaded in runs]
    if len(set(captures)) > 1:
        raise DataError(
            f"{runs[1].path}: trained on {captures[1]}, but {runs[0].path} on {captures[0]}; "
            "compare runs of the same capture."
        )
    viewer = Viewer(runs, host=host, port=port)
    if viewer.port != port:
        print(f"Port {port} is in use; taking {viewer.port}.", flush=True)
    print(f"view: {viewer.address}  (Ctrl-C stops)", flush=True)
    if following:
        yield_to_training()
    # Closed by whoever started it as by Ctrl-C.
    signal.signal(signal.SIGTERM, signal.default_int_handler)
    try:
        threading.Event().wait()
    except KeyboardInterrupt:
        raise KeyboardInterrupt("The viewer is closed.") from None
    finally:
        viewer.close()


def _names(runs: list[Run]) -> list[str]:
    """Names of runs: their methods, or their folders where that is not enough."""
    names = [run.method for run in runs]
    if len(set(names)) < len(runs):
        names = [run.path.resolve().name for run in runs]
    if len(set(names)) < len(runs):
        names = [str(run.path) for run in runs]
    return names


def _summary(viewed_runs: list[ViewedRun]) -> str:
    """Markdown with the capture's name, steps and counts of the runs."""
    lines = [f"**{plain(viewed_runs[0].capture.name)}**"]
    for viewed in viewed_runs:
        run = viewed.run
        human, scene = run.gaussians["human"], run.gaussians["scene"]
        lines.append(
            f"{plain(viewed.name)}: step {run.iteration:,}, {human:,} Gaussians of the person, "
            f"{scene:,} of the scene"
        )
    return "  \n".join(lines)


def _address(host: str, port: int) -> str:
    """Where a browser of this machine finds the page of a server that listens at ``host``."""
    if host in _ALL_INTERFACES:
        host = "localhost"
    # The colons of an IPv6 address are no port's.
    return f"http://[{host}]:{port}" if ":" in host else f"http://{host}:{port}"


def _free_port(host: str, port: int) -> int:
    """The first port from ``port`` on that can be listened at."""
    if not 0 < port < 65536:
        raise ConfigError(f"--port {port}: expected 1 to 65535.")
    last = min(port + _PORTS_TRIED, 65536)
    for candidate in range(port, last):
        try:
            family, kind, *_, address = socket.getaddrinfo(
                host or None, candidate, type=socket.SOCK_STREAM, flags=socket.AI_PASSIVE
            )[0]
        except socket.gaierror as error:
            raise ConfigError(f"--host {host}: no such address ({error.strerror}).") from None
        with socket.socket(family, kind) as probe:
            # As the server will: a port that is only waiting to be forgotten is free.
            probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            try:
                probe.bind(address)
            except OSError as error:
                if error.errno == errno.EADDRINUSE:
                    continue
                raise ConfigError(
                    f"--host {host} --port {candidate}: cannot listen there ({error.strerror})."
                ) from None
            return candidate
    raise ConfigError(f"--port {port}: this port and the next {_PORTS_TRIED} are all in use.")
