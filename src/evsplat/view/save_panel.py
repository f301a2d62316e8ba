"""The controls that hand what is shown to the browser as a file."""

import io
import json

import viser
from PIL import Image

from evsplat.camera import Camera
from evsplat.commands import command
from evsplat.errors import DataError
from evsplat.export.gaussians import FileKind, facts_of, file_rotation, write_file
from evsplat.files import scratch_folder
from evsplat.film.camera_path import camera_path_document
from evsplat.view.client import Client
from evsplat.view.controls import when_changed
from evsplat.view.request import ViewRequest

_FORMATS: dict[str, tuple[FileKind, str]] = {
    "PLY": ("ply", ".ply"),
    "SPZ": ("spz", ".spz"),
    "SPLAT": ("splat", ".splat"),
    "glTF": ("gltf", ".glb"),
}
"""Kind and ending of a file by the format's label."""


class SavePanel:
    """A picture of the view, the Gaussians of its instant, and a camera path for films."""

    def __init__(self, client: Client) -> None:
        """Build the controls in the folder that is open."""
        self.client, gui = client, client.handle.gui
        picture = gui.add_button("Picture (PNG)", icon=viser.Icon.DOWNLOAD)
        self.format = gui.add_dropdown("Format", tuple(_FORMATS))
        when_changed(self.format, _nothing)
        gaussians = gui.add_button("Gaussians", icon=viser.Icon.DOWNLOAD)
        self._keys: list[Camera] = []
        add_key = gui.add_button("Add key frame of a camera path", icon=viser.Icon.PLUS)
        save_path = gui.add_button("Camera path (JSON)", icon=viser.Icon.DOWNLOAD)
        clear_path = gui.add_button("Forget key frames", icon=viser.Icon.TRASH)

        async def save_picture(_: viser.GuiEvent) -> None:
            client.scheduler.submit(self._send_picture)

        async def save_gaussians(_: viser.GuiEvent) -> None:
            client.scheduler.submit(self._send_gaussians)

        async def add(_: viser.GuiEvent) -> None:
            self._add_key()

        async def save_keys(_: viser.GuiEvent) -> None:
            self._send_path()

        async def forget(_: viser.GuiEvent) -> None:
            self._keys.clear()
            self._notify("No key frames", "The next camera path starts anew.")

        add_key.on_click(add)
        save_path.on_click(save_keys)
        clear_path.on_click(forget)
        picture.on_click(save_picture)
        gaussians.on_click(save_gaussians)

    def _send_picture(self) -> None:
        """Draw the present view with all its pixels and hand it to the browser as a file."""
        request = self.client.current
        size = request.width, request.height
        picture = self.client.compositor.compose(request, size, draft=False)
        data = io.BytesIO()
        Image.fromarray(picture).save(data, "PNG")
        self._send(f"{self._stem(request)}.png", data.getvalue())

    def _send_gaussians(self) -> None:
        """Send the parts that are shown, as they are posed and as they are coloured from here."""
        request, compositor = self.client.current, self.client.compositor
        viewed, motion, parts = compositor.viewed, request.motion, request.look.parts
        kind, ending = _FORMATS[self.format.value]
        cloud = viewed.cloud(compositor.camera(request), request.time_us, motion, parts)
        which = {"all": "", "human": "-person", "scene": "-scene"}[parts]
        name = f"{self._stem(request)}{which}{ending}"
        posed = {"motion": motion.name or "recorded", "angles_deg": motion.angles}
        facts = facts_of(viewed.run) | {"time_us": request.time_us, **posed}
        rotation = file_rotation(viewed.track(None), kind, None)
        with scratch_folder() as folder:
            path = folder / name
            try:
                write_file(path, kind, cloud, rotation, facts)
            except DataError as error:
                self._notify("Nothing is saved", str(error).removeprefix(f"{path}: "))
                return
            data = path.read_bytes()
        self._send(name, data)
        self._notify(name, f"{len(cloud):,} Gaussians, {len(data) / 1e6:.1f} MB.")

    def _add_key(self) -> None:
        """Keep the camera that is seen through as the next key of the path."""
        self._keys.append(self.client.compositor.camera(self.client.current))
        self._notify(f"Key frame {len(self._keys)}", "Keys are spread evenly over the film.")

    def _send_path(self) -> None:
        """Send the keys as a file that `evsplat render --path` reads; none: the present view."""
        keys = self._keys or [self.client.compositor.camera(self.client.current)]
        name = f"{self.client.compositor.capture.name}-camera-path.json"
        self._send(name, json.dumps(camera_path_document(keys), indent=1).encode())
        self._notify(name, f"{len(keys)} key frames: {command('render', 'RUN', '--path', name)}")

    def _stem(self, request: ViewRequest) -> str:
        """File name of a request's instant, without ending."""
        motion = "" if request.motion.name is None else f"-{request.motion.name}"
        return f"{self.client.compositor.capture.name}{motion}-{request.time_us / 1e3:.1f}ms"

    def _send(self, name: str, data: bytes) -> None:
        self.client.handle.send_file_download(name, data, save_immediately=True)

    def _notify(self, title: str, body: str) -> None:
        self.client.handle.add_notification(title, body, auto_close_seconds=6)


async def _nothing(_: viser.GuiEvent) -> None:
    """The choice is read when it is needed."""
