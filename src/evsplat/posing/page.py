"""poses.html: what was found, over the sharpened pictures, and how sure it is."""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from html import escape
from typing import Any

import numpy as np
from jaxtyping import Float
from PIL import Image, ImageDraw
from torch import Tensor

from evsplat.body import BodyTrack, silhouette
from evsplat.body.silhouette import body_box
from evsplat.camera import Camera
from evsplat.capture import TrainingCapture
from evsplat.inspection.drawing import DETAIL_PX, draw_outline, fit, to_picture
from evsplat.landmarks import Landmarks, SharpPicture
from evsplat.landmarks.track import HARDLY
from evsplat.pages import Embedder, document, figure, folded, section
from evsplat.posing.fit import PoseFit
from evsplat.posing.rig import LIMBS, Rig
from evsplat.spread import evenly_spread

_OPEN, _MOST = 8, 48
"""Pictures shown at once, and in all."""
_DOUBTFUL_PX = 3.0
"""Pictures whose landmarks lie this many of their standard deviations off are told."""
_OUTLINE, _LANDMARK, _UNSEEN = (60, 255, 120), (255, 220, 60), (255, 90, 60)
_NOT_SEEN = 0.5
_MARGIN = 0.12
"""Room around the person in a tile, share of the box on each side."""
_BONES = (
    *(("left_shoulder", "right_shoulder"), ("left_hip", "right_hip")),
    *((f"{s}_{a}", f"{s}_{b}") for s in ("left", "right") for a, b in (
        ("shoulder", "elbow"), ("elbow", "wrist"), ("hip", "knee"), ("knee", "ankle"),
        ("shoulder", "hip"))),
)  # fmt: skip


def poses_page(
    name: str,
    capture: TrainingCapture,
    pictures: Sequence[SharpPicture],
    landmarks: Landmarks,
    track: BodyTrack,
    fitted: PoseFit,
    made: Mapping[str, Any],
) -> str:
    """The page as HTML, one file with its pictures inside."""
    cameras = {frame.name: capture.camera(frame) for frame in capture.frames}
    shown_in = _pictures_of(landmarks, pictures)
    off, shown = misfit(fitted), sorted(shown_in)
    chosen = evenly_spread(shown, _MOST)
    first = evenly_spread(chosen, _OPEN)
    rest = [index for index in chosen if index not in first]
    worst = sorted((i for i in shown if off[i] > _DOUBTFUL_PX), key=lambda i: -off[i])[:_OPEN]
    embed = Embedder(lossless=False)

    def tile(index: int) -> str:
        picture = shown_in[index]
        drawn = _drawn(picture, cameras[picture.frame.name], track, landmarks, index)
        label = f"{picture.frame.name}, {picture.time_us / 1e6:.3f} s, {off[index]:.1f} σ"
        return figure(embed.image(np.asarray(drawn), label), label)

    grid = lambda indices: f'<div class="tiles">{"".join(map(tile, indices))}</div>'  # noqa: E731
    body = (
        f"<header><p class='kicker'>evsplat poses</p><h1>{escape(name)}</h1>"
        f"<p class='lead'>{len(track.times_us)} key poses from landmarks in "
        f"{len(landmarks.times_us)} pictures.</p></header><main>"
        + section(
            "Over the pictures",
            "Outline of the posed body (green) over the sharpened pictures; landmarks that are "
            "seen (yellow) and guessed (red). σ: how far landmarks lie from the pose fitted to "
            "them, in their standard deviations.",
            grid(first) + folded(f"{len(rest)} more pictures", grid(rest) if rest else ""),
        )
        + section("How sure", _SURE, _limb_table(track, fitted.rig))
        + section("In doubt", _DOUBT, _doubts(fitted, landmarks) + (grid(worst) if worst else ""))
        + section(
            "Made with", "", _table(_lines({name: made[name] for name in made if name != "policy"}))
        )
        + "</main>"
    )
    return document(f"{name}: poses", body, style="poses.css")


def _pictures_of(landmarks: Landmarks, pictures: Sequence[SharpPicture]) -> dict[int, SharpPicture]:
    """The picture of each row of landmarks that has one: of one time, one after the other."""
    at: dict[int, list[SharpPicture]] = {}
    for picture in pictures:
        at.setdefault(picture.time_us, []).append(picture)
    found: dict[int, SharpPicture] = {}
    for index, time in enumerate(landmarks.times_us.tolist()):
        if at.get(time):
            found[index] = at[time].pop(0)
    return found


_SURE = (
    "Standard deviations as the fit expects them, degrees per axis (limbs: of their least sure "
    "joint) and centimetres; the mean over time, and the greatest."
)
_DOUBT = (
    "Limbs that may as well point the other way in depth, and the pictures whose landmarks lie "
    "farthest from the pose."
)


