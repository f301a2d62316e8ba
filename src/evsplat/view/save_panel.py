"""Controls that hand what is shown to the browser as a file."""

import io
import tempfile
from collections.abc import Callable
from pathlib import Path

import viser
from PIL import Image

from evsplat.errors import DataError
from evsplat.export.gaussians import FileKind, facts_of, file_rotation, write_file
from evsplat.view.client import Client
from evsplat.view.request import ViewRequest

_FORMATS: dict[str, tuple[FileKind, str]] = {
    "PLY": ("ply", ".ply"),
    "SPZ": ("spz", ".spz"),
    "SPLAT": ("splat", ".splat"),
    "glTF": ("gltf", ".glb"),
}
"""Kind and ending of a file by what the browser shows."""


class SavePanel:
    """A picture of the view, and the Gaussians of its instant for other programs."""

    def __init__(self, client: Client, instant_name: Callable[[ViewRequest], str]) -> None:
        """Build the controls in the folder that is open; files begin with ``instant_name``."""
        self.client, self.instant_name = client, instant_name
        gui, scheduler = client.handle.gui, client.scheduler
        picture = gui.add_button("Picture (PNG)", icon=viser.Icon.DOWNLOAD)
        known = self.client.painter.subject.has_splats
        self.format = gui.add_dropdown("Format", tuple(_FORMATS), visible=known)
        gaussians = gui.add_button("Gaussians", icon=viser.Icon.DOWNLOAD, visible=known)

        async def save_picture(_: viser.GuiEvent) -> None:
            scheduler.do(self._send_picture)

        async def save_gaussians(_: viser.GuiEvent) -> None:
            scheduler.do(self._send_gaussians)

        picture.on_click(save_picture)
        gaussians.on_click(save_gaussians)

    def _send_picture(self) -> None:
        """Draw the present view with all its pixels and hand it to the browser as a file."""
        request = self.client.standing
        picture = self.client.painter.paint(request, (request.width, request.height), rough=False)
        data = io.BytesIO()
        Image.fromarray(picture).save(data, "PNG")
        self._send(f"{self.instant_name(request)}.png", data.getvalue())

    def _send_gaussians(self) -> None:
        """The parts that are shown, as they are posed and as they are coloured from here."""
        request, painter = self.client.standing, self.client.painter
        subject, parts = painter.subject, request.look.parts
        kind, ending = _FORMATS[self.format.value]
        cloud = subject.cloud(painter.camera(request), request.time_us, request.motion, parts)
        which = {"all": "", "human": "-person", "scene": "-scene"}[parts]
        name = f"{self.instant_name(request)}{which}{ending}"
        motion = {"motion": request.motion.name or "recorded", "angles_deg": request.motion.angles}
        facts = facts_of(subject.run) | {"time_us": request.time_us, **motion}
        rotation = file_rotation(subject.track(None), kind, None)
        with tempfile.TemporaryDirectory(prefix="evsplat-view-") as folder:
            path = Path(folder) / name
            try:
                write_file(path, kind, cloud, rotation, facts)
            except DataError:
                self._tell("Nothing to save", f"There is no Gaussian of the {which[1:]}.")
                return
            data = path.read_bytes()
        self._send(name, data)
        self._tell(name, f"{len(cloud):,} Gaussians, {len(data) / 1e6:.1f} MB.")

    def _send(self, name: str, data: bytes) -> None:
        self.client.handle.send_file_download(name, data, save_immediately=True)

    def _tell(self, title: str, body: str) -> None:
        self.client.handle.add_notification(title, body, auto_close_seconds=6)
