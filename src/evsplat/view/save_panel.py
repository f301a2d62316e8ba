"""The controls that hand what is shown to the browser as a file."""

import io
import tempfile
from pathlib import Path
from typing import TYPE_CHECKING

import viser
from PIL import Image

from evsplat.errors import DataError
from evsplat.export.gaussians import FileKind, facts_of, file_rotation, write_file

if TYPE_CHECKING:
    from evsplat.view.panel import Panel

_FORMATS: dict[str, tuple[FileKind, str]] = {
    "PLY": ("ply", ".ply"),
    "SPZ": ("spz", ".spz"),
    "SPLAT": ("splat", ".splat"),
    "glTF": ("gltf", ".glb"),
}
"""Kind and ending of a file by what the browser shows."""


class SavePanel:
    """A picture of the view, and the Gaussians of its instant for other programs."""

    def __init__(self, panel: "Panel") -> None:
        """Build the controls in the folder that is open."""
        self.panel, self.client = panel, panel.client
        gui, desk = panel.gui, panel.client.desk
        picture = gui.add_button("Picture (PNG)", icon=viser.Icon.DOWNLOAD)
        known = self.client.painter.subject.has_splats
        self.format = gui.add_dropdown("Format", tuple(_FORMATS), visible=known)
        gaussians = gui.add_button("Gaussians", icon=viser.Icon.DOWNLOAD, visible=known)

        async def save_picture(_: viser.GuiEvent) -> None:
            desk.do(self._send_picture)

        async def save_gaussians(_: viser.GuiEvent) -> None:
            desk.do(self._send_gaussians)

        picture.on_click(save_picture)
        gaussians.on_click(save_gaussians)

    def _send_picture(self) -> None:
        """Draw the present view with all its pixels and hand it to the browser as a file."""
        wish = self.client.standing
        picture = self.client.painter.paint(wish, (wish.width, wish.height), rough=False)
        data = io.BytesIO()
        Image.fromarray(picture).save(data, "PNG")
        self._send(f"{self.panel.instant_name(wish)}.png", data.getvalue())

    def _send_gaussians(self) -> None:
        """The parts that are shown, as they are posed and as they are coloured from here."""
        wish, painter = self.client.standing, self.client.painter
        subject, parts = painter.subject, wish.look.parts
        kind, ending = _FORMATS[self.format.value]
        cloud = subject.cloud(painter.camera(wish), wish.time_us, wish.motion, parts)
        which = {"all": "", "human": "-person", "scene": "-scene"}[parts]
        name = f"{self.panel.instant_name(wish)}{which}{ending}"
        motion = {"motion": wish.motion.name or "recorded", "angles_deg": wish.motion.angles}
        facts = facts_of(subject.run) | {"time_us": wish.time_us, **motion}
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
