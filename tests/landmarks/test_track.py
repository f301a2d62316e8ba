"""The person found and tracked, and what is refused instead of finding a wrong one."""

from collections.abc import Callable
from dataclasses import replace
from functools import partial
from types import SimpleNamespace

import numpy as np
import pytest
import torch

from evsplat.body.skeleton import find_skeleton
from evsplat.capture import Policy, load_body_track, load_capture
from evsplat.errors import DataError
from evsplat.landmarks import find_landmarks, sharp_pictures
from evsplat.landmarks.detect import MIRRORED, Found, Region, find_in
from evsplat.landmarks.landmarks import BLAZEPOSE_33
from evsplat.landmarks.motion import Motion, global_shift, pieces
from evsplat.landmarks.pictures import CARRIED_SIGMA, SharpPicture
from evsplat.landmarks.refusals import (
    refuse_empty,
    refuse_half_out_of_view,
    refuse_moving_camera,
)
from evsplat.landmarks.track import _of_somebody, _seen, _sigma, _Tracker
from evsplat.shipped import demo_capture

JOINTS = {"shoulder": "upper_arm", "elbow": "forearm", "knee": "shin", "ankle": "foot"}


class Changed:
    """A capture whose pictures are changed on reading."""

    def __init__(self, capture, change: Callable, static: bool = True):
        self._capture, self._change, self.is_static_camera = capture, change, static

    def __getattr__(self, name):
        return getattr(self._capture, name)

    def image(self, frame):
        return self._change(self._capture.image(frame), frame.index)

    def median_background(self):
        pictures = torch.stack([self.image(frame) for frame in self.train_frames])
        return pictures.median(0).values


@pytest.fixture(scope="module")
def demo():
    return load_capture(demo_capture())


@pytest.fixture(scope="module")
def training(demo):
    return demo.for_training(Policy())


@pytest.fixture(scope="module")
def middles(training):
    return sharp_pictures(training, fractions=(0.5,))


def blurry(capture, every: int) -> list[SharpPicture]:
    frames = capture.train_frames[::every]
    return [
        SharpPicture(frame.mid_us, frame, 2.0, partial(as_recorded, capture, frame))
        for frame in frames
    ]


def as_recorded(capture, frame):
    return capture.image(frame), None


def test_the_person_of_the_demo_capture_is_found(demo, training, middles, network):
    found = find_landmarks(training, middles[::8], network=network, progress=False)
    track = load_body_track(demo)
    joints = track.body.joint_transforms(*track.at(torch.as_tensor(found.times_us)))[..., :3, 3]
    true = demo.camera(demo.frames[0]).project(joints)[0].numpy()
    skeleton = find_skeleton(track.body.parents, track.body.joint_names)
    pairs = [
        (found.index(f"{side}_{name}"), skeleton.limbs[f"{side}_{part}"])
        for name, part in JOINTS.items()
        for side in ("left", "right")
    ]
    here, there = (list(column) for column in zip(*pairs, strict=True))
    error = np.linalg.norm(found.places[:, here] - true[:, there], axis=-1)
    height = np.ptp(true[..., 1], axis=1).mean()
    assert np.median(error) < 0.025 * height
    ratio = error / found.sigma_px[:, here]
    assert 0.4 < np.median(ratio) < 2.5
    assert (found.seen > 0).all() and (np.diff(found.times_us) > 0).all()


@pytest.mark.parametrize(("carried", "belief", "factor"), [(False, 0.5, 2), (True, 0.1, 4)])
def test_points_of_somebody_hardly_recognised_count_alike(middles, carried, belief, factor):
    spread = np.linspace(0, 6, 33)
    picture = replace(middles[0], sigma=CARRIED_SIGMA) if carried else middles[0]
    nowhere = np.zeros((33, 3))
    region = Region(np.zeros(2), 100.0)
    found = Found(nowhere[:, :2], spread, np.linspace(0, 1, 33), nowhere, 0.2, region)
    assert not found.is_person
    np.testing.assert_array_equal(_seen(picture, found), belief)
    # 0.8 pixels in a region of 100, and what the copies disagree by.
    expected = factor * picture.sigma * np.hypot(0.8, spread)
    np.testing.assert_allclose(_sigma(picture, found), expected)


def test_points_at_which_the_copies_disagree_count_less(middles):
    spread, visible = np.linspace(0, 1.4, 33), np.linspace(1, 0.3, 33)
    nowhere, region = np.zeros((33, 3)), Region(np.zeros(2), 100.0)
    found = Found(nowhere[:, :2], spread, visible, nowhere, 0.9, region)
    assert found.is_person
    # Twice the 0.8 pixels that clear points have in such a region halve the belief.
    np.testing.assert_allclose(_seen(middles[0], found), 0.9 * visible / (1 + (spread / 1.6) ** 2))
    np.testing.assert_allclose(_sigma(middles[0], found), middles[0].sigma * np.hypot(0.8, spread))


def somebody(flag: float, doubt: float = 0.0) -> Found:
    """A person in a region of 100 pixels."""
    nowhere = np.zeros((33, 3))
    region = Region(np.zeros(2), 100.0)
    return Found(nowhere[:, :2], np.full(33, 100 * doubt), np.ones(33), nowhere, flag, region)


