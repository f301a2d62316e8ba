"""Sharp pictures within exposures and between them."""

import json
import logging

import torch

from evsplat.capture import Policy, load_capture
from evsplat.landmarks import BLAZEPOSE_33, COCO_17, OPENPOSE_25, WHOLEBODY_133, sharp_pictures
from evsplat.landmarks import pictures as making
from evsplat.landmarks.pictures import BLURRY_SIGMA, CARRIED_SIGMA, _blend
from evsplat.pictures import decode, luminance

WITH_EVENTS = Policy(held_out_events=True)


def change(path, **entries):
    document = json.loads((path / "capture.json").read_text())
    document |= entries
    document = {key: value for key, value in document.items() if value != "gone"}
    (path / "capture.json").write_text(json.dumps(document))
    return path


def test_sets_of_names_have_as_many_as_they_are_called_after():
    sets = {17: COCO_17, 133: WHOLEBODY_133, 25: OPENPOSE_25, 33: BLAZEPOSE_33}
    assert all(len(names) == len(set(names)) == count for count, names in sets.items())


def test_held_out_times_are_carried_to_only_where_the_policy_shows_their_events(tiny_capture):
    capture = load_capture(tiny_capture())
    hidden = sharp_pictures(capture.for_training(Policy()))
    seen = sharp_pictures(capture.for_training(WITH_EVENTS))
    assert {picture.frame.split for picture in hidden} == {"train"} and len(hidden) == 21
    carried = [picture for picture in seen if picture.frame.split == "test"]
    assert len(carried) == 9 and {picture.sigma for picture in carried} == {CARRIED_SIGMA}
    assert [picture.time_us for picture in seen] == sorted(p.time_us for p in seen)


def test_carried_pictures_have_the_brightness_of_their_time(tiny_capture):
    capture = load_capture(tiny_capture())
    pictures = sharp_pictures(capture.for_training(WITH_EVENTS), fractions=(0.5,))
    before = capture.image(capture.train_frames[-1])
    for picture in pictures:
        if picture.frame.split == "test":
            truth = capture.sharp(capture.frames[picture.frame.index])
            image, near, true = (luminance(decode(x)) for x in (picture.image, before, truth))
            assert (image - true).abs().mean() < 0.75 * (near - true).abs().mean()


def test_carried_pictures_are_in_doubt_where_two_exposures_disagree():
    white, black = torch.ones(1, 2, 3), torch.zeros(1, 2, 3)
    passed = torch.tensor([[0.0, 9.0]]), torch.tensor([[0.0, 0.0]])
    mean, doubt = _blend([(white, passed[0]), (black, passed[1])], "power")
    # Weights of one half each, and of 1 and 100.
    torch.testing.assert_close(mean[0, :, 0], torch.tensor([1 / 2, 1 / 101]))
    torch.testing.assert_close(doubt, torch.tensor([[1 / 4, 100 / 101**2]]))
    assert not _blend([(white, passed[0])], "power")[1].any()


def test_a_capture_without_a_body_has_the_same_pictures(tiny_capture):
    with_body = sharp_pictures(load_capture(tiny_capture()).for_training(Policy()))
    path = change(tiny_capture("bare"), body=None)
    without = sharp_pictures(load_capture(path).for_training(Policy()))
    for a, b in zip(with_body, without, strict=True):
        assert torch.equal(a.image, b.image)


def test_without_events_they_are_the_blurry_ones_and_the_log_says_so(tiny_capture, caplog):
    capture = load_capture(change(tiny_capture(), events="gone")).for_training(Policy())
    with caplog.at_level(logging.WARNING):
        pictures = sharp_pictures(capture)
    assert "there are no events, so poses are looked for in the blurry pictures" in caplog.text
    assert {picture.sigma for picture in pictures} == {BLURRY_SIGMA}
    assert torch.equal(pictures[0].image, capture.image(capture.train_frames[0]))


def test_pictures_are_made_when_they_are_looked_at_and_those_of_few_frames_kept(
    tiny_capture, monkeypatch
):
    """In order of time each exposure is sharpened once; looked at again they are the same."""
    made = []
    original = making.deblur

    def counted(image, events, exposure_us, times, *rest, **options):
        made.append(exposure_us)
        return original(image, events, exposure_us, times, *rest, **options)

    monkeypatch.setattr(making, "deblur", counted)
    capture = load_capture(tiny_capture(frames=40)).for_training(Policy())
    found = sharp_pictures(capture)
    assert not made
    first = [picture.image for picture in found]
    frames = len(capture.train_frames)
    assert len(found) == 3 * frames and len(made) == len(set(made)) == frames
    assert frames > making._KEPT_FRAMES
    again = found[-1].image
    assert len(made) == frames and again is first[-1]
    assert torch.equal(found[0].image, first[0]) and len(made) == frames + 1
