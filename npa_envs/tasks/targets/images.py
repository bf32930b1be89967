"""Picture files of targets: reading, removal of plain backgrounds, scaling."""

from __future__ import annotations

import io
import math
import os
import warnings
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from PIL import Image, UnidentifiedImageError, features

from npa_envs.atomic_files import read_bytes
from npa_envs.errors import MissingDependencyError, NPAError, importing, shown
from npa_envs.tasks.targets.picture_modes import Mask, correct_tiles, kind_of_tiff, to_rgba

OPAQUE = 128
"""Minimum alpha of a pixel that belongs to a target, out of 255."""

BACKGROUND_TOLERANCE = 28
"""How far a background's red, green and blue may be from its colour, out of 255."""

_UNIFORM = 0.95  # of the border's pixels
_MAX_CUT_OUT = 2048  # pixels on each side
_MAX_FILE = 256 * 2**20  # bytes
_MAX_PADDED = 9216  # pixels on each side

MAX_AREA = 2**26
"""Maximum number of pixels of a picture: 8192 x 8192."""

FORMATS = ("PNG", "JPEG", "BMP", "GIF", "PPM", "TIFF", "WEBP")
"""Pillow's names of the formats allowed everywhere. Others may start other programs, as EPS does.
AVIF is allowed where Pillow has it, HEIC where pillow-heif is installed."""

TRANSPARENT_SHARE = 0.001
"""A picture is cut out by alpha if a larger share of its pixels have an alpha below one half."""

MAX_GRID_SIDE = 6144
"""Maximum side of the square grid to which a picture is scaled [pixels]."""

MAX_POINT_COUNT = 2**24
"""Maximum number of points of a target."""

FloatImage = NDArray[np.float32]


def read_image(path: Path, *, keep_background: bool = False) -> tuple[Image.Image, str]:
    """Read a picture as RGBA, and return it with a line about what was read.

    The background of one without transparency is made transparent, unless it is kept.
    """
    opened = open_image(path)
    if keep_background:
        return opened, summary_of(path.name, opened, "its whole rectangle")
    image, how = opened, "cut out by alpha"
    if not is_cut_out(opened):
        try:
            image, how = cut_out_background(opened, label=str(path)), "cut out of its background"
        except NPAError:
            # A few transparent pixels are better than no target.
            if not is_cut_out(opened, least=0.0):
                raise
    require_opaque_pixels(image, label=str(path))
    return image, summary_of(path.name, opened, f"{how}, {opaque_share(image)} of its pixels")


def summary_of(name: str, image: Image.Image, text: str) -> str:
    """Return a line about a picture called `name`: its size, and what was used of it."""
    return f"{shown(name)[1:-1]}: {image.width} x {image.height}, {text}"


def opaque_share(image: Image.Image) -> str:
    """Return the share of an RGBA picture's pixels that are opaque, such as "41 %"."""
    return f"{100 * _opaque_count(image) / (image.width * image.height):.0f} %"


def is_cut_out(image: Image.Image, *, least: float = TRANSPARENT_SHARE) -> bool:
    """Return whether alpha cuts an RGBA picture out: more than this share is transparent."""
    return bool((np.asarray(image.getchannel("A")) < OPAQUE).mean() > least)


def with_background(image: Image.Image) -> Image.Image:
    """Return an RGBA picture, opaque: what is transparent becomes white."""
    white = Image.new("RGBA", image.size, (255, 255, 255, 255))
    return Image.alpha_composite(white, image)


def open_image(path: Path) -> Image.Image:
    """Read a picture as RGBA, as it is."""
    return decode_image(read_bytes(path, limit=_MAX_FILE, what="target"), label=str(path))


