"""A long recording is corrected in pieces, whose motions are joined without a jump."""

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from evsplat.body import BodyTrack, PoseErrors
from evsplat.capture import load_body_track
from evsplat.posing import pieces as cutting
from evsplat.posing import refine as refining
from evsplat.posing.pieces import Piece, _spans, between, cut_in_pieces, joined
from evsplat.posing.refine import refine
from evsplat.posing.targets import NobodyInViewError

from ..seen import seen

KEYS = np.arange(40) * 40_000
SPANS = [(0, 600_000), (440_000, 1_120_000), (1_000_000, int(KEYS[-1]))]


def moving_track(body, seed=0, errors=None):
    rng = np.random.default_rng(seed)
    poses = 0.3 * rng.normal(size=(len(KEYS), len(body.parents), 3))
    return BodyTrack(body, KEYS, poses, rng.normal(size=(len(KEYS), 3)), errors=errors)


def said(rad, metres, body):
    keys, joints = len(KEYS), len(body.parents)
    return PoseErrors("estimated", np.full((keys, joints), rad), np.full((keys, 3), metres))


def pieces_of(spans):
    return [Piece([], start, end, 1) for start, end in spans]


@pytest.mark.parametrize("seed", range(20))
def test_pieces_cover_everything_and_share_what_they_must(seed):
    rng = np.random.default_rng(seed)
    most, count = int(rng.integers(24, 200)), int(rng.integers(1, 3_000))
    spans = _spans(count, most)
    assert spans[0][0] == 0 and spans[-1][1] == count - 1
    assert all(last - first < most for first, last in spans)
    assert len({last - first for first, last in spans}) == 1
    shared = [a[1] - b[0] + 1 for a, b in zip(spans, spans[1:], strict=False)]
    assert all(each >= cutting._SHARED_FRAMES for each in shared)
    assert len(spans) == 1 or (len(spans) - 1) * (most - 8) < count - 8, "no more than needed"


def test_pieces_of_one_motion_are_that_motion(body):
    whole = moving_track(body, errors=said(0.1, 0.02, body))
    pieces = pieces_of(SPANS)
    found = joined(pieces, [between(whole, piece.start_us, piece.end_us) for piece in pieces])
    assert found.times_us.tolist() == KEYS.tolist()
    keys = KEYS.tolist()
    for ours, given in zip(found.at(keys), whole.at(keys), strict=True):
        torch.testing.assert_close(ours, given, rtol=0, atol=2e-5)
    np.testing.assert_allclose(found.errors.joint_rad, whole.errors.joint_rad)
    np.testing.assert_allclose(found.errors.root_m, whole.errors.root_m)


def test_between_two_pieces_the_motion_goes_evenly_from_one_to_the_other(body):
    """A turn by 0.4 and a step of 10 cm, in equal parts of the time that both know."""
    first = moving_track(body, errors=said(0.1, 0.02, body))
    turn = Rotation.from_rotvec([0.0, 0.4, 0.0])
    turned = (Rotation.from_rotvec(first.poses.reshape(-1, 3)) * turn).as_rotvec()
    second = BodyTrack(
        body,
        KEYS,
        turned.reshape(first.poses.shape),
        first.transl + [0.1, 0, 0],
        errors=said(0.3, 0.06, body),
    )
    found = joined(pieces_of([(0, 600_000), (440_000, int(KEYS[-1]))]), [first, second])
    share = np.clip((KEYS - 440_000) / 160_000, 0, 1)
    off = Rotation.from_rotvec(first.poses[:, 3]).inv() * Rotation.from_rotvec(found.poses[:, 3])
    np.testing.assert_allclose(off.as_rotvec()[:, 1], 0.4 * share, atol=1e-5)
    np.testing.assert_allclose((found.transl - first.transl)[:, 0], 0.1 * share, atol=1e-6)
    variance = 0.1**2 + share * (0.3**2 - 0.1**2)
    np.testing.assert_allclose(found.errors.joint_rad[:, 0], np.sqrt(variance))


