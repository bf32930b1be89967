"""Files of pictures (PNG) and films (GIF, WebP, MP4, filmstrip), written whole or not at all.

Frames are pictures of one size, uint8, shape [H, W, 3] each; `fps` is their number per second.
"""

from __future__ import annotations

import io
import math
import struct
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import Any, Literal

import numpy as np
import torch
from numpy.typing import NDArray
from PIL import Image, ImageDraw, ImageFont
from torch import Tensor

from npa_envs.atomic_files import atomic_path, write_bytes
from npa_envs.checks import as_list, check_count, checked_count, checked_finite, is_real
from npa_envs.errors import NPAError, importing, shown
from npa_envs.ops import Cameras, orbit
from npa_envs.render.colours import Background, background_colour, to_uint8
from npa_envs.tasks.targets.views import ANGLE, DISTANCE

Frame = NDArray[np.uint8]
"""Pixels of a picture, uint8, shape [H, W, 3]; the first row is the top."""

GIF_HIGHEST_RATE = 50
"""Maximum `fps` at which players show a GIF."""

_MARGIN = 8


def write_png(path: str | Path, frame: Frame) -> None:
    """Write one picture, uint8, shape [H, W, 3], as a PNG, slowly so that the file is small."""
    write_bytes(path, _encoded([frame], format="PNG", optimize=True))


def encode_frame(frame: Frame, kind: Literal["PNG", "JPEG"]) -> bytes:
    """Return the bytes of a picture's file (uint8, [H, W, 3]), encoded fast rather than small."""
    return _encoded([frame], format=kind, compress_level=1, quality=90)


def _encoded(frames: Iterable[Frame], **options: Any) -> bytes:
    first, *others = map(Image.fromarray, checked_frames(frames))
    buffer = io.BytesIO()
    first.save(buffer, append_images=others, **options)
    return buffer.getvalue()


def write_gif(path: str | Path, frames: Iterable[Frame], fps: float = 25) -> None:
    """Write frames, uint8, [H, W, 3] each, as a GIF that repeats for ever.

    All frames share 256 colours, without dithering. Times are rounded to hundredths of a second.
    `fps` is at most 50. A picture that does not change for more than 655 s raises NPAError.
    """
    pictures = checked_frames(frames)
    check_rate(fps, highest=GIF_HIGHEST_RATE)
    palette, background, entry = _shared_palette(pictures)
    indexed = []
    for picture in pictures:
        quantised = Image.fromarray(picture).quantize(palette=palette, dither=Image.Dither.NONE)
        # Pillow chooses entries approximately; a background off by one level would flicker.
        index = np.array(quantised)
        index[(picture == background).all(axis=-1)] = entry
        exact = Image.fromarray(index, "P")
        exact.putpalette(palette.getpalette() or [])
        indexed.append(exact)
    ends = [round(100 * (k + 1) / fps) for k in range(len(pictures))]
    durations = [10 * (end - start) for start, end in zip([0, *ends], ends, strict=False)]
    with atomic_path(path) as temporary:
        try:
            indexed[0].save(
                temporary, format="GIF", save_all=True, append_images=indexed[1:],
                duration=durations, loop=0, optimize=False, disposal=1,
            )  # fmt: skip
        except (OverflowError, struct.error) as error:
            # Pillow merges equal frames into one, whose time [1/100 s] has 16 bits.
            raise NPAError(
                f"frames may be alike for at most 655 s in a GIF, got more at fps={fps:g}: "
                "raise fps, or leave some of them out"
            ) from error


def write_webp(
    path: str | Path, frames: Iterable[Frame], fps: float = 25, *, quality: int = 50
) -> None:
    """Write frames, uint8, [H, W, 3] each, as a WebP that repeats for ever.

    Its size is about a fifth of a GIF's. `quality` is from 0 (smallest file) to 100.
    """
    write_bytes(path, encode_webp(frames, fps, quality=quality))


def encode_webp(frames: Iterable[Frame], fps: float = 25, *, quality: int = 50) -> bytes:
    """Return the bytes of the file that `write_webp` writes."""
    check_rate(fps)
    if not (is_real(quality) and 0 <= quality <= 100):
        raise NPAError(f"quality must be in [0, 100], got {shown(quality)}: try 50")
    duration = round(1000 / fps)
    return _encoded(
        frames, format="WebP", save_all=True, duration=duration, loop=0, quality=quality, method=4
    )


