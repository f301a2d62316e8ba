"""What the viewer's save buttons send, over the protocol that browsers speak."""

import asyncio
import io
import json
import struct
from pathlib import Path

import numpy as np
import pytest
import torch

viser = pytest.importorskip("viser", reason="needs the extra view: pip install 'evsplat[view]'")

import msgspec  # noqa: E402
import websockets  # noqa: E402
import zstandard  # noqa: E402
from PIL import Image  # noqa: E402

from evsplat.capture import load_capture  # noqa: E402
from evsplat.film.camera_path import read_camera_path  # noqa: E402
from evsplat.training.reconstruction import GaussianReconstruction  # noqa: E402
from evsplat.training.run import Run  # noqa: E402
from evsplat.view.request import Motion  # noqa: E402
from evsplat.view.server import Viewer  # noqa: E402
from evsplat.view.viewed_run import ViewedRun  # noqa: E402

from ..export.clouds import read_ply, read_spz  # noqa: E402
from ..small_model import built, small_config  # noqa: E402
from .test_page_messages import CAMERA  # noqa: E402

SIDE = 48


class Browser:
    """The other end of viser's protocol, as far as buttons and downloads go."""

    def __init__(self, socket):
        self.socket = socket
        self.controls = {}

    async def messages(self):
        raw = await asyncio.wait_for(self.socket.recv(), 30)
        size = int.from_bytes(raw[8:16], "little")
        plain = zstandard.ZstdDecompressor().decompress(
            raw[16 : 16 + size], max_output_size=int.from_bytes(raw[:8], "little")
        )
        found = msgspec.msgpack.decode(plain)["messages"]
        for message in found:
            if "props" in message and "label" in (message["props"] or {}):
                self.controls[message["props"]["label"]] = message["uuid"]
        return found

    async def send(self, **message):
        await self.socket.send(msgspec.msgpack.encode(message))

    async def set(self, label, value):
        while label not in self.controls:
            await self.messages()
        updates = {"value": value}
        await self.send(type="GuiUpdateMessage", uuid=self.controls[label], updates=updates)

    async def download(self, label):
        """Press a button; the name and the content of the file that comes."""
        await self.set(label, True)
        start, parts = None, {}
        while start is None or len(parts) < start["part_count"]:
            for message in await self.messages():
                if message["type"] == "FileTransferStartDownload":
                    start = message
                elif message["type"] == "FileTransferPart":
                    parts[message["part_index"]] = message["content"]
        content = b"".join(parts[i] for i in range(start["part_count"]))
        assert len(content) == start["size_bytes"]
        return start["filename"], content


@pytest.fixture(name="run")
def _run(tiny_capture):
    capture = load_capture(tiny_capture())
    config = small_config("evsplat", "human.count=60")
    model = built("evsplat", capture, "human.count=60").model
    counts = {"human": model.gaussians.human_count, "scene": model.gaussians.scene_count}
    made = GaussianReconstruction("evsplat", model)
    facts = (capture, made, 7, 0.0, "cpu", counts, False)
    return Run(Path("none"), config, "evsplat", config.policy, *facts)


def in_browser(run, port, act, size=(SIDE, SIDE)):
    """Let ``act`` use the viewer of a run as a browser does."""

    async def visit(viewer):
        address = f"ws://127.0.0.1:{viewer.port}"
        protocol = [f"viser-v{viser.__version__}"]
        async with websockets.connect(
            address, subprotocols=protocol, max_size=None, compression=None
        ) as socket:
            browser = Browser(socket)
            await browser.send(**CAMERA | {"image_width": size[0], "image_height": size[1]})
            return await act(browser)

    viewer = Viewer([run], host="127.0.0.1", port=port)
    try:
        return asyncio.run(visit(viewer))
    finally:
        viewer.close()


def test_the_picture_comes_with_all_pixels_of_the_window(run):
    name, content = in_browser(run, 18650, lambda browser: browser.download("Picture (PNG)"))
    assert name.startswith(f"{run.capture.name}-") and name.endswith("ms.png")
    assert Image.open(io.BytesIO(content)).size == (SIDE, SIDE)


@pytest.mark.parametrize(("size", "opened"), [((390, 844), False), ((844, 390), True)])
def test_folders_are_folded_where_the_panel_would_lie_over_the_person(run, size, opened):
    async def act(browser):
        found = {}
        while "Save" not in found:
            for message in await browser.messages():
                if "expand_by_default" in (message.get("props") or {}):
                    found[message["props"]["label"]] = message["props"]["expand_by_default"]
        return found

    found = in_browser(run, 18790 + opened, act, size)
    outer = ("Time", "Camera", "Show", "Motion and pose", "Save")
    assert {name: found[name] for name in outer} == dict.fromkeys(outer, opened)


