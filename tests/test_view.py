"""Pictures and pages of a clip: what is drawn is where it should be, and the page holds the data it was given."""

import base64
import json
import os
import re
import shutil
import struct
import subprocess
import zlib

import numpy as np
import pytest

from rbd_jax.view import Clip, check_writable, encode_png, render, write_html, write_png

PLANE = {"kind": "plane", "size": (), "body": -1, "pos": (0, 0, 0), "quat": (1, 0, 0, 0), "name": "ground"}
BLUE, ORANGE = (0, 114, 178), (230, 159, 0)  # the palette's first two


def sphere(body, radius=0.2):
    return {"kind": "sphere", "size": (radius,), "body": body, "pos": (0, 0, 0), "quat": (1, 0, 0, 0)}


def still(points, geoms, **kwargs):
    """One world, one instant, bodies at ``points`` without rotation."""
    pos = np.asarray(points, float).reshape(1, 1, -1, 3)
    quat = np.broadcast_to([1.0, 0, 0, 0], (*pos.shape[:3], 4))
    return Clip(geoms, [0.0], pos, quat, **kwargs)


def moving(W=3, T=50, n=4, seed=0):
    """Bodies on smooth random paths that tumble; spheres and boxes alternate."""
    rng = np.random.default_rng(seed)
    t = np.arange(T) / 60.0
    amplitude, rate = rng.uniform(0.2, 1.0, (2, W, 1, n, 3))
    pos = amplitude * np.sin(3 * rate * t[None, :, None, None]) + [0, 0, 1.5]
    axis = rng.normal(size=(W, 1, n, 3))
    axis /= np.linalg.norm(axis, axis=-1, keepdims=True)
    half = 4.0 * t[None, :, None, None] * np.ones((W, 1, n, 1))
    quat = np.concatenate([np.cos(half), np.sin(half) * axis], -1)
    box = {"kind": "box", "size": (0.1, 0.15, 0.2), "pos": (0.05, 0, 0), "quat": (1, 0, 0, 0)}
    geoms = [PLANE] + [sphere(b, 0.1) if b % 2 else {**box, "body": b} for b in range(n)]
    return Clip(geoms, t, pos, quat, energy=rng.uniform(1, 2, (W, T)), title="A </script> & test")


def decode_png(data):
    """Pixels (height, width, 3) of an 8-bit PNG file without interlacing."""
    assert data[:8] == b"\x89PNG\r\n\x1a\n"
    at, packed = 8, b""
    while at < len(data):
        (length,), name = struct.unpack(">I", data[at : at + 4]), data[at + 4 : at + 8]
        body = data[at + 8 : at + 8 + length]
        assert struct.unpack(">I", data[at + 8 + length : at + 12 + length])[0] == zlib.crc32(name + body)
        if name == b"IHDR":
            width, height, depth, colour, _, _, interlace = struct.unpack(">IIBBBBB", body)
        packed += body if name == b"IDAT" else b""
        at += 12 + length
    assert depth == 8 and colour in (2, 6) and not interlace
    channels = 3 if colour == 2 else 4
    rows = np.frombuffer(zlib.decompress(packed), np.uint8).reshape(height, 1 + width * channels)
    out = np.zeros((height + 1, width + 1, channels), int)  # a border of zeros above and to the left
    for y in range(height):
        kind, row = rows[y, 0], rows[y, 1:].reshape(width, channels).astype(int)
        above = out[y]
        if kind in (0, 2):
            out[y + 1, 1:] = row + (above[1:] if kind == 2 else 0)
        elif kind == 1:
            out[y + 1, 1:] = np.cumsum(row, 0)
        else:
            for x in range(width):
                a, b, c = out[y + 1, x], above[x + 1], above[x]
                guess = (a + b) // 2
                if kind == 4:
                    pa, pb, pc = abs(b - c), abs(a - c), abs(a + b - 2 * c)
                    guess = np.where((pa <= pb) & (pa <= pc), a, np.where(pb <= pc, b, c))
                out[y + 1, x + 1] = (row[x] + guess) & 255
        out[y + 1] &= 255
    return out[1:, 1:, :3].astype(np.uint8)


