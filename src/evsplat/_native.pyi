"""Types of the extension module; see native/module.cpp."""

from collections.abc import Sequence

from numpy import ndarray
from torch import Tensor

Fields = list[Tensor | None]
"""Means, quaternions, scales, opacities, channels, linear, 2-D offset."""

class Render:
    """One render of T times; keeps what its backward pass needs."""

    def __init__(
        self,
        width: int,
        height: int,
        K: Tensor,
        world_to_camera: Tensor,
        near: float,
        low_pass: float,
        moving: Fields,
        still: Fields,
        background: Tensor | None,
        times: int,
        threads: int,
    ) -> None: ...
    def forward(
        self,
        image: Tensor,
        alpha: Tensor,
        radii: Tensor,
        still_radii: Tensor,
        keep: bool = False,
        earlier: Render | None = None,
    ) -> None: ...
    def backward(
        self,
        image_grad: Tensor | None,
        alpha_grad: Tensor | None,
        moving: Fields,
        still: Fields,
        view: Tensor | None,
        background: Tensor | None,
    ) -> None: ...
    @property
    def seconds(self) -> dict[str, float]: ...
    @property
    def bytes(self) -> int: ...
    @property
    def intersections(self) -> int: ...
    @property
    def patch_steps(self) -> int: ...

class Mlp:
    """One evaluation of a network; keeps what its backward pass needs."""

    def __init__(
        self,
        point: Tensor,
        both: Tensor | None,
        bias: Tensor,
        point_weight: Tensor,
        both_weight: Tensor,
        layers: list[Tensor],
        slope: float,
        keep: bool,
        threads: int,
    ) -> None: ...
    def forward(self, output: Tensor) -> None: ...
    def backward(
        self,
        output_grad: Tensor,
        point: Tensor | None,
        both: Tensor | None,
        bias: Tensor,
        point_weight: Tensor,
        both_weight: Tensor,
        layers: list[Tensor],
    ) -> None: ...

class Sensor:
    """An event camera: the state of its pixels, moved from picture to picture."""

    def __init__(
        self,
        on: ndarray,
        off: ndarray,
        leak: ndarray | None,
        phase: ndarray | None,
        hot_hz: ndarray | None,
        lin_log: bool,
        eps: float,
        cutoff_hz: float,
        shot_hz: float,
        refractory_us: float,
        seed: int,
    ) -> None: ...
    def step(self, luma: ndarray, time_us: int, threads: int) -> bool: ...
    @property
    def count(self) -> int: ...
    def take(self, t: ndarray, x: ndarray, y: ndarray, p: ndarray) -> None: ...

def skin(
    position: Tensor,
    weight: Tensor,
    bones: Tensor,
    moved: Tensor,
    blended: Tensor,
    threads: int,
) -> None: ...
def skin_backward(
    position: Tensor,
    weight: Tensor,
    bones: Tensor,
    blended: Tensor,
    moved_grad: Tensor | None,
    blended_grad: Tensor | None,
    position_grad: Tensor | None,
    weight_grad: Tensor | None,
    bones_grad: Tensor | None,
    threads: int,
) -> None: ...
def isometry(rows: Tensor, arrays: list[Tensor], grads: list[Tensor]) -> tuple[float, float]: ...
def ssim(
    image: Tensor,
    reference: Tensor,
    window: Tensor,
    c1: float,
    c2: float,
    grad: Tensor | None,
    threads: int,
) -> tuple[float, float]: ...
def add_sign(
    image: Tensor,
    reference: Tensor,
    by_difference: float,
    scale: float,
    grad: Tensor,
    threads: int,
) -> None: ...
def power(
    given: Tensor, exponent: float, value: Tensor, slope: Tensor | None, threads: int
) -> None: ...
def log_brightness(
    coded: Tensor,
    weight: tuple[float, float, float],
    gamma: float,
    darkest: float,
    eps: float,
    value: Tensor,
    slope: Tensor | None,
    threads: int,
) -> None: ...
def nearest(
    points: Tensor,
    queries: Tensor | None,
    index: Tensor,
    square: Tensor,
    threads: int,
) -> None: ...

class Light:
    """A lamp, light from all around, and how surfaces answer; metres and texels."""

    position: Sequence[float]
    power: float
    world_to_light: Sequence[float]
    shadow_focal: float
    shadow_radius: float
    shadow_size: int
    shadow_bias: float
    ambient_below: Sequence[float]
    ambient_above: Sequence[float]
    rim: float
    wrap: float
    specular: float
    shininess: float

class Stage:
    """A person in a room, drawn with a z-buffer."""

    def __init__(
        self,
        corners: ndarray,
        normals: ndarray,
        uv: ndarray,
        layer: ndarray,
        tint: ndarray,
        direct: ndarray,
        ambient: ndarray,
        room_texture: list[ndarray],
        faces: ndarray,
        person_uv: ndarray,
        cutout: ndarray,
        bones: ndarray,
        weights: ndarray,
        contact: ndarray,
        rest_joints: ndarray,
        atlas: list[ndarray],
        alpha: ndarray,
        light: Light,
    ) -> None: ...
    def draw(
        self,
        K: ndarray,
        world_to_camera: ndarray,
        bones: ndarray,
        vertices: ndarray,
        normals: ndarray,
        shadows: bool,
        samples: int,
        image: ndarray,
        threads: int,
    ) -> None: ...

def decode_events(
    kind: str,
    data: ndarray,
    state: ndarray,
    t: ndarray,
    x: ndarray,
    y: ndarray,
    p: ndarray,
) -> tuple[int, int]: ...
def parse_events(
    text: ndarray,
    last: bool,
    roles: list[int],
    delimiter: str,
    time_exponent: int,
    columns: ndarray,
) -> tuple[int, int, int, int]: ...
def lanes() -> int: ...
def levels() -> list[str]: ...
def level() -> str: ...
def multiply_add(rounds: int) -> float: ...
