"""Picture files of every depth, transparent colour and colour profile have the right pixels."""

import io
import itertools
import struct
import sys
import zlib

import numpy as np
import pytest
from PIL import Image, ImageCms, TiffImagePlugin, TiffTags, features

from npa_envs.errors import MissingDependencyError, NPAError
from npa_envs.tasks.targets.images import open_image, read_image
from npa_envs.tasks.targets.picture_points import load_target
from npa_envs.tasks.targets.textures import load_texture

ROWS, COLUMNS = np.mgrid[:32, :32] - 15.5
DISK = np.hypot(ROWS, COLUMNS) < 10
RING = DISK & (np.hypot(ROWS, COLUMNS) > 5)
INSIDE, OUTSIDE = (16, 8), (0, 0)


def write_png(path, samples, depth, colour_type, *chunks):
    """Write samples [H, W, ...] as a PNG with these chunks before the pixels."""
    rows = samples.reshape(len(samples), -1)
    if depth < 8:
        bits = np.unpackbits(rows.astype(np.uint8)[..., None], axis=-1)[..., 8 - depth :]
        rows = np.packbits(bits.reshape(len(rows), -1), axis=1)
    packed = rows.astype(">u2" if depth == 16 else np.uint8)
    data = b"".join(b"\0" + row.tobytes() for row in packed)
    size = samples.shape[1::-1]
    head = (b"IHDR", struct.pack(">IIBBBBB", *size, depth, colour_type, 0, 0, 0))
    with path.open("wb") as file:
        file.write(b"\x89PNG\r\n\x1a\n")
        for kind, content in (head, *chunks, (b"IDAT", zlib.compress(data)), (b"IEND", b"")):
            check = struct.pack(">I", zlib.crc32(kind + content))
            file.write(struct.pack(">I", len(content)) + kind + content + check)


def write_tiff(path, samples, *, photometric=1, order="<", packed=False, planes=1, **tags):
    """Write samples [H, W] or [H, W, S] as a TIFF of one strip, or one strip a plane."""
    samples = samples if samples.ndim == 3 else samples[..., None]
    height, width, count = samples.shape
    kind = {"u": 1, "i": 2, "f": 3}[samples.dtype.kind]
    parts = np.moveaxis(samples, -1, 0) if planes == 2 else [samples]
    strips = [part.astype(samples.dtype.newbyteorder(order)).tobytes() for part in parts]
    strips = [zlib.compress(strip) for strip in strips] if packed else strips
    lengths = [len(strip) for strip in strips]
    # From the end of the directory, to which Pillow adds its place.
    places = [sum(lengths[:k]) for k in range(len(strips))]
    values = {256: [width], 257: [height], 258: [8 * samples.dtype.itemsize] * count}
    values |= {259: [8 if packed else 1], 262: [photometric], 273: places, 277: [count]}
    values |= {278: [height], 279: lengths, 284: [planes], 339: [kind] * count}
    values |= {int(tag[1:]): value for tag, value in tags.items()}
    head = (b"II*\0" if order == "<" else b"MM\0*") + struct.pack(f"{order}I", 8)
    directory = TiffImagePlugin.ImageFileDirectory_v2(head)
    for tag, numbers in values.items():
        directory.tagtype[tag] = TiffTags.LONG
        directory[tag] = numbers
    path.write_bytes(head + directory.tobytes(8) + b"".join(strips))


def pixels(path):
    return np.asarray(open_image(path)).astype(int)


# Transparent colours of PNG.

GREYS = [(depth, key) for depth in (1, 2, 4, 8, 16) for key in {0, 1, 2**depth - 1}]


@pytest.mark.parametrize(("depth", "key"), GREYS)
def test_what_a_png_names_transparent_is_so_at_every_depth(tmp_path, depth, key):
    """A grey, and the colour of a palette, which is grey here."""
    other = key - 1 if key else key + 1
    chunks = {0: [(b"tRNS", struct.pack(">H", key))]}
    if depth < 16:
        palette = np.repeat(np.linspace(0, 255, 2**depth).astype(np.uint8), 3).tobytes()
        chunks[3] = [(b"PLTE", palette), (b"tRNS", key * b"\xff" + b"\0")]
    for colour_type, of_type in chunks.items():
        write_png(tmp_path / "ring.png", np.where(RING, other, key), depth, colour_type, *of_type)
        rgba = pixels(tmp_path / "ring.png")
        assert (rgba[..., 3] == 255 * RING).all()
        assert abs(rgba[INSIDE][0] - 255 * other / (2**depth - 1)) < 1


