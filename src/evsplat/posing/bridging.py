"""Between pictures a found motion goes on as the pictures around them show it."""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Bool, Int64
from scipy.interpolate import CubicSpline, make_interp_spline
from scipy.spatial.transform import Rotation

from evsplat.body import BodyTrack
from evsplat.body.rotations import nearest_axis_angle
from evsplat.body.smoothing import continuous_quaternions, smooth_values

_SMOOTH_S = 0.025
"""Wobbles below this are not carried into a gap: what neighbouring pictures differ in is an error
as well, and a curve through it swings out beyond them."""
_LONGEST_S, _LONGEST_END_S = 0.75, 0.2
"""Of longer gaps, and ends, the pictures around say less than how people hold themselves."""
_GOES_ON_S = 0.2
"""Time in which what moves at the first or last picture comes to rest beyond it."""
_FEWEST = 5
"""Pictures that a curve needs."""


def bridged(track: BodyTrack, shown_us: Sequence[int]) -> BodyTrack:
    """The motion, whose keys between pictures lie on a smooth curve through its poses at them.

    Where no picture holds it, the price of a motion draws a pose to the usual one, and a correction
    to none at all. Poses at the pictures' times ``shown_us`` stay as they are, and so do those in
    gaps longer than `_LONGEST_S`. The curves are natural cubic smoothing splines of the joints'
    quaternions and of the root's place, plus what they miss at the pictures, linear in between.
    Before the first and after the last picture the motion goes on from there and comes to rest,
    unless that end is longer than `_LONGEST_END_S`.
    """
    times = track.times_us
    shown = np.unique(np.asarray(shown_us, np.int64))
    shown = shown[(shown >= times[0]) & (shown <= times[-1])]
    if len(shown) < _FEWEST:
        return track
    moved = _near(times, shown)
    seconds, at_s = (1e-6 * (each - shown[0]) for each in (shown, times[moved]))

    rotations, transl = (each.double().numpy() for each in track.at(shown.tolist()))
    count, joints = rotations.shape[:2]
    vectors = Rotation.from_matrix(rotations.reshape(-1, 3, 3)).as_rotvec()
    turns = continuous_quaternions(vectors.reshape(count, joints, 3)).reshape(count, -1)
    known = np.concatenate([turns, transl], 1)
    smooth = smooth_values(seconds, known, _SMOOTH_S**4 * count / seconds[-1])
    spline = CubicSpline(seconds, smooth, bc_type="natural")
    nearest_s = at_s.clip(0, seconds[-1])
    beyond = (at_s - nearest_s) / _GOES_ON_S
    goes_on_s = _GOES_ON_S * np.sign(beyond) * -np.expm1(-np.abs(beyond))
    curve = spline(nearest_s) + goes_on_s[:, None] * spline(nearest_s, 1)
    curve += make_interp_spline(seconds, known - smooth, k=1)(nearest_s)

    poses, places = track.poses.copy(), track.transl.copy()
    found = Rotation.from_quat(curve[:, : 4 * joints].reshape(-1, 4)).as_rotvec()
    poses[moved] = found.reshape(-1, joints, 3)
    places[moved] = curve[:, 4 * joints :]
    poses = nearest_axis_angle(poses)
    return track.with_keys(times, poses, places, source="bridged motion", errors=track.errors)


def _near(times: Int64[np.ndarray, "P"], shown: Int64[np.ndarray, "N"]) -> Bool[np.ndarray, "P"]:
    """Times in gaps and at ends that are short enough."""
    following = np.searchsorted(shown, times, side="right").clip(1, len(shown) - 1)
    gap_us = shown[following] - shown[following - 1]
    begins, ends = times < shown[0], times > shown[-1]
    lasts_us = np.select([begins, ends], [shown[0] - times[0], times[-1] - shown[-1]], gap_us)
    longest_us = 1e6 * np.where(begins | ends, _LONGEST_END_S, _LONGEST_S)
    return lasts_us <= longest_us
