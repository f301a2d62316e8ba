"""The renderer once more, slowly: rays against triangles in float64, one picture at a time."""

import numpy as np

from evsplat.capture import Camera
from evsplat.staging import room as lights
from evsplat.staging.character import Character
from evsplat.staging.renderer import STILL_SAMPLES
from evsplat.staging.room import Lighting, RoomMesh


def draw(
    room: RoomMesh,
    character: Character,
    light: Lighting,
    camera: Camera,
    vertices: np.ndarray,
    normals: np.ndarray,
    contacts: np.ndarray,
) -> np.ndarray:
    """Linear RGB and share of the person (H, W, 4); ``vertices`` and ``normals`` are posed."""
    eye, rays = camera_rays(camera, STILL_SAMPLES)
    hit = intersect(eye, rays, room.corners.astype(np.float64))
    size = camera.height, STILL_SAMPLES, camera.width, STILL_SAMPLES
    albedo, direct, ambient, place, up = shade_room(room, eye, rays, hit, camera)
    direct = (albedo * direct[..., None]).reshape(*size, 3).mean((1, 3))
    ambient = (albedo * ambient).reshape(*size, 3).mean((1, 3))
    middle = STILL_SAMPLES // 2
    place = place.reshape(*size, 3)[:, middle, :, middle]
    up = up.reshape(size)[:, middle, :, middle]

    shadow = Shadow(light, vertices[character.faces])
    lamp = shadow.lit(place.reshape(-1, 3)).reshape(place.shape[:2])
    floor = (up > 0.7) & (place[..., 2] < 0.3)
    around = np.where(floor, contact(contacts, place), 1.0)

    eye, rays = camera_rays(camera, 2)
    room_depth = intersect(eye, rays, room.corners.astype(np.float64))[1]
    corners = vertices[character.faces]
    person = intersect(eye, rays, corners, visible=_cutouts(character))
    mine = person[1] < room_depth
    colour = np.zeros((len(rays), 3))
    if mine.any():
        faces, weights = character.faces[person[0][mine]], person[2][mine]
        where = np.einsum("nk,nkc->nc", weights, vertices[faces])
        normal = np.einsum("nk,nkc->nc", weights, normals[faces])
        uv = character.uv.astype(np.float64)
        texels = texture(
            linear(character.atlas[None, ..., :3]),
            np.zeros(mine.sum(), int),
            np.einsum("nk,nkc->nc", weights, uv[faces]),
            _texels_per_sample(
                eye, rays[mine], corners[person[0][mine]], uv[faces], camera, 2, character.atlas
            ),
            levels=3,
        )
        colour[mine] = shade_person(light, shadow, texels, where, normal, eye)
    size = camera.height, 2, camera.width, 2
    cover = mine.reshape(size).mean((1, 3))[..., None]
    seen = colour.reshape(*size, 3).mean((1, 3))
    seen += (1 - cover) * (direct * lamp[..., None] + ambient * around[..., None])
    return np.concatenate([seen, cover], -1)


def camera_rays(camera: Camera, samples: int) -> tuple[np.ndarray, np.ndarray]:
    """Eye and directions whose depth along the camera is 1, row by row."""
    pose, k = camera.world_to_camera.double().numpy(), camera.K.double().numpy()
    x = (np.arange(camera.width * samples) + 0.5) / samples
    y = (np.arange(camera.height * samples) + 0.5) / samples
    grid = np.stack(np.meshgrid(x, y), -1).reshape(-1, 2)
    local = np.column_stack([(grid - k[:2, 2]) / k[[0, 1], [0, 1]], np.ones(len(grid))])
    return -pose[:3, :3].T @ pose[:3, 3], local @ pose[:3, :3]


def intersect(eye, rays, corners, visible=None):
    """Nearest triangle, its depth and the shares of its corners, by Moeller and Trumbore."""
    nearest = np.full(len(rays), np.inf)
    index, share = np.zeros(len(rays), int), np.zeros((len(rays), 3))
    for f, (a, b, c) in enumerate(corners):
        depth, u, v = _plane(eye, rays, a, b, c)
        inside = (u >= 0) & (v >= 0) & (u + v <= 1) & (depth > 0.05) & (depth < nearest)
        if visible is not None:
            inside &= visible(f, u, v)
        nearest[inside], index[inside] = depth[inside], f
        share[inside] = np.column_stack([1 - u - v, u, v])[inside]
    return index, nearest, share