@pytest.mark.parametrize(
    ("depth", "key", "other"),
    [(8, (4, 8, 12), (4, 8, 13)), (16, (4660, 22136, 513), (4660, 22136, 514))],
)
def test_the_colour_that_a_png_names_transparent_is_compared_exactly(tmp_path, depth, key, other):
    samples = np.where(RING[..., None], other, key)
    # An orientation turns the picture and its transparent pixels alike.
    exif = Image.Exif()
    exif[0x0112] = 6
    chunks = (b"tRNS", struct.pack(">HHH", *key)), (b"eXIf", exif.tobytes()[6:])
    write_png(tmp_path / "ring.png", samples[:, :20], depth, 2, *chunks)
    assert (pixels(tmp_path / "ring.png")[..., 3] == 255 * np.rot90(RING[:, :20], -1)).all()


# Depths of TIFF.

TYPES = ("u1", "u2", "u4", "i1", "i2", "i4", "f4")


@pytest.mark.parametrize(("order", "packed"), [*itertools.product("<>", (False, True))])
@pytest.mark.parametrize("kind", TYPES)
@pytest.mark.parametrize("photometric", [0, 1])
def test_grey_tiffs_are_scaled_by_their_depth_or_refused(
    tmp_path, order, packed, kind, photometric
):
    """A quarter of white on white."""
    dtype = np.dtype(kind)
    white = 1.0 if dtype.kind == "f" else float(np.iinfo(dtype).max)
    levels = np.where(DISK, 0.25, 1.0)
    samples = (white * (levels if photometric else 1.0 - levels)).astype(dtype)
    path = tmp_path / "disk.tif"
    write_tiff(path, samples, photometric=photometric, order=order, packed=packed)
    read_by_pillow = photometric == 1 or kind in ("u1", "f4") or (kind == "u2" and order == "<")
    if not read_by_pillow or (kind == "u4" and order == ">"):
        with pytest.raises(NPAError, match="TIFF of a kind that Pillow does not read"):
            open_image(path)
        return
    rgba = pixels(path)
    assert abs(rgba[INSIDE][:3] - 63.75).max() < 2
    assert tuple(rgba[OUTSIDE]) == (255, 255, 255, 255)


def test_a_nearly_black_picture_stays_so_and_a_line_says_it(tmp_path, caplog):
    for kind in ("<u2", "<u4"):
        write_tiff(tmp_path / f"{kind[1:]}.tif", np.where(DISK, 200, 40).astype(kind))
        assert pixels(tmp_path / f"{kind[1:]}.tif")[..., :3].max() == 0
    write_png(tmp_path / "g.png", np.where(DISK, 255, 40), 16, 0)
    assert pixels(tmp_path / "g.png")[..., :3].max() == 0
    told = [message.partition("dark: its largest value is ")[2] for message in caplog.messages]
    tops = ("200 of 65535", "200 of 4294967295", "255 of 65535")
    assert told == [f"{top}: scale its values" for top in tops]
    # Grey whose 0 is white, and colours, of which Pillow keeps the upper 8 bits.
    caplog.clear()
    write_tiff(tmp_path / "i.tif", np.where(DISK, 65335, 65495).astype("<u2"), photometric=0)
    dark = np.where(DISK[..., None], (200, 0, 3000), 40)
    write_png(tmp_path / "c.png", dark, 16, 2)
    write_tiff(tmp_path / "c.tif", dark.astype("<u2"), photometric=2)
    shades = [pixels(tmp_path / name)[INSIDE].tolist() for name in ("i.tif", "c.png", "c.tif")]
    assert shades == [[0, 0, 0, 255], [0, 0, 11, 255], [0, 0, 11, 255]]
    told = [message.partition("dark: its largest value is ")[2] for message in caplog.messages]
    assert told == [f"{top}: scale its values" for top in ("200 of 65535", *["11 of 255"] * 2)]


@pytest.mark.parametrize(
    ("kind", "content", "told"),
    [
        (b"cHRM", struct.pack(">8I", 31270, 32900, 64000, 33000, 21000, 71000, 15000, 6000), 1),
        (b"cHRM", struct.pack(">8I", 31270, 32900, 64000, 33000, 30000, 60000, 15000, 6000), 0),
        (b"cICP", bytes((9, 16, 0, 1)), 1),
        (b"cICP", bytes((1, 13, 0, 1)), 0),
    ],
)
def test_other_primaries_of_a_png_are_told(tmp_path, caplog, kind, content, told):
    write_png(tmp_path / "c.png", np.full((4, 4, 3), (200, 60, 60)), 8, 2, (kind, content))
    assert pixels(tmp_path / "c.png")[1, 1].tolist() == [200, 60, 60, 255]
    line = "left out: its primaries (cHRM or cICP); colours are read as sRGB"
    assert [message.partition(": ")[2] for message in caplog.messages] == told * [line]


