"""Pixels of picture files as RGBA in sRGB: bit depths, floats, transparent colours, profiles."""

from __future__ import annotations

import io
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageFile, ImageOps, TiffImagePlugin

from npa_envs.errors import NPAError, shown
from npa_envs.tasks.targets.notes import left_out

Mask = NDArray[np.bool_]

BRIGHT = 2.0
"""Floats of which most positive ones are above this are not on a scale where 1 is white."""

DARK = 0.25
"""Pictures of more than 8 bits whose largest value is below this, where 1 is white, are told of."""

_CLIPPED = 1.0 + 0.5 / 255.0
_SRGB_GAMMA = 1.0 / 2.2
_MODES_OF_PROFILES = {"RGB": "RGB", "GRAY": "L", "CMYK": "CMYK", "Lab": "LAB"}
_BITS, _PHOTOMETRIC, _PLANES, _SUBFILES, _SAMPLE_FORMAT = 258, 262, 284, 330, 339  # tags of TIFF
_COLOURS = 320
_SEPARATE = 2  # of _PLANES
_SIGNED, _FLOAT = 2, 3  # of _SAMPLE_FORMAT
_NATIVE_MODES = {"F;32BF": "F;32NF", "I;32BS": "I;32NS", "I;16BS": "I;16NS"}


def to_rgba(opened: ImageFile.ImageFile, content: bytes, name: str) -> Image.Image:
    """Return a loaded picture as RGBA, upright, in sRGB; `content` has the bytes of its file.

    Samples are scaled by the file's bit depth; white is 1 for floats. A colour that a PNG names
    transparent becomes so, and so does NaN. An embedded colour profile is applied. What is not
    used is told by `left_out`, which calls the file `name`.
    """
    white, inverted, kind = _scale_of(opened)
    tags: Any = getattr(opened, "tag_v2", {})
    if getattr(opened, "is_animated", False) or _SUBFILES in tags:
        left_out(name, "all its frames, pages or pictures but the first")
    is_png = opened.format == "PNG"
    image = ImageOps.exif_transpose(opened)
    palette = tags.get(_COLOURS, ()) if image.mode == "P" else ()
    if 0 < max(palette, default=0) < 256:
        # Some programs write colours of 8 bits, of which Pillow takes the upper half of 16.
        image.putpalette(np.array(palette, np.uint8).reshape(3, -1).T.tobytes())
    there = _not_transparent(image, content) if is_png else None
    if image.mode.startswith("I") or image.mode == "F" or kind == _SIGNED:
        image, numbers = _to_eight_bits(image, white, inverted, kind, name)
        there = numbers if there is None else there & numbers
    if image.mode == "La":
        image = image.convert("LA")
    rgba = image.convert("RGB" if image.mode in ("LAB", "CMYK") else "RGBA").convert("RGBA")
    if image.info.get("icc_profile"):
        grey, other = image.mode in ("1", "L", "LA"), image.mode in ("LAB", "CMYK")
        own = image.convert("L") if grey else image if other else rgba.convert("RGB")
        if (colours := _in_srgb(own, image.info["icc_profile"], name)) is not None:
            colours.putalpha(rgba.getchannel("A"))
            rgba = colours
    elif is_png and "srgb" not in image.info:
        gamma = image.info.get("gamma", _SRGB_GAMMA)
        if abs(gamma / _SRGB_GAMMA - 1.0) > 0.05:
            left_out(name, f"its gamma of {gamma:g}; colours are read as sRGB")
    if there is not None:
        alpha = np.asarray(rgba.getchannel("A")) * there
        rgba.putalpha(Image.fromarray(alpha.astype(np.uint8)))
    return rgba


def correct_tiles(opened: ImageFile.ImageFile) -> None:
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


def kind_of_tiff(content: bytes) -> str:
    """Return what the samples of a TIFF file are, for an error; "" for another file."""
    if not content.startswith(tuple(TiffImagePlugin.PREFIXES)):
        return ""
    try:
        tags = TiffImagePlugin.ImageFileDirectory_v2(content[: 16 if content[2] == 43 else 8])
        file = io.BytesIO(content)
        file.seek(tags.next)
        tags.load(file)
        numbers = [tags.get(tag) for tag in (_BITS, _SAMPLE_FORMAT, _PHOTOMETRIC)]
    except Exception:
        # Damaged directories raise exceptions of many kinds.
        return "TIFF with a damaged directory"
    return "TIFF of bits {}, sample format {}, photometric {}".format(*map(shown, numbers))


def _scale_of(opened: ImageFile.ImageFile) -> tuple[float, bool, int]:
    """Return a grey picture's sample that is white, whether 0 is so instead, and a sample format.

    The format is 1 for unsigned integers, else `_SIGNED` or `_FLOAT`.
    """
    if opened.format != "TIFF":
        # Pillow scales the samples of PGM files to 16 bits.
        return (1.0, False, _FLOAT) if opened.mode == "F" else (65535.0, False, 1)
    tags: Any = getattr(opened, "tag_v2", {})
    kind, bits = tags.get(_SAMPLE_FORMAT, (1,))[0], tags.get(_BITS, (1,))[0]
    # Pillow inverts up to 8 bits only.
    inverted = tags.get(_PHOTOMETRIC) == 0
    white = 1.0 if kind == _FLOAT else 2.0 ** (bits - (kind == _SIGNED)) - 1.0
    return white, inverted, kind


def _to_eight_bits(
    image: Image.Image, white: float, inverted: bool, kind: int, name: str
) -> tuple[Image.Image, Mask]:
    """Return a grey picture in 8 bits, and where its samples are numbers; see `_scale_of`."""
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
        levels = 1.0 - levels
    elif 0.0 < largest < DARK:
        text = f"its largest value is {largest * white:g} of {white:.10g}: scale its values"
        left_out(name, text, what="dark")
    levels = np.where(numbers, levels, 0.0) * 255.0
    grey = Image.fromarray(levels.clip(0, 255).astype(np.uint8))
    grey.info = image.info
    return grey, numbers


def _not_transparent(image: Image.Image, content: bytes) -> Mask | None:
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
            lower = np.asarray(ImageOps.exif_transpose(low))
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
