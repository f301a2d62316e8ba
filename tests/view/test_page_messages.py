"""What a page may send, and that nothing else reaches what draws."""

import math

import pytest

pytest.importorskip("viser", reason="needs the extra view: pip install 'evsplat[view]'")

import msgspec  # noqa: E402

from evsplat.view.page_messages import MOST_BYTES, check_message  # noqa: E402

CAMERA = {
    "type": "ViewerCameraMessage",
    "wxyz": (1.0, 0.0, 0.0, 0.0),
    "position": (0.0, 0.0, -3),
    "fov": 0.8,
    "near": 0.01,
    "far": 100.0,
    "image_height": 4320,
    "image_width": 7680,
    "look_at": (0.0, 0.0, 0.0),
    "up_direction": (0.0, -1.0, 0.0),
}
UPDATE = {"type": "GuiUpdateMessage", "uuid": "a", "updates": {"value": 0.5}}


def check(message: object) -> None:
    check_message(msgspec.msgpack.encode(message))


@pytest.mark.parametrize(
    "message",
    [
        CAMERA,
        {**CAMERA, "image_width": 0, "far": math.inf, "more": None},
        UPDATE,
        *({**UPDATE, "updates": {"value": value}} for value in (True, -3, "as recorded", "")),
    ],
)
def test_what_the_page_sends_passes(message):
    check(message)


@pytest.mark.parametrize("number", [math.nan, math.inf, -math.inf, 1e300, None, "1", [], 10**18])
@pytest.mark.parametrize("name", ["position", "look_at", "up_direction", "wxyz"])
def test_a_camera_is_of_numbers_that_can_be_drawn(name, number):
    values = [*CAMERA[name][:-1], number]
    with pytest.raises(ValueError, match=name):
        check({**CAMERA, name: values})


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("wxyz", (0.0, 0.0, 0.0, 0.0)),
        ("wxyz", (1.0, 0.0)),
        ("position", 5),
        ("position", {"x": 1}),
        ("look_at", CAMERA["position"]),  # no direction to look in
        ("fov", 0),
        ("fov", math.pi),
        ("fov", -1.0),
        ("fov", math.nan),
        ("fov", "wide"),
        ("image_width", 10**9),
        ("image_width", -1),
        ("image_width", 7.5),
        ("image_height", True),
        ("image_height", 16_000),  # beside a width of 7680
    ],
)
def test_a_camera_that_is_none_is_named(name, value):
    with pytest.raises(ValueError, match=name):
        check({**CAMERA, name: value})
    with pytest.raises(ValueError, match=name):
        check({key: given for key, given in CAMERA.items() if key != name})


@pytest.mark.parametrize(
    ("updates", "said"),
    [
        ({"update_cb": [1]}, "a value and nothing else"),  # what viser calls after a change
        ({"value": 1, "removed": True}, "a value and nothing else"),
        ({}, "a value and nothing else"),
        (None, "a value and nothing else"),
        ({"value": math.nan}, "finite"),
        ({"value": math.inf}, "finite"),
        ({"value": [1, 2]}, "finite"),
        ({"value": b"1"}, "finite"),
        ({"value": "x" * 1000}, "short text"),
    ],
)
def test_of_a_control_its_value_alone_is_changed(updates, said):
    with pytest.raises(ValueError, match=said):
        check({**UPDATE, "updates": updates})
    with pytest.raises(ValueError, match="uuid"):
        check({**UPDATE, "uuid": 7})


@pytest.mark.parametrize(
    "data",
    [
        "text",
        b"",
        b"\xff" * 50,
        msgspec.msgpack.encode([1]),
        msgspec.msgpack.encode(None),
        msgspec.msgpack.encode({"type": ["GuiUpdateMessage"]}),
        msgspec.msgpack.encode({"type": "FileTransferStartUpload"}),
        b"\x91" * 5000,
        b"\xdf\xff\xff\xff\xff",
    ],
    ids=range(9),
)
def test_all_else_is_none(data):
    with pytest.raises(ValueError) as refusal:
        check_message(data)
    assert len(data) < MOST_BYTES and len(str(refusal.value)) < 200
