"""Layer 9: a clip as MJCF with a keyframe a sample, for MuJoCo's viewer.

``python -m mujoco.viewer --mjcf=FILE``, then the slider "Key" and the button "Load key" (or ``mj_resetDataKeyframe``).

It shows what happened and simulates nothing: gravity and contact are off. ``rbd_jax.to_mjcf`` writes the scene itself.
"""

from __future__ import annotations

import os
from xml.sax.saxutils import quoteattr

import numpy as np

from .clip import STATIC, Clip, grid_offsets, unique_names
from .gltf import GROUND


def write_replay(clip: Clip, path: str | os.PathLike[str]) -> None:
    """Write ``clip``, its worlds side by side; the keyframes are named after their instants [s].

    Raises:
      OSError: the file cannot be written.
    """
    with open(path, "w", encoding="utf-8") as file:
        file.write(replay(clip))


def replay(clip: Clip) -> str:
    """The text of the file."""
    W, T, n = clip.shape
    lo, hi = clip.bounds()
    offsets = grid_offsets(W, lo, hi)
    width = GROUND * float(np.max(hi - lo))
    colours = clip.colours()
    numbers = lambda v: '"' + " ".join(f"{x:.9g}" for x in np.ravel(v)) + '"'
    worlds = unique_names(clip.worlds)
    bodies = unique_names(f"{world}_{name}" for world in worlds for name in clip.names)
    out = [
        f"<mujoco model={quoteattr(clip.title)}>",
        '  <option gravity="0 0 0"><flag contact="disable"/></option>',
        '  <visual><headlight ambient="0.4 0.4 0.4"/></visual>',
        f"  <statistic center={numbers((lo + hi) / 2)} extent={numbers(np.max(hi - lo) * np.sqrt(W))}/>",
        "  <worldbody>",
    ]

    def geom(indent: str, w: int, g: int, shift):
        kind, body = clip.kind[g], clip.body[g]
        size = clip.geom_size[w, g]
        if kind == "plane":
            size = (width, width, 1.0)
            if body != STATIC:  # MuJoCo has no moving planes
                kind, size = "box", (width, width, 1e-3 * width)
        rgb = [int(colours[g][k : k + 2], 16) / 255 for k in (1, 3, 5)]
        size = size[:1] if kind == "sphere" else size
        place = f"pos={numbers(clip.geom_pos[w, g] + shift)} quat={numbers(clip.geom_quat[w, g])}"
        out.append(f'{indent}<geom type="{kind}" size={numbers(size)} {place} rgba={numbers([*rgb, 1])}/>')

    for w in range(W):
        for g in np.flatnonzero(clip.body == STATIC):
            geom("    ", w, g, offsets[w])
        for k in range(n):
            out.append(f"    <body name={quoteattr(bodies[w * n + k])}>")
            out.append('      <freejoint/><inertial pos="0 0 0" mass="1" diaginertia="1 1 1"/>')
            for g in np.flatnonzero(clip.body == k):
                geom("      ", w, g, 0.0)
            out.append("    </body>")
    out += ["  </worldbody>", "  <keyframe>"]
    poses = np.concatenate([clip.pos + offsets[:, None, None], clip.quat], axis=-1)
    for t in range(T):
        out.append(f'    <key name="{clip.time[t]:.9g} s" time="{clip.time[t]:.9g}" qpos={numbers(poses[:, t])}/>')
    return "\n".join([*out, "  </keyframe>", "</mujoco>", ""])
