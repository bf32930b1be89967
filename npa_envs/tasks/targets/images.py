"""Picture files for targets: reading, cutting out of the background, resampling."""

from __future__ import annotations

import math
import warnings
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageOps, UnidentifiedImageError

from npa_envs.errors import NPAError

OPAQUE = 128
"""Least alpha, of 255, at which a pixel belongs to the target."""

_BACKGROUND_TOLERANCE = 28
_UNIFORM_SHARE = 0.95
_LARGEST_CUT_OUT = 2048

FloatImage = NDArray[np.float32]
Mask = NDArray[np.bool_]


def read_image(path: Path) -> Image.Image:
    """Read a picture as RGBA; one without transparency is cut out of its plain background.

    Args:
        path: A PNG, JPEG, WebP or other file that Pillow reads; of an animation, the first frame.

    Raises:
        NPAError: As for `open_image`, or the picture is fully transparent, or has neither
            transparency nor a plain background.
    """
    image = open_image(path)
    if np.asarray(image.getchannel("A")).min() == 255:
        return cut_out_background(image, label=str(path))
    require_opaque_pixels(image, label=str(path))
    return image


def open_image(path: Path) -> Image.Image:
    """Read a picture as RGBA, as it is.

    Args:
        path: A PNG, JPEG, WebP or other file that Pillow reads; of an animation, the first frame.

    Raises:
        NPAError: The file is missing, not readable, empty, truncated, no picture, or too large.
    """
    try:
        if path.is_dir():
            raise NPAError(f"target {str(path)!r} is a folder: give the path of a picture file")
        if path.stat().st_size == 0:
            raise NPAError(
                f"target {str(path)!r} is an empty file (0 bytes): save the picture anew"
            )
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", Image.DecompressionBombWarning)
            with Image.open(path) as opened:
                opened.load()
                return _to_rgba(ImageOps.exif_transpose(opened))
    except FileNotFoundError as error:
        raise NPAError(f"target {str(path)!r} does not exist: check the path") from error
    except PermissionError as error:
        raise NPAError(f"target {str(path)!r} may not be read: check its permissions") from error
    except Image.DecompressionBombError as error:
        raise NPAError(
            f"target {str(path)!r} must have at most {2 * (Image.MAX_IMAGE_PIXELS or 0)} pixels, "
            f"got more ({error}): scale the picture down first"
        ) from error
    except UnidentifiedImageError as error:
        raise NPAError(
            f"target {str(path)!r} must be a picture (PNG, JPEG, WebP ...), "
            "but its content is none that Pillow knows: save it as PNG"
        ) from error
    except NPAError:
        raise
    except Exception as error:
        # Pillow's decoders report damaged data by exceptions of many kinds.
        if isinstance(error, OSError) and error.errno is not None:
            raise NPAError(
                f"target {str(path)!r} cannot be read ({error}): check the path"
            ) from error
        raise NPAError(
            f"target {str(path)!r} cannot be decoded, it is truncated or damaged ({error}): "
            "save the picture anew, as PNG"
        ) from error


def looks_like_path(source: str) -> bool:
    """Return whether text is the path of a file: by a folder or suffix in it, or that it exists."""
    if "/" in source or "\\" in source or Path(source).suffix:
        return True
    try:
        return source != "" and Path(source).exists()
    except (OSError, ValueError):
        return False


def scaled_square(image: Image.Image, side: int) -> FloatImage:
    """Return a square RGBA picture scaled to `side` pixels: colours times alpha, and alpha.

    Returns:
        In [0, 1], shape [side, side, 4]; the first row is the upper one.
    """
    kind = Image.Resampling.BOX if image.width >= side else Image.Resampling.BICUBIC
    # Pillow's premultiplied mode: colours of transparent pixels do not leak.
    scaled = image.convert("RGBa").resize((side, side), kind)
    return np.asarray(scaled).astype(np.float32) / np.float32(255.0)