def write_mp4(path: str | Path, frames: Iterable[Frame], fps: float = 25) -> None:
    """Write frames, uint8, [H, W, 3] each, as an H.264 film that browsers play (with imageio).

    An odd width or height is made even by repeating the last column or row.
    """
    pictures = checked_frames(frames)
    check_rate(fps)
    hint = "pip install 'imageio[ffmpeg]', or write a GIF"
    with importing("imageio with ffmpeg", "an MP4 file", hint):
        import imageio.v2 as imageio
        import imageio_ffmpeg
    height, width, _ = pictures[0].shape
    padding = ((0, height % 2), (0, width % 2), (0, 0))
    with atomic_path(path) as temporary:
        writer: Any
        with imageio.get_writer(
            temporary, format="FFMPEG", mode="I", fps=fps, codec="libx264", quality=8,
            pixelformat="yuv420p", macro_block_size=2, output_params=["-movflags", "+faststart"],
            ffmpeg_log_level="error",
        ) as writer:  # fmt: skip
            for picture in pictures:
                writer.append_data(np.pad(picture, padding, mode="edge"))
        # The writer does not report failures of the encoder, for example on a full disk.
        try:
            count, _ = imageio_ffmpeg.count_frames_and_secs(str(temporary))
        except RuntimeError as error:
            raise OSError(f"the encoder left a broken film: {error}") from error
        if count != len(pictures):
            raise OSError(f"the encoder wrote {count} of {len(pictures)} frames")