def misfit(fitted: PoseFit) -> list[float]:
    """Root mean square of each picture's landmarks' distances, in standard deviations."""
    evidence, problem = fitted.problem.evidence, fitted.problem
    posed = problem.posed(fitted.state)
    off = evidence.views.project(evidence.points.of(posed))[0] - evidence.places
    square = (off / evidence.sigma_px[..., None]).square().mean(-1)
    total = (evidence.weight * square).sum(-1) / evidence.weight.sum(-1).clamp_min(1e-9)
    return total.sqrt().tolist()


def _window(vertices: Float[Tensor, "V 3"], camera: Camera) -> tuple[int, int, int, int]:
    """Left, top, width and height of a square about the person, for as far as the picture reaches.

    All of the picture where the person is out of view.
    """
    box = body_box(vertices, camera, margin=_MARGIN)
    if box is None:
        return 0, 0, camera.width, camera.height
    side = max(box.right - box.left, box.bottom - box.top)
    size = min(side, camera.width), min(side, camera.height)
    left = min(max((box.left + box.right - size[0]) // 2, 0), camera.width - size[0])
    top = min(max((box.top + box.bottom - size[1]) // 2, 0), camera.height - size[1])
    return left, top, *size


def _drawn(
    picture: SharpPicture, camera: Camera, track: BodyTrack, landmarks: Landmarks, index: int
) -> Image.Image:
    vertices = track.vertices(picture.time_us)
    left, top, width, height = _window(vertices, camera)
    size = fit(width, height, DETAIL_PX)
    scale = size[0] / width
    K = camera.K.clone()
    K[0, 2] -= left
    K[1, 2] -= top
    large = replace(camera, width=width, height=height, K=K).resized(*size)
    image = to_picture(picture.image[top : top + height, left : left + width], size)
    mask = silhouette(vertices, track.body.faces, large)
    draw_outline(image, mask.numpy(), _OUTLINE)
    draw = ImageDraw.Draw(image)
    places, seen = (landmarks.places[index] - [left, top]) * scale, landmarks.seen[index]
    for start, end in _BONES:
        a, b = landmarks.index(start), landmarks.index(end)
        if a is not None and b is not None and min(seen[a], seen[b]) > 0:
            draw.line([tuple(places[a]), tuple(places[b])], fill=_LANDMARK, width=1)
    for place, sure in zip(places, seen, strict=True):
        if sure > 0:
            colour = _LANDMARK if sure > _NOT_SEEN else _UNSEEN
            draw.ellipse([*(place - 2), *(place + 2)], fill=colour)
    return image


def _limb_table(track: BodyTrack, rig: Rig) -> str:
    assert track.errors is not None
    degrees, place = np.degrees(track.errors.joint_rad), track.errors.root_m
    rows = []
    for limb, parts in {"trunk": ("root",), **LIMBS}.items():
        worst = degrees[:, [rig.joint(part) for part in parts]].max(1)
        rows.append((limb.replace("_", " "), f"{worst.mean():.0f}°", f"{worst.max():.0f}°"))
    along = np.sqrt((place**2).sum(1)) * 100
    rows.append(("place", f"{along.mean():.1f} cm", f"{along.max():.1f} cm"))
    return _table(rows, head=("", "mean", "most"))


def _lines(made: Mapping[str, Any], under: str = "") -> list[tuple[str, str]]:
    """What has a value, by name."""
    lines: list[tuple[str, str]] = []
    for name, value in made.items():
        if isinstance(value, Mapping):
            lines += _lines(value, f"{under}{name}: ")
        elif value is not None and value != []:
            shown = ", ".join(map(str, value)) if isinstance(value, list) else str(value)
            lines.append((f"{under}{name}".replace("_", " "), shown))
    return lines


def _table(rows: Sequence[tuple[str, ...]], head: tuple[str, ...] = ()) -> str:
    """A table whose rows begin with a name; it scrolls where the window is narrower."""
    heads = "".join(f'<th scope="col">{escape(cell)}</th>' for cell in head)
    lines = "".join(
        f'<tr><th scope="row">{escape(first)}</th>'
        + "".join(f"<td>{escape(cell)}</td>" for cell in cells)
        + "</tr>"
        for first, *cells in rows
    )
    above = f"<thead><tr>{heads}</tr></thead>" if heads else ""
    return f'<div class="scroll plain"><table>{above}<tbody>{lines}</tbody></table></div>'


def _doubts(fitted: PoseFit, landmarks: Landmarks) -> str:
    hardly, count = int((landmarks.seen.max(1) <= HARDLY).sum()), len(landmarks.seen)
    said = ""
    if hardly:
        said = (
            f"<p>The person is hardly recognised in {hardly} of {count} pictures; poses there "
            "follow from those before and after, and from the person's outline.</p>"
        )
    if not fitted.doubts:
        return f"{said}<p>No limb's depth is in doubt.</p>"
    rows = "".join(
        f"<li>{doubt.part.replace('_', ' ')}, {doubt.start_us / 1e6:.3f} to "
        f"{doubt.end_us / 1e6:.3f} s: odds {np.exp(doubt.odds_log):.1f} to 1</li>"
        for doubt in fitted.doubts
    )
    return f"{said}<ul>{rows}</ul>"
