"""A strip per capture: the person in one test frame, as recorded, by every row, in truth."""

from pathlib import Path

import numpy as np
from jaxtyping import UInt8
from PIL import Image, ImageDraw, ImageFont

from evsplat.benching.figures import Records
from evsplat.benching.folder import BenchFolder
from evsplat.capture import Capture, Frame, load_capture
from evsplat.evaluation.regions import HumanRegions
from evsplat.files import make_folder
from evsplat.pages import read_rgb
from evsplat.pictures import to_bytes
from evsplat.pictures.box import Box
from evsplat.pictures.files import save_png

TILE_PX = 240
"""Height of the pictures."""
_LINE_PX = 17
_TITLE_LINES = 3
_GAP_PX = 6
_FONT_PX = 13
_WIDEST, _LETTERS = 4, 200

_NO_GLYPH = str.maketrans("", "", "†")
"""Marks of titles that the font does not have."""

Font = ImageFont.FreeTypeFont | ImageFont.ImageFont
Tile = tuple[str, str, UInt8[np.ndarray, "H W 3"]]
"""Title, figure, picture."""


def write_strips(records: Records, folder: BenchFolder) -> list[Path]:
    """Write ``strips/CAPTURE.png`` of every capture that some row was measured on."""
    written = []
    for name, source in records.plan.sources.items():
        if not any(records.drawn(name, row.name) for row in records.plan.suite.rows):
            continue
        capture = load_capture(source.path)
        if not capture.test_frames:
            continue
        path = folder.path / "strips" / f"{name}.png"
        make_folder(path.parent)
        save_png(path, strip(_tiles(records, capture, name, folder)))
        written.append(path)
    return written


def strip(tiles: list[Tile]) -> UInt8[np.ndarray, "H W 3"]:
    """Pictures beside each other on white, titles and figures below them."""
    scaled = [_scaled(picture) for _, _, picture in tiles]
    width = sum(image.width + _GAP_PX for image in scaled) - _GAP_PX
    font = ImageFont.load_default(_FONT_PX)
    labels = [
        [*_lines(title, font, image.width), *_lines(note, font, image.width)]
        for (title, note, _), image in zip(tiles, scaled, strict=True)
    ]
    page = Image.new("RGB", (width, TILE_PX + 2 + _LINE_PX * max(map(len, labels))), "white")
    draw = ImageDraw.Draw(page)
    x = 0
    for label, image in zip(labels, scaled, strict=True):
        page.paste(image, (x, 0))
        for line, text in enumerate(label):
            draw.text((x, TILE_PX + 2 + line * _LINE_PX), text, "black", font)
        x += image.width + _GAP_PX
    return np.asarray(page)


def _scaled(picture: UInt8[np.ndarray, "H W 3"]) -> Image.Image:
    """As high as a tile, or as wide as `_WIDEST` of them."""
    high, wide = picture.shape[:2]
    scale = min(TILE_PX / high, _WIDEST * TILE_PX / wide)
    size = max(1, round(wide * scale)), max(1, round(high * scale))
    return Image.fromarray(picture).resize(size, Image.Resampling.LANCZOS)


def _lines(text: str, font: Font, width: int) -> list[str]:
    """The text between words in at most `_TITLE_LINES` lines, cut where a line is too long."""
    lines: list[str] = []
    for word in text[:_LETTERS].translate(_NO_GLYPH).split():
        longer = f"{lines[-1]} {word}" if lines else word
        if lines and font.getlength(longer) <= width:
            lines[-1] = longer
        else:
            lines.append(word)
    if len(lines) > _TITLE_LINES:
        lines = [*lines[: _TITLE_LINES - 1], " ".join(lines[_TITLE_LINES - 1 :])]
    return [_cut_short(line, font, width) for line in lines]


def _cut_short(text: str, font: Font, width: int) -> str:
    """The text, cut where it would run into its neighbour."""
    if font.getlength(text) <= width:
        return text
    while text and font.getlength(f"{text}…") > width:
        text = text[:-1]
    return f"{text}…"


def _tiles(records: Records, capture: Capture, name: str, folder: BenchFolder) -> list[Tile]:
    """The test frame in the middle: the camera's picture, every measured row, the truth."""
    frame = capture.test_frames[len(capture.test_frames) // 2]
    box = HumanRegions(capture).crop(frame)
    tiles: list[Tile] = [("recorded", "", _cut(_shown(capture, frame, "image"), box))]
    for row in records.plan.suite.rows:
        for record in records.drawn(name, row.name)[:1]:
            entry = next((e for e in record["per_frame"] if e["frame"] == frame.name), None)
            if entry is None:
                continue
            id = f"{name}/{row.name}/seed{record['cell']['seed']}"
            remedy = f"remove {folder.record_of(id)} to measure it again"
            picture = read_rgb(folder.run_of(id) / entry["pictures"]["render"], remedy)
            mask = entry["protocols"]["standard"]["person_mask"]["psnr"]
            note = "" if mask is None else f"{mask:.2f} dB mask"
            tiles.append((row.label, note, _cut(picture, box)))
    if frame.sharp is not None:
        tiles.append(("truth", "", _cut(_shown(capture, frame, "sharp"), box)))
    return tiles


def _shown(capture: Capture, frame: Frame, kind: str) -> UInt8[np.ndarray, "H W 3"]:
    picture = capture.image(frame) if kind == "image" else capture.sharp(frame)
    return to_bytes(capture.shown(picture))


def _cut(picture: UInt8[np.ndarray, "H W 3"], box: Box | None) -> UInt8[np.ndarray, "h w 3"]:
    """The person's part of a picture; all of it where nobody is in view."""
    return picture if box is None else picture[box.top : box.bottom, box.left : box.right]