@pytest.mark.parametrize(
    ("value", "expected", "line"),
    [
        (np.nan, (0, 0, 0, 0), "what is no number (NaN) and becomes transparent, at 32 of 1024"),
        (np.inf, (255, 255, 255, 255), "values above 1, up to inf, which become white, at 32 of"),
        (37.5, (255, 255, 255, 255), "values above 1, up to 37.5, which become white, at 32 of"),
        (-np.inf, (0, 0, 0, 255), "negative values, which become black, at 32 of 1024 pixels"),
        (-0.5, (0, 0, 0, 255), "negative values, which become black, at 32 of 1024 pixels"),
        (1.0001, (255, 255, 255, 255), None),
    ],
)
def test_of_floats_1_is_white_and_a_line_tells_of_others(tmp_path, caplog, value, expected, line):
    levels = np.where(DISK, 0.5, 1.0).astype(np.float32)
    levels[0] = value
    write_tiff(tmp_path / "disk.tif", levels)
    rgba = pixels(tmp_path / "disk.tif")
    assert tuple(rgba[OUTSIDE]) == expected
    assert tuple(rgba[INSIDE]) == (127, 127, 127, 255)
    assert [line in message for message in caplog.messages] == ([True] if line else [])


def test_floats_on_another_scale_and_kinds_that_pillow_cannot_read_are_named(tmp_path):
    levels = np.where(DISK, 0.5, 1.0)
    write_tiff(tmp_path / "a.tif", (255 * levels).astype(np.float32))
    write_tiff(tmp_path / "b.tif", levels.astype(np.float16))
    write_tiff(tmp_path / "c.tif", np.stack([levels] * 3, -1).astype("<f4"), photometric=2)
    for name, message in (
        ("a", "floats, of which 1 is white, .* the largest is 255: divide them"),
        ("b", "TIFF of a kind that Pillow does not read"),
        ("c", "TIFF of a kind that Pillow does not read"),
    ):
        with pytest.raises(NPAError, match=message):
            open_image(tmp_path / f"{name}.tif")


def test_palettes_of_tiffs_with_8_bits_are_not_black(tmp_path):
    for factor in (1, 257):
        palette = [factor * level for level in (0, 200, *[0] * 254, 0, 60, *[0] * 254, 0, 30)]
        indices, entries = DISK.astype("u1"), {"t320": palette + [0] * 254}
        write_tiff(tmp_path / "disk.tif", indices, photometric=3, **entries)
        assert tuple(pixels(tmp_path / "disk.tif")[INSIDE]) == (200, 60, 30, 255)


COLOUR = (0.25, 0.5, 1.0)


@pytest.mark.parametrize(
    ("colour", "kind", "planes", "packed"),
    [([0.25], "u1", 1, False), *itertools.product([COLOUR], ["u1", "u2"], [1, 2], [False, True])],
)
@pytest.mark.parametrize("premultiplied", [False, True])
def test_alpha_of_tiffs_is_read_whether_or_not_colours_are_multiplied_by_it(
    tmp_path, colour, kind, planes, packed, premultiplied
):
    alpha = np.where(DISK, 0.75, 0.0)[..., None]
    colours = np.array(colour) * (alpha if premultiplied else DISK[..., None])
    samples = (np.iinfo(kind).max * np.concatenate([colours, alpha], -1)).round().astype(kind)
    kinds = {"photometric": {1: 1, 3: 2}[len(colour)], "planes": planes, "packed": packed}
    write_tiff(tmp_path / "disk.tif", samples, **kinds, t338=[2 - premultiplied])
    if planes == 2 and premultiplied and not packed:
        with pytest.raises(NPAError, match="of a kind that Pillow does not read"):
            open_image(tmp_path / "disk.tif")
        return
    rgba = pixels(tmp_path / "disk.tif")
    shade = COLOUR if len(colour) == 3 else 3 * colour
    assert abs(rgba[INSIDE] / 255 - (*shade, 0.75)).max() < 2 / 255
    assert (rgba[..., 3] > 0).tolist() == DISK.tolist()


# Colour profiles.


