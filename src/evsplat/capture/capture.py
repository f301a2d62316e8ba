"""`Capture`: a recording on disk, and `for_training`, which hides what is held out of it."""

import logging
from collections.abc import Callable
from pathlib import Path

from evsplat.capture.policy import Policy
from evsplat.capture.read import CaptureReader
from evsplat.capture.training_capture import HumanFinder, TrainingCapture
from evsplat.capture.validate import check_capture
from evsplat.commands import command
from evsplat.errors import DataError
from evsplat.wording import counted

logger = logging.getLogger(__name__)


class Capture(CaptureReader):
    """A blurry video, its events and body poses. Pictures and events are read when asked for.

    Pictures are float32 in [0, 1], coded as `transfer` says; `shown` codes light for a display.
    Lens distortion is removed on reading, from pictures and events alike, so that `camera`
    describes them exactly. The pose of a moving camera is known at the mid-exposure of its frames
    only; `cameras_at` interpolates between them.
    """

    def for_training(
        self,
        policy: Policy,
        masker: Callable[[TrainingCapture], HumanFinder] | None = None,
    ) -> TrainingCapture:
        """The part that methods, restorers, maskers and calibration may see; they get no other.

        ``masker`` makes what finds people for ``policy.masks=estimated``.
        """
        return TrainingCapture(self, policy, masker)


def load_capture(path: Path | str, *, needs_body: bool = True, warn: bool = True) -> Capture:
    """Open a capture after the quick checks (descriptions, headers, poses; not every pixel).

    Raises `DataError` with the first error found; warnings are logged where it shall ``warn``, that
    there is no body only if it ``needs_body``.
    """
    metadata, findings = check_capture(Path(path), deep=False)
    errors = [finding for finding in findings if finding.severity == "error"]
    if errors or metadata is None:
        more = (
            f"\n{counted(len(errors) - 1, 'more error')}, which this lists: "
            f"{command('inspect', path)}"
            if len(errors) > 1
            else ""
        )
        raise DataError(f"{errors[0]}{more}")
    for finding in findings if warn else ():
        if needs_body or finding.field != "body":
            logger.warning("%s", finding)
    return Capture(metadata)
