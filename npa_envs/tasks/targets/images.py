"""Pictures of targets as RGBA in sRGB: files, removal of plain backgrounds, scaling, emoji.

It needs no torch, whose import takes seconds: files that cannot be read are refused at once.
"""

from __future__ import annotations

import contextlib
import io
import math
import os
import unicodedata
import warnings
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageDraw, ImageFile, ImageFont, ImageOps, UnidentifiedImageError, features

from npa_envs.atomic_files import read_bytes
from npa_envs.errors import MissingDependencyError, NPAError, importing, shown
from npa_envs.tasks.targets.notes import left_out

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
Mask = NDArray[np.bool_]

BRIGHT = 2.0
"""Floats of which most positive ones are above this are not on a scale where 1 is white."""

DARK = 0.25
"""Pictures of more than 8 bits whose largest value is below this, where 1 is white, are told of."""

_CLIPPED = 1.0 + 0.5 / 255.0
_SRGB_GAMMA = 1.0 / 2.2
_SRGB_PRIMARIES = (0.3127, 0.329, 0.64, 0.33, 0.3, 0.6, 0.15, 0.06)
_MODES_OF_PROFILES = {"RGB": "RGB", "GRAY": "L", "CMYK": "CMYK", "Lab": "LAB"}
# Tags of TIFF.
_BITS, _PHOTOMETRIC, _PLANES, _COLOURS, _SUBFILES, _SAMPLE_FORMAT = 258, 262, 284, 320, 330, 339
_SEPARATE = 2  # of _PLANES
_SIGNED, _FLOAT = 2, 3  # of _SAMPLE_FORMAT
_NATIVE_MODES = {"F;32BF": "F;32NF", "I;32BS": "I;32NS", "I;16BS": "I;16NS"}


def read_image(
    path: Path, *, keep_background: bool = False, kind: str = "picture"
) -> tuple[Image.Image, str]:
    """Read a picture as RGBA, and return it with a line about what was read.

    The background of one without transparency is made transparent, unless it is kept. `kind`: what
    the file must be, for the error that it is something else.
    """
    opened = open_image(path, kind=kind)
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


def open_image(path: Path, *, upright: bool = True, kind: str = "picture") -> Image.Image:
    """Read a picture as RGBA, as it is; turned as its EXIF data say, unless not `upright`."""
    content = read_bytes(path, limit=_MAX_FILE, what="target")
    return decode_image(content, label=str(path), upright=upright, kind=kind)


