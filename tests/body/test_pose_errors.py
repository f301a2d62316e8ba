"""Errors of key poses: typical ones of a source, and what does not fit a track."""

import numpy as np
import pytest

from evsplat.body import POSE_SOURCES, BodyTrack, PoseErrors, make_body
from evsplat.errors import DataError

from .helpers import random_rig


def track_with(errors):
    body, _ = make_body(**random_rig(0, joints=4))
    return BodyTrack(body, np.array([0, 9]), np.zeros((2, 4, 3)), np.zeros((2, 3)), errors=errors)


def test_typical_errors_grow_from_exact_to_estimated_and_say_that_they_are_typical():
    errors = [track_with(PoseErrors.typical_of(source, 2, 4)).errors for source in POSE_SOURCES]
    assert [error.source for error in errors] == ["exact", "markers", "estimated"]
    assert all(error.typical for error in errors)
    assert errors[0].joint_rad.max() == errors[0].root_m.max() == 0
    for less, more in zip(errors, errors[1:], strict=False):
        assert (less.joint_rad < more.joint_rad).all() and (less.root_m < more.root_m).all()


def test_a_track_keeps_its_errors_and_has_none_where_nobody_says():
    errors = PoseErrors("estimated", np.full((2, 4), 0.1), np.full((2, 3), 0.02))
    assert track_with(errors).to("cpu").errors is errors and not errors.typical
    assert track_with(None).errors is None


@pytest.mark.parametrize(
    "change, message",
    [
        ({"source": "guessed"}, "source is 'guessed', expected one of exact, markers, estimated"),
        ({"joint_rad": np.zeros((2, 3))}, r"errors.joint_rad has shape \(2, 3\), .* \(2, 4\)"),
        ({"root_m": np.zeros(3)}, r"errors.root_m has shape \(3,\), expected \(2, 3\)"),
        ({"root_m": np.full((2, 3), np.nan)}, "errors.root_m must hold finite numbers"),
        ({"joint_rad": np.full((2, 4), -0.1)}, "errors.joint_rad must hold finite numbers of at l"),
    ],
)
def test_errors_that_do_not_fit_are_refused_by_name(change, message):
    errors = {"source": "markers", "joint_rad": np.zeros((2, 4)), "root_m": np.zeros((2, 3))}
    with pytest.raises(DataError, match=message):
        track_with(PoseErrors(**{**errors, **change}))