class Scripted(_Tracker):
    """A tracker that finds what it is told, and notes where it looks."""

    def __init__(self, followed: Found, searched: Found):
        super().__init__(None, None)
        self._followed, self._found = followed, searched
        self.settled, self.searches = [], []

    def settle(self, image, region):
        self.settled.append(region)
        return self._followed

    def search_anew(self, picture):
        self.searches.append(picture)
        return self._found


def test_one_picture_of_an_exposure_is_searched_for_somebody_lost(middles):
    first, second = (
        [replace(picture, time_us=picture.time_us + k) for k in range(3)] for picture in middles[:2]
    )
    weak, strong = somebody(0.6), somebody(0.8)
    tracker = Scripted(weak, strong)
    found = [tracker.find(picture) for picture in (*first, *second)]
    assert tracker.searches == [first[0], second[0]]
    assert found == [strong, weak, weak, strong, weak, weak]
    # what was found with some belief is followed from picture to picture
    follows = [region is strong.region for region in tracker.settled]
    assert follows == [True, False, False, True, False]


def test_somebody_seen_clearly_is_not_searched_for(middles):
    tracker = Scripted(somebody(0.95, 0.012), somebody(0.99))
    found = [tracker.find(picture) for picture in middles[:4]]
    assert tracker.searches == middles[:1]
    assert [person.flag for person in found] == [0.99, 0.95, 0.95, 0.95]


def test_a_region_is_kept_where_nobody_is_believed_to_be(middles):
    lost, seen = somebody(0.2), somebody(0.99)
    tracker = Scripted(lost, seen)
    tracker.find(middles[0])
    tracker._found = lost
    for picture in middles[1:4]:
        assert tracker.find(picture) is lost
    assert all(region is seen.region for region in tracker.settled)


def test_doubtful_pictures_follow_from_better_ones_after_them(middles):
    better, worse = somebody(0.97, 0.002), somebody(0.3)
    for followed, expected in ((better, better), (worse, None)):
        tracker = Scripted(followed, worse)
        found = [somebody(0.9, 0.03), somebody(0.8), somebody(1.0, 0.01), somebody(0.7)]
        before = list(found)
        tracker.look_back(middles[:4], found)
        # nothing comes after the last, and what comes after the third is worse than it
        assert found[2:] == before[2:]
        assert found[:2] == (before[:2] if expected is None else [expected, expected])


def test_names_change_sides_in_a_mirror():
    for index, name in enumerate(BLAZEPOSE_33):
        other = BLAZEPOSE_33[MIRRORED[index]]
        assert (
            other == name
            if name == "nose"
            else {"left", "right"} <= set(f"{name}_{other}".split("_"))
        )
    assert (MIRRORED[MIRRORED] == np.arange(39)).all()


def test_a_mirrored_picture_has_mirrored_landmarks(middles, network):
    picture = middles[0].image
    width = picture.shape[1]
    region = Region(np.array([width / 2, picture.shape[0] / 2]), 0.9 * width)
    one, other = find_in(network, picture, region), find_in(network, picture.flip(1), region)
    swap = MIRRORED[:33]
    mirrored = other.places[swap] * [-1, 1] + [width, 0]
    assert np.median(np.linalg.norm(one.places - mirrored, axis=-1)) < 0.02 * width
    assert np.median(np.abs(one.world - other.world[swap] * [-1, 1, 1])) < 0.05


def test_the_person_is_found_upside_down(training, middles, network):
    tracker = _Tracker(network, Motion(training))
    picture = middles[0].image
    height, width = picture.shape[:2]
    region = Region(np.array([width / 2, height / 2]), float(max(height, width)))
    upright = tracker.search(picture, [region])
    turned = tracker.search(picture.flip(0, 1), [region])
    there = np.array([width, height]) - turned.places
    assert np.median(np.linalg.norm(upright.places - there, axis=-1)) < 0.02 * width
    assert abs(abs(turned.region.angle) - np.pi) < 0.4


def test_nobody_is_one_sentence(tiny_capture, network):
    capture = load_capture(tiny_capture()).for_training(Policy())
    with pytest.raises(DataError, match="nobody was found in .* of 1 pictures"):
        find_landmarks(capture, blurry(capture, 10), network=network, progress=False)


def test_an_empty_room_is_refused_after_a_few_pictures(training, network, monkeypatch):
    room = training.median_background()
    generator = torch.Generator().manual_seed(0)
    empty = Changed(
        training, lambda picture, _: room + 0.01 * torch.randn(picture.shape, generator=generator)
    )
    empty.events = None
    looked = []
    search = _Tracker.search
    monkeypatch.setattr(_Tracker, "search", lambda *a: looked.append(1) or search(*a))
    with pytest.raises(DataError, match="nobody was found in 2 of 2 pictures looked at first"):
        find_landmarks(empty, blurry(empty, 1)[::12], network=network, progress=False)
    assert len(looked) == 2


