"""What the avatar's page shows in a browser, against our own rasteriser."""

import base64
import json
import shutil
import subprocess
from io import BytesIO

import numpy as np
import pytest
import torch
from PIL import Image

from evsplat.capture import load_capture
from evsplat.export import export_run
from evsplat.export.avatar import avatar_of
from evsplat.export.bake import at_rest, with_correctives
from evsplat.models.smoothing import widened
from evsplat.pictures import shown
from evsplat.render import render
from evsplat.similarity import psnr

BROWSER = next(filter(None, map(shutil.which, ("chromium", "google-chrome", "chrome"))), None)
_ARGUMENTS = (
    "--headless --no-sandbox --use-angle=swiftshader --enable-unsafe-swiftshader "
    "--ignore-gpu-blocklist --disable-background-networking --no-first-run --dump-dom"
).split()
_PROBE = """
<script type="module">
const said = document.createElement("pre");
try { said.textContent = (() => {SCRIPT})(); } catch (error) { said.textContent = String(error); }
said.id = "said";
document.body.replaceChildren(said);
</script>
"""
_SHOT = """
  avatarPlayer.seek(0.1);
  avatarPlayer.look(CAMERA);
  return document.getElementById("picture").toDataURL().split(",")[1];
"""
needs_browser = pytest.mark.skipif(BROWSER is None, reason="needs Chromium to show the page")


def _said_by_browser(page, script: str, folder, *more: str) -> str:
    """What a script returns that runs in the page, once the page has started."""
    text = page.read_text(encoding="utf-8")
    probe = folder / "probe.html"
    probe.write_text(text.replace("</html>", _PROBE.replace("SCRIPT", script)), encoding="utf-8")
    profile = f"--user-data-dir={folder / 'profile'}"
    command = [BROWSER, *_ARGUMENTS, *more, profile, probe.as_uri()]
    done = subprocess.run(command, capture_output=True, text=True, timeout=300, check=True)
    return done.stdout.partition('<pre id="said">')[2].partition("</pre>")[0]


def _drawn_by_browser(page, camera, folder) -> torch.Tensor:
    """The picture of a page at 0.1 s as a camera sees it, sRGB in [0, 1]."""
    given = {"width": camera.width, "height": camera.height}
    given |= {"K": camera.K.tolist(), "world_to_camera": camera.world_to_camera.tolist()}
    data = _said_by_browser(page, _SHOT.replace("CAMERA", json.dumps(given)), folder)
    picture = Image.open(BytesIO(base64.b64decode(data, validate=True)))
    return torch.from_numpy(np.asarray(picture.convert("RGB"), dtype=np.float32) / 255)


@needs_browser
@pytest.mark.parametrize(("transfer", "times_larger"), [("power", 1), ("linear", 1), ("power", 3)])
def test_the_page_shows_what_our_rasteriser_draws(run, tmp_path, transfer, times_larger):
    """Pictures that hold light are coded for the screen, of which the page said nothing."""
    described = run.capture.path / "capture.json"
    document = json.loads(described.read_text(encoding="utf-8"))
    for camera in document["cameras"].values():
        camera["transfer"] = transfer
    described.write_text(json.dumps(document), encoding="utf-8")
    run.capture = capture = load_capture(run.capture.path)
    source = run.reconstruction
    page = export_run(run.path, "avatar", out=tmp_path / "dancer.html")
    frame = capture.frames[len(capture.frames) // 2]
    recorder, time = capture.camera(frame), capture.frames[0].mid_us + 100_000
    camera = recorder.resized(times_larger * recorder.width, times_larger * recorder.height)
    rotations, bones = source.pose([time])
    avatar = avatar_of(with_correctives(run, at_rest(run, None), None))
    with torch.no_grad():
        person = avatar.gaussians.posed(bones, rotations)
        person = widened(person, source.low_pass, camera, [recorder])
        image = render(person, camera, low_pass=source.low_pass).image[0]
    want = shown(image[..., :3].clamp(0, 1), transfer)
    got = _drawn_by_browser(page, camera, tmp_path)
    assert want.std() > 0.05
    # Half floats and eight bits; a picture that is not coded is below 20 dB.
    assert psnr(got, want) > 45


@needs_browser
@pytest.mark.parametrize(
    ("size", "is_open"), [("640,420", "false"), ("1280,800", "true"), ("520,900", "false")]
)
def test_the_panel_is_open_where_it_does_not_hide_the_person(run, tmp_path, size, is_open):
    """In a window of 640 x 420 it lay over the person from all sides but the first."""
    page = export_run(run.path, "avatar", out=tmp_path / "dancer.html")
    script = 'return document.getElementById("fold").getAttribute("aria-expanded");'
    assert _said_by_browser(page, script, tmp_path, f"--window-size={size}") == is_open


@needs_browser
def test_keys_turn_the_view_and_a_lost_drawing_is_told(run, tmp_path):
    page = export_run(run.path, "avatar", out=tmp_path / "dancer.html")
    script = """
      const picture = document.getElementById("picture"), { orbit } = avatarPlayer;
      const press = (key) => picture.dispatchEvent(new KeyboardEvent("keydown", { key }));
      const before = [orbit.heading, orbit.pitch, orbit.distance];
      picture.focus();
      const focused = document.activeElement === picture;
      for (const key of ["ArrowLeft", "ArrowUp", "+", "x"]) press(key);
      const after = [orbit.heading, orbit.pitch, orbit.distance];
      const message = document.getElementById("message"), hidden = message.hidden;
      picture.dispatchEvent(new Event("webglcontextlost"));
      const told = message.hidden ? "" : message.textContent;
      return JSON.stringify({ before, after, focused, hidden, told });
    """
    said = json.loads(_said_by_browser(page, script, tmp_path))
    heading, pitch, distance = said["before"]
    assert said["focused"] and said["hidden"]
    np.testing.assert_allclose(said["after"], [heading + 0.1, pitch + 0.1, 0.9 * distance])
    assert "reload the page" in said["told"]


@needs_browser
def test_the_view_has_a_direction_from_straight_above_and_after_fingers_that_met(run, tmp_path):
    page = export_run(run.path, "avatar", out=tmp_path / "dancer.html")
    script = """
      const { orbit } = avatarPlayer;
      orbit.fingers.set(1, [5, 5]);
      orbit.fingers.set(2, [5, 5]);
      orbit.moved({ pointerId: 1, clientX: 50, clientY: 5, buttons: 1 }, 100);
      const near = orbit.distance > 0;
      const down = orbit.up.map((v) => -v);
      orbit.stand([0, 0, 0], down, 2);
      const forward = orbit.pose()[2].slice(0, 3);
      const error = Math.hypot(...forward.map((v, k) => v - down[k]));
      return JSON.stringify([near, error < 0.05, Math.abs(orbit.pitch) <= 1.55]);
    """
    assert json.loads(_said_by_browser(page, script, tmp_path)) == [True, True, True]


@needs_browser
def test_more_gaussians_than_the_device_can_draw_are_a_sentence(run, tmp_path):
    page = export_run(run.path, "avatar", out=tmp_path / "dancer.html")
    text = page.read_text(encoding="utf-8")
    page.write_text(text.replace("gl.getParameter(gl.MAX_TEXTURE_SIZE)", "0"), encoding="utf-8")
    script = """
      const message = document.getElementById("message");
      return message.hidden ? "" : message.textContent;
    """
    said = _said_by_browser(page, script, tmp_path)
    assert said.startswith("These are more Gaussians than this device can draw")