def profile(space, **tags):
    """Return the bytes of an ICC profile with these tags; its connection space is XYZ or Lab."""
    table, data = struct.pack(">I", len(tags)), b""
    for name, content in tags.items():
        place = 132 + 12 * len(tags) + len(data)
        table += name.encode() + struct.pack(">II", place, len(content))
        data += content + b"\0" * (-len(content) % 4)
    white = struct.pack(">3i", 63190, 65536, 54061)
    kind, between = (b"prtr", b"Lab ") if "A2B0" in tags else (b"mntr", b"XYZ ")
    head = struct.pack(">I4sI", 132 + len(table) - 4 + len(data), b"lcms", 0x02400000)
    head += kind + space + between + struct.pack(">6H", 2026, 1, 1, 0, 0, 0) + b"acsp"
    head += bytes(28) + white
    return head.ljust(128, b"\0") + table + data


def xyz(*numbers):
    return b"XYZ \0\0\0\0" + struct.pack(">3i", *(round(65536 * n) for n in numbers))


LINEAR = b"curv" + bytes(8)
WIDE = {
    "rXYZ": xyz(0.61, 0.311, 0.019), "gXYZ": xyz(0.205, 0.626, 0.061),
    "bXYZ": xyz(0.149, 0.063, 0.745), "wtpt": xyz(0.9642, 1.0, 0.8249),
}  # fmt: skip
RGB_PROFILE = profile(b"RGB ", **WIDE, rTRC=LINEAR, gTRC=LINEAR, bTRC=LINEAR)
GREY_PROFILE = profile(b"GRAY", wtpt=xyz(0.9642, 1.0, 0.8249), kTRC=LINEAR)
LAB_PROFILE = ImageCms.ImageCmsProfile(ImageCms.createProfile("LAB")).tobytes()


def ink_profile():
    """A profile of four inks on a grid of two: paper is white, any ink is Lab 40, 60, 40."""
    ramp = bytes(range(256))
    grid = bytes([255, 128, 128]) + 15 * bytes([102, 188, 168])
    unit = struct.pack(">9i", *(65536 * (k % 4 == 0) for k in range(9)))
    table = b"mft1\0\0\0\0" + bytes([4, 3, 2, 0]) + unit + 4 * ramp + grid + 3 * ramp
    return profile(b"CMYK", A2B0=table, wtpt=xyz(0.9642, 1.0, 0.8249))


PROFILED = {
    "RGB": ("RGB", RGB_PROFILE, "png"), "RGBA": ("RGBA", RGB_PROFILE, "png"),
    "RGB JPEG": ("RGB", RGB_PROFILE, "jpg"), "RGB WebP": ("RGB", RGB_PROFILE, "webp"),
    "palette": ("P", RGB_PROFILE, "png"), "grey": ("L", GREY_PROFILE, "png"),
    "grey with alpha": ("LA", GREY_PROFILE, "png"), "grey by RGB": ("L", RGB_PROFILE, "jpg"),
    "CMYK": ("CMYK", ink_profile(), "tif"), "CMYK JPEG": ("CMYK", ink_profile(), "jpg"),
    "Lab": ("LAB", LAB_PROFILE, "tif"),
}  # fmt: skip


@pytest.mark.parametrize("case", PROFILED)
def test_an_embedded_profile_gives_the_colours_of_littlecms(tmp_path, case):
    mode, icc, suffix = PROFILED[case]
    image = Image.new("RGB", (24, 16), (200, 60, 60)).convert(mode)
    if mode.endswith("A"):
        image.putalpha(200)
    path = tmp_path / f"plain.{suffix}"
    lossless = {"lossless": True} if suffix == "webp" else {"quality": 100}
    image.save(path, icc_profile=icc, **(lossless if suffix in ("jpg", "webp") else {}))
    stored = {"P": "RGB", "LA": "L"}.get(mode, mode)
    own = Image.open(path).convert("RGB" if case == "grey by RGB" else stored)
    source, target = ImageCms.ImageCmsProfile(io.BytesIO(icc)), ImageCms.createProfile("sRGB")
    out = "RGBA" if mode == "RGBA" else "RGB"
    expected = ImageCms.profileToProfile(own, source, target, outputMode=out).getpixel((5, 5))
    rgba = pixels(path)[5, 5]
    assert tuple(rgba[:3]) == tuple(expected[:3])
    assert rgba[3] == (200 if mode.endswith("A") else 255)
    if mode == "L":
        deep = np.full((16, 24), 257 * own.convert("L").getpixel((5, 5)))
        embedded = (b"iCCP", b"icc\0\0" + zlib.compress(icc))
        write_png(tmp_path / "deep.png", deep, 16, 0, embedded)
        assert tuple(pixels(tmp_path / "deep.png")[5, 5]) == tuple(rgba)
    if mode != "LAB":
        assert abs(rgba[:3] - np.asarray(image.convert("RGB"))[5, 5]).max() > 20