def decode_image(content: bytes, *, label: str) -> Image.Image:
    """Return the picture in the bytes of a file as RGBA, as it is; errors call it `label`."""
    name = shown(label)
    if not content:
        raise NPAError(f"target {name} is an empty file (0 bytes): save the picture again")
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            with Image.open(io.BytesIO(content), formats=_formats(content, name)) as opened:
                _check_area(opened.size, name)
                correct_tiles(opened)
                opened.load()
                # A format inside of another may have another size.
                _check_area(opened.size, name)
                return to_rgba(opened, content, label)
    except Image.DecompressionBombError as error:
        raise _too_large(name, "more") from error
    except UnidentifiedImageError as error:
        if kind := kind_of_tiff(content):
            raise NPAError(
                f"target {name} is a {kind}, which Pillow does not read, or damaged: save it as PNG"
            ) from error
        raise NPAError(
            f"target {name} must be a picture ({', '.join(FORMATS)}, AVIF, HEIC), "
            "but its content is none of these: save it as PNG"
        ) from error
    except NPAError:
        raise
    except Exception as error:
        # Pillow's decoders report damaged data by exceptions of many kinds.
        raise NPAError(
            f"target {name} cannot be decoded, it is truncated or damaged, or of a kind that "
            f"Pillow does not read ({shown(error)}): save the picture again, as PNG"
        ) from error


def _formats(content: bytes, name: str) -> tuple[str, ...]:
    """Return Pillow's names of the formats that a file may have.

    Raise MissingDependencyError for AVIF or HEIC where what reads it is missing.
    """
    if content[4:8] != b"ftyp":
        return FORMATS
    brands = content[8 : int.from_bytes(content[:4], "big")]
    if b"avif" in brands or b"avis" in brands:
        if not features.check("avif"):
            raise MissingDependencyError(
                f"target {name} is an AVIF picture, which this Pillow does not read: "
                "pip install --upgrade pillow, or save it as PNG"
            )
        return (*FORMATS, "AVIF")
    if not any(brand in brands for brand in (b"hei", b"hev", b"mif1", b"msf1")):
        return FORMATS
    hint = "pip install pillow-heif, or save it as PNG"
    with importing("pillow-heif", f"target {name}, a HEIC picture,", hint):
        import pillow_heif
    pillow_heif.register_heif_opener()
    return (*FORMATS, "HEIF")


def _check_area(size: tuple[int, int], name: str) -> None:
    if size[0] * size[1] > MAX_AREA:
        raise _too_large(name, f"{size[0]} x {size[1]}")


def _too_large(name: str, got: str) -> NPAError:
    return NPAError(
        f"target {name} must have at most {MAX_AREA} pixels, got {got}: scale the picture down"
    )


def looks_like_path(source: str) -> bool:
    """Return whether text contains a folder or a suffix, or is the path of an existing file."""
    if "/" in source or "\\" in source or Path(source).suffix:
        return True
    return os.path.exists(source)


def scaled_square(image: Image.Image, side: int) -> FloatImage:
    """Return a square picture scaled to [side, side, 4]: colours times alpha, alpha, in [0, 1]."""
    method = Image.Resampling.BOX if image.width >= side else Image.Resampling.BICUBIC
    # Pillow's premultiplied mode: colours of transparent pixels do not leak.
    scaled = image.convert("RGBa").resize((side, side), method)
    return np.asarray(scaled).astype(np.float32) / np.float32(255.0)


def require_opaque_pixels(image: Image.Image, *, label: str) -> None:
    """Raise NPAError, which calls the picture `label`, if no pixel has an alpha above one half."""
    alpha = np.asarray(image.getchannel("A"))
    if alpha.size == 0 or alpha.max() < OPAQUE:
        highest = 0.0 if alpha.size == 0 else alpha.max() / 255
        raise NPAError(
            f"target {shown(label)} must have pixels with alpha above 0.5, the highest is "
            f"{highest:.2f} "
            f"({image.width} x {image.height} pixels): give a picture that is not fully transparent"
        )