def like(picture, colour, tolerance=0.06):
    """Pixels of the hue of ``colour``: their chromaticity is near, however bright they are."""
    p = (picture / 255.0) ** 2.2 + 1e-3
    c = (np.array(colour) / 255.0) ** 2.2
    return np.linalg.norm(p / p.sum(-1, keepdims=True) - c / c.sum(), axis=-1) < tolerance


# ------------------------------------------------------------------ picture


def test_png_file_decodes_to_what_was_rendered(tmp_path):
    clip = moving()
    write_png(clip, tmp_path / "a.png", width=97, height=61)
    picture = decode_png((tmp_path / "a.png").read_bytes())
    assert picture.shape == (61, 97, 3)
    assert np.array_equal(picture, render(clip, width=97, height=61))
    assert picture.std() > 5


def test_encoder_is_exact():
    noise = np.random.default_rng(0).integers(0, 256, (7, 5, 3), dtype=np.uint8)
    assert np.array_equal(decode_png(encode_png(noise)), noise)
    with pytest.raises(ValueError, match="uint8"):
        encode_png(noise.astype(float))


def test_lone_sphere_fills_the_middle():
    picture = render(still([(3, -2, 5)], [sphere(0)]), width=200, height=120)
    blue = like(picture, BLUE, 0.15)
    ys, xs = np.nonzero(blue)
    assert 0.1 < blue.mean() < 0.5
    assert abs(xs.mean() - 100) < 15 and abs(ys.mean() - 60) < 20
    assert not blue[:3].any() and not blue[-3:].any()


def test_spheres_are_on_their_sides():
    """Seen from -y, +x is on the right and +z is up."""
    clip = still([(-1, 0, 0), (1, 0, 1)], [sphere(0), sphere(1)])
    picture = render(clip, width=240, height=160, azimuth=-90, elevation=0)
    (yb, xb), (yo, xo) = (np.nonzero(like(picture, c)) for c in (BLUE, ORANGE))
    assert len(xb) > 100 and len(xo) > 100
    assert xb.max() < 120 < xo.min() and yo.mean() < yb.mean() - 20


def test_nearer_geom_hides_the_farther():
    clip = still([(0, 0, 0), (0, -1, 0)], [sphere(0), sphere(1, 0.3)])
    picture = render(clip, width=120, height=80, azimuth=-90, elevation=0)
    assert not like(picture, BLUE).any() and like(picture, ORANGE).sum() > 200


def test_geom_offset_follows_the_attitude_of_the_body():
    """A geom at +x of a body turned by 90 deg about y is below the body's origin."""
    geoms = [{**sphere(0), "pos": (1, 0, 0)}, sphere(1)]
    half = np.sqrt(0.5)
    clip = Clip(geoms, [0.0], np.zeros((1, 1, 2, 3)), [[[(half, 0, half, 0), (1, 0, 0, 0)]]])
    assert np.allclose(clip.poses(0, 0)[0][0], [(0, 0, -1), (0, 0, 0)])
    picture = render(clip, width=120, height=120, azimuth=-90, elevation=0)
    (yb, xb), (yo, xo) = (np.nonzero(like(picture, c)) for c in (BLUE, ORANGE))
    assert yb.min() > yo.max() and abs(xb.mean() - xo.mean()) < 8


def test_box_silhouette():
    """A 2 x 2 x 1 box seen square on covers a rectangle of these proportions."""
    clip = still([(0, 0, 0)], [{"kind": "box", "size": (1, 1, 0.5), "body": 0}])
    picture = render(clip, width=200, height=200, azimuth=-90, elevation=0)
    ys, xs = np.nonzero(like(picture, BLUE, 0.1))
    width, height = np.ptp(xs) + 1, np.ptp(ys) + 1
    assert abs(width / height - 2) < 0.1
    assert len(xs) > 0.95 * width * height


def test_sphere_casts_a_shadow_on_the_ground():
    lit = render(still([(0, 0, 0.6)], [PLANE, sphere(0)]), width=160, height=120).astype(int)
    sky = render(still([(0, 0, 0.6)], [sphere(0)]), width=160, height=120).astype(int)
    ground = np.abs(lit - sky).sum(-1) > 0
    dark = (lit.sum(-1) < 3 * 185) & (np.ptp(lit, -1) < 12) & ground
    assert 30 < dark.sum() < 4000


