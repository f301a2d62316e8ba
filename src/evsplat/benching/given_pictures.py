"""Pictures of test frames that no method drew, measured as any method's are."""

import hashlib
from abc import ABC, abstractmethod
from collections.abc import Sequence
from pathlib import Path

import torch
from jaxtyping import Float
from torch import Tensor

from evsplat.camera import Camera
from evsplat.capture import Capture, Frame
from evsplat.capture.read import without_gain
from evsplat.errors import DataError
from evsplat.methods.reconstruction import Parts, Rendering
from evsplat.methods.trivial import same_view
from evsplat.pictures.files import read_image, to_rgb, to_unit_range
from evsplat.untrusted.faults import open_bytes
from evsplat.untrusted.pictures import image_size

PICTURES = "pictures"
"""Method of a row whose pictures are given."""
OWN_PICTURE = "own_picture"
"""Method of a row with the blurry pictures that the camera took at test times."""


class _OfTestFrames(ABC):
    """Whole pictures, one for the view and the time of each test frame."""

    def render(self, camera: Camera, times_us: Sequence[int], *, parts: Parts = "all") -> Rendering:
        """The pictures; of other views, times or parts there are none (`DataError`)."""
        if parts != "all":
            raise DataError("pictures that were made elsewhere do not tell person from scene.")
        rgb = torch.stack([self._picture(camera, time) for time in times_us])
        alpha = torch.ones(rgb.shape[:3])
        return Rendering(rgb, alpha, torch.zeros_like(alpha))

    @abstractmethod
    def _picture(self, camera: Camera, time_us: int) -> Float[Tensor, "H W 3"]:
        """The picture of a view at a time."""


class GivenPictures(_OfTestFrames):
    """Test frames as somebody else's program drew them.

    ``folder`` holds ``FRAME.png`` for every test frame, of the frame's own size, which stands in
    place of the capture's sharp picture: coded as that is, and of the same brightness, so that
    light is divided by the frame's gain here as it is there. What that program was given to see is
    not known.

    Raises:
        DataError: A picture is missing, unreadable or of another size, or is grey and its frame's
            gain is that of three colours.
    """

    name = PICTURES

    def __init__(self, folder: Path, capture: Capture) -> None:
        self._capture = capture
        self._places: list[tuple[Camera, Frame, Path]] = []
        frames = capture.test_frames
        paths = [folder / f"{frame.name}.png" for frame in frames]
        missing = [path.name for path in paths if not path.is_file()]
        if missing:
            raise DataError(
                f"{folder}: {len(missing)} of the {len(frames)} test frames of {capture.name} have "
                f"no picture here ({', '.join(missing[:5])}{' ...' if missing[5:] else ''}); every "
                "test frame needs one, named after the frame."
            )
        for frame, path in zip(frames, paths, strict=True):
            camera = capture.camera(frame)
            found = image_size(path)
            if found != (camera.width, camera.height):
                raise DataError(
                    f"{path}: has {found[0]}x{found[1]} pixels, expected the frame's "
                    f"{camera.width}x{camera.height}."
                )
            self._places.append((camera, frame, path))

    def _picture(self, camera: Camera, time_us: int) -> Float[Tensor, "H W 3"]:
        for view, frame, path in self._places:
            if frame.mid_us == time_us and same_view(view, camera):
                pixels = read_image(path)
                if frame.gain is not None:
                    transfer = self._capture.transfer(frame)
                    pixels = without_gain(path, pixels, frame.gain, transfer)
                return to_rgb(to_unit_range(pixels))
        raise DataError(f"no picture was given of this view at {time_us} us.")


class OwnPicture(_OfTestFrames):
    """What the camera itself recorded of each test frame, blurry: nobody else sees it."""

    name = OWN_PICTURE

    def __init__(self, capture: Capture) -> None:
        self._capture = capture

    def _picture(self, camera: Camera, time_us: int) -> Float[Tensor, "H W 3"]:
        for frame in self._capture.test_frames:
            if frame.mid_us == time_us and same_view(self._capture.camera(frame), camera):
                return self._capture.image(frame)
        raise DataError(f"no picture was recorded of this view at {time_us} us.")


def digest_of(folder: Path) -> str:
    """Digest that changes when a picture directly in ``folder`` does."""
    state = hashlib.sha256()
    for path in sorted(folder.glob("*.png")):
        state.update(path.name.encode())
        with open_bytes(path) as file:
            state.update(file.read())
    return state.hexdigest()[:16]