def test_a_profile_of_no_use_is_told_of_and_the_colours_stay(tmp_path, caplog):
    image = Image.new("RGB", (9, 9), (200, 60, 60))
    for icc in (b"no profile", GREY_PROFILE, RGB_PROFILE[:200]):
        image.save(tmp_path / "plain.png", icc_profile=icc)
        assert tuple(pixels(tmp_path / "plain.png")[4, 4]) == (200, 60, 60, 255)
    assert len(caplog.messages) >= 2
    assert all("left out: its colour profile" in message for message in caplog.messages)
    write_png(tmp_path / "g.png", np.full((9, 9, 3), 99), 8, 2, (b"gAMA", struct.pack(">I", 10**5)))
    assert pixels(tmp_path / "g.png")[4, 4, 0] == 99
    assert "its gamma of 1;" in caplog.messages[-1]


# What is used of a file, and the line that says it.


@pytest.mark.parametrize("case", ["opaque", "one 254", "all 254", "one transparent", "all 200"])
def test_hardly_transparent_pictures_are_cut_out_of_their_background(tmp_path, case):
    rgba = np.full((40, 40, 4), 255, np.uint8)
    rgba[12:28, 12:28, :3] = (200, 30, 30)
    corner = {"one 254": 254, "one transparent": 0}.get(case, 255)
    rgba[..., 3] = {"all 254": 254, "all 200": 200}.get(case, 255)
    rgba[0, 0, 3] = min(rgba[0, 0, 3], corner)
    Image.fromarray(rgba).save(tmp_path / "square.png")
    image, summary = read_image(tmp_path / "square.png")
    alpha = np.asarray(image)[..., 3]
    assert (alpha >= 128).sum() == 256
    assert alpha.max() == rgba[..., 3].max()
    assert summary == "square.png: 40 x 40, cut out of its background, 16 % of its pixels"


@pytest.mark.parametrize("suffix", ["gif", "png", "webp", "avif", "tif"])
def test_the_first_of_several_frames_is_read_and_a_line_says_so(tmp_path, caplog, suffix):
    if suffix == "avif" and not features.check("avif"):
        pytest.skip("this Pillow has no AVIF")
    frames = [Image.new("RGB", (32, 32), colour) for colour in ((200, 40, 40), (40, 40, 200))]
    frames[0].save(tmp_path / f"film.{suffix}", save_all=True, append_images=frames[1:])
    assert abs(pixels(tmp_path / f"film.{suffix}")[5, 5, :3] - (200, 40, 40)).max() < 8
    (message,) = caplog.messages
    assert message.endswith("left out: all its frames, pages or pictures but the first")
    frames[0].save(tmp_path / f"still.{suffix}")
    open_image(tmp_path / f"still.{suffix}")
    assert len(caplog.messages) == 1


def test_heic_is_read_by_pillow_heif_or_refused_with_its_name(tmp_path, monkeypatch):
    path = tmp_path / "photo.heic"
    path.write_bytes(b"\0\0\0\x18ftypheic\0\0\0\0mif1heic" + bytes(50))
    with monkeypatch.context() as patched:
        patched.setitem(sys.modules, "pillow_heif", None)
        with pytest.raises(MissingDependencyError, match=r"HEIC.*pip install pillow-heif"):
            open_image(path)
    pillow_heif = pytest.importorskip("pillow_heif")
    red = Image.new("RGB", (64, 64), (200, 40, 40))
    pillow_heif.from_pillow(red).save(path)
    assert abs(pixels(path)[5, 5, :3] - (200, 40, 40)).max() < 8


def test_targets_say_what_was_read_of_their_files(tmp_path):
    image = Image.new("RGBA", (60, 40))
    image.paste((200, 30, 30, 255), (10, 10, 30, 30))
    image.save(tmp_path / "red.png")
    image.convert("RGB").save(tmp_path / "opaque.jpg")
    points = {"point_count": 100}
    assert load_target(tmp_path / "red.png", **points).summary == (
        "red.png: 60 x 40, cut out by alpha, 17 % of its pixels"
    )
    kept = load_target(tmp_path / "red.png", **points, keep_background=True)
    assert kept.to("cpu").summary == "red.png: 60 x 40, its whole rectangle"
    assert load_texture(tmp_path / "red.png", resolution=8).summary == (
        "red.png: 60 x 40, its middle square of 40 x 40, alpha covers 17 %"
    )
    assert load_texture(tmp_path / "opaque.jpg", resolution=8).summary == (
        "opaque.jpg: 60 x 40, its middle square of 40 x 40, covered evenly"
    )
    assert load_target("heart", **points).summary == load_texture("cells").summary == ""