def test_ghosts_strip_and_several_worlds():
    clip = moving(T=20)
    plain = render(clip, frame=-1, width=120, height=80)
    assert render(clip, frames=[0, 10], width=120, height=80).std() != plain.std()
    assert render(clip, strip=3, width=121, height=40).shape == (40, 121, 3)
    assert render(clip, world=[0, 1, 2], width=120, height=80).std() > 5


def test_runaway_body_does_not_shrink_the_picture():
    rng = np.random.default_rng(1)
    points = rng.uniform(-1, 1, (40, 3))
    start, end = points.copy(), points.copy()
    end[0] = (1e4, 0, 0)
    pos = np.stack([start, end])[None]
    quat = np.broadcast_to([1.0, 0, 0, 0], (1, 2, 40, 4))
    lo, hi = Clip([sphere(b) for b in range(40)], [0, 1], pos, quat).frame([0], [0, 1])
    assert np.all(hi - lo < 4)
    assert np.all(lo <= start.min(0)) and np.all(hi >= start.max(0))  # what the scene starts with is kept


def test_only_planes_or_only_static_geoms_can_be_shown():
    none = np.zeros((1, 1, 0, 3)), np.zeros((1, 1, 0, 4))
    for geoms in ([PLANE], [PLANE, {"kind": "box", "size": (1, 1, 1), "body": -1}]):
        assert render(Clip(geoms, [0.0], *none), width=60, height=40).std() > 1


# ------------------------------------------------------------------ page


def decode_page(page):
    """Header and arrays of a page, positions and unit quaternions as its player sees them (W, T, n, c)."""
    head = json.loads(re.search(r'id="head">(.*?)</script>', page, re.S)[1])
    raw = zlib.decompress(base64.b64decode(re.search(r'id="data">(.*?)</script>', page, re.S)[1]))
    arrays = {}
    for name, a in head["arrays"].items():
        count = int(np.prod(a["shape"]))
        arrays[name] = np.frombuffer(raw, "<" + np.dtype(a["type"]).str[1:], count, a["offset"]).reshape(a["shape"])
    for name in ("pos", "quat"):
        arrays[name] = np.cumsum(arrays[name], -1, dtype=np.int16).astype(float)
    mid, step = (arrays[k].astype(float)[..., None] for k in ("pos_mid", "pos_step"))
    pos = (mid + step * arrays["pos"]).transpose(0, 3, 1, 2)
    quat = (arrays["quat"] / 32767).transpose(0, 3, 1, 2)
    return head, arrays, pos, quat / np.linalg.norm(quat, axis=-1, keepdims=True)


def test_page_holds_the_data(tmp_path):
    clip = moving()
    clip.quat[:, ::3] *= -1  # the same attitudes; the page must not let them flip
    write_html(clip, tmp_path / "a.html")
    head, arrays, pos, quat = decode_page((tmp_path / "a.html").read_text("utf-8"))
    assert head["shape"] == [3, 50, 4] and head["title"] == clip.title
    assert head["kind"] == clip.kind and head["body"] == clip.body.tolist()
    assert np.array_equal(arrays["time"], clip.time)
    assert np.allclose(arrays["energy"], clip.energy, rtol=1e-6)
    span = np.ptp(clip.pos, axis=1, keepdims=True)
    assert np.all(np.abs(pos - clip.pos) <= 1.1 * span / 65534 + 1e-6)
    dot = np.abs(np.sum(quat * clip.quat, -1))
    assert np.all(2 * np.arccos(np.minimum(dot, 1)) < 1e-4)
    assert np.all(np.sum(quat[:, 1:] * quat[:, :-1], -1) > 0)


def test_page_is_self_contained_and_escapes(tmp_path):
    write_html(moving(), tmp_path / "a.html")
    page = (tmp_path / "a.html").read_text("utf-8")
    assert not re.search(r"(https?:)?//[a-z0-9-]+\.[a-z]", page, re.I)
    assert not re.search(r"\b(src|href)=(?!\"data:)", page) and "@import" not in page and "url(" not in page
    assert "@HEAD@" not in page and "@DATA@" not in page
    assert "A </script>" not in page and page.count("</script>") == 3
    assert "default-src 'none'" in page


