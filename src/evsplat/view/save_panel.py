"""The controls that hand what is shown to the browser as a file."""

import io

import viser
from PIL import Image

from evsplat.errors import DataError
from evsplat.export.gaussians import FileKind, facts_of, file_rotation, write_file
from evsplat.files import scratch_folder
from evsplat.view.client import Client
from evsplat.view.request import ViewRequest

_FORMATS: dict[str, tuple[FileKind, str]] = {
    "PLY": ("ply", ".ply"),
    "SPZ": ("spz", ".spz"),
    "SPLAT": ("splat", ".splat"),
    "glTF": ("gltf", ".glb"),
}
"""Kind and ending of a file by the format's label."""


class SavePanel:
    """A picture of the view, and the Gaussians of its instant for other programs."""

    def __init__(self, client: Client) -> None:
        """Build the controls in the folder that is open."""
        self.client, gui = client, client.handle.gui
        picture = gui.add_button("Picture (PNG)", icon=viser.Icon.DOWNLOAD)
        self.format = gui.add_dropdown("Format", tuple(_FORMATS))
        gaussians = gui.add_button("Gaussians", icon=viser.Icon.DOWNLOAD)

        async def save_picture(_: viser.GuiEvent) -> None:
            client.scheduler.submit(self._send_picture)

        async def save_gaussians(_: viser.GuiEvent) -> None:
            client.scheduler.submit(self._send_gaussians)

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
            except DataError:
                self._notify("Nothing to save", f"There is no Gaussian of the {which[1:]}.")
                return
            data = path.read_bytes()
        self._send(name, data)
        self._notify(name, f"{len(cloud):,} Gaussians, {len(data) / 1e6:.1f} MB.")

    def _stem(self, request: ViewRequest) -> str:
        """File name of a request's instant, without ending."""
        motion = "" if request.motion.name is None else f"-{request.motion.name}"
        return f"{self.client.compositor.capture.name}{motion}-{request.time_us / 1e3:.1f}ms"

    def _send(self, name: str, data: bytes) -> None:
        self.client.handle.send_file_download(name, data, save_immediately=True)

    def _notify(self, title: str, body: str) -> None:
        self.client.handle.add_notification(title, body, auto_close_seconds=6)
