"""Settings of method `evsplat`."""

from dataclasses import dataclass
from typing import Annotated, ClassVar, Literal

from evsplat.capture import Policy
from evsplat.methods.dropped import EVSPLAT
from evsplat.methods.poses import PoseSettings
from evsplat.methods.settings import (
    WITH_EVENTS,
    WITH_WINDOWS,
    Densify,
    Nominal,
    NotNegative,
    Positive,
    Weight,
)
from evsplat.methods.starts import FROM_MEDIAN, FittedScene, HumanStart
from evsplat.ranges import Above, AtLeast, AtMost, ReadIf, Within
from evsplat.render import LOW_PASS

_LAMPS = ReadIf("lamps", "above 0", lambda lamps: lamps > 0)
_SEVERAL = ReadIf("most_renders", "3 or more", lambda most: most > 2)
_SHADING = ReadIf("shading", "true", lambda shading: bool(shading))


@dataclass(frozen=True)
class DiscRates:
    """Adam's learning rates at the start of training."""

    means: NotNegative = 6e-4
    """Centres, metres."""
    scales_log: NotNegative = 1e-2
    """Logarithms of the standard deviations."""
    opacity_logits: NotNegative = 0.05
    """Opacities before the sigmoid."""
    colour_logits: NotNegative = 1e-2
    """Colours before the sigmoid."""
    shade: NotNegative = 1e-3
    """Network of what poses do to the person's brightness."""
    deformation: NotNegative = 0.05
    """What the person's shape changes by in time where poses err, centimetres, up to four times as
    much where that is by more than 0.05 radians; 0 = nothing."""
    pose: NotNegative = 0.1
    """Pose residuals, units of the errors expected; lower where these exceed 0.05 radians."""
    shading: Annotated[float, AtLeast(0), _SHADING] = 6e-3
    """Light on the person."""
    shadow: Annotated[float, AtLeast(0), _LAMPS] = 2e-2
    """Places of the lamps and their shadows."""
    sensor: Annotated[float, AtLeast(0), WITH_EVENTS, WITH_WINDOWS] = 1e-3
    """Logarithms of the contrast thresholds, and the events' clock."""
    final: Annotated[float, Above(0), AtMost(1)] = 0.1
    """Factor that every rate reaches at the end, exponentially from 0.3 of the training on."""


