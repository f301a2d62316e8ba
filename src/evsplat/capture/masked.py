"""A recording as a human-only method sees it: black outside of the person."""

from pathlib import Path

from jaxtyping import Bool, Float
from torch import Tensor

from evsplat.capture.metadata import Frame
from evsplat.capture.training_capture import TrainingCapture
from evsplat.commands import command
from evsplat.errors import ConfigError, DataError

HUMAN_ABOVE = 0.5
"""Share of a pixel above which it is the person's."""


def masks_command(capture: Path, *, static_camera: bool, in_place: bool = False) -> str:
    """The command that finds the person in a capture's pictures, for the user to type.

    The default way compares them with a static background, which moving cameras have none of.
    ``in_place`` adds them to the capture itself, else a new one has them.
    """
    way = () if static_camera else ("--with", "silhouette")
    return command("masks", capture, *way, *(("--in-place",) if in_place else ()))


def command_for_lacking_masks(capture: TrainingCapture) -> str:
    """`masks_command`, into the capture itself where that can be: whatever reads it has them."""
    return masks_command(
        capture.path, static_camera=capture.is_static_camera, in_place=capture.takes_masks
    )


def frames_without_masks(capture: TrainingCapture) -> list[Frame]:
    """Training frames without a mask that is seen."""
    return [frame for frame in capture.train_frames if not capture.has_mask(frame)]


def require_masks(capture: TrainingCapture, method: str) -> None:
    """A `DataError` where a training frame has no mask, a `ConfigError` where none may be seen."""
    if capture.policy.masks == "none":
        raise ConfigError(
            f"policy.masks is none, and {method} learns the person from masks; pass --set "
            "policy.masks=given, or estimated."
        )
    if without := frames_without_masks(capture):
        ways = command_for_lacking_masks(capture)
        if capture.is_static_camera:  # estimates are differences to a static background
            ways += ", or pass --set policy.masks=estimated"
        raise DataError(
            f"{capture.path / 'capture.json'}: {len(without)} of {len(capture.train_frames)} "
            f"training frames have no mask (the first is {without[0].name!r}), and {method} learns "
            f"the person from masks; make them with: {ways}."
        )


class MaskedCapture(TrainingCapture):
    """The same capture with pictures that are black where the mask says that nobody is.

    The released 3DGS-Avatar cuts pictures hard, so a pixel is taken whole or not at all.
    """

    def __init__(self, capture: TrainingCapture, method: str) -> None:
        """The capture as ``method`` sees it; raises as `require_masks`."""
        require_masks(capture, method)
        super().__init__(capture._source, capture.policy, capture._masker)

    def image(self, frame: Frame | str) -> Float[Tensor, "H W 3"]:
        """The blurry picture of a training frame, black outside of the person."""
        return super().image(frame) * self.human(frame)[..., None]

    def human(self, frame: Frame | str) -> Bool[Tensor, "H W"]:
        """The person's pixels in a training frame."""
        mask = self.mask(frame)
        assert mask is not None
        return mask > HUMAN_ABOVE