def decode_image(
    content: bytes, *, label: str, upright: bool = True, profile: bool = True, kind: str = "picture"
) -> Image.Image:
    """Return the picture in the bytes of a file as RGBA, as it is; errors call it `label`.

    It is turned as its EXIF data say, if `upright`. `profile`: its colour profile is applied.
    """
    name = shown(label)
    if not content:
        raise NPAError(f"target {name} is an empty file (0 bytes): save the picture again")
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            with Image.open(io.BytesIO(content), formats=_formats(content, name)) as opened:
                _check_area(opened.size, name)
                _correct_tiles(opened)
                opened.load()
                # A format inside of another may have another size.
                _check_area(opened.size, name)
                return _to_rgba(opened, content, label, upright=upright, profile=profile)
    except Image.DecompressionBombError as error:
        raise _too_large(name, "more") from error
    except UnidentifiedImageError as error:
        what = "none of these"
        if content[:4] in (b"II*\0", b"MM\0*", b"II+\0", b"MM\0+"):
            what = "a TIFF of a kind that Pillow does not read, or damaged"
        raise NPAError(
            f"target {name} must be a {kind} ({', '.join(FORMATS)}, AVIF, HEIC), "
            f"but its content is {what}: save it as PNG"
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
    brands = content[8 : int.from_bytes(content[:4], "big")] if content[4:8] == b"ftyp" else b""
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


# Pixels: bit depths, floats, transparent colours, profiles.


def _to_rgba(
    opened: ImageFile.ImageFile, content: bytes, name: str, *, upright: bool, profile: bool
) -> Image.Image:
    """Return a loaded picture as RGBA, in sRGB; `content` has the bytes of its file.

    Samples are scaled by the file's bit depth; white is 1 for floats. A colour that a PNG names
    transparent becomes so, and so does NaN. `upright`: the picture is turned as its EXIF data say.
    `profile`: an embedded colour profile is applied. What is not used is told by `left_out`, which
    calls the file `name`.
    """
    tags: Any = getattr(opened, "tag_v2", {})
    kind = tags.get(_SAMPLE_FORMAT, (_FLOAT if opened.mode == "F" else 1,))[0]
    if getattr(opened, "is_animated", False) or _SUBFILES in tags:
        left_out(name, "all its frames, pages or pictures but the first")
    is_png = opened.format == "PNG"
    image = ImageOps.exif_transpose(opened) if upright else opened.copy()
    deep = (content[24] if is_png else max(tags.get(_BITS, (8,)))) > 8
    palette = tags.get(_COLOURS, ()) if image.mode == "P" else ()
    if 0 < max(palette, default=0) < 256:
        # Some programs write colours of 8 bits, of which Pillow takes the upper half of 16.
        image.putpalette(np.array(palette, np.uint8).reshape(3, -1).T.tobytes())
    there = _not_transparent(image, content, upright) if is_png else None
    if image.mode.startswith("I") or image.mode == "F" or kind == _SIGNED:
        # Pillow scales the samples of PGM files to 16 bits, and inverts up to 8 bits only.
        bits, inverted = tags.get(_BITS, (16,))[0], tags.get(_PHOTOMETRIC) == 0
        image, numbers = _to_eight_bits(image, kind, bits, inverted, name)
        there, deep = numbers if there is None else there & numbers, False
    if image.mode == "La":
        image = image.convert("LA")
    rgba = image.convert("RGB" if image.mode in ("LAB", "CMYK") else "RGBA").convert("RGBA")
    if deep and (top := int(np.asarray(rgba)[..., :3].max())) < 255 * DARK:
        # Pillow has cut colours to 8 bits.
        left_out(name, f"its largest value is {top} of 255: scale its values", what="dark")
    if profile and image.info.get("icc_profile"):
        grey, other = image.mode in ("1", "L", "LA"), image.mode in ("LAB", "CMYK")
        own = image.convert("L") if grey else image if other else rgba.convert("RGB")
        if (colours := _in_srgb(own, image.info["icc_profile"], name)) is not None:
            colours.putalpha(rgba.getchannel("A"))
            rgba = colours
    elif is_png and "srgb" not in image.info:
        gamma = image.info.get("gamma", _SRGB_GAMMA)
        if abs(gamma / _SRGB_GAMMA - 1.0) > 0.05:
            left_out(name, f"its gamma of {gamma:g}; colours are read as sRGB")
        primaries = image.info.get("chromaticity", _SRGB_PRIMARIES)
        code = content.partition(b"IDAT")[0].partition(b"cICP")[2][:2]
        if not np.allclose(primaries, _SRGB_PRIMARIES, atol=0.01) or code not in (b"", b"\1\r"):
            left_out(name, "its primaries (cHRM or cICP); colours are read as sRGB")
    if there is not None:
        alpha = np.asarray(rgba.getchannel("A")) * there
        rgba.putalpha(Image.fromarray(alpha.astype(np.uint8)))
    return rgba


def _correct_tiles(opened: ImageFile.ImageFile) -> None:
    """Correct, before a TIFF is loaded, how Pillow unpacks samples of more than 8 bits.

    It swaps the bytes of big-endian ones that libtiff has swapped before, and takes planes of 16
    bits, where they are not compressed, for planes of 8.
    """
    tags: Any = getattr(opened, "tag_v2", {})
    planes = tags.get(_PLANES) == _SEPARATE and max(tags.get(_BITS, (1,))) == 16
    tiles: list[Any] = opened.tile if tags else []
    for k, tile in enumerate(tiles):
        mode, *others = tile.args
        if tile.codec_name == "libtiff":
            mode = _NATIVE_MODES.get(mode, mode)
        elif planes and len(mode) == 1:
            mode += ";16B" if tags.prefix == b"MM" else ";16L"
        tiles[k] = tile._replace(args=(mode, *others))


def _to_eight_bits(
    image: Image.Image, kind: int, bits: int, inverted: bool, name: str
) -> tuple[Image.Image, Mask]:
    """Return a grey picture in 8 bits, and where its samples are numbers.

    The samples' `kind` is 1 for unsigned integers, else `_SIGNED` or `_FLOAT`. White is their
    largest value, 1 for floats, or 0 if they are `inverted`.
    """
    white = 1.0 if kind == _FLOAT else 2.0 ** (bits - (kind == _SIGNED)) - 1.0
    stored = np.asarray(image)
    if image.mode == "L":
        stored = stored.view(np.int8)
    levels = stored.astype(np.float64)
    if white >= 2.0**31 and kind != _SIGNED:
        # Pillow reads unsigned samples of 32 bits as signed ones.
        levels %= 2.0**32
    levels /= white
    numbers = ~np.isnan(levels)
    values = levels[numbers]
    largest = float(values.max(initial=0.0))
    if kind == _FLOAT and 2 * (values > BRIGHT).sum() > (values > 0.0).sum():
        raise NPAError(
            f"target {shown(name)} has floats, of which 1 is white, but most of its values above 0 "
            f"are above {BRIGHT:g}, and the largest is {largest:g}: divide them by their white, or "
            "save it with 8 or 16 bits"
        )
    for outside, text in (
        (~numbers, "what is no number (NaN) and becomes transparent"),
        (values > _CLIPPED, f"values above 1, up to {largest:g}, which become white"),
        (values < 0.0, "negative values, which become black"),
    ):
        if outside.any():
            left_out(name, f"{text}, at {outside.sum()} of {outside.size} pixels")
    if inverted:
        levels, largest = 1.0 - levels, 1.0 - float(values.min(initial=1.0))
    if 0.0 < largest < DARK:
        text = f"its largest value is {largest * white:g} of {white:.10g}: scale its values"
        left_out(name, text, what="dark")
    levels = np.where(numbers, levels, 0.0) * 255.0
    grey = Image.fromarray(levels.clip(0, 255).astype(np.uint8))
    grey.info = image.info
    return grey, numbers


def _not_transparent(image: Image.Image, content: bytes, upright: bool) -> Mask | None:
    """Return where a PNG's pixels have another colour than the transparent one of tRNS, [H, W].

    None: Pillow makes them transparent itself. It compares grey of 2 and 4 bits, which it has
    scaled, and colours of 16 bits, which it has cut to 8, with the unscaled number in the file.
    """
    transparent, depth = image.info.get("transparency"), content[24]
    if transparent is None or image.mode == "P":
        return None
    if depth < 16:
        if image.mode == "L" and transparent < 2**depth:
            image.info["transparency"] = transparent * (255 // (2**depth - 1))
        return None
    del image.info["transparency"]
    samples = np.asarray(image)
    if image.mode == "RGB":
        with Image.open(io.BytesIO(content), formats=("PNG",)) as low:
            # The same decoder, told that the other byte of each sample is the higher one.
            low.tile = [tile._replace(args="RGB;16L") for tile in low.tile]
            lower = np.asarray(ImageOps.exif_transpose(low) if upright else low)
        samples = samples.astype(np.uint16) * 256 + lower
    different = samples.reshape(*samples.shape[:2], -1) != np.array(transparent)
    return np.asarray(different.any(axis=-1))


def _in_srgb(image: Image.Image, profile: bytes, name: str) -> Image.Image | None:
    """Return a picture as RGB by its ICC profile; None, and a line that says so, if it is no use.

    The picture's mode is L, RGB, CMYK or LAB.
    """
    try:
        from PIL import ImageCms

        source = ImageCms.ImageCmsProfile(io.BytesIO(profile))
        space = source.profile.xcolor_space.strip()
        if space == "RGB" and image.mode == "L":
            image = image.convert("RGB")
        if _MODES_OF_PROFILES.get(space) != image.mode:
            raise ValueError(f"it is for {space}, the picture is {image.mode}")
        target = ImageCms.createProfile("sRGB")
        return ImageCms.profileToProfile(image, source, target, outputMode="RGB")
    except Exception as error:
        # A Pillow without littleCMS, and damaged profiles, of which it reports many kinds.
        left_out(name, f"its colour profile ({shown(error)})")
        return None


# Shapes.


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
    highest = np.asarray(image.getchannel("A")).max(initial=0)
    if highest < OPAQUE:
        raise NPAError(
            f"target {shown(label)} must have pixels with alpha above 0.5, the highest is "
            f"{highest / 255:.2f} ({image.width} x {image.height} pixels): give a picture that is "
            "not fully transparent"
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


# Pictures of emoji characters, from a colour-emoji font that is installed.

FONTS = (
    "NotoColorEmoji.ttf",
    "Apple Color Emoji.ttc",
    "seguiemj.ttf",
    "Twemoji.ttf",
    "TwemojiMozilla.ttf",
    "JoyPixels.ttf",
)
"""Names of files of colour-emoji fonts, of Linux, macOS, Windows and others."""

# Bitmap fonts open only at the sizes that they hold: 109 is Noto's, 160, 96 ... are Apple's.
_FONT_SIZES = (109, 160, 136, 128, 96, 72, 64, 48, 32)
_INK = (255, 0, 254)
_KEYCAP, _PICTURE_STYLE = "\u20e3", "\ufe0f"


def is_emoji(text: str) -> bool:
    """Return whether text looks like an emoji: a few characters, one of them a picture symbol."""
    if not 0 < len(text) <= 16 or text.isascii():
        return False
    if _KEYCAP in text or _PICTURE_STYLE in text:
        return True
    return any(unicodedata.category(c) == "So" or ord(c) >= 0x1F000 for c in text)


def find_emoji_fonts() -> list[ImageFont.FreeTypeFont]:
    """Return the fonts of `FONTS` that Pillow finds in the system's folders of fonts."""
    fonts = []
    for name in FONTS:
        for size in _FONT_SIZES:
            with contextlib.suppress(OSError):
                fonts.append(ImageFont.truetype(name, size))
                break
    return fonts


def render_emoji(text: str) -> Image.Image:
    """Return the RGBA picture of one emoji."""
    fonts = find_emoji_fonts()
    if not fonts:
        raise MissingDependencyError(
            f"target {shown(text)} is an emoji and needs an installed colour-emoji font, found "
            "none: install one, on Debian and Ubuntu with 'apt install fonts-noto-color-emoji', or "
            "give a picture file or a built-in target"
        )
    singles = [font for font in fonts if font.getlength(text) <= 1.5 * font.getlength("\U0001f600")]
    for font in singles:
        image = _drawn_emoji(font, text)
        if image is not None:
            return image
    names = ", ".join(font.getname()[0] or "a font" for font in fonts)
    if len(singles) < len(fonts):
        raise NPAError(
            f"target {shown(text)} must be one emoji, but {names} draws several: give one of them"
        )
    raise NPAError(
        f"target {shown(text)} must be an emoji that an installed font draws in colour, but none "
        f"of {names} does: give another emoji, a picture file, or install 'fonts-noto-color-emoji'"
    )


def _drawn_emoji(font: ImageFont.FreeTypeFont, text: str) -> Image.Image | None:
    """Return text in a font's own colours as RGBA, without margin; None: it has no such glyph."""
    side = 3 * int(font.size)
    image = Image.new("RGBA", (side, side), (0, 0, 0, 0))
    try:
        ImageDraw.Draw(image).text(
            (side // 4, side // 4), text, font=font, embedded_color=True, fill=_INK
        )
    except (OSError, ValueError):
        return None
    pixels = np.asarray(image).astype(np.float32)
    # Text is drawn with colours multiplied by alpha; undone here, or edges would darken.
    pixels[..., :3] *= 255 / np.maximum(pixels[..., 3:], 1)
    solid = pixels[pixels[..., 3] > 127][:, :3]
    # A font without this emoji draws nothing; one without colours draws in the ink it is given.
    if len(solid) == 0 or np.abs(solid - _INK).max() <= 4:
        return None
    whole = Image.fromarray(pixels.round().clip(0, 255).astype(np.uint8))
    return whole.crop(image.getbbox())
