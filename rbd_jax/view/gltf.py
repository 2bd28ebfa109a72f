"""Layer 9: a clip as one binary glTF 2.0 file (.glb) with animation, for Blender, browsers and game engines.

A node a body, moved by linear interpolation of its samples, with its geoms as children. glTF has y upwards and
quaternions x, y, z, w; the root turns the worlds over.
"""

from __future__ import annotations

import json
import os
import struct

import numpy as np

from .clip import Clip, continuous, grid_offsets, linear

FLOAT, UINT = 5126, 5125
VERTICES, INDICES = 34962, 34963
#: Half-width of a ground plane [m], in units of the scene's size.
GROUND = 3.0
ROOT = (-(0.5**0.5), 0.0, 0.0, 0.5**0.5)  # z up to y up


def unit_sphere(rings: int = 12, sides: int = 24):
    """(vertices, triangles) of a sphere of radius 1; a vertex is its own normal."""
    theta, phi = np.linspace(0, np.pi, rings + 1), np.linspace(0, 2 * np.pi, sides + 1)
    t, p = np.meshgrid(theta, phi, indexing="ij")
    points = np.stack([np.sin(t) * np.cos(p), np.sin(t) * np.sin(p), np.cos(t)], -1).reshape(-1, 3)
    a = (np.arange(rings)[:, None] * (sides + 1) + np.arange(sides)).ravel()
    b = a + sides + 1
    return points, points, np.concatenate([np.stack([a, b, b + 1], -1), np.stack([a, b + 1, a + 1], -1)])


def unit_box():
    """(vertices, normals, triangles) of a box of half-extents 1: four vertices a face."""
    points, normals, faces = [], [], []
    for axis in range(3):
        for sign in (1.0, -1.0):
            n = np.zeros(3)
            n[axis] = sign
            u, v = np.roll(np.eye(3), 0, 0)[(axis + 1) % 3], np.eye(3)[(axis + 2) % 3]
            first = len(points)
            points += [n - u - v, n + u - v, n + u + v, n - u + v]
            normals += [n] * 4
            around = [(0, 1, 2), (0, 2, 3)] if sign > 0 else [(0, 2, 1), (0, 3, 2)]
            faces += [[first + k for k in f] for f in around]
    return np.array(points), np.array(normals), np.array(faces)


def unit_plane():
    """(vertices, normals, triangles) of a square of half-width 1 that looks up z."""
    points = np.array([[-1.0, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]])
    return points, np.tile([0.0, 0, 1], (4, 1)), np.array([[0, 1, 2], [0, 2, 3]])


SHAPES = {"sphere": unit_sphere, "box": unit_box, "plane": unit_plane}


class _Buffer:
    """The binary chunk, and the views and accessors into it."""

    def __init__(self):
        self.data, self.views, self.accessors = bytearray(), [], []

    def add(self, array, kind: str, component: int, target: int | None = None, limits: bool = False) -> int:
        array = np.ascontiguousarray(array, np.float32 if component == FLOAT else np.uint32)
        view = {"buffer": 0, "byteOffset": len(self.data), "byteLength": array.nbytes}
        self.views.append({**view, **({"target": target} if target else {})})
        self.data += array.tobytes()
        entry = {"bufferView": len(self.views) - 1, "componentType": component, "count": len(array), "type": kind}
        if limits:
            flat = array.reshape(len(array), -1)
            entry |= {"min": flat.min(0).tolist(), "max": flat.max(0).tolist()}
        self.accessors.append(entry)
        return len(self.accessors) - 1


def write_glb(clip: Clip, path: str | os.PathLike[str]) -> None:
    """Write ``clip``, its worlds side by side.

    Raises:
      OSError: the file cannot be written.
    """
    with open(path, "wb") as file:
        file.write(glb(clip))