def test_geoms_that_differ_between_worlds(tmp_path):
    size = [(0.1,), (0.2,), (0.3,)]
    clip = Clip([{**sphere(0), "size": size}], [0.0], np.zeros((3, 1, 1, 3)), np.tile([1.0, 0, 0, 0], (3, 1, 1, 1)))
    write_html(clip, tmp_path / "a.html")
    _, arrays, _, _ = decode_page((tmp_path / "a.html").read_text("utf-8"))
    assert np.allclose(arrays["geom_size"][:, 0, 0], [0.1, 0.2, 0.3])
    assert arrays["geom_pos"].shape[0] == 1


def test_size_of_a_long_page(tmp_path):
    write_html(moving(W=1, T=600, n=100), tmp_path / "a.html")  # 10 s of 100 bodies that never rest, at 60 Hz
    assert (tmp_path / "a.html").stat().st_size < 2e6


# ------------------------------------------------------------------ bad input


@pytest.mark.parametrize(
    "change, message",
    [
        ({"geoms": []}, "nothing to show"),
        ({"time": []}, "nothing to show|do not go with"),
        ({"pos": np.zeros((1, 2, 1, 2))}, r"\(W, T, n, 3\)"),
        ({"quat": np.ones((1, 2, 2, 4))}, "quat"),
        ({"quat": np.zeros((1, 2, 1, 4))}, "zero quaternion"),
        ({"pos": np.full((1, 2, 1, 3), np.nan)}, "not finite"),
        ({"time": [1.0, 1.0]}, "increase"),
        ({"energy": np.zeros(2)}, "energy"),
        ({"names": ["a", "b"]}, "names"),
        ({"dynamic": 2}, "dynamic"),
        ({"geoms": [sphere(1)]}, "body = 1"),
        ({"geoms": [{**sphere(0), "kind": "mesh"}]}, "mesh"),
        ({"geoms": [sphere(0, -1.0)]}, "> 0"),
        ({"geoms": [{**sphere(0), "size": (1, 2)}]}, "size has shape"),
    ],
)
def test_bad_clip(change, message):
    good = {
        "geoms": [sphere(0)],
        "time": [0.0, 1.0],
        "pos": np.zeros((1, 2, 1, 3)),
        "quat": np.tile([1.0, 0, 0, 0], (1, 2, 1, 1)),
    }
    Clip(**good)
    with pytest.raises(ValueError, match=message):
        Clip(**{**good, **change})


def test_empty_clip_has_nothing_to_show():
    with pytest.raises(ValueError, match="nothing to show"):
        Clip([sphere(0)], [], np.zeros((1, 0, 1, 3)), np.zeros((1, 0, 1, 4)))


def test_bad_choice_of_world_frame_or_size():
    clip = moving(W=2, T=3)
    for kwargs, message in [
        ({"world": 2}, "world = 2"),
        ({"frame": 3}, "frame = 3"),
        ({"frames": [-4]}, "frame = -4"),
        ({"width": 0}, "pixels"),
        ({"strip": 0}, "strip"),
    ]:
        with pytest.raises(ValueError, match=message):
            render(clip, **{"width": 8, "height": 8, **kwargs})


def test_check_writable(tmp_path):
    check_writable(tmp_path / "new.html")
    assert not list(tmp_path.iterdir())
    (tmp_path / "old.png").write_bytes(b"x")
    check_writable(tmp_path / "old.png")
    assert (tmp_path / "old.png").read_bytes() == b"x"
    with pytest.raises(FileNotFoundError, match="does not exist"):
        check_writable(tmp_path / "no" / "a.png")
    with pytest.raises(IsADirectoryError, match="folder"):
        check_writable(tmp_path)
    with pytest.raises(NotADirectoryError, match="not a folder"):
        check_writable(tmp_path / "old.png" / "a.png")
    with pytest.raises(ValueError, match="empty"):
        check_writable("")


