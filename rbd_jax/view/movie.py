"""Layer 9: a clip as a moving picture: GIF through Pillow, MP4 through imageio-ffmpeg's ffmpeg. No display needed."""

from __future__ import annotations

import os
import subprocess
from collections.abc import Iterator, Sequence

import numpy as np

from .clip import AZIMUTH, ELEVATION, Clip
from .png import render

#: The camera fits so many instants, evenly spread.
FITTED = 24


def pictures(
    clip: Clip,
    world: int | Sequence[int] = 0,
    fps: float = 30.0,
    speed: float = 1.0,
    width: int = 480,
    height: int = 320,
    azimuth: float = AZIMUTH,
    elevation: float = ELEVATION,
) -> Iterator[np.ndarray]:
    """Pictures (height, width, 3) at ``fps`` of playing time, ``speed`` times as fast as life, with one camera.

    Raises:
      ValueError: fps or speed not positive; what ``render`` refuses.
    """
    for name, value in (("fps", fps), ("speed", speed)):
        if not (np.isfinite(value) and value > 0):
            raise ValueError(f"movie: {name} = {value} must be finite and > 0")
    length = clip.time[-1] - clip.time[0]
    count = max(1, round(length / speed * fps))
    at = clip.time[0] + np.arange(count + 1) * speed / fps
    frames = np.abs(clip.time[None] - at[:, None]).argmin(1)
    fits = np.unique(np.linspace(0, clip.shape[1] - 1, FITTED).round().astype(int)).tolist()
    for frame in frames.tolist():
        yield render(clip, world, frame, width, height, azimuth=azimuth, elevation=elevation, fits=fits)


def write_gif(clip: Clip, path: str | os.PathLike[str], fps: float = 25.0, **how) -> None:
    """A GIF that loops; 256 colours chosen once for all pictures. ``how`` as for :func:`pictures`.

    GIF counts in hundredths of a second: 25, 50 and 20 pictures a second are exact.

    Raises:
      ValueError: Pillow is not installed (``pip install 'rbd-jax[viz]'``); what :func:`pictures` refuses.
    """
    try:
        from PIL import Image
    except ModuleNotFoundError:
        raise ValueError("write_gif needs Pillow: pip install 'rbd-jax[viz]'") from None
    shots = [Image.fromarray(p) for p in pictures(clip, fps=fps, **how)]
    sheet = Image.fromarray(np.concatenate([np.asarray(s) for s in shots[:: max(1, len(shots) // 8)]]))
    palette = sheet.quantize(256, dither=Image.Dither.NONE)
    shots = [s.quantize(palette=palette, dither=Image.Dither.NONE) for s in shots]
    # the format is named, as a path may have any ending
    shots[0].save(path, "GIF", save_all=True, append_images=shots[1:], duration=round(1000 / fps), loop=0)


def write_mp4(clip: Clip, path: str | os.PathLike[str], fps: float = 30.0, **how) -> None:
    """An H.264 movie that every browser plays; width and height are made even.

    Raises:
      ValueError: imageio-ffmpeg is not installed (``pip install 'rbd-jax[viz]'``). OSError: ffmpeg's own complaint.
    """
    try:
        import imageio_ffmpeg
    except ModuleNotFoundError:
        raise ValueError("write_mp4 needs imageio-ffmpeg: pip install 'rbd-jax[viz]'") from None
    how = {**how, "width": how.get("width", 480) // 2 * 2, "height": how.get("height", 320) // 2 * 2}
    command = [
        imageio_ffmpeg.get_ffmpeg_exe(), "-y", "-loglevel", "error", "-f", "rawvideo", "-pix_fmt", "rgb24",
        "-s", f"{how['width']}x{how['height']}", "-r", f"{fps:g}", "-i", "-", "-an", "-c:v", "libx264",
        "-pix_fmt", "yuv420p", "-crf", "20", "-movflags", "+faststart", "-f", "mp4", os.fspath(path),
    ]  # fmt: skip
    process = subprocess.Popen(command, stdin=subprocess.PIPE, stderr=subprocess.PIPE)
    try:
        for picture in pictures(clip, fps=fps, **how):
            process.stdin.write(picture.tobytes())
    except BrokenPipeError:
        pass  # ffmpeg says below why it stopped
    finally:
        _, said = process.communicate()
    if process.returncode:
        raise OSError(f"{os.fspath(path)}: ffmpeg: {said.decode(errors='replace').strip()}")
