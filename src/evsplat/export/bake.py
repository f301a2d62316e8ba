"""``export avatar``: from a run to a page that plays its person, and what that loses."""

import logging
from dataclasses import asdict, dataclass
from pathlib import Path

import torch
from jaxtyping import Float
from torch import Tensor
from tqdm import tqdm

from evsplat.camera import Camera
from evsplat.capture import Capture
from evsplat.errors import DataError
from evsplat.evaluation.protocols import PSNR_CEILING_DB
from evsplat.export.avatar import Avatar, Clip, avatar_of, clip_of, recorded_clip, write_avatar
from evsplat.export.gaussians import cloud_at, facts_of, instant_of
from evsplat.film import load_motion_of
from evsplat.film.camera_path import check_camera
from evsplat.methods.reconstruction import Parts
from evsplat.models.at_rest import SkinnedGaussians
from evsplat.options import ExportOptions
from evsplat.render import Splats, render
from evsplat.similarity import psnr
from evsplat.training.reconstruction import GaussianReconstruction
from evsplat.training.run import Run
from evsplat.wording import counted

logger = logging.getLogger(__name__)


def at_rest(run: Run, camera: str | None) -> SkinnedGaussians:
    """The person's mean over the training frames; colours as ``camera`` (or theirs) sees them."""
    capture = run.capture
    if camera is not None:
        check_camera(capture, camera)
    views = [
        (frame.mid_us, capture.camera_at(camera or frame.camera, frame.mid_us))
        for frame in capture.train_frames
    ]
    return run.reconstruction.at_rest(views)


_BAKED_POSES = 90
"""Instants of the recording whose poses the correctives are fitted to."""


