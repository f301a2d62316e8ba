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
from evsplat.pictures import shown
from evsplat.render import render
from evsplat.similarity import psnr

BROWSER = next(filter(None, map(shutil.which, ("chromium", "google-chrome", "chrome"))), None)
_ARGUMENTS = (
    "--headless --no-sandbox --use-angle=swiftshader --enable-unsafe-swiftshader "
    "--ignore-gpu-blocklist --disable-background-networking --no-first-run --dump-dom"
).split()
_SHOT = """
<script type="module">
const shown = document.createElement("pre");
try {
  avatarPlayer.seek(0.1);
  avatarPlayer.look(CAMERA);
  shown.textContent = document.getElementById("picture").toDataURL().split(",")[1];
} catch (error) { shown.textContent = String(error); }
shown.id = "shot";
document.body.replaceChildren(shown);
</script>
"""


def _drawn_by_browser(page, camera, folder) -> torch.Tensor:
    """The picture of a page at 0.1 s as a camera sees it, sRGB in [0, 1]."""
    given = {"width": camera.width, "height": camera.height}
    given |= {"K": camera.K.tolist(), "world_to_camera": camera.world_to_camera.tolist()}
    probe = page.read_text(encoding="utf-8").replace(
        "</html>", _SHOT.replace("CAMERA", json.dumps(given)) + "</html>"
    )
    (folder / "probe.html").write_text(probe, encoding="utf-8")
    command = [BROWSER, *_ARGUMENTS, f"--user-data-dir={folder / 'profile'}"]
    done = subprocess.run(
        [*command, (folder / "probe.html").as_uri()],
        capture_output=True,
        text=True,
        timeout=300,
        check=True,
    )
    text = done.stdout.partition('<pre id="shot">')[2].partition("</pre>")[0]
    picture = Image.open(BytesIO(base64.b64decode(text, validate=True)))
    return torch.from_numpy(np.asarray(picture.convert("RGB"), dtype=np.float32) / 255)


@pytest.mark.skipif(BROWSER is None, reason="needs Chromium to show the page")
@pytest.mark.parametrize("transfer", ["power", "linear"])
def test_the_page_shows_what_our_rasteriser_draws(run, tmp_path, transfer):
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
    camera, time = capture.camera(frame), capture.frames[0].mid_us + 100_000
    rotations, bones = source.pose([time])
    avatar = avatar_of(with_correctives(run, at_rest(run, None), None))
    with torch.no_grad():
        person = avatar.gaussians.posed(bones, rotations)
        image = render(person, camera, low_pass=source.low_pass).image[0]
    want = shown(image[..., :3].clamp(0, 1), transfer)
    got = _drawn_by_browser(page, camera, tmp_path)
    assert want.std() > 0.05
    # Half floats and eight bits; a picture that is not coded is below 20 dB.
    assert psnr(got, want) > 45