def write_filmstrip(
    path: str | Path,
    frames: Iterable[Frame],
    captions: Sequence[str] | None = None,
    columns: int | None = None,
    background: Background = "white",
) -> None:
    """Write frames, uint8, [H, W, 3] each, as one picture: a grid, row by row, captions below.

    The file is a WebP if its name ends in `.webp`, else a PNG. `captions` are one for each frame;
    None: no text. A row has `columns` frames; None: 8, or all frames if they are fewer.
    """
    pictures = checked_frames(frames)
    count = len(pictures)
    texts: list[Any] = [] if captions is None else as_list(captions) or []
    right = len(texts) == count and all(isinstance(text, str) for text in texts)
    if captions is not None and not right:
        raise NPAError(
            f"captions must be texts, one for each of the {count} frames, got {shown(captions)}: "
            "give a list of str, or None"
        )
    across = min(count, 8) if columns is None else columns
    check_count("columns", across, ": try 4")
    across = min(across, count)
    height, width, _ = pictures[0].shape
    # The largest font that keeps every caption within a frame's width, or the smallest.
    fonts = map(ImageFont.load_default, range(max(12, min(28, width // 12)), 10, -1))
    fitting = (font for font in fonts if all(font.getlength(text) <= width for text in texts))
    font: Any = next(fitting, None) or ImageFont.load_default(10)
    _, top, _, bottom = font.getbbox("Ågjy")
    text_height = math.ceil(bottom - top) + _MARGIN if texts else 0
    cell = max([width, *(math.ceil(font.getlength(text)) for text in texts)])
    pitch_x, pitch_y = cell + _MARGIN, height + text_height + _MARGIN
    down = -(-count // across)
    red, green, blue = (round(255 * part) for part in background_colour(background))
    size = (across * pitch_x + _MARGIN, down * pitch_y + _MARGIN)
    strip = Image.new("RGB", size, (red, green, blue))
    ink = "#333333" if red + green + blue > 3 * 127 else "#cccccc"
    draw = ImageDraw.Draw(strip)
    for k, picture in enumerate(pictures):
        left, upper = _MARGIN + (k % across) * pitch_x, _MARGIN + (k // across) * pitch_y
        strip.paste(Image.fromarray(picture), (left + (cell - width) // 2, upper))
        if texts:
            middle = (left + cell / 2, upper + height + _MARGIN / 2)
            draw.text(middle, texts[k], fill=ink, font=font, anchor="ma")
    with atomic_path(path) as temporary:
        if Path(path).suffix.lower() == ".webp":
            strip.save(temporary, format="WebP", quality=88, method=6)
        else:
            strip.save(temporary, format="PNG")


def check_rate(fps: float, *, highest: float = 1000) -> None:
    """Raise NPAError unless `fps` (frames per second) is a number in [0.1, `highest`]."""
    if not (is_real(fps) and 0.1 <= fps <= highest):
        raise NPAError(f"fps must be in [0.1, {highest}], got {shown(fps)}: try 25")


def checked_frames(frames: Iterable[Frame]) -> list[Frame]:
    """Return frames as a list; raise NPAError unless all are uint8, [H, W, 3], of one size."""
    try:
        pictures = [np.ascontiguousarray(frame) for frame in frames]
    except (TypeError, ValueError, RuntimeError) as error:
        raise NPAError(
            f"frames must be a sequence of uint8 [H, W, 3] arrays, got others ({error}): give "
            "[frame] for one"
        ) from error
    if not pictures:
        raise NPAError(
            "frames must hold at least one picture, got none: give uint8 [H, W, 3] arrays"
        )
    for k, picture in enumerate(pictures):
        is_picture = picture.ndim == 3 and picture.shape[-1] == 3 and picture.size > 0
        if picture.dtype != np.uint8 or not is_picture:
            name = "frame" if len(pictures) == 1 else f"frame {k}"
            raise NPAError(
                f"{name} must be uint8 of shape [H, W, 3] and a size that is not zero, got "
                f"{picture.dtype} {picture.shape}: make frames with npa_envs.render.to_uint8"
            )
        if picture.shape != pictures[0].shape:
            raise NPAError(
                f"frames must all have one size, got {pictures[0].shape} and frame {k} of "
                f"{picture.shape}: render them at one resolution"
            )
    return pictures


def _shared_palette(pictures: list[Frame]) -> tuple[Image.Image, Frame, int]:
    """Return 256 colours for all frames, the most frequent colour, and its index among them."""
    step = max(1, math.ceil(sum(p.size // 3 for p in pictures) / 2**20))
    sample = np.concatenate([p.reshape(-1, 3)[k % step :: step] for k, p in enumerate(pictures)])
    coarse = (sample >> 3) @ np.array([1024, 32, 1])
    counts = np.bincount(coarse)
    means = [np.bincount(coarse, sample[:, k]) / np.maximum(counts, 1) for k in range(3)]
    shades = sample[coarse == counts.argmax()]
    fine = (shades & 7) @ np.array([64, 8, 1])
    background = shades[(fine == np.bincount(fine).argmax()).argmax()]
    # Weighted by roots of counts: otherwise a large background takes most of the palette.
    repeats = np.ceil(np.sqrt(counts)).astype(np.int64)
    swatch = np.repeat(np.stack(means, axis=1).round().astype(np.uint8), repeats, axis=0)[None]
    palette = Image.fromarray(swatch).quantize(
        colors=255, method=Image.Quantize.MEDIANCUT, kmeans=2, dither=Image.Dither.NONE
    )
    colours = (palette.getpalette() or [])[: 255 * 3]
    entry = len(colours) // 3
    palette.putpalette([*colours, *(int(v) for v in background)])
    return palette, background, entry


def turntable_frames(
    views: Callable[[Cameras], Tensor],
    *,
    frame_count: int = 60,
    resolution: int = 256,
    elevation: float = 20.0,
    azimuth: float = 0.0,
    background: Background = "white",
    device: str | torch.device = "cpu",
) -> list[NDArray[np.uint8]]:
    """Return pictures, uint8, [R, R, 3] each, of a 3D world from cameras on a circle around it.

    `views` returns the world's pictures from V cameras: colours times alpha, and alpha, shape
    [1, V, R, R, 4]. The cameras stand `elevation` degrees above the horizon, and the first one
    `azimuth` degrees around the vertical axis. R is `resolution`, `device` the world's.
    """
    frame_count = checked_count("frame_count", frame_count)
    azimuth = checked_finite("azimuth", azimuth, " [degrees]")
    frames = []
    with torch.no_grad():
        for k in range(frame_count):
            angle = azimuth + 360.0 * k / frame_count
            cameras = orbit(
                1, elevation, DISTANCE, ANGLE, width=resolution, height=resolution, azimuth=angle
            )
            picture = views(cameras.to(torch.device(device)))[0, 0]
            frames.append(to_uint8(picture.flip(0), background))
    return frames