def glb(clip: Clip) -> bytes:
    """The bytes of the file."""
    buffer = _Buffer()
    W, T, n = clip.shape
    lo, hi = clip.bounds()
    offsets = grid_offsets(W, lo, hi)
    width = GROUND * float(np.max(hi - lo))

    colours = clip.colours()
    palette = list(dict.fromkeys(colours))
    materials = [
        {"pbrMetallicRoughness": {"baseColorFactor": [*linear(c).tolist(), 1.0], "metallicFactor": 0.0,
                                  "roughnessFactor": 0.7}}
        for c in palette
    ]  # fmt: skip
    meshes, mesh_of, shape_of = [], {}, {}

    def mesh(kind: str, colour: str) -> int:
        if (kind, colour) not in mesh_of:
            if kind not in shape_of:
                points, normals, faces = SHAPES[kind]()
                shape_of[kind] = (
                    buffer.add(points, "VEC3", FLOAT, VERTICES, limits=True),
                    buffer.add(normals, "VEC3", FLOAT, VERTICES),
                    buffer.add(faces.reshape(-1), "SCALAR", UINT, INDICES),
                )
            at, normal, index = shape_of[kind]
            part = {"attributes": {"POSITION": at, "NORMAL": normal}, "indices": index,
                    "material": palette.index(colour)}  # fmt: skip
            meshes.append({"name": kind, "primitives": [part]})
            mesh_of[kind, colour] = len(meshes) - 1
        return mesh_of[kind, colour]

    quats = continuous(clip.quat)  # the short way round between samples
    nodes = [{"name": clip.title, "rotation": list(ROOT), "children": []}]
    times = buffer.add(clip.time - clip.time[0], "SCALAR", FLOAT, limits=True)
    channels, samplers = [], []

    def node(parent: int, **fields) -> int:
        nodes.append(fields)
        nodes[parent].setdefault("children", []).append(len(nodes) - 1)
        return len(nodes) - 1

    xyzw = lambda q: q[..., [1, 2, 3, 0]]
    for w in range(W):
        world = node(0, name=clip.worlds[w], translation=offsets[w].tolist())
        bodies = []
        for k in range(n):
            quat = quats[w, :, k]
            body = node(
                world, name=clip.names[k], translation=clip.pos[w, 0, k].tolist(), rotation=xyzw(quat[0]).tolist()
            )
            bodies.append(body)
            if T < 2:
                continue
            for what, values, kind in (("translation", clip.pos[w, :, k], "VEC3"), ("rotation", xyzw(quat), "VEC4")):
                samplers.append({"input": times, "output": buffer.add(values, kind, FLOAT), "interpolation": "LINEAR"})
                channels.append({"sampler": len(samplers) - 1, "target": {"node": body, "path": what}})
        for g, (kind, body) in enumerate(zip(clip.kind, clip.body)):
            size = [width, width, 1.0] if kind == "plane" else clip.geom_size[w, g].tolist()
            node(bodies[body] if body >= 0 else world, name=clip.geoms[g].get("name") or kind, scale=size,
                 mesh=mesh(kind, colours[g]), translation=clip.geom_pos[w, g].tolist(),
                 rotation=xyzw(clip.geom_quat[w, g]).tolist())  # fmt: skip
    tree = {
        "asset": {"version": "2.0", "generator": "rbd_jax"}, "scene": 0, "scenes": [{"nodes": [0]}], "nodes": nodes,
        "meshes": meshes, "materials": materials, "accessors": buffer.accessors, "bufferViews": buffer.views,
        "buffers": [{"byteLength": len(buffer.data)}],
    }  # fmt: skip
    if channels:
        tree["animations"] = [{"name": "motion", "channels": channels, "samplers": samplers}]
    text = json.dumps(tree, separators=(",", ":"), allow_nan=False).encode()
    text += b" " * (-len(text) % 4)
    blob = bytes(buffer.data) + b"\0" * (-len(buffer.data) % 4)
    chunks = struct.pack("<II", len(text), 0x4E4F534A) + text + struct.pack("<II", len(blob), 0x004E4942) + blob
    return struct.pack("<III", 0x46546C67, 2, 12 + len(chunks)) + chunks