def test_a_short_recording_is_left_whole(tiny_capture):
    capture = seen(tiny_capture(frames=20))
    track = load_body_track(capture)
    (piece,) = cut_in_pieces(track, capture)
    assert piece.frames == sorted(capture.frames, key=lambda frame: frame.mid_us)
    assert piece.start_us <= track.times_us[0] and piece.end_us >= track.times_us[-1]
    assert piece.shrink == 1
    corrected = BodyTrack(track.body, track.times_us, track.poses, track.transl)
    assert joined([piece], [corrected]) is corrected


def test_large_pictures_are_halved_until_enough_of_them_fit(tiny_capture, monkeypatch):
    capture = seen(tiny_capture(frames=20, width=32, height=24))
    for bound, shrink in ((24 * 3 * 32 * 24, 1), (24 * 3 * 32 * 24 - 1, 2), (24 * 3 * 8 * 6, 4)):
        monkeypatch.setattr(cutting, "_MOST_PIXELS", bound)
        pieces = cut_in_pieces(load_body_track(capture), capture)
        assert {piece.shrink for piece in pieces} == {shrink}


def test_pictures_of_one_piece_are_there_at_once_and_all_of_them_count(tiny_capture, monkeypatch):
    capture = seen(tiny_capture(frames=40))
    track = load_body_track(capture)
    camera = capture.camera(capture.frames[0])
    monkeypatch.setattr(cutting, "_MOST_PIXELS", 24 * 3 * camera.width * camera.height)
    asked = []
    original = refining.find_targets

    def noted(motion, of, pictures, **options):
        asked.append((motion, {picture.frame.name for picture in pictures}))
        return original(motion, of, pictures, **options)

    monkeypatch.setattr(refining, "find_targets", noted)
    found = refine(track, capture, steps=(2, 2), discs=100)
    assert len(asked) > 1
    trained = {frame.name for frame in capture.train_frames}
    assert set().union(*(names for _, names in asked)) == trained, "the policy shows no others"
    for motion, names in asked:
        assert len(names) <= 24
        assert len(motion.times_us) < len(track.times_us)
    assert set(track.times_us.tolist()) <= set(found.track.times_us.tolist())
    assert found.track.errors.joint_rad.shape == (
        len(found.track.times_us),
        len(track.body.parents),
    )


def test_where_nobody_is_in_view_the_motion_stays_and_the_rest_is_corrected(
    tiny_capture, monkeypatch
):
    capture = seen(tiny_capture(frames=40))
    track = load_body_track(capture)
    camera = capture.camera(capture.frames[0])
    monkeypatch.setattr(cutting, "_MOST_PIXELS", 24 * 3 * camera.width * camera.height)
    pieces = cut_in_pieces(track, capture)
    original = refining.find_targets

    def left(motion, of, pictures, **options):
        """Nobody in the last piece."""
        if pictures[-1].frame.name == capture.train_frames[-1].name:
            raise NobodyInViewError("nobody")
        return original(motion, of, pictures, **options)

    monkeypatch.setattr(refining, "find_targets", left)
    found = refine(track, capture, steps=(2, 2), discs=100)
    alone = [key for key in track.times_us.tolist() if key > pieces[-2].end_us]
    assert alone
    for ours, given in zip(found.track.at(alone), track.at(alone), strict=True):
        torch.testing.assert_close(ours, given, rtol=0, atol=2e-5)
    corrected = [key for key in track.times_us.tolist() if key < pieces[-1].start_us]
    moved = (found.track.at(corrected)[1] - track.at(corrected)[1]).norm(dim=1)
    assert float(moved.max()) > 1e-4
    monkeypatch.setattr(cutting, "_MOST_PIXELS", 1 << 40)
    with pytest.raises(NobodyInViewError, match="nobody"):
        refine(track, capture, steps=(2, 2), discs=100)


def test_what_ends_a_correction_is_not_told_behind_its_bar(tiny_capture, monkeypatch, capsys):
    """A message that goes on in the line of the bar is hard to find."""
    capture = seen(tiny_capture())
    monkeypatch.setattr(refining, "_descended", lambda *_: 1 / 0)
    with pytest.raises(ZeroDivisionError) as error:
        refine(load_body_track(capture), capture, progress=True)
    shown = capsys.readouterr().err
    assert "refinement" in shown and shown.endswith("\r")
    assert error.tb is not None  # which keeps the bar alive, as a message's does