def with_correctives(run: Run, gaussians: SkinnedGaussians, camera: str | None) -> SkinnedGaussians:
    """The person at rest with what the recorded poses do beyond skinning."""
    capture = run.capture
    mids = sorted(frame.mid_us for frame in capture.frames)
    shown = camera or capture.train_frames[0].camera
    count = min(_BAKED_POSES, 3 * len(mids))
    times = [mids[0] + k * (mids[-1] - mids[0]) // max(count - 1, 1) for k in range(count)]
    views = list(zip(times, capture.cameras_at(shown, times), strict=True))
    return run.reconstruction.with_correctives(gaussians, views)


def export_avatar(
    run: Run, path: Path, parts: Parts, camera: str | None, options: ExportOptions
) -> Path:
    """Write the avatar of a run, say what it drops, and return its page."""
    capture, source = run.capture, run.reconstruction
    track = source.track
    clips: list[Clip] = []
    if options.motion is not None:
        other = load_motion_of(options.motion, track, fps=options.motion_fps)
        clips.append(clip_of(Path(options.motion).stem, other))
    gaussians = with_correctives(run, at_rest(run, camera), camera)
    avatar = avatar_of(gaussians, _elsewhere(source, gaussians))
    mids = [frame.mid_us for frame in capture.frames]
    clips.insert(0, recorded_clip(source, (min(mids), max(mids))))
    loss = measure_loss(source, avatar, capture)
    instant = instant_of(capture, time_s=None, frame=None, camera=camera)
    scene = None
    if parts == "all":
        scene = cloud_at(source.elsewhere(), instant.camera, instant.time_us, "scene")
    facts = {**facts_of(run), "note": loss.sentence(), "loss_db": asdict(loss)}
    facts["low_pass_px2"] = source.low_pass
    page = write_avatar(
        path,
        avatar,
        clips,
        track=track,
        camera=instant.camera,
        scene=scene,
        transfer=capture.transfer(capture.frames[0]),
        facts=facts,
    )
    logger.info("%s", loss.sentence())
    logger.info(
        "%d Gaussians, %d joints, %s; metres, axes of the capture.",
        len(avatar.skin),
        len(gaussians.body.parents),
        " and ".join(f"motion {clip.name}" for clip in clips),
    )
    return page


@torch.no_grad()
def _elsewhere(
    source: GaussianReconstruction, gaussians: SkinnedGaussians
) -> tuple[Float[Tensor, "H J"], Float[Tensor, " H"]] | None:
    """Bones' weights and factors on sizes in motions that were not recorded; None: the same."""
    model = source.in_new_motion(source.track).model
    weights = model.skinning_weights(gaussians.means.to(source.model.device)).cpu()
    time_us = int(source.track.times_us[0])
    center = torch.zeros(3, device=source.model.device)
    new, recorded = (
        each.at([time_us], center, hard_semantics=True).human.scales[0]
        for each in (model, source.model)
    )
    # Gaussians are only ever made smaller, along all axes alike.
    sizes = (new / recorded).amax(-1).clamp(0, 1).cpu()
    same = torch.allclose(weights, gaussians.weights, atol=1e-6) and bool((sizes > 1 - 1e-6).all())
    return None if same else (weights, sizes)


@dataclass(frozen=True)
class Psnr:
    """PSNR, mean over frames, dB; at most `PSNR_CEILING_DB` of each frame."""

    person: float
    """PSNR on the person's pixels."""
    full: float
    """PSNR on the full frame."""


@dataclass(frozen=True)
class Loss:
    """Model and avatar on the test frames, in the same scene, drawn by the same rasteriser."""

    frames: int
    keeps_light: bool
    """True where the avatar has the light, which a method may know."""
    correctives: int
    """Fields that the avatar keeps of what poses do beyond skinning."""
    avatar_to_model: Psnr
    model_to_truth: Psnr | None
    """None where the capture has no sharp truth."""
    avatar_to_truth: Psnr | None

    def sentence(self) -> str:
        """The loss in words, with its figures."""
        dropped = "the rest of cloth, own shadow and colour" + (
            "" if self.keeps_light else ", light"
        )
        sentence = (
            f"Dropped: what poses do beyond skinning and {self.correctives} correctives "
            f"({dropped}). On the "
            f"person's pixels of {counted(self.frames, 'test frame')} the avatar is "
            f"{self.avatar_to_model.person:.2f} dB PSNR from the model"
        )
        if self.model_to_truth is None or self.avatar_to_truth is None:
            return sentence + "."
        before, after = self.model_to_truth.person, self.avatar_to_truth.person
        return (
            f"{sentence}; against the sharp truth {before:.2f} dB becomes {after:.2f} dB "
            f"({round(after - before, 2) + 0.0:+.2f})."
        )


@torch.no_grad()
def measure_loss(source: GaussianReconstruction, avatar: Avatar, capture: Capture) -> Loss:
    """Draw model and avatar on the test frames, or on all frames where none is held out."""
    frames = [f for f in capture.frames if f.split == "test"] or list(capture.frames)
    rows: dict[str, list[Psnr]] = {"avatar": [], "model_truth": [], "avatar_truth": []}
    for frame in tqdm(frames, unit="frame", desc="avatar against model", dynamic_ncols=True):
        camera = capture.camera(frame)
        person, scene = source.splats(camera, [frame.mid_us])
        rotations, bones = source.pose([frame.mid_us])
        skinned = avatar.gaussians.posed(bones, rotations)
        model, model_share = _draw(person, scene, camera, source.low_pass)
        baked, avatar_share = _draw(skinned, scene, camera, source.low_pass)
        mask = capture.mask(frame)
        pixels = torch.maximum(model_share, avatar_share) > 0.5 if mask is None else mask > 0.5
        if not bool(pixels.any()):
            continue

        def of(image: Tensor, reference: Tensor, pixels: Tensor = pixels) -> Psnr:
            # Where none of the person is drawn the pictures are equal.
            values = (psnr(image, reference, mask=pixels), psnr(image, reference))
            return Psnr(*(min(float(value), PSNR_CEILING_DB) for value in values))

        rows["avatar"].append(of(baked, model))
        if frame.sharp is not None:
            truth = capture.sharp(frame)
            rows["model_truth"].append(of(model, truth))
            rows["avatar_truth"].append(of(baked, truth))
    between = _mean(rows["avatar"])
    if between is None:
        raise DataError(f"{capture.path}: the person is in none of the test frames.")
    return Loss(
        len(rows["avatar"]),
        avatar.gaussians.light is not None,
        0 if avatar.gaussians.correctives is None else len(avatar.gaussians.correctives.values),
        between,
        _mean(rows["model_truth"]),
        _mean(rows["avatar_truth"]),
    )


def _draw(
    person: Splats, scene: Splats, camera: Camera, low_pass: float
) -> tuple[Float[Tensor, "H W 3"], Float[Tensor, "H W"]]:
    """Picture and the person's share of it."""
    layers = [_on_cpu(layer) for layer in (person, scene)]
    image = render(layers[0], camera, static=layers[1], low_pass=low_pass).image[0].clamp(0, 1)
    return image[..., :3], image[..., 3]


def _on_cpu(splats: Splats) -> Splats:
    given = {name: value for name, value in vars(splats).items() if value is not None}
    return Splats(**{name: value.cpu() for name, value in given.items()})


def _mean(values: list[Psnr]) -> Psnr | None:
    if not values:
        return None
    count = len(values)
    return Psnr(sum(v.person for v in values) / count, sum(v.full for v in values) / count)
