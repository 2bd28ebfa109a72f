"""Layer 9: a clip as USD text (.usda) with time samples, for Omniverse, Houdini, Blender and usdview. Metres, z up."""

from __future__ import annotations

import os

import numpy as np

from .clip import Clip, grid_offsets, linear, unique_names
from .gltf import GROUND


def write_usda(clip: Clip, path: str | os.PathLike[str]) -> None:
    """Write ``clip``, its worlds side by side.

    Raises:
      OSError: the file cannot be written.
    """
    with open(path, "w", encoding="utf-8") as file:
        file.write(usda(clip))


def usda(clip: Clip) -> str:
    """The text of the file."""
    W, T, n = clip.shape
    lo, hi = clip.bounds()
    offsets = grid_offsets(W, lo, hi)
    width = GROUND * float(np.max(hi - lo))
    time = clip.time - clip.time[0]
    rate = 1.0 / np.median(np.diff(time)) if T > 1 else 24.0  # a sample a frame where they are evenly spaced
    codes = time * rate
    colours = [linear(c) for c in clip.colours()]
    title = clip.title.replace("\\", "/").replace('"', "'").replace("\n", " ")
    out = [
        "#usda 1.0", "(", '    defaultPrim = "World"', f'    doc = "{title}"', "    metersPerUnit = 1",
        '    upAxis = "Z"', f"    timeCodesPerSecond = {rate:.9g}", f"    startTimeCode = {codes[0]:.9g}",
        f"    endTimeCode = {codes[-1]:.9g}", ")", "", 'def Xform "World"', "{",
    ]  # fmt: skip

    def numbers(v) -> str:
        return "(" + ", ".join(f"{x:.9g}" for x in v) + ")"

    def put(depth: int, *lines: str):
        out.extend("    " * depth + line for line in lines)

    def geom(depth: int, w: int, g: int, name: str):
        kind = clip.kind[g]
        size = np.array([width, width, 1.0]) if kind == "plane" else clip.geom_size[w, g]
        schema = {"sphere": "Sphere", "box": "Cube", "plane": "Mesh"}[kind]
        put(depth, f'def {schema} "{name}"', "{")
        inner = {"sphere": ["double radius = 1"], "box": ["double size = 2"]}.get(kind) or [
            "int[] faceVertexCounts = [4]", "int[] faceVertexIndices = [0, 1, 2, 3]",
            "point3f[] points = [(-1, -1, 0), (1, -1, 0), (1, 1, 0), (-1, 1, 0)]",
            'uniform token subdivisionScheme = "none"',
        ]  # fmt: skip
        put(depth + 1, *inner, f"color3f[] primvars:displayColor = [{numbers(colours[g])}]",
            f"double3 xformOp:translate = {numbers(clip.geom_pos[w, g])}",
            f"quatf xformOp:orient = {numbers(clip.geom_quat[w, g])}", f"double3 xformOp:scale = {numbers(size)}",
            'uniform token[] xformOpOrder = ["xformOp:translate", "xformOp:orient", "xformOp:scale"]')  # fmt: skip
        put(depth, "}")

    worlds = unique_names(clip.worlds)
    for w in range(W):
        put(1, f'def Xform "{worlds[w]}"', "{")
        put(
            2,
            f"double3 xformOp:translate = {numbers(offsets[w])}",
            'uniform token[] xformOpOrder = ["xformOp:translate"]',
        )
        # names of a world's children are unique among bodies and static geoms together
        fixed = [g for g in range(len(clip.geoms)) if clip.body[g] < 0]
        label = lambda g: clip.geoms[g].get("name") or clip.kind[g]
        names = unique_names([*clip.names, *(label(g) for g in fixed)])
        for name, g in zip(names[n:], fixed):
            geom(2, w, g, name)
        for k in range(n):
            put(2, f'def Xform "{names[k]}"', "{")
            samples = lambda rows: ", ".join(f"{c:.9g}: {numbers(r)}" for c, r in zip(codes, rows))
            put(3, f"double3 xformOp:translate.timeSamples = {{ {samples(clip.pos[w, :, k])} }}",
                f"quatf xformOp:orient.timeSamples = {{ {samples(clip.quat[w, :, k])} }}",
                'uniform token[] xformOpOrder = ["xformOp:translate", "xformOp:orient"]')  # fmt: skip
            mine = [g for g in range(len(clip.geoms)) if clip.body[g] == k]
            for name, g in zip(unique_names([label(g) for g in mine]), mine):
                geom(3, w, g, name)
            put(2, "}")
        put(1, "}")
    out.append("}")
    return "\n".join(out) + "\n"
