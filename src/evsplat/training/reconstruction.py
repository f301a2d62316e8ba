"""A trained model as it is looked at: pictures, depth and certainty at any time, other motions."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import torch
from jaxtyping import Float
from torch import Tensor

from evsplat.body import BodyTrack
from evsplat.capture import Camera
from evsplat.errors import DataError
from evsplat.methods.reconstruction import Parts, Rendering
from evsplat.models.at_rest import Skinned, SkinnedGaussians, mean_at_rest, with_correctives
from evsplat.models.beyond import Beyond
from evsplat.models.drawing import SHADOW_STEP_PX, draw, draw_depth, shadowed_scene
from evsplat.models.kept import Kept
from evsplat.models.layers import Layers
from evsplat.models.seen import Seen, draw_values
from evsplat.models.smoothing import smoothed
from evsplat.models.solid_scene import SolidScene
from evsplat.render import Backdrop, Splats, render


@dataclass(frozen=True)
class GaussianReconstruction:
    """A trained model, drawn from any camera at any time of the recording."""

    name: str
    model: Skinned
    seen: Seen | None = None
    """What training saw of the person; None in checkpoints from before its end."""
    backdrop: Backdrop | None = None
    """What the scene looked like to the picture before, for a camera that mostly stands still."""
    posed: Kept | None = None
    """The Gaussians at the times drawn last, for a camera that moves while time stands still."""
    shadow_step_px: int = SHADOW_STEP_PX
    """Shadows are looked up so far apart."""
    changes: tuple[Callable[[Layers, Camera], Layers], ...] = ()
    """What a film makes of the posed Gaussians before they are drawn."""
    beyond: Beyond | None = None
    """What pictures of person and scene show where nothing is; black without."""
    solid: SolidScene | None = None
    """The scene as it is `elsewhere`; None where the end of training did not make one."""
    recorders: tuple[Camera, ...] = ()
    """Cameras that training saw through, or some of them."""
    as_wide: bool = False
    """Whether pictures finer than those of the recorders show Gaussians as wide as those did."""

    def render(self, camera: Camera, times_us: Sequence[int], *, parts: Parts = "all") -> Rendering:
        """Pictures at the given times; see `Reconstruction`.

        Raises:
            DataError: A picture is not finite, as of a checkpoint that somebody changed: numbers
                that are finite themselves overflow in it.
        """
        with torch.no_grad():
            camera, layers = self._posed(camera, times_us)
            if parts == "all":
                drawing = draw(
                    layers, camera, backdrop=self.backdrop, shadow_step_px=self.shadow_step_px
                )
                rgb, human = _stacked(drawing.rgb), _stacked(drawing.semantic)
                alpha = drawing.output.alpha
                if self.beyond is not None:
                    rgb = self.beyond.fill(rgb, alpha, camera)
            else:
                layer = layers.human if parts == "human" else layers.scene
                output = render(layer, camera, low_pass=layers.low_pass)
                rgb, human, alpha = output.image[..., :3], output.image[..., 3], output.alpha
        if not bool(rgb.sum().isfinite()):
            raise DataError(
                f"the trained model ({self.name}) draws numbers that are not finite at "
                f"{int(times_us[0])} us, expected light: its run's last checkpoint is damaged. "
                "Remove that file, so that the one before is taken, or train anew."
            )
        # The scene alone is drawn once.
        shape = len(times_us), camera.height, camera.width
        return Rendering(
            rgb=rgb.cpu().clamp(0, 1).expand(*shape, 3),
            alpha=alpha.cpu().expand(shape),
            human=human.cpu().clamp(0, 1).expand(shape),
        )

    def depth(
        self, camera: Camera, times_us: Sequence[int], *, parts: Parts = "all"
    ) -> Float[Tensor, "T H W"]:
        """Mean of z in the camera over what a pixel shows, metres; 0 where it shows nothing."""
        with torch.no_grad():
            camera, layers = self._posed(camera, times_us)
            depth = draw_depth(layers, camera, parts=parts).cpu()
        return depth.expand(len(times_us), *depth.shape[1:])

    def certainties(self) -> Float[Tensor, " H"] | None:
        """How well training saw each Gaussian of the person, 0 to 1; None where nothing tells."""
        return None if self.seen is None else self.seen.certainty()

    @torch.no_grad()
    def certainty(
        self, camera: Camera, times_us: Sequence[int], *, parts: Parts = "all"
    ) -> Float[Tensor, "T H W"]:
        """How well training saw what a pixel shows of the person, 0 to 1; the scene counts as 1.

        Raises:
            DataError: The checkpoint does not tell.
        """
        if self.seen is None:
            raise DataError(
                "--show certainty: the run's checkpoint does not say what training saw, being from "
                "before its end or from an older version; go on with 'evsplat train CAPTURE --out "
                "RUN --resume', which adds it."
            )
        camera, layers = self._posed(camera, times_us)
        human = (
            self.seen.certainty().to(self.model.device)[None, :, None].expand(len(times_us), -1, -1)
        )
        scene = layers.scene.means.new_ones(1, layers.scene.means.shape[1], 1)
        if parts == "all":
            return draw_values(layers, camera, human, scene)[..., 0].cpu().clamp(0, 1)
        layer = replace(layers.human, channels=human)
        if parts == "scene":
            layer = replace(layers.scene, channels=scene)
        picture = render(layer, camera, low_pass=layers.low_pass).image[..., 0].cpu().clamp(0, 1)
        return picture.expand(len(times_us), *picture.shape[1:])

    def _posed(self, camera: Camera, times_us: Sequence[int]) -> tuple[Camera, Layers]:
        camera = camera.to(self.model.device)
        times = list(times_us)

        def pose() -> Layers:
            return self.model.at(times, camera.center(), hard_semantics=True)

        if self.posed is None or self.model.depends_on_view:
            layers = pose()
        else:
            layers = self.posed.of(self.model.parameters(), pose, asked=times)
        for change in self.changes:
            layers = change(layers, camera)
        if self.as_wide:
            layers = smoothed(layers, camera, self.recorders)
        return camera, layers

    @property
    def track(self) -> BodyTrack:
        """The recorded motion and its body."""
        return self.model.track

    def following(self, track: BodyTrack) -> "GaussianReconstruction":
        """The same person and scene with the motion ``track`` (same body, own times) instead."""
        model = self.model.following(track)
        return GaussianReconstruction(
            self.name,
            model,
            self.seen,
            solid=self.solid,
            recorders=self.recorders,
            as_wide=self.as_wide,
        )

    def in_new_motion(self, track: BodyTrack) -> "GaussianReconstruction":
        """As `following`, for poses that were not recorded: neighbours on the skin stay together.

        What was learned fits the recorded poses without that, by 0.2 dB of the person's pixels.
        """
        moving = self.following(track)
        moving.model.stay_together()
        return moving

    def elsewhere(self, *changes: Callable[[Layers, Camera], Layers]) -> "GaussianReconstruction":
        """As it is seen from where it was not recorded: with the `solid` scene, if there is one.

        The posed Gaussians are changed by each of ``changes`` in turn before they are drawn.
        """
        solid = () if self.solid is None else (self.solid.stand_for,)
        return replace(self.at_any_size(), changes=solid + changes)

    def at_any_size(self) -> "GaussianReconstruction":
        """As pictures are to show it that may be larger than the recorded ones; see `smoothed`."""
        return replace(self, as_wide=True)

    @property
    def low_pass(self) -> float:
        """Variance of the filter of a pixel in its pictures, px^2; viewers of others take 0.3."""
        return self.model.low_pass

    @torch.no_grad()
    def splats(
        self, camera: Camera, times_us: Sequence[int], *, parts: Parts = "all"
    ) -> list[Splats]:
        """Gaussians that `render` draws, world metres; the person first.

        Channels are R, G, B (sRGB) and the semantic attribute (1 = person). Colours that depend on
        the direction are those seen from ``camera``.
        """
        _, layers = self._posed(camera, times_us)
        if parts == "all":
            return [layers.human, shadowed_scene(layers)]
        return [layers.human if parts == "human" else layers.scene]

    def at_rest(self, views: Sequence[tuple[int, Camera]]) -> SkinnedGaussians:
        """The person's mean over ``views`` (times in us and their cameras), in canonical space."""
        return mean_at_rest(self.model, views)

    def with_correctives(
        self, rest: SkinnedGaussians, views: Sequence[tuple[int, Camera]]
    ) -> SkinnedGaussians:
        """A person at rest and what the poses at ``views`` change beyond skinning."""
        return with_correctives(rest, self.model, views)

    @torch.no_grad()
    def pose(
        self, times_us: Sequence[int]
    ) -> tuple[Float[Tensor, "T J 3 3"], Float[Tensor, "T J 4 4"]]:
        """The recorded motion with what the method corrected of it.

        Rotations of joints against their parents, and bone transforms canonical to world.
        """
        rotations, bones = self.model.pose(list(times_us))
        return rotations.cpu(), bones.cpu()


def _stacked(pictures: tuple[Tensor, ...]) -> Tensor:
    """With an axis of times; one picture is not copied."""
    return pictures[0][None] if len(pictures) == 1 else torch.stack(pictures)
