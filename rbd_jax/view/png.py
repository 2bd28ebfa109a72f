"""Layer 9: a picture of a clip by ray casting in numpy; the PNG file is written with zlib alone."""

from __future__ import annotations

import os
import struct
import zlib
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from . import clip as look
from .clip import Clip

SAMPLES = 2  # a side: SAMPLES^2 rays a pixel


class Camera(NamedTuple):
    """Pinhole camera: ``eye`` (3,), rows of ``axes`` (3, 3) = right, up, forward; ``tan`` of half the angles."""

    eye: np.ndarray
    axes: np.ndarray
    tan: np.ndarray


class Solids(NamedTuple):
    """Spheres and boxes of one picture, arrays over geoms."""

    sphere: np.ndarray  # (G,) bool
    pos: np.ndarray  # (G, 3)
    rot: np.ndarray  # (G, 3, 3) local to world
    size: np.ndarray  # (G, 3)
    radius: np.ndarray  # (G,) of the bounding sphere
    colour: np.ndarray  # (G, 3) linear


class Hits(NamedTuple):
    """Nearest hit of each ray: distance (inf: none), geom, point in its frame, normal in the world."""

    depth: np.ndarray
    geom: np.ndarray
    local: np.ndarray
    normal: np.ndarray


def write_png(
    clip: Clip,
    path: str | os.PathLike[str],
    world: int | Sequence[int] = 0,
    frame: int = -1,
    width: int = 960,
    height: int = 600,
    *,
    frames: Sequence[int] | None = None,
    strip: int | Sequence[int] | None = None,
    azimuth: float = look.AZIMUTH,
    elevation: float = look.ELEVATION,
) -> None:
    """Write a picture of ``clip``, framed automatically; the arguments are those of ``render``."""
    picture = render(
        clip, world, frame, width, height, frames=frames, strip=strip, azimuth=azimuth, elevation=elevation
    )
    data = encode_png(picture)
    with open(path, "wb") as f:
        f.write(data)


