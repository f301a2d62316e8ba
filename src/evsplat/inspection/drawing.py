"""Sheets of labelled tiles, outlines, lines and colours, drawn with Pillow."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Bool, Float
from PIL import Image, ImageDraw, ImageFont
from scipy.ndimage import binary_dilation, binary_erosion
from torch import Tensor

from evsplat.calibration import EventSource
from evsplat.events import count_map
from evsplat.files import atomic_path
from evsplat.pictures import to_bytes

PAPER, INK, FAINT = (255, 255, 255), (38, 43, 51), (128, 136, 148)
TRAIN, TEST = (38, 124, 160), (226, 114, 38)
BRIGHTER, DARKER = (235, 40, 40), (40, 90, 245)
CURVE = (108, 92, 168)
OVERSAMPLING = 2
"""Curves are drawn larger and reduced, because Pillow's lines have no soft edges."""
# Longer windows cover the person so densely that single edges cannot be told apart.
EVENT_WINDOW_US = 20_000
DETAIL_FRAMES, DETAIL_PX = 8, 380
"""Pictures of a detailed sheet, and their longer side."""
_GAP, _LABEL_HEIGHT, _HEADER_HEIGHT, _BORDER = 10, 20, 62, 4


@dataclass(frozen=True)
class Tile:
    """A picture with a frame of the split's colour and a line of text below."""

    image: Image.Image
    label: str
    split: str


def font(size: int) -> ImageFont.FreeTypeFont | ImageFont.ImageFont:
    """Pillow's own font in pixels of height."""
    return ImageFont.load_default(size)


def split_colour(split: str) -> tuple[int, int, int]:
    """One colour for train, another for test; "" is neither."""
    return {"train": TRAIN, "test": TEST}.get(split, FAINT)


def save_drawings(drawings: Mapping[str, Image.Image], out_dir: Path) -> tuple[Path, ...]:
    """Write each drawing as NAME.png; gives the files."""
    pictures = []
    for name, drawing in drawings.items():
        pictures.append(out_dir / f"{name}.png")
        with atomic_path(pictures[-1]) as temporary:
            # Half of the time of level 6 for 7 % more bytes.
            drawing.save(temporary, compress_level=4)
    return tuple(pictures)


def to_picture(image: Float[Tensor, "H W 3"], size: tuple[int, int]) -> Image.Image:
    """8-bit picture of sRGB in [0, 1], resampled to ``size`` (width, height)."""
    return Image.fromarray(to_bytes(image)).resize(size, Image.Resampling.LANCZOS)


def fit(width: int, height: int, longest: int) -> tuple[int, int]:
    """Size with the same shape whose longer side is ``longest``."""
    scale = longest / max(width, height)
    return max(1, round(width * scale)), max(1, round(height * scale))


def sheet(title: str, subtitle: str, tiles: list[Tile], columns: int) -> Image.Image:
    """Tiles in rows below a title and a legend of the splits."""
    columns = min(columns, len(tiles))
    cell_width = max(tile.image.width for tile in tiles) + 2 * _BORDER + _GAP
    cell_height = max(tile.image.height for tile in tiles) + 2 * _BORDER + _LABEL_HEIGHT + _GAP
    rows = -(-len(tiles) // columns)
    # wide enough for the header even with few tiles
    width = max(columns * cell_width + _GAP, 720)
    page = Image.new("RGB", (width, _HEADER_HEIGHT + rows * cell_height + _GAP), PAPER)
    draw = ImageDraw.Draw(page)
    header(draw, title, subtitle, page.width, {tile.split for tile in tiles} - {""})
    for index, tile in enumerate(tiles):
        x = _GAP + index % columns * cell_width
        y = _HEADER_HEIGHT + index // columns * cell_height
        colour = split_colour(tile.split)
        outer = (x + tile.image.width + 2 * _BORDER - 1, y + tile.image.height + 2 * _BORDER - 1)
        draw.rectangle(((x, y), outer), fill=colour)
        page.paste(tile.image, (x + _BORDER, y + _BORDER))
        draw.text((x + 1, outer[1] + 4), tile.label, fill=INK, font=font(13))
    return page


def header(
    draw: ImageDraw.ImageDraw, title: str, subtitle: str, width: int, splits: set[str]
) -> None:
    """Title, subtitle and, at the right, which colour is which split."""
    draw.text((_GAP, 8), title, fill=INK, font=font(22))
    draw.text((_GAP, 36), subtitle, fill=FAINT, font=font(14))
    x = width - _GAP
    for split in sorted(splits):
        x -= int(draw.textlength(split, font=font(14)))
        draw.text((x, 11), split, fill=INK, font=font(14))
        x -= 18
        draw.rectangle((x, 13, x + 12, 25), fill=split_colour(split))
        x -= 14


def event_tile(
    events: EventSource,
    image: Float[Tensor, "H W 3"],
    middle_us: int,
    label: str,
    split: str = "",
) -> Tile:
    """Events of `EVENT_WINDOW_US` about a time over the greyed picture, counted in the label."""
    height, width = image.shape[:2]
    stream = events.between(middle_us - EVENT_WINDOW_US // 2, middle_us + EVENT_WINDOW_US // 2)
    mixed = events_over(image, count_map(stream, height, width))
    picture = to_picture(mixed, fit(width, height, DETAIL_PX))
    return Tile(picture, f"{label}   {len(stream):,} events", split)


def events_over(
    image: Float[Tensor, "H W 3"], counts: Float[Tensor, "H W"]
) -> Float[Tensor, "H W 3"]:
    """Signed event counts over the greyed picture: red where brighter, blue where darker."""
    grey = image.mean(-1, keepdim=True).expand(-1, -1, 3)
    strength = (counts.abs() / 3).clamp(0, 1).sqrt()[..., None]
    colour = torch.where(
        counts[..., None] > 0, torch.tensor(BRIGHTER) / 255, torch.tensor(DARKER) / 255
    )
    return (0.25 + 0.6 * grey) * (1 - strength) + colour * strength


def line(
    draw: ImageDraw.ImageDraw,
    points: Sequence[tuple[float, float]],
    colour: tuple[int, int, int],
    width: float,
) -> None:
    """A line through points in page coordinates, on a page that is `OVERSAMPLING` times larger."""
    scaled = [(OVERSAMPLING * x, OVERSAMPLING * y) for x, y in points]
    draw.line(scaled, fill=colour, width=round(OVERSAMPLING * width))


def round_ticks(start: int, end: int) -> list[int]:
    """Round numbers from ``start`` to ``end``, about ten of them."""
    step = 1
    for step in (m * 10**e for e in range(1, 12) for m in (1, 2, 5)):
        if (end - start) / step <= 12:
            break
    return list(range(-(-start // step) * step, end + 1, step))


def short_number(value: float) -> str:
    """A number in short, such as 1234567 as '1.23M'."""
    for unit, size in (("G", 1e9), ("M", 1e6), ("k", 1e3)):
        if value >= size:
            return f"{value / size:.3g}{unit}"
    return f"{value:.3g}"


def draw_outline(
    picture: Image.Image,
    mask: Bool[np.ndarray, "H W"],
    colour: tuple[int, int, int],
    *,
    halo: bool = True,
) -> None:
    """Draw the inner edge of ``mask`` on a picture of the same size, over a dark halo."""
    edge = mask & ~binary_erosion(mask, border_value=1)
    if halo:
        edge = binary_dilation(edge)
        around = binary_dilation(edge, iterations=1)
        picture.paste((0, 0, 0), mask=Image.fromarray(around).convert("L"))
    picture.paste(colour, mask=Image.fromarray(edge).convert("L"))