def cut_out_background(image: Image.Image, *, label: str) -> Image.Image:
    """Return an opaque RGBA picture with its plain background made transparent.

    The background has the colour of the border and is connected with it; a hole that the object
    encloses stays opaque. The object's colour and alpha are estimated for pixels at its edge.
    Sides above 2048 pixels are reduced first. Errors call the picture `label`.
    """
    image = image.reduce(math.ceil(max(image.size) / _MAX_CUT_OUT))
    rgb = np.asarray(image.convert("RGB")).astype(np.float32)
    border = np.concatenate([rgb[0], rgb[-1], rgb[:, 0], rgb[:, -1]])
    background = np.median(border, axis=0)
    uniform = (np.abs(border - background).max(axis=-1) <= BACKGROUND_TOLERANCE).mean()
    if uniform < _UNIFORM:
        raise NPAError(
            f"target {shown(label)} is opaque, so at least {_UNIFORM:.0%} of its border must have "
            f"one colour (the background), but only {uniform:.0%} have, so there is no part to cut "
            "out: --keep-background grows the whole rectangle (in Python keep_background=True), "
            "or give a PNG or WebP with a transparent background"
        )
    cut = cut_out(image, background)
    if not np.asarray(cut.getchannel("A")).any():
        raise NPAError(
            f"target {shown(label)} is opaque and of one colour all over, nothing to grow: give a "
            "picture with an object, best a PNG with a transparent background; --keep-background "
            "grows the whole rectangle (in Python keep_background=True)"
        )
    require_opaque_pixels(cut, label=label)
    return cut


def cut_out(image: Image.Image, background: FloatImage) -> Image.Image:
    """Return a picture with the `background`, a colour [3], made transparent next to its border."""
    rgb = np.asarray(image.convert("RGB")).astype(np.float32)
    similar = np.abs(rgb - background).max(axis=-1) <= BACKGROUND_TOLERANCE
    colour, alpha = _unmix_edge(rgb, ~_connected_to_border(similar), background)
    alpha = np.minimum(255 * alpha, np.asarray(image.getchannel("A")))
    pixels = np.concatenate([colour, alpha[..., None]], axis=-1)
    return Image.fromarray(pixels.round().clip(0, 255).astype(np.uint8), "RGBA")


def resample(image: Image.Image, point_count: int, *, label: str = "picture") -> Image.Image:
    """Return an RGBA picture scaled so that about `point_count` of its pixels are opaque.

    It is padded to a square. Colours are means weighted by alpha. Errors call the picture `label`.
    """
    padded, span, pitch = _padded(image.crop(image.getchannel("A").getbbox()), point_count)
    return _sample(padded, span, _best_pitch(padded, span, pitch, point_count, label))