@pytest.mark.skipif(not hasattr(os, "geteuid") or os.geteuid() == 0, reason="root may write anywhere")
def test_check_writable_permission(tmp_path):
    tmp_path.chmod(0o500)
    with pytest.raises(PermissionError, match="no permission"):
        check_writable(tmp_path / "a.png")


def test_check_writable_permission_is_asked_of_the_system(tmp_path, monkeypatch):
    monkeypatch.setattr(os, "access", lambda path, mode: False)
    with pytest.raises(PermissionError, match="no permission"):
        check_writable(tmp_path / "a.png")


# ------------------------------------------------------------------ browser

CHROMIUM = shutil.which("chromium") or shutil.which("chromium-browser") or shutil.which("google-chrome")


def browse(page, shot, *flags):
    """Screenshot of ``page`` (a path, with a fragment) and what the console said."""
    command = [CHROMIUM, "--headless=new", "--no-sandbox", "--hide-scrollbars", "--window-size=640,480"]
    command += ["--enable-logging=stderr", "--virtual-time-budget=4000", f"--screenshot={shot}"]
    command += [f"--user-data-dir={shot.parent / 'profile'}", *flags, f"file://{page}"]
    done = subprocess.run(command, capture_output=True, text=True, timeout=120)
    said = [line for line in done.stderr.splitlines() if "CONSOLE" in line]
    return decode_png(shot.read_bytes()), said


@pytest.mark.skipif(CHROMIUM is None, reason="needs chromium on PATH")
@pytest.mark.parametrize("layout", ["one", "grid"])
def test_page_draws_in_chromium(tmp_path, layout):
    geoms = [PLANE, sphere(0), {"kind": "box", "size": (0.2, 0.2, 0.2), "body": 1}]
    pos = np.tile([[(-0.5, 0, 0.2), (0.5, 0, 0.2)], [(-0.5, 0, 0.4), (0.5, 0, 0.2)]], (4, 1, 1, 1))
    clip = Clip(geoms, [0.0, 1.0], pos, np.tile([1.0, 0, 0, 0], (4, 2, 2, 1)), energy=np.ones((4, 2)))
    write_html(clip, tmp_path / "a.html")
    software = "--use-angle=swiftshader", "--enable-unsafe-swiftshader"
    picture, said = browse(f"{tmp_path}/a.html#play=0&layout={layout}", tmp_path / "a.png", *software)
    assert said == []
    scene = picture[60:300, :540]
    blue, orange = like(scene, BLUE, 0.1), like(scene, ORANGE, 0.1)
    assert blue.sum() > 100 and orange.sum() > 100
    if layout == "one":
        assert np.nonzero(blue)[1].max() < np.nonzero(orange)[1].min()  # sphere on the left, box on the right


@pytest.mark.skipif(CHROMIUM is None, reason="needs chromium on PATH")
def test_shadows_on_the_page_are_whole(tmp_path):
    """Balls high above the ground, whose shadows fall behind all that the light must see."""
    geoms = [PLANE, *(sphere(k) for k in range(3))]
    pos = np.array([[[(x, 0.0, z) for x in (-0.6, 0.0, 0.6)] for z in (1.5, 0.3)]])
    write_html(Clip(geoms, [0.0, 1.0], pos, np.tile([1.0, 0, 0, 0], (1, 2, 3, 1))), tmp_path / "a.html")
    software = "--use-angle=swiftshader", "--enable-unsafe-swiftshader"
    picture, said = browse(f"{tmp_path}/a.html#play=0", tmp_path / "a.png", *software)
    assert said == []
    scene = picture[150:330].astype(int)
    dark = (scene.max(-1) < 185) & (np.ptp(scene, axis=-1) < 12)
    columns = np.flatnonzero(dark.any(0))
    parts = np.split(columns, np.flatnonzero(np.diff(columns) > 3) + 1)
    areas = sorted(dark[:, c].sum() for c in parts if len(c) > 5)
    assert len(areas) == 3 and areas[0] > 0.7 * areas[2], areas