def render(
    clip: Clip,
    world: int | Sequence[int] = 0,
    frame: int = -1,
    width: int = 960,
    height: int = 600,
    *,
    frames: Sequence[int] | None = None,
    strip: int | Sequence[int] | None = None,
    azimuth: float = look.AZIMUTH,
    elevation: float = look.ELEVATION,
    fits: Sequence[int] = (),
) -> np.ndarray:
    """Picture (height, width, 3) of uint8.

    ``world``: one index, or several to be shown side by side. ``frame``: the instant shown. ``frames``:
    further instants shown as ghosts, the earlier the fainter. ``strip``: that many instants, evenly spaced
    (or these instants), as panels from left to right with one camera; ``frame`` and ``frames`` are unused.
    ``azimuth``, ``elevation`` [deg]: where the camera stands as seen from the scene. ``fits``: instants that the
    camera must fit too, though they are not shown: a movie has one camera.
    """
    if width < 1 or height < 1:
        raise ValueError(f"picture of {width} x {height} pixels: both must be at least 1")
    worlds = [clip.world_index(w) for w in np.atleast_1d(world)]
    if strip is not None:
        T = clip.shape[1]
        panels = np.linspace(0, T - 1, strip).round().astype(int) if np.ndim(strip) == 0 else strip
        panels = [clip.frame_index(f) for f in panels]
        if not panels or width < len(panels):
            raise ValueError(f"strip = {strip}: needs 1..{width} panels in {width} pixels")
        edges = np.linspace(0, width, len(panels) + 1).round().astype(int)
        parts = [
            _panel(clip, worlds, f, [], panels, (b - a, height), azimuth, elevation)
            for f, a, b in zip(panels, edges[:-1], edges[1:])
        ]
        for part in parts[1:]:
            part[:, : max(1, width // 480)] = 255
        return np.concatenate(parts, 1)
    frame = clip.frame_index(frame)
    ghosts = sorted({clip.frame_index(f) for f in frames or ()} - {frame})
    framed = sorted({*ghosts, frame, *(clip.frame_index(f) for f in fits)})
    return _panel(clip, worlds, frame, ghosts, framed, (width, height), azimuth, elevation)


def encode_png(rgb: np.ndarray) -> bytes:
    """A PNG file of the picture ``rgb``: (height, width, 3) of uint8."""
    rgb = np.asarray(rgb)
    if rgb.dtype != np.uint8 or rgb.ndim != 3 or rgb.shape[2] != 3:
        raise ValueError(f"encode_png: {rgb.dtype} {rgb.shape} must be uint8 (height, width, 3)")
    height, width = rgb.shape[:2]
    rows = rgb.copy()
    rows[:, 1:] -= rgb[:, :-1]  # filter 1: difference from the pixel on the left
    rows = np.concatenate([np.ones((height, 1), np.uint8), rows.reshape(height, -1)], 1)

    def chunk(name: bytes, data: bytes) -> bytes:
        body = name + data
        return struct.pack(">I", len(data)) + body + struct.pack(">I", zlib.crc32(body))

    header = struct.pack(">IIBBBBB", width, height, 8, 2, 0, 0, 0)
    parts = (b"IHDR", header), (b"IDAT", zlib.compress(rows.tobytes(), 9)), (b"IEND", b"")
    return b"\x89PNG\r\n\x1a\n" + b"".join(chunk(*p) for p in parts)


def camera_for(lo, hi, points, radii, aspect, azimuth, elevation) -> Camera:
    """Camera that looks at the middle of the spheres (points, radii), as near as they all fit."""
    a, e = np.deg2rad([azimuth, np.clip(elevation, -89.0, 89.0)])
    back = np.array([np.cos(e) * np.cos(a), np.cos(e) * np.sin(a), np.sin(e)])
    right = np.array([-np.sin(a), np.cos(a), 0.0])
    axes = np.stack([right, np.cross(back, right), -back])
    half = np.deg2rad(look.FIELD_OF_VIEW) / 2
    tan = np.tan(half) * np.array([aspect, 1.0] if aspect > 1 else [1.0, 1 / aspect])
    sin = np.sin(np.arctan(tan))
    room = 0.86  # share of the picture that the scene may fill
    target = (lo + hi) / 2
    for _ in range(4):
        c = (points - target) @ axes.T
        ahead = [np.abs(c[:, k]) / (tan[k] * room) + radii / (sin[k] * room) - c[:, 2] for k in (0, 1)]
        distance = np.max(ahead)
        for k in (0, 1):  # centre what is seen
            spread = radii * tan[k] / sin[k]
            angle = (c[:, k] + spread) / (distance + c[:, 2]), (c[:, k] - spread) / (distance + c[:, 2])
            target = target + axes[k] * 0.5 * (np.max(angle[0]) + np.min(angle[1])) * distance
    return Camera(target - axes[2] * distance, axes, tan)


def _panel(clip, worlds, frame, ghosts, framed, size, azimuth, elevation) -> np.ndarray:
    """One picture: what is seen at ``frame``, ``ghosts`` over it, with a camera that fits all of ``framed``."""
    width, height = size[0] * SAMPLES, size[1] * SAMPLES
    lo, hi = clip.frame(worlds, framed)
    offsets = look.grid_offsets(len(worlds), lo, hi)
    low, high = lo + offsets.min(0), hi + offsets.max(0)
    points, radii = _extent([_solids(clip, worlds, f, offsets) for f in framed], low, high)
    camera = camera_for(low, high, points, radii, size[0] / size[1], azimuth, elevation)
    rays, image = _rays(camera, width, height)
    solids = _solids(clip, worlds, frame, offsets)
    faded = [_solids(clip, worlds, f, offsets, moving=True) for f in ghosts]

    hits = cast(camera, rays, solids, width, height)
    on = np.flatnonzero(np.isfinite(hits.depth))
    point = (camera.eye + rays[on] * hits.depth[on, None]).astype(np.float32)
    light = _lighting(solids, point, hits.normal[on], hits.geom[on])
    image[on] = shade(solids, hits, on, rays, light)

    depth = hits.depth
    reach = float(np.linalg.norm(high - low)) / 2
    one = float(np.linalg.norm(hi - lo)) / 2
    for plane in _planes(clip, worlds, frame, offsets, camera, (lo + hi) / 2, (low + high) / 2, one, reach):
        _draw_plane(image, depth, camera, rays, solids, plane, look.square(lo, hi), height)
    for i, ghost in enumerate(faded):
        layer = cast(camera, rays, ghost, width, height, depth)
        on = np.flatnonzero(layer.geom >= 0)
        alpha = np.float32(0.2 + 0.4 * (i + 1) / len(faded))
        colour = shade(ghost, layer, on, rays, (np.float32(1), np.float32(1)))
        image[on] += alpha * (colour - image[on])

    image = image.reshape(size[1], SAMPLES, size[0], SAMPLES, 3).mean((1, 3))
    return (np.clip(image, 0, 1) ** (1 / 2.2) * 255 + 0.5).astype(np.uint8)


def _extent(seen: list[Solids], low, high) -> tuple[np.ndarray, np.ndarray]:
    """Spheres (points, radii) to be seen: solids within the box (low, high) and their shadows on its floor.

    A box is its eight corners.
    """
    points, radii = [], []
    signs = np.array([(x, y, z) for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)])
    for s in seen:
        inside = np.all((s.pos >= low) & (s.pos <= high), -1)
        balls, boxes = inside & s.sphere, inside & ~s.sphere
        corners = s.pos[boxes, None] + np.einsum("gij,kj,gj->gki", s.rot[boxes], signs, s.size[boxes])
        points += [s.pos[balls], corners.reshape(-1, 3)]
        radii += [s.radius[balls], np.zeros(corners[..., 0].size)]
    points, radii = np.concatenate(points), np.concatenate(radii)
    if not len(points):
        return np.stack([low, high]), np.zeros(2)
    shadow = points - np.array(look.LIGHT) / look.LIGHT[2] * (points[:, 2:] - low[2])
    return np.concatenate([points, shadow]), np.concatenate([radii, 0.7 * radii])


def _rays(camera: Camera, width: int, height: int) -> tuple[np.ndarray, np.ndarray]:
    """Unit directions (N, 3) of all rays, row by row from the top left, and the background that they see."""
    x, y = (np.arange(width) + 0.5) * 2 / width - 1, 1 - (np.arange(height) + 0.5) * 2 / height
    y, x = np.meshgrid(y, x, indexing="ij")
    rays = np.stack([x * camera.tan[0], y * camera.tan[1], np.ones_like(x)], -1) @ camera.axes
    rays /= np.linalg.norm(rays, axis=-1, keepdims=True)
    top, bottom = (look.linear(c) for c in look.SKY_COLOURS)
    sky = bottom + (top - bottom) * ((y + 1) / 2)[..., None]
    return rays.astype(np.float32).reshape(-1, 3), sky.astype(np.float32).reshape(-1, 3)


def _solids(clip: Clip, worlds, frame: int, offsets, moving: bool = False) -> Solids:
    """Spheres and boxes of ``worlds`` at ``frame``; ``moving``: without those fixed to the world."""
    pick = np.array([k != "plane" for k in clip.kind]) & ((clip.body >= 0) | (not moving))
    colour = np.array([look.linear(c) for c in clip.colours()]).reshape(-1, 3)[pick]
    sphere = np.array([k == "sphere" for k in clip.kind])[pick]
    pos, rot = [], []
    for w, offset in zip(worlds, offsets):
        p, q = clip.poses(w, frame)
        pos.append(p[0, pick] + offset)
        rot.append(look.matrix(q[0, pick]))
    return Solids(
        np.tile(sphere, len(worlds)),
        np.concatenate(pos),
        np.concatenate(rot),
        np.concatenate([clip.geom_size[w, pick] for w in worlds]),
        np.concatenate([clip.radius[w, pick] for w in worlds]),
        np.tile(colour, (len(worlds), 1)),
    )


def _ray_solid(solids: Solids, g: int, origin: np.ndarray, rays: np.ndarray):
    """Distances along unit ``rays`` (N, 3) at which geom ``g`` is entered (inf: missed or behind).

    ``origin`` is one point or one a ray. Also the origin and the rays in the geom's frame.
    """
    rot = solids.rot[g].astype(np.float32)
    o = (np.asarray(origin - solids.pos[g], np.float32)) @ rot
    d = rays @ rot
    if solids.sphere[g]:
        b = np.sum(o * d, -1)
        inside = b * b - np.sum(o * o, -1) + np.float32(solids.size[g, 0]) ** 2
        t = -b - np.sqrt(np.maximum(inside, 0))
        return np.where((inside > 0) & (t > 0), t, np.inf).astype(np.float32), o, d
    with np.errstate(divide="ignore", invalid="ignore"):
        inverse = 1 / np.where(d == 0, np.float32(1e-20), d)
        middle, half = -o * inverse, np.abs(inverse) * solids.size[g].astype(np.float32)
        enter, leave = (middle - half).max(-1), (middle + half).min(-1)
    return np.where((enter < leave) & (enter > 0), enter, np.inf).astype(np.float32), o, d


def cast(camera: Camera, rays, solids: Solids, width: int, height: int, behind=None) -> Hits:
    """Nearest hit of each ray, nearer than the depths ``behind`` where given."""
    depth = np.full(len(rays), np.inf, np.float32) if behind is None else behind.copy()
    geom = np.full(len(rays), -1, np.int32)
    local, normal = np.zeros((len(rays), 3), np.float32), np.zeros((len(rays), 3), np.float32)
    centre = (solids.pos - camera.eye) @ camera.axes.T
    for g, (c, r) in enumerate(zip(centre, solids.radius)):
        pixels = _rectangle(c, r, camera.tan, width, height)
        if not len(pixels):
            continue
        t, o, d = _ray_solid(solids, g, camera.eye, rays[pixels])
        near = t < depth[pixels]
        pixels, t, d = pixels[near], t[near], d[near]
        p = o + d * t[:, None]
        if solids.sphere[g]:
            n = p / np.float32(solids.size[g, 0])
        else:
            face = np.argmax(np.abs(p) / solids.size[g].astype(np.float32), -1)
            n = np.eye(3, dtype=np.float32)[face] * np.sign(p)
        depth[pixels], geom[pixels], local[pixels] = t, g, p
        normal[pixels] = n @ solids.rot[g].T.astype(np.float32)
    return Hits(depth, geom, local, normal)


def _rectangle(c, r, tan, width, height) -> np.ndarray:
    """Flat indices of the pixels that a sphere at ``c`` (right, up, forward) of radius ``r`` may cover."""
    spans = []
    for k, count in ((0, width), (1, height)):
        distance = np.hypot(c[k], c[2])
        if distance <= r * 1.0001:
            spans.append((0, count))
            continue
        angle, half = np.arctan2(c[k], c[2]), np.arcsin(r / distance)
        if angle - half >= np.pi / 2 or angle + half <= -np.pi / 2:
            return np.zeros(0, int)
        lo = np.tan(max(angle - half, -1.57)) / tan[k]
        hi = np.tan(min(angle + half, 1.57)) / tan[k]
        if k:
            lo, hi = -hi, -lo
        edge = np.clip(np.array([lo, hi]) * 0.5 * count + 0.5 * count, 0, count)
        spans.append((int(np.floor(edge[0])), int(np.ceil(edge[1]))))
    (x0, x1), (y0, y1) = spans
    return (np.arange(y0, y1)[:, None] * width + np.arange(x0, x1)).ravel()


def _lighting(solids: Solids, point, normal, own) -> tuple[np.ndarray, np.ndarray]:
    """Share of direct light (0 or 1, a hard shadow) and of sky light (0..1) that reaches each point.

    ``own``: the geom a point lies on, -1 for none. Geoms are visited one by one; the points near one are
    found by a sort along a direction at right angles to the light.
    """
    sun, sky = np.ones(len(point), np.float32), np.ones(len(point), np.float32)
    if not len(point):
        return sun, sky
    light = (np.array(look.LIGHT) / np.linalg.norm(look.LIGHT)).astype(np.float32)
    u = np.cross(light, (1.0, 0, 0)).astype(np.float32)
    u /= np.linalg.norm(u)
    order = np.argsort(point @ u)
    point, normal, own = point[order], normal[order], own[order]
    key = point @ u
    lit = normal @ light > 0
    sun_sorted, open_sky = lit.astype(np.float32), np.ones(len(point), np.float32)
    for g in range(len(solids.pos)):
        centre, r = solids.pos[g].astype(np.float32), solids.radius[g]
        a, b = np.searchsorted(key, np.array([centre @ u - 3 * r, centre @ u + 3 * r], np.float32))
        to = centre - point[a:b]
        along = to @ light
        square = np.einsum("ij,ij->i", to, to)
        other = own[a:b] != g
        dark = np.flatnonzero((square - along**2 < r * r) & (along > -r) & (sun_sorted[a:b] > 0) & other)
        if len(dark):
            rays = np.broadcast_to(light, (len(dark), 3))
            t, _, _ = _ray_solid(solids, g, point[a:b][dark].astype(np.float64), rays)
            sun_sorted[a:b][dark[np.isfinite(t)]] = 0
        ball = float(np.prod(solids.size[g]) ** (1 / 3)) * (1.0 if solids.sphere[g] else 1.24)
        near = np.flatnonzero((square < (4 * ball) ** 2) & other)
        if len(near):
            distance = np.sqrt(np.maximum(square[near], 1e-12))
            facing = np.einsum("ij,ij->i", to[near], normal[a:b][near]) / distance
            covered = np.minimum(ball / np.maximum(distance, ball), 1) ** 2 * np.clip(facing, 0, 1)
            covered *= np.clip(2 - distance / (2 * ball), 0, 1)  # nothing at the edge of the neighbourhood
            open_sky[a:b][near] *= 1 - 0.8 * covered
    sun[order], sky[order] = sun_sorted, open_sky
    return sun, sky


def _lit(albedo, normal, view, sun, sky, gloss: float):
    """Lambert and hemispherical light on ``albedo`` (N, 3), with a soft highlight."""
    light = (np.array(look.LIGHT) / np.linalg.norm(look.LIGHT)).astype(np.float32)
    direct = np.clip(normal @ light, 0, 1) * sun
    ambient = (0.5 + 0.5 * normal[..., 2]) * 0.2 + 0.24
    out = albedo * (0.62 * direct + ambient * sky)[..., None]
    if gloss:
        half = light - view
        half /= np.linalg.norm(half, axis=-1, keepdims=True)
        out += (gloss * np.clip(np.sum(half * normal, -1), 0, 1) ** 40 * sun)[..., None]
    return out.astype(np.float32)


def shade(solids: Solids, hits: Hits, on, rays, light) -> np.ndarray:
    """Colours (N, 3) of the rays ``on`` that hit a solid: octants on spheres, dark edges on boxes."""
    geom, p = hits.geom[on], hits.local[on]
    size = solids.size[geom].astype(np.float32)
    colour = solids.colour[geom].astype(np.float32)
    sphere = solids.sphere[geom]
    pale = sphere & (np.prod(np.sign(p), -1) > 0)
    colour = np.where(pale[:, None], colour + (1 - colour) * np.float32(0.62), colour)
    gap = np.sort(size - np.abs(p), -1)[:, 1]  # from the nearest edge, on the face
    pixel = hits.depth[on] * np.float32(0.0011)
    edge = ~sphere & (gap < np.maximum(0.03 * size.min(-1), pixel))
    colour = np.where(edge[:, None], colour * np.float32(0.42), colour)
    return _lit(colour, hits.normal[on], rays[on], *light, gloss=0.10)


class Patch(NamedTuple):
    """Part of a plane that is drawn: opaque up to ``inner`` metres from ``middle``, gone at ``outer``."""

    point: np.ndarray
    axes: np.ndarray  # rows: two directions in the plane, then its normal
    middle: np.ndarray
    inner: float
    outer: float


def _planes(clip, worlds, frame, offsets, camera, centre, middle, one, reach) -> list[Patch]:
    """Planes that face the camera, level ones first.

    A level plane is one ground for all worlds; others get a patch in each. ``centre`` and ``one`` are middle
    and radius of a single world, ``middle`` and ``reach`` of all of them.
    """
    level, tilted = [], []
    index = [i for i, k in enumerate(clip.kind) if k == "plane"]
    for w, offset in zip(worlds, offsets):
        pos, quat = clip.poses(w, frame)
        for i in index:
            axes, point = look.matrix(quat[0, i]).T, pos[0, i]
            flat = axes[2, 2] > 0.9999
            point = point if flat else point + offset
            if np.dot(camera.eye - point, axes[2]) <= 0:
                continue
            about = middle if flat else centre + offset
            about = about - axes[2] * np.dot(about - point, axes[2])
            if not flat:
                tilted.append(Patch(point, axes, about, 0.75 * one, 1.1 * one))
            elif not any(np.isclose(p.point[2], point[2]) for p in level):
                level.append(Patch(point, axes, about, 2.2 * reach, 7.0 * reach))
    return level + tilted


def _draw_plane(image, depth, camera, rays, solids, patch: Patch, square: float, height: int) -> None:
    """Blend a checkered patch into ``image`` where it is nearer than ``depth``, which it updates."""
    normal = patch.axes[2].astype(np.float32)
    toward = rays @ normal
    with np.errstate(divide="ignore", invalid="ignore"):
        t = np.float32(np.dot(patch.point - camera.eye, patch.axes[2])) / toward
    on = np.flatnonzero((toward < 0) & (t > 0) & (t < depth))
    p = (camera.eye + rays[on] * t[on, None]).astype(np.float32)
    away = np.linalg.norm(p - patch.middle.astype(np.float32), axis=-1)
    on, p, away = on[away < patch.outer], p[away < patch.outer], away[away < patch.outer]
    alpha = np.clip((patch.outer - away) / (patch.outer - patch.inner), 0, 1)
    alpha = (alpha * alpha * (3 - 2 * alpha)).astype(np.float32)
    uv = (p - patch.point.astype(np.float32)) @ patch.axes[:2].T.astype(np.float32)
    odd = np.floor(uv / np.float32(square)).sum(-1) % 2
    blur = t[on] * np.float32(2 * camera.tan[1] / height / square) / -toward[on]  # squares a ray stands for
    odd += (np.float32(0.5) - odd) * np.clip(4 * blur - 1, 0, 1)
    pale, dark = (look.linear(c).astype(np.float32) for c in look.GROUND_COLOURS)
    albedo = pale + odd[:, None] * (dark - pale)
    n = np.broadcast_to(normal, p.shape)
    sun, sky = _lighting(solids, p + n * np.float32(1e-4 * patch.inner), n, np.full(len(on), -1))
    colour = _lit(albedo, n, rays[on], sun, sky, gloss=0.0)
    image[on] += alpha[:, None] * (colour - image[on])
    depth[on[alpha > 0.5]] = t[on[alpha > 0.5]]