def _plane(eye, rays, a, b, c):
    e1, e2 = b - a, c - a
    p = np.cross(rays, e2)
    with np.errstate(divide="ignore", invalid="ignore"):
        inverse = 1 / (p @ e1 if e1.ndim == 1 else (p * e1).sum(-1))
        s = eye - a
        u = inverse * (p * s).sum(-1)
        q = np.cross(s, e1)
        v = inverse * (rays * q).sum(-1)
        return inverse * (q * e2).sum(-1), u, v


def linear(textures):
    return (textures.astype(np.float64) / 255) ** 2.2


def texture(pixels, layer, uv, texels_per_sample, levels):
    """Trilinear look-up in (L, H, W, 3), repeated."""
    pyramid = [pixels]
    while len(pyramid) < levels and not any(side % 2 for side in pyramid[-1].shape[1:3]):
        p = pyramid[-1]
        shape = (len(p), p.shape[1] // 2, 2, p.shape[2] // 2, 2, 3)
        pyramid.append(p.reshape(shape).mean((2, 4)))
    level = np.clip(0.5 * np.log2(np.maximum(texels_per_sample, 1e-12)), 0, len(pyramid) - 1)
    low = np.floor(level).astype(int)
    result = np.zeros((len(uv), 3))
    for k in range(len(pyramid)):
        weight = np.where(low == k, 1 - (level - low), np.where(low + 1 == k, level - low, 0))
        result += weight[:, None] * _bilinear(pyramid[k], layer, uv)
    return result


def _bilinear(pixels, layer, uv):
    size = np.array(pixels.shape[2:0:-1])
    at = uv * size - 0.5
    low = np.floor(at).astype(int)
    f = at - low
    total = 0
    for dx in (0, 1):
        for dy in (0, 1):
            x, y = (low + (dx, dy) - 0).T % size[:, None]
            weight = (f[:, 0] if dx else 1 - f[:, 0]) * (f[:, 1] if dy else 1 - f[:, 1])
            total = total + weight[:, None] * pixels[layer, y, x]
    return total


def _texels_per_sample(eye, rays, corners, uv, camera, samples, pixels):
    """Texels that a sample covers, from the texture's change to the samples beside and below."""
    pose, k = camera.world_to_camera.double().numpy(), camera.K.double().numpy()
    step = 1e-4
    moves = (pose[0, :3] / k[0, 0] / samples, pose[1, :3] / k[1, 1] / samples)
    texel = uv * np.array(pixels.shape[-2:-4:-1])

    def at(directions):
        _, u, v = _plane(eye, directions, corners[:, 0], corners[:, 1], corners[:, 2])
        return (
            ((1 - u - v)[:, None] * texel[:, 0])
            + u[:, None] * texel[:, 1]
            + v[:, None] * texel[:, 2]
        )

    dx, dy = ((at(rays + step * move) - at(rays - step * move)) / (2 * step) for move in moves)
    return np.abs(dx[:, 0] * dy[:, 1] - dx[:, 1] * dy[:, 0])


def shade_room(room, eye, rays, hit, camera):
    index, depth, share = hit
    there = np.isfinite(depth)
    corners, uv = room.corners[index].astype(np.float64), room.uv[index].astype(np.float64)
    texels = texture(
        linear(room.textures),
        room.layer[index],
        np.einsum("nk,nkc->nc", share, uv),
        _texels_per_sample(eye, rays, corners, uv, camera, STILL_SAMPLES, room.textures),
        levels=5,
    )
    albedo = np.where(there[:, None], texels * room.tint[index], 0)
    direct = np.einsum("nk,nk->n", share, room.direct[index].astype(np.float64))
    ambient = np.einsum("nk,nkc->nc", share, room.ambient[index].astype(np.float64))
    place = np.einsum("nk,nkc->nc", share, corners)
    return albedo, direct, ambient, place, np.where(there, room.normals[index][:, 2], 0)


class Shadow:
    def __init__(self, light: Lighting, corners: np.ndarray) -> None:
        self.view, self.size = light.shadow_view(), lights._SHADOW_TEXELS
        self.focal = self.size * lights._SHADOW_FOCAL
        self.bias = light.shadow_bias_m
        x = (np.arange(self.size) + 0.5 - self.size / 2) / self.focal
        grid = np.stack(np.meshgrid(x, x), -1).reshape(-1, 2)
        rays = np.column_stack([grid, np.ones(len(grid))]) @ self.view[:, :3]
        eye = -self.view[:, :3].T @ self.view[:, 3]
        self.depth = intersect(eye, rays, corners)[1].reshape(self.size, self.size)

    def lit(self, places: np.ndarray) -> np.ndarray:
        seen = places @ self.view[:, :3].T + self.view[:, 3]
        with np.errstate(divide="ignore", invalid="ignore"):
            at = seen[:, :2] / seen[:, 2:] * self.focal + self.size / 2
        inside = (seen[:, 2] > 0.05) & (at >= 0).all(1) & (at < self.size).all(1)
        at = np.where(inside[:, None], at, 0)
        total = np.zeros(len(places))
        for k in range(12):
            radius = self.size * lights._SHADOW_SOFTNESS * np.sqrt((k + 0.5) / 12)
            angle = (k + 0.5) * 2.39996
            tap = at + radius * np.array([np.cos(angle), np.sin(angle)]) - 0.5
            low = np.floor(tap).astype(int)
            f = tap - low
            for dx in (0, 1):
                for dy in (0, 1):
                    x, y = low[:, 0] + dx, low[:, 1] + dy
                    known = (x >= 0) & (y >= 0) & (x < self.size) & (y < self.size)
                    depth = self.depth[y.clip(0, self.size - 1), x.clip(0, self.size - 1)]
                    free = ~known | (depth > seen[:, 2] - self.bias)
                    weight = (f[:, 0] if dx else 1 - f[:, 0]) * (f[:, 1] if dy else 1 - f[:, 1])
                    total += weight * free / 12
        return np.where(inside, total, 1.0)


def shade_person(light, shadow, albedo, place, normal, eye):
    def unit(v):
        return v / np.linalg.norm(v, axis=-1, keepdims=True)

    normal, to_eye = unit(normal), unit(eye - place)
    facing = (normal * to_eye).sum(-1)
    normal = np.where(facing[:, None] < 0, -normal, normal)
    facing = np.abs(facing)
    away = np.array(light.lamp[:3]) - place
    to_light = unit(away)
    power = 4 * light.lamp[3] * light.lamp[4] / np.pi * light.lamp_strength
    cosine = (normal * to_light).sum(-1)
    lamp = np.maximum((cosine + light.wrap) / (1 + light.wrap), 0)
    lamp *= np.maximum(-to_light @ light.facing, 0) / (away**2).sum(-1)
    lamp *= power * shadow.lit(place)
    half = np.maximum((normal * unit(to_light + to_eye)).sum(-1), 0)
    gloss = light.specular * lamp * half**light.shininess
    above = (0.5 + 0.5 * normal[:, 2])[:, None]
    around = (1 - above) * light.ambient_below + above * np.array(light.ambient_above)
    return albedo * ((lamp + light.rim * facing)[:, None] + around) + gloss[:, None]


def contact(joints, place):
    left = np.ones(place.shape[:2])
    for joint in joints:
        d = joint - place
        r2 = (d**2).sum(-1)
        hidden = d[..., 2] / np.sqrt(r2 + 1e-6) * 0.022 / (r2 + 0.004) * (1 - r2)
        left *= np.where((r2 < 1) & (hidden > 0), 1 - np.minimum(hidden, 0.85), 1)
    return left


def _cutouts(character: Character):
    alpha = character.atlas[..., 3]

    def visible(f, u, v):
        if not character.cutout[f]:
            return np.ones(len(u), bool)
        share = np.nan_to_num(np.column_stack([1 - u - v, u, v]))
        at = share @ character.uv[character.faces[f]] * alpha.shape[::-1]
        x, y = at.astype(int).T
        inside = alpha[y.clip(0, alpha.shape[0] - 1), x.clip(0, alpha.shape[1] - 1)]
        return inside >= 115

    return visible