@pytest.mark.skipif(CHROMIUM is None, reason="needs chromium on PATH")
def test_page_without_webgl_says_so(tmp_path):
    write_html(moving(), tmp_path / "a.html")
    command = [CHROMIUM, "--headless=new", "--no-sandbox", "--disable-3d-apis", "--dump-dom"]
    command += [
        "--virtual-time-budget=4000",
        f"--user-data-dir={tmp_path / 'profile'}",
        f"file://{tmp_path}/a.html",
    ]
    dom = subprocess.run(command, capture_output=True, text=True, timeout=120).stdout
    assert re.search(r'<div id="message" role="alert">This page needs WebGL2', dom)


# --- movies, and scenes for other programs ---

QUICK = {"fps": 10.0, "width": 48, "height": 32}


def test_a_movie_has_one_camera_and_the_clips_length():
    from rbd_jax.view import pictures

    clip = moving(W=1, T=61, n=2)  # a second
    shots = list(pictures(clip, **QUICK))
    assert len(shots) == 11 and all(s.shape == (32, 48, 3) and s.dtype == np.uint8 for s in shots)
    assert len(list(pictures(clip, **QUICK, speed=2.0))) == 6
    corners = np.array([s[0, 0] for s in shots], int)  # the sky, where nothing moves
    assert np.ptp(corners, 0).max() <= 2 and not np.array_equal(shots[0], shots[5])
    for bad in ({"fps": 0.0}, {"speed": -1.0}, {"fps": float("nan")}):
        with pytest.raises(ValueError, match="must be finite and > 0"):
            next(pictures(clip, **bad))


def test_gif_plays_what_was_drawn(tmp_path):
    image = pytest.importorskip("PIL.Image")
    from rbd_jax.view import pictures, write_gif

    clip = moving(W=1, T=31, n=2)
    write_gif(clip, tmp_path / "a.gif", **QUICK)
    with image.open(tmp_path / "a.gif") as gif:
        assert gif.n_frames == 6 and gif.info["duration"] == 100 and gif.info["loop"] == 0
        for k, shot in enumerate(pictures(clip, **QUICK)):
            gif.seek(k)
            assert np.abs(np.asarray(gif.convert("RGB"), int) - shot).mean() < 6  # 256 colours


def test_mp4_is_a_movie(tmp_path):
    ffmpeg = pytest.importorskip("imageio_ffmpeg")
    from rbd_jax.view import write_mp4

    write_mp4(moving(W=1, T=31, n=2), tmp_path / "a.mp4", fps=10.0, width=65, height=49)
    frames, seconds = ffmpeg.count_frames_and_secs(str(tmp_path / "a.mp4"))
    assert frames == 6 and seconds == pytest.approx(0.6, abs=0.11)
    with pytest.raises(OSError, match="ffmpeg"):
        write_mp4(moving(W=1, T=2, n=1), tmp_path / "nowhere" / "a.mp4", **QUICK)


def glb_parts(data):
    magic, version, length = struct.unpack_from("<III", data)
    assert (magic, version, length) == (0x46546C67, 2, len(data)) and length % 4 == 0
    size, kind = struct.unpack_from("<II", data, 12)
    assert kind == 0x4E4F534A
    tree = json.loads(data[20 : 20 + size])
    blob_size, kind = struct.unpack_from("<II", data, 20 + size)
    assert kind == 0x004E4942 and 28 + size + blob_size == len(data)
    blob = data[28 + size :]

    def read(k):
        a = tree["accessors"][k]
        view = tree["bufferViews"][a["bufferView"]]
        width = {"SCALAR": 1, "VEC3": 3, "VEC4": 4}[a["type"]]
        dtype = {5126: "<f4", 5125: "<u4"}[a["componentType"]]
        assert view["byteOffset"] % 4 == 0 and view["byteLength"] == a["count"] * width * 4
        return np.frombuffer(blob, dtype, a["count"] * width, view["byteOffset"]).reshape(a["count"], width)

    return tree, read