def test_a_camera_path_of_key_frames_is_one_that_films_are_made_with(run, tmp_path):
    async def act(browser):
        await browser.set("Add key frame of a camera path", True)
        await browser.set("Add key frame of a camera path", True)
        kept = await browser.download("Camera path (JSON)")
        await browser.set("Forget key frames", True)
        return kept, await browser.download("Camera path (JSON)")

    (name, content), (_, without) = in_browser(run, 18670, act)
    assert [len(json.loads(file)["keys"]) for file in (content, without)] == [2, 1]
    (tmp_path / name).write_bytes(content)
    camera = read_camera_path(tmp_path / name)(0.5)
    assert (camera.width, camera.height) == (SIDE, SIDE)
    recorded = run.capture.camera(run.capture.frames[0])  # what the viewer opens on
    assert torch.allclose(camera.world_to_camera, recorded.world_to_camera, atol=1e-5)


def test_gaussians_come_in_every_format_and_as_the_parts_that_are_shown(run, tmp_path):
    async def act(browser):
        files = {}
        for parts, formats in (
            ("person and scene", ("PLY", "SPZ", "SPLAT", "glTF")),
            ("person", ("PLY",)),
            ("scene", ("SPLAT",)),
        ):
            await browser.set("Parts", parts)
            for kind in formats:
                await browser.set("Format", kind)
                name, content = await browser.download("Gaussians")
                files[parts, kind] = tmp_path / name
                files[parts, kind].write_bytes(content)
        return files

    files = in_browser(run, 18660, act)
    people, scene = run.gaussians["human"], run.gaussians["scene"]

    whole = files["person and scene", "PLY"]
    comments, columns = read_ply(whole)
    assert any("angles_deg" in comment for comment in comments)
    # The window shows the first frame; the file holds that instant.
    first = min(run.capture.frames, key=lambda frame: frame.mid_us)
    assert whole.name == f"{run.capture.name}-{first.mid_us / 1e3:.1f}ms.ply"
    expected = ViewedRun(run, "it").cloud(run.capture.camera(first), first.mid_us, Motion(), "all")
    found = np.stack([columns[axis] for axis in "xyz"], 1)
    np.testing.assert_allclose(found, expected.means, atol=1e-6)
    np.testing.assert_array_equal(columns["semantic"], [1] * people + [0] * scene)

    person = files["person", "PLY"]
    assert person.name.endswith("ms-person.ply")
    assert len(read_ply(person)[1]["x"]) == people
    splat = files["scene", "SPLAT"]
    assert splat.name.endswith("ms-scene.splat") and splat.stat().st_size == 32 * scene
    spz = files["person and scene", "SPZ"]
    assert spz.suffix == ".spz" and read_spz(spz)["mean"].size == 3 * (people + scene)
    glb = files["person and scene", "glTF"]
    magic, version, length = struct.unpack("<4sII", glb.read_bytes()[:12])
    assert (glb.suffix, magic, version, length) == (".glb", b"glTF", 2, glb.stat().st_size)


def test_values_that_a_control_cannot_have_are_taken_back_and_told_in_a_line(run, caplog, capfd):
    """Of a page that is broken; what is drawn and saved after that is as it was before."""
    impossible = {
        "Time, ms": 1e18,
        "Divider": -1e9,
        "Speed": "never",
        "Colours": "<b>",
        "Compare with": "x" * 150,
        "Motion": "../../etc",
        "Format": "exe",
        "Recorded by": "no such camera",
    }

    async def act(browser):
        before = await browser.download("Picture (PNG)")
        for label, value in impossible.items():
            await browser.set(label, value)
        gaussians = await browser.download("Gaussians")
        return before, await browser.download("Picture (PNG)"), gaussians

    before, after, (name, _) = in_browser(run, 18680, act)
    assert before == after and name.endswith(".ply")
    said = [record.getMessage() for record in caplog.records if record.levelname == "WARNING"]
    assert len(said) == len(impossible)
    assert all("cannot be chosen" in line and len(line) < 200 for line in said)
    assert "Traceback" not in "".join(capfd.readouterr())


@pytest.mark.parametrize(
    "junk", [{"fov": float("nan")}, {"position": (float("inf"), 0, 0)}, {"image_width": 10**9}]
)
def test_a_browser_whose_camera_is_none_is_left_and_others_go_on(run, caplog, capfd, junk):

    async def act(browser):
        host, port = browser.socket.remote_address[:2]
        protocol = [f"viser-v{viser.__version__}"]
        async with websockets.connect(f"ws://{host}:{port}", subprotocols=protocol) as other:
            await other.send(msgspec.msgpack.encode(CAMERA | junk))
            with pytest.raises(websockets.exceptions.ConnectionClosed):
                while True:
                    await asyncio.wait_for(other.recv(), 10)
        return await browser.download("Picture (PNG)")

    _, content = in_browser(run, 18690, act)
    assert Image.open(io.BytesIO(content)).size == (SIDE, SIDE)
    (said,) = [record.getMessage() for record in caplog.records if record.levelname == "WARNING"]
    assert said.startswith("The viewer closed a connection: no message of its page (ValueError: ")
    assert "Traceback" not in "".join(capfd.readouterr())
