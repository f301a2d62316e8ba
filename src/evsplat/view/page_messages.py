"""What the viewer's page may send: a camera that can be drawn, and one value of a control.

viser takes any field of its controls from a page, and numbers that are none.
"""

import math
from collections.abc import Mapping
from typing import Any

import msgspec

MOST_BYTES = 1 << 16
"""Of a message; those of the page have some hundred."""
_LONGEST_PX, _MOST_PX = 16_384, 36_000_000
"""Of a window: a saved picture has all of its pixels, and 8k has 33 million."""
_FARTHEST = 1e9
_NEAREST = 1e-6
_LEAST_FOV = 1e-4
_LONGEST_TEXT = 200
_VECTORS = {"position": 3, "look_at": 3, "up_direction": 3, "wxyz": 4}


def check_message(data: bytes | str) -> None:
    """Raise `ValueError` with a few words where a message is none of the viewer's page."""
    if not isinstance(data, bytes):
        raise ValueError("text, expected bytes")
    try:
        message = msgspec.msgpack.decode(data)
    except (msgspec.MsgspecError, RecursionError) as error:
        raise ValueError(f"no MessagePack: {error}") from None
    kind = message.get("type") if isinstance(message, dict) else None
    if kind == "ViewerCameraMessage":
        _check_camera(message)
    elif kind == "GuiUpdateMessage":
        _check_update(message)
    else:
        raise ValueError(f"of type {str(kind)[:40]!r}, expected a camera or a control's value")


def _check_camera(message: Mapping[str, Any]) -> None:
    for name, length in _VECTORS.items():
        values = message.get(name)
        if not isinstance(values, list) or len(values) != length:
            raise ValueError(f"{name}: expected {length} numbers")
        if not all(_is_number(value) and abs(value) <= _FARTHEST for value in values):
            raise ValueError(f"{name}: expected numbers of {_FARTHEST:g} at most")
    if math.dist(message["look_at"], message["position"]) < _NEAREST:
        raise ValueError("look_at: expected another place than position")
    if not 0.5 < math.hypot(*message["wxyz"]) < 2:
        raise ValueError("wxyz: expected a unit quaternion")
    fov: Any = message.get("fov")
    if not (_is_number(fov) and _LEAST_FOV < fov < math.pi - _LEAST_FOV):
        raise ValueError("fov: expected an angle below 180 degrees")
    width: Any = message.get("image_width")
    height: Any = message.get("image_height")
    if not all(type(side) is int and 0 <= side <= _LONGEST_PX for side in (width, height)):
        raise ValueError(f"image_width, image_height: expected 0 to {_LONGEST_PX} pixels")
    if width * height > _MOST_PX:
        raise ValueError(f"image_width, image_height: expected {_MOST_PX:,} pixels at most")


def _check_update(message: Mapping[str, Any]) -> None:
    updates = message.get("updates")
    if not isinstance(message.get("uuid"), str):
        raise ValueError("uuid: expected the name of a control")
    if not isinstance(updates, dict) or list(updates) != ["value"]:
        raise ValueError("updates: expected a value and nothing else")
    value = updates["value"]
    if not (_is_number(value) or isinstance(value, str) and len(value) <= _LONGEST_TEXT):
        raise ValueError("value: expected a finite number, a choice or a short text")


def _is_number(value: object) -> bool:
    """Finite; True and False are numbers."""
    return isinstance(value, int | float) and math.isfinite(value)