def test_gltf_holds_the_motion():
    from rbd_jax.view.gltf import glb

    clip = moving(W=2, T=20, n=3)
    tree, read = glb_parts(glb(clip))
    nodes, (animation,) = tree["nodes"], tree["animations"]
    assert nodes[0]["rotation"] == pytest.approx([-(0.5**0.5), 0, 0, 0.5**0.5])  # y is up in glTF
    bodies = [k for k, x in enumerate(nodes) if x.get("name") in clip.names]
    assert len(bodies) == 6 and len(animation["channels"]) == 12
    for channel in animation["channels"]:
        sampler = animation["samplers"][channel["sampler"]]
        np.testing.assert_allclose(read(sampler["input"])[:, 0], clip.time - clip.time[0], atol=1e-6)
        place = bodies.index(channel["target"]["node"])
        w, k = divmod(place, 3)
        values = read(sampler["output"])
        if channel["target"]["path"] == "translation":
            np.testing.assert_allclose(values, clip.pos[w, :, k], atol=1e-6)
        else:
            q = values[:, [3, 0, 1, 2]]
            np.testing.assert_allclose(np.abs((q * clip.quat[w, :, k]).sum(-1)), 1, atol=1e-6)
            assert ((q[1:] * q[:-1]).sum(-1) > 0).all()  # the short way round
    for mesh in tree["meshes"]:  # triangles look outwards
        part = mesh["primitives"][0]
        points, normals = read(part["attributes"]["POSITION"]), read(part["attributes"]["NORMAL"])
        faces = read(part["indices"]).reshape(-1, 3)
        a, b, c = (points[faces[:, k]] for k in range(3))
        area = np.cross(b - a, c - a)
        wide = np.linalg.norm(area, axis=1) > 1e-9
        assert ((area * normals[faces[:, 0]]).sum(-1)[wide] > 0).all()


def test_usd_holds_the_motion():
    from rbd_jax.view.usd import usda

    clip = moving(W=2, T=5, n=2)
    text = usda(clip)
    assert text.startswith("#usda 1.0\n") and text.count("{") == text.count("}") and 'upAxis = "Z"' in text
    tracks = re.findall(r"xformOp:translate.timeSamples = \{ (.*) \}", text)
    assert len(tracks) == 4
    for track, (w, k) in zip(tracks, [(0, 0), (0, 1), (1, 0), (1, 1)]):
        rows = re.findall(r"([\d.e+-]+): \(([^)]*)\)", track)
        np.testing.assert_allclose([float(t) for t, _ in rows], np.arange(5), atol=1e-6)
        np.testing.assert_allclose([[float(x) for x in r.split(",")] for _, r in rows], clip.pos[w, :, k], atol=1e-7)
    usd = pytest.importorskip("pxr.Usd")
    stage = usd.Stage.CreateInMemory()
    assert stage.GetRootLayer().ImportFromString(text)


def test_mujoco_shows_the_motion_as_keyframes(tmp_path):
    """Every geom of every world is where the clip has it, at every sample, and stays there."""
    import mujoco

    from rbd_jax.view import write_replay
    from rbd_jax.view.clip import grid_offsets, rotate

    clip = moving(W=2, T=4, n=3)
    write_replay(clip, tmp_path / "a.xml")
    model = mujoco.MjModel.from_xml_path(str(tmp_path / "a.xml"))
    data = mujoco.MjData(model)
    assert model.nkey == 4
    offsets = grid_offsets(2, *clip.bounds())
    for t in range(4):
        mujoco.mj_resetDataKeyframe(model, data, t)
        mujoco.mj_step(model, data)
        mujoco.mj_forward(model, data)
        assert model.ngeom == 2 * len(clip.geoms)
        for w, g in np.ndindex(2, len(clip.geoms)):
            k, where = clip.body[g], clip.geom_pos[w, g]
            if k >= 0:
                where = clip.pos[w, t, k] + rotate(clip.quat[w, t, k], where)
            distance = np.linalg.norm(data.geom_xpos - (where + offsets[w]), axis=1)
            assert distance.min() < 1e-6, (t, w, g)


def test_names_are_identifiers_and_unique():
    from rbd_jax.view.clip import unique_names

    assert unique_names(["a b", "a_b", "", "7", "ä"]) == ["a_b", "a_b_2", "_", "_7", "__2"]


# --- forces of contact and another run, on the page ---


