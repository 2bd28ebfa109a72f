"""Layer 9: one self-contained page that plays a clip offline (WebGL2, ``player.html``, ``.css`` and ``.js``)."""

from __future__ import annotations

import base64
import html
import json
import os
import zlib
from pathlib import Path

import numpy as np

from . import clip as look
from .clip import Clip

HERE = Path(__file__).parent
FULL = 32767  # largest quantised value


def write_html(clip: Clip, path: str | os.PathLike[str]) -> None:
    """Write a page that plays ``clip`` in any browser with WebGL2. It needs no network and no other file.

    Positions are kept to 1/65534 of the range that the body's path spans, attitudes to 1e-4 rad,
    14 bytes a body and sample before compression.
    """
    Path(path).write_text(page_of(clip), "utf-8")


def page_of(clip: Clip) -> str:
    """The text of that page."""
    head, blob = pack(clip)
    page = (HERE / "player.html").read_text("utf-8")
    parts = {
        "@TITLE@": html.escape(clip.title),
        "@STYLE@": (HERE / "player.css").read_text("utf-8"),
        "@SCRIPT@": (HERE / "player.js").read_text("utf-8"),
        "@HEAD@": json.dumps(head, separators=(",", ":"), allow_nan=False).replace("<", "\\u003c"),
        "@DATA@": base64.b64encode(blob).decode("ascii"),
    }
    for mark, text in parts.items():
        before, after = page.split(mark)
        page = before + text + after
    return page


def pack(clip: Clip) -> tuple[dict, bytes]:
    """What the page holds: a header for JSON, and one zlib-compressed block of the arrays it lists.

    Per world, body and component, ``pos = pos_mid + pos_step * k`` and ``quat = k / 32767``, with ``k`` the
    running sum (modulo 2^16) along time of the int16 arrays ``pos`` and ``quat``, both (W, n, c, T).
    """
    W, T, n = clip.shape
    lo, hi = clip.bounds()
    arrays = {
        "time": clip.time.astype(np.float64),
        "geom_size": _shared(clip.geom_size).astype(np.float32),
        "geom_pos": _shared(clip.geom_pos).astype(np.float32),
        "geom_quat": _shared(clip.geom_quat).astype(np.float32),
        **_poses("", clip.pos, clip.quat),
    }
    if clip.ghost is not None:
        arrays |= _poses("ghost_", *clip.ghost)
    if clip.contacts is not None:
        arrays |= _contacts(*clip.contacts)
    if clip.energy is not None:
        arrays["energy"] = clip.energy.astype(np.float32)
    table, offset = {}, 0
    for name, a in arrays.items():
        arrays[name] = a = np.ascontiguousarray(a, a.dtype.newbyteorder("<"))
        table[name] = {"type": a.dtype.name, "shape": a.shape, "offset": offset}
        offset += -(-a.nbytes // 8) * 8
    raw = b"".join(a.tobytes().ljust(-(-a.nbytes // 8) * 8, b"\0") for a in arrays.values())
    head = {
        "title": clip.title,
        "ghost": clip.ghost_name,
        "shape": [W, T, n],
        "dynamic": clip.dynamic,
        "names": clip.names,
        "worlds": clip.worlds,
        "kind": clip.kind,
        "body": clip.body.tolist(),
        "colour": clip.colours(),
        "palette": look.PALETTE,
        "ground": look.GROUND_COLOURS,
        "light": look.LIGHT,
        "view": [look.FIELD_OF_VIEW, look.AZIMUTH, look.ELEVATION],
        "lo": lo.tolist(),
        "hi": hi.tolist(),
        "square": look.square(lo, hi),
        "follow": _lost(clip, lo, hi),
        "arrays": table,
    }
    return head, zlib.compress(raw, 9)


def _poses(prefix: str, pos: np.ndarray, quat: np.ndarray) -> dict[str, np.ndarray]:
    """Poses (W, T, n, 3 | 4) as int16 in units of the body's own path."""
    pos = pos.transpose(0, 2, 3, 1)
    mid = (pos.max(-1) + pos.min(-1)) / 2
    step = np.maximum((pos.max(-1) - pos.min(-1)) / 2 / FULL, 1e-12)
    quat = look.continuous(quat).transpose(0, 2, 3, 1)
    # float32 first in use: quantise against the numbers that the page will read
    mid, step = mid.astype(np.float32), step.astype(np.float32)
    return {
        f"{prefix}pos_mid": mid,
        f"{prefix}pos_step": step,
        f"{prefix}pos": _differences((pos - mid[..., None]) / step[..., None]),
        f"{prefix}quat": _differences(quat * FULL),
    }


def _contacts(points: np.ndarray, forces: np.ndarray) -> dict[str, np.ndarray]:
    """The contacts that carry a force, one after the other: those of world w, instant t are ``contact_first[w T + t]``
    to the next entry. Points in steps of the range they span, forces in steps of the largest component.

    ``contact_scale``: middle (3) and step (3) of the points, step of the forces, and the force that is drawn long: the
    95th percentile of all.
    """
    live = np.isfinite(forces).all(-1) & (np.abs(np.nan_to_num(forces)).max(-1) > 0)
    first = np.concatenate([[0], np.cumsum(live.sum(-1).ravel())])
    points, forces = points[live], forces[live]
    if not len(points):
        return {}
    mid = (points.max(0) + points.min(0)) / 2
    step = np.maximum((points.max(0) - points.min(0)) / 2 / FULL, 1e-12)
    push = np.abs(forces).max() / FULL
    long = np.percentile(np.linalg.norm(forces, axis=-1), 95)
    whole = lambda a: np.rint(a).astype(np.int16)
    return {
        "contact_first": first.astype(np.float64),
        "contact_scale": np.array([*mid, *step, push, long]),
        "contact_point": whole((points - mid) / step),
        "contact_force": whole(forces / push),
    }


def _shared(a: np.ndarray) -> np.ndarray:
    """One row where all worlds agree."""
    return a[:1] if np.all(a == a[:1]) else a


def _differences(values: np.ndarray) -> np.ndarray:
    """Rounded to int16, then the difference from the sample before (modulo 2^16), the first one kept."""
    k = np.clip(np.rint(values), -FULL, FULL).astype(np.int64)
    k = np.diff(k, axis=-1, prepend=0)
    return (k & 0xFFFF).astype(np.uint16).view(np.int16)


def _lost(clip: Clip, lo: np.ndarray, hi: np.ndarray) -> int:
    """A lone body whose path dwarfs it is followed from the start: its row, else -1."""
    size = max(clip.radius[:, clip.body == 0].max(initial=0.0), 1e-12)
    return 0 if clip.shape[2] == 1 and np.max(hi - lo) > 40 * size else -1