@dataclass(frozen=True)
class EvsplatConfig:
    """All settings of method `evsplat`."""

    DROPPED: ClassVar[dict[str, str]] = EVSPLAT

    policy: Policy = Policy()
    """Held-out data that training may see."""
    iterations: Annotated[int, AtLeast(1)] = 2_000
    """Training steps; all schedules stretch with it. Twice as many bring less than 0.2 dB. Without
    ``--iterations`` a run on exact poses ends earlier where little more is to come."""

    human: HumanStart = HumanStart(count=None, spacing_px=0.85)
    """Discs of the person at the start."""
    scene: FittedScene = FROM_MEDIAN
    """Discs of the scene at the start; the median of a pixel is that of frames whose body is not
    near it."""
    fill: NotNegative = 0.001
    """How strongly neighbours along the surface, and the other side's, decide at the end of
    training about colours of the person that were little seen; 0 leaves them as they are."""
    densify: Densify = Densify(start=1_000, end=10_000, gradient=2e-4, max_human=0)
    """Growth and pruning. The person does not grow: it starts with as many discs as there are
    pixels to tell them apart, and the more lie in one, the farther they reach past the outline."""

    width: Annotated[int, AtLeast(1)] = 64
    """Hidden width of the network of what poses do to the person's brightness."""
    shade_start: Nominal = 3_000
    """Nominal iteration at which that network is switched on; 15000: never."""
    pose_noise: NotNegative = 0.1
    """Standard deviation of the noise on the rotation matrices that it sees, in half of the
    steps."""
    shading: bool = True
    """The person's brightness depends on the surface's normal and place in the world."""
    lamps: Annotated[int, Within(0, 16)] = 4
    """Lamps at learned places, whose shadows of the person fall on the scene and which, with
    ``shading``, light the person; 0 = none."""
    self_shadow: Annotated[bool, _LAMPS, _SHADING] = True
    """Parts of the person that are nearer to a lamp shade others."""
    low_pass: Annotated[float, Above(0), AtMost(LOW_PASS)] = 0.1
    """Variance of the filter of a pixel, px^2; 3DGS and viewers of others take 0.3, the most."""

    px_per_render: Annotated[float, Above(0), _SEVERAL] = 3.0
    """Way of the body between neighbouring renders of an exposure, pixels."""
    most_renders: Annotated[int, AtLeast(1)] = 7
    """Upper bound of renders in an exposure, odd; 1 compares the sharp middle, as `paper` does."""

    event_weight: Weight = 0.2
    """Weight of the event term; 0 = without events."""
    event_term: Annotated[Literal["windows", "paper"], WITH_EVENTS] = "windows"
    """``windows``: changes between any two rendered times, with their amplitude. ``paper``:
    normalised changes between neighbouring frames' middles (its eq. 8-9)."""
    event_start: Annotated[Nominal, WITH_EVENTS] = 750
    """First nominal iteration of the event term."""
    event_eps: Annotated[float, Above(0), WITH_EVENTS, WITH_WINDOWS] = 0.004
    """Added to linear luminance: darker than this a sensor sees nothing."""
    event_reach: Annotated[float, AtLeast(0), WITH_EVENTS, WITH_WINDOWS] = 0.5
    """Reach of windows before or after an exposure, in intervals of the training frames."""
    event_ramp_us: Annotated[int, AtLeast(0), WITH_EVENTS, WITH_WINDOWS] = 100_000
    """Between two events of one polarity that lie at most so far apart, brightness is taken to
    change evenly instead of all at once at the second; 0: all at once."""
    event_hue_from: Annotated[Nominal, WITH_EVENTS, WITH_WINDOWS] = 15_000
    """Nominal iteration from which events pull at all channels alike, instead of as luminance has
    them, and leave the hue to the frames; 15000: never. 4500 takes tints off fast limbs."""
    event_noise_aware: Annotated[bool, WITH_EVENTS, WITH_WINDOWS] = True
    """Weigh differences by the sensor's background noise, and leave hot pixels out."""
    contrast_weight: Annotated[Weight, WITH_EVENTS, WITH_WINDOWS] = 1.0
    """Weight of the squared distance of the thresholds' logarithms from where they started."""
    clock: Annotated[Literal["auto", "always", "never"], WITH_EVENTS, WITH_WINDOWS] = "auto"
    """Learn by how much the events' clock is late, on top of the capture's own offset, starting at
    what training frames and events tell where that is over 4 ms and three standard errors.
    ``auto``: only there; ``always``: elsewhere from 0."""

    pose: PoseSettings = PoseSettings(
        smooth="auto",
        refine="auto",
        between=True,
        start=1_500,
        prior=1e-3,
        std_rad=None,
        std_m=None,
        events_of_held_out=False,
    )
    """Errors of the given poses."""

    l1_weight: Weight = 0.8
    """Weight of the mean absolute difference to the blurry frame, sRGB."""
    dssim_weight: Weight = 0.2
    """Weight of 1 - SSIM."""
    semantic_weight: Weight = 0.1
    """Weight of the rendered attribute's cross-entropy against the posed body's silhouette."""
    binarise_weight: Weight = ((0, 0.0), (5_000, 0.001), (10_000, 0.01))
    """Weight of the mean of m (1 - m), which pushes the attribute m to 0 or 1."""
    semantic_band_px_at_256: Positive = 9.0
    """Width of the undecided band around the posed body, for a picture 256 pixels high (A8)."""

    rates: DiscRates = DiscRates()
    """Learning rates."""