def require_opaque_pixels(image: Image.Image, *, label: str) -> None:
    """Raise NPAError where no pixel of the RGBA picture has an alpha above one half."""
    alpha = np.asarray(image.getchannel("A"))
    if alpha.size == 0 or alpha.max() < OPAQUE:
        highest = 0.0 if alpha.size == 0 else alpha.max() / 255
        raise NPAError(
            f"target {label!r} must have pixels with alpha above 0.5, the highest is {highest:.2f} "
            f"({image.width} x {image.height} pixels): give a picture that is not fully transparent"
        )


def cut_out_background(image: Image.Image, *, label: str) -> Image.Image:
    """Make the plain background of an opaque picture transparent.

    The background is what has the colour of the border and is connected with it; a hole that the
    object encloses stays opaque. Pixels at the object's edge, which mix both colours, are unmixed.
    A side above 2048 pixels is reduced to that first.

    Args:
        image: An RGBA picture without transparent pixels.
        label: The name of the picture in error messages.

    Raises:
        NPAError: The border is not of one colour, or the whole picture is.
    """
    image = image.reduce(math.ceil(max(image.size) / _LARGEST_CUT_OUT))
    rgb = np.asarray(image.convert("RGB")).astype(np.float32)
    border = np.concatenate([rgb[0], rgb[-1], rgb[:, 0], rgb[:, -1]])
    background = np.median(border, axis=0)
    uniform = (np.abs(border - background).max(axis=-1) <= _BACKGROUND_TOLERANCE).mean()
    if uniform < _UNIFORM_SHARE:
        raise NPAError(
            f"target {label!r} has no transparency, so at least {_UNIFORM_SHARE:.0%} of its border "
            f"must have one colour (the background), but only {uniform:.0%} have: "
            "give a PNG or WebP with a transparent background"
        )
    similar = np.abs(rgb - background).max(axis=-1) <= _BACKGROUND_TOLERANCE
    outside = _connected_to_border(similar)
    if outside.all():
        raise NPAError(
            f"target {label!r} has no transparency and one colour all over, nothing to grow: "
            "give a picture with an object, best a PNG with a transparent background"
        )
    colour, alpha = _unmix_edge(rgb, ~outside, background)
    pixels = np.concatenate([colour, 255 * alpha[..., None]], axis=-1)
    cut = Image.fromarray(pixels.round().clip(0, 255).astype(np.uint8), "RGBA")
    require_opaque_pixels(cut, label=label)
    return cut