def with_marks():
    """One ball on the ground, pressed by 10 N (and once by 20 N), and the same ball 0.5 m aside in another run."""
    clip = still([(0, 0, 0.2)], [PLANE, sphere(0)])
    pos, quat = np.repeat(clip.pos, 3, 1), np.repeat(clip.quat, 3, 1)
    point = np.zeros((1, 3, 2, 3))
    force = np.full((1, 3, 2, 3), np.nan)
    force[0, :, 0] = [[0, 0, 10], [0, 0, 20], [0, 0, 10]]
    force[0, 1, 1] = 0.0  # touches and carries nothing
    return Clip(
        [PLANE, sphere(0)], [0.0, 0.5, 1.0], pos, quat, contacts=(point, force), ghost=(pos + [0.5, 0, 0], quat)
    )


def test_page_holds_contacts_and_ghost(tmp_path):
    write_html(with_marks(), tmp_path / "a.html")
    head, arrays, _, _ = decode_page((tmp_path / "a.html").read_text("utf-8"))
    assert arrays["contact_first"].tolist() == [0, 1, 2, 3]
    scale = arrays["contact_scale"]
    np.testing.assert_allclose(scale[6] * arrays["contact_force"], [[0, 0, 10], [0, 0, 20], [0, 0, 10]], atol=1e-3)
    np.testing.assert_allclose(scale[:3] + scale[3:6] * arrays["contact_point"], 0, atol=1e-9)
    np.testing.assert_allclose(arrays["ghost_pos_mid"][0, 0], [0.5, 0, 0.2], atol=1e-6)
    plain = moving()
    write_html(plain, tmp_path / "b.html")
    assert not {"contact_first", "ghost_pos"} & set(decode_page((tmp_path / "b.html").read_text("utf-8"))[0]["arrays"])
    for bad in (
        {"contacts": (np.zeros((1, 2, 1, 3)),) * 2},
        {"ghost": (np.zeros((1, 1, 1, 3)), np.ones((1, 1, 1, 4)))},
    ):
        with pytest.raises(ValueError, match="clip: (contacts|ghost)"):
            Clip([sphere(0)], [0.0, 1.0, 2.0], np.zeros((1, 3, 1, 3)), np.tile([1.0, 0, 0, 0], (1, 3, 1, 1)), **bad)


@pytest.mark.skipif(CHROMIUM is None, reason="needs chromium on PATH")
def test_marks_are_drawn_in_chromium(tmp_path):
    write_html(with_marks(), tmp_path / "a.html")
    software = "--use-angle=swiftshader", "--enable-unsafe-swiftshader"
    seen = {}
    for name, marks in (("all", "&trails=1"), ("none", "&contacts=0&ghost=0")):
        page = f"{tmp_path}/a.html#play=0{marks}"
        seen[name], said = browse(page, tmp_path / f"{name}.png", *software)
        assert said == []
    red = [like(picture[60:330], (179, 38, 30), 0.1).sum() for picture in seen.values()]
    black = [like(picture[60:330], (29, 39, 51), 0.1).sum() for picture in seen.values()]
    assert red[0] > 20 and red[1] == 0, red  # the arrow
    assert black[0] > black[1] + 20, black  # the outline


def test_forces_of_a_ball_at_rest_are_its_weight():
    import rbd_jax as rbd
    from rbd_jax.parity import ghost
    from rbd_jax.record import clip

    ball = rbd.Body("ball", rbd.Sphere(0.1), pos=(0, 0, 0.1), vel=(0, 0, 0), mass=2.0)
    scene = rbd.Scene(bodies=[ball], static=[rbd.Plane()], dt=0.005)
    model, state = rbd.build(scene, method="fast")
    states = rbd.batch(state, 2)
    _, traj = rbd.rollout(model, states, 20, every=10)
    film = clip(model, traj, forces=True, ghost=ghost(scene, model, states, 20, 10))
    points, forces = film.contacts
    assert points.shape == forces.shape == (2, 3, 1, 3)
    np.testing.assert_allclose(forces[:, 1:, 0], np.broadcast_to([0, 0, 2 * 9.81], (2, 2, 3)), rtol=1e-3, atol=1e-3)
    np.testing.assert_allclose(points[:, 1:, 0], 0, atol=1e-3)
    assert film.ghost[0].shape == (2, 3, 1, 3) and abs(film.ghost[0][0, -1, 0, 2] - 0.1) < 2e-3