def _padded(image: Image.Image, point_count: int) -> tuple[Image.Image, int, float]:
    """Return a picture in the middle of a transparent square, its longer side [pixels], its pitch.

    A pitch is the side [pixels] of the squares that become one pixel each. This one is estimated
    from the area that is opaque, for `point_count` pixels.
    """
    area = _opaque_count(image)
    pitch = math.sqrt(area / point_count)
    # A picture far larger than the grid is reduced first, for speed, unless that loses fine parts.
    factor = int(pitch / 4)
    if factor > 1:
        reduced = image.reduce(factor)
        if _opaque_count(reduced) * factor**2 > 0.9 * area:
            image, pitch = reduced, pitch / factor
    span, margin = max(image.size), _margin(image, pitch)
    if span + 2 * margin > _MAX_PADDED:
        factor = math.ceil((span + 2 * margin) / _MAX_PADDED)
        image = image.reduce(factor)
        pitch = math.sqrt(max(_opaque_count(image), 1) / point_count)
        span, margin = max(image.size), _margin(image, pitch)
    padded = Image.new("RGBA", (span + 2 * margin, span + 2 * margin), (0, 0, 0, 0))
    padded.paste(image, (margin + (span - image.width) // 2, margin + (span - image.height) // 2))
    return padded, span, pitch


def _best_pitch(
    padded: Image.Image, span: int, pitch: float, point_count: int, label: str
) -> float:
    """Return the pitch that leaves about `point_count` opaque pixels, by bisection from `pitch`."""
    alpha = padded.getchannel("A")

    def count(candidate: float) -> int:
        sampled = _sample(alpha, span, candidate)
        return int((np.asarray(sampled) >= OPAQUE).sum())

    fine, coarse = pitch / 1.5, min(pitch * 1.5, span)
    while span / fine <= MAX_GRID_SIDE and count(fine) < point_count:
        fine /= 1.5
    if span / fine > MAX_GRID_SIDE:
        raise NPAError(
            f"target {shown(label)} must give {point_count} points on a grid of at most "
            f"{MAX_GRID_SIDE} x {MAX_GRID_SIDE} pixels, but its opaque pixels are few and far "
            "apart: fill more of the picture, or lower target_point_count"
        )
    best, best_miss = pitch, abs(count(pitch) - point_count)
    for _ in range(24):
        middle = 0.5 * (fine + coarse)
        reached = count(middle)
        if abs(reached - point_count) < best_miss:
            best, best_miss = middle, abs(reached - point_count)
        if best_miss == 0:
            break
        fine, coarse = (middle, coarse) if reached > point_count else (fine, middle)
    if best_miss == point_count and count(best) == 0:
        raise NPAError(
            f"target {shown(label)} is too thin to be resampled to {point_count} points, no opaque "
            "pixel would be left: thicken it or raise target_point_count"
        )
    return best


def _margin(image: Image.Image, pitch: float) -> int:
    """Return the width [pixels] of the transparent border that resampling needs."""
    return 2 + math.ceil(min(0.5 * max(image.size) + 4 * pitch, 2.0 * max(image.size) + 2.0))


def _sample(padded: Image.Image, span: int, pitch: float) -> Image.Image:
    """Return the middle of `padded` scaled by 1 / `pitch`, ceil(span / pitch) + 2 pixels a side."""
    side = math.ceil(span / pitch) + 2
    low = 0.5 * (padded.width - side * pitch)
    high = low + side * pitch
    # Above one source pixel a grid pixel LANCZOS averages; below, where it would ring, BICUBIC.
    method = Image.Resampling.LANCZOS if pitch > 1 else Image.Resampling.BICUBIC
    return padded.resize((side, side), method, box=(low, low, high, high))


def _opaque_count(image: Image.Image) -> int:
    return int((np.asarray(image.getchannel("A")) >= OPAQUE).sum())


def _connected_to_border(similar: Mask) -> Mask:
    """Return which pixels of a mask are connected with its border, [H, W]."""
    connected = np.zeros_like(similar)
    connected[0], connected[-1] = similar[0], similar[-1]
    connected[:, 0], connected[:, -1] = similar[:, 0], similar[:, -1]
    while True:
        before = int(connected.sum())
        for view, free in ((connected, similar), (connected.T, similar.T)):
            for k in range(1, len(view)):
                view[k] |= view[k - 1] & free[k]
            for k in range(len(view) - 2, -1, -1):
                view[k] |= view[k + 1] & free[k]
        if int(connected.sum()) == before:
            return connected


def _sums_of_nine(values: FloatImage) -> FloatImage:
    """Return the sum of each pixel and its eight neighbours, 0 outside, shape [H, W, ...]."""
    padded = np.pad(values, [(1, 1), (1, 1), (0, 0)][: values.ndim])
    rows = padded[:-2] + padded[1:-1] + padded[2:]
    sums: FloatImage = rows[:, :-2] + rows[:, 1:-1] + rows[:, 2:]
    return sums


def _unmix_edge(
    rgb: FloatImage, inside: Mask, background: FloatImage
) -> tuple[FloatImage, FloatImage]:
    """Return the object's colours [H, W, 3] and alpha [H, W] in a picture; it is `inside`.

    For pixels at its edge they are estimated from the colours of the object and the background.
    """
    core = _sums_of_nine(inside.astype(np.float32)) == 9.0
    near = _sums_of_nine(core.astype(np.float32))
    total = _sums_of_nine(rgb * core[..., None])
    # The object's colour at an edge pixel is the mean of the inner pixels that touch it.
    known = inside & ~core & (near > 0)
    colour, alpha = rgb.copy(), inside.astype(np.float32)
    inner = total[known] / near[known][:, None]
    contrast = np.linalg.norm(inner - background, axis=-1)
    ratio = np.linalg.norm(rgb[known] - background, axis=-1) / np.maximum(contrast, 1)
    colour[known], alpha[known] = inner, ratio.clip(0, 1)
    return colour, alpha