def resample(image: Image.Image, point_count: int, *, label: str = "picture") -> Image.Image:
    """Scale a picture so that the number of its opaque pixels is nearest to `point_count`.

    The scale is continuous: the picture is sampled with a pitch found by bisection, on a square
    grid that holds the whole picture, so that other shapes than squares are padded. Colours are
    averaged with alpha as weight, so that those of transparent pixels never leak in.

    Args:
        image: An RGBA picture with at least one opaque pixel.
        point_count: The number of opaque pixels aimed at.
        label: The name of the picture in error messages.

    Raises:
        NPAError: Nothing opaque is left at the scale nearest to `point_count`.
    """
    image = image.crop(image.getchannel("A").getbbox())
    area = _opaque_count(image)
    pitch = math.sqrt(area / point_count)
    # A picture far larger than the grid is halved first, for speed, unless that loses fine parts.
    factor = int(pitch / 4)
    if factor > 1:
        reduced = image.reduce(factor)
        if _opaque_count(reduced) * factor**2 > 0.9 * area:
            image, pitch = reduced, pitch / factor
    span = max(image.size)
    margin = 2 + math.ceil(0.5 * span + 4 * pitch)
    padded = Image.new("RGBA", (span + 2 * margin, span + 2 * margin), (0, 0, 0, 0))
    padded.paste(image, (margin + (span - image.width) // 2, margin + (span - image.height) // 2))
    alpha = padded.getchannel("A")

    def count(candidate: float) -> int:
        sampled = _sample(alpha, span, candidate)
        return int((np.asarray(sampled) >= OPAQUE).sum())

    fine, coarse = pitch / 1.5, min(pitch * 1.5, span)
    while count(fine) < point_count:
        fine /= 1.5
    best, best_miss = pitch, abs(count(pitch) - point_count)
    for _ in range(24):
        middle = 0.5 * (fine + coarse)
        found = count(middle)
        if abs(found - point_count) < best_miss:
            best, best_miss = middle, abs(found - point_count)
        if best_miss == 0:
            break
        fine, coarse = (middle, coarse) if found > point_count else (fine, middle)
    if best_miss == point_count and count(best) == 0:
        raise NPAError(
            f"target {label!r} is too thin to be resampled to {point_count} points, no opaque "
            "pixel would be left: thicken it or raise target_point_count"
        )
    return _sample(padded, span, best)


def _sample(padded: Image.Image, span: int, pitch: float) -> Image.Image:
    side = math.ceil(span / pitch) + 2
    low = 0.5 * (padded.width - side * pitch)
    high = low + side * pitch
    # Above one source pixel a grid pixel LANCZOS averages; below, where it would ring, BICUBIC.
    kind = Image.Resampling.LANCZOS if pitch > 1 else Image.Resampling.BICUBIC
    return padded.resize((side, side), kind, box=(low, low, high, high))


def _opaque_count(image: Image.Image) -> int:
    return int((np.asarray(image.getchannel("A")) >= OPAQUE).sum())


def _to_rgba(image: Image.Image) -> Image.Image:
    if image.mode.startswith("I") or image.mode == "F":
        # Pillow would clip sixteen bits at 255 instead of scaling them.
        levels = np.asarray(image).astype(np.float64)
        top = 255.0 if levels.max() < 256 else 65535.0
        if image.mode == "F" and levels.max() <= 1:
            top = 1.0
        image = Image.fromarray((levels / top * 255).clip(0, 255).astype(np.uint8))
    return image.convert("RGBA")


def _connected_to_border(similar: Mask) -> Mask:
    reached = np.zeros_like(similar)
    reached[0], reached[-1] = similar[0], similar[-1]
    reached[:, 0], reached[:, -1] = similar[:, 0], similar[:, -1]
    while True:
        before = int(reached.sum())
        for view, free in ((reached, similar), (reached.T, similar.T)):
            for k in range(1, len(view)):
                view[k] |= view[k - 1] & free[k]
            for k in range(len(view) - 2, -1, -1):
                view[k] |= view[k + 1] & free[k]
        if int(reached.sum()) == before:
            return reached


def _unmix_edge(
    rgb: FloatImage, inside: Mask, background: FloatImage
) -> tuple[FloatImage, FloatImage]:
    height, width = inside.shape
    padded = np.pad(inside, 1)
    shifts = [(r, c) for r in range(3) for c in range(3) if (r, c) != (1, 1)]
    core = inside.copy()
    for r, c in shifts:
        core &= padded[r : r + height, c : c + width]
    edge = inside & ~core
    weight = np.pad(core, 1).astype(np.float32)
    weighted = np.pad(rgb * core[..., None], ((1, 1), (1, 1), (0, 0)))
    total, near = np.zeros_like(rgb), np.zeros(inside.shape, dtype=np.float32)
    for r, c in shifts:
        total += weighted[r : r + height, c : c + width]
        near += weight[r : r + height, c : c + width]
    # Where an edge pixel touches the object's inside, that is its own colour without background.
    known = edge & (near > 0)
    colour, alpha = rgb.copy(), inside.astype(np.float32)
    own = total[known] / near[known][:, None]
    contrast = np.linalg.norm(own - background, axis=-1)
    share = np.linalg.norm(rgb[known] - background, axis=-1) / np.maximum(contrast, 1)
    colour[known], alpha[known] = own, share.clip(0, 1)
    return colour, alpha