def test_pictures_before_somebody_enters_have_no_landmarks(training, network):
    room, enters = training.median_background(), 14
    late = Changed(training, lambda picture, index: picture if index >= enters else room)
    late.events = None
    pictures = blurry(late, 3)
    indices = [picture.frame.index for picture in pictures]
    assert 3 <= sum(index < enters for index in indices) < len(indices) - 2
    found = find_landmarks(late, pictures, network=network, progress=False)
    expected = [p.time_us for p in pictures if p.frame.index >= enters]
    assert found.times_us.tolist() == expected


@pytest.mark.parametrize(
    ("moves", "recognised", "kept"),
    [
        ("0000 1111", "0000 1111", "0000 1111"),
        ("0000 1111", "0100 1101", "0000 1111"),  # furniture; somebody hardly recognised
        ("0000 1111", "1101 1111", "1111 1111"),  # somebody who stands still at first
        ("1100 0011", "1100 0011", "1100 0011"),
        ("1111 0000", "1110 0010", "1111 0000"),
        ("0000 0000", "0100 0000", "1111 1111"),  # nobody at all, which is refused
    ],
)
def test_stretches_that_show_nobody_are_left_out(moves, recognised, kept):
    moves, recognised, kept = (
        [mark == "1" for mark in marks if mark != " "] for marks in (moves, recognised, kept)
    )
    motion = SimpleNamespace(moves_little=lambda time: not moves[time])
    pictures = [SimpleNamespace(time_us=index) for index in range(len(moves))]
    found = [SimpleNamespace(is_person=person) for person in recognised]
    of_somebody, persons = _of_somebody(motion, pictures, found)
    expected = [index for index, keep in enumerate(kept) if keep]
    assert [picture.time_us for picture in of_somebody] == expected
    assert persons == [found[index] for index in expected]


@pytest.mark.parametrize("shown", [1, 2])
def test_furniture_that_is_once_taken_for_somebody_is_nobody(training, middles, shown):
    answers = iter([True] * shown + [False] * 6)

    def look():
        refuse_empty(training, middles[:6], lambda _: next(answers))

    if shown == 2:
        look()
        assert len(list(answers)) == 6  # no more were looked at
    else:
        with pytest.raises(DataError, match="nobody was found in 5 of 6 pictures"):
            look()


def test_a_person_cut_at_the_hips_is_one_sentence(training, middles, network):
    def upper(picture, _=None):
        return picture[: round(0.6 * len(picture))]

    capture = Changed(training, upper)
    capture.events = None
    pictures = [
        replace(picture, make=partial(lambda whole: (upper(whole), None), picture.image))
        for picture in middles[:1]
    ]
    with pytest.raises(DataError, match="partly out of view in 1 of 1 pictures"):
        find_landmarks(capture, pictures, network=network, progress=False)


def test_a_second_person_is_one_sentence(training, network):
    background = training.median_background()
    side = background.shape[1] // 3

    def double(picture, index):
        """The person again, a third of the picture to the side."""
        moved = picture.roll(side, 1)
        there = (moved - background.roll(side, 1)).abs().amax(-1, keepdim=True) > 0.08
        return torch.where(there, moved, picture)

    capture = Changed(training, double)
    with pytest.raises(DataError, match="second person"):
        find_landmarks(capture, blurry(capture, 11), network=network, progress=False)


def test_a_person_beyond_the_border_is_one_sentence(training, middles):
    places = np.full((4, 33, 2), 40.0)
    refuse_half_out_of_view(training, middles[:4], places)
    places[:3, 23:] = [40, 1000]
    with pytest.raises(DataError, match="partly out of view in 3 of 4 pictures"):
        refuse_half_out_of_view(training, middles[:4], places)


def test_a_moving_background_is_one_sentence_and_a_moving_person_is_not(training, middles):
    box = np.array([[60.0, 40.0], [160.0, 240.0]])
    places = np.resize(box, (len(middles), 33, 2))
    refuse_moving_camera(training, (middles, places))
    shaken = Changed(training, lambda picture, index: picture.roll((3 * index, -2 * index), (0, 1)))
    with pytest.raises(DataError, match="background moves by 4 pixels"):
        refuse_moving_camera(shaken, (middles, places))
    with pytest.raises(DataError, match="has a moving camera"):
        refuse_moving_camera(Changed(training, None, static=False), None)


def test_shifts_are_found_outside_of_what_moves_alone():
    generator = torch.Generator().manual_seed(0)
    picture = torch.rand(60, 80, 3, generator=generator)
    after = picture.roll((2, -5), (0, 1))
    still = np.ones((60, 80), bool)
    still[20:40, 30:60] = False
    after[20:40, 30:60] = torch.rand(20, 30, 3, generator=generator)
    assert global_shift(picture, after, still) == (-5.0, 2.0)
    assert global_shift(picture, picture, still) == (0.0, 0.0)


def test_pieces_near_each_other_are_one():
    moving = np.zeros((100, 120), bool)
    moving[10:40, 20:30] = moving[41:60, 20:30] = moving[80:85, 100:110] = True
    first, second = pieces(moving)
    assert (first.x0, first.y0, first.x1, first.y1) == (20, 10, 30, 60)
    assert second.side == 10
