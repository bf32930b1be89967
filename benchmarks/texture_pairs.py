"""Does the texture metric see textures? Twelve pairs whose order is known by construction.

Of each pair, another piece of a texture must be nearer to the texture than a spoiled copy of it.
Both are drawn by 16 384 particles, as a rule could draw them at best, at 256 x 256 pixels. The
pairs were fixed before the metric was chosen. Pieces of photographs are corners of those that
scikit-image ships (`pip install scikit-image`): the target is the first, the other piece the last.
Other pieces of built-in textures are drawn with another seed.

    python benchmarks/texture_pairs.py
    python benchmarks/texture_pairs.py --all    # every spoiled copy of every texture
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable
from typing import Any

import numpy as np
import torch
from scipy.ndimage import gaussian_filter

from npa_envs.measure.texture_metric import TextureMetric
from npa_envs.tasks.targets.textures import TextureTarget, draw_pattern
from npa_envs.tasks.texture import Texture, TextureConfig

Array = np.ndarray[Any, Any]
SIDE = 256
"""Side of all pictures [pixels]."""
PARTICLES = 16_384
"""Number of particles that draw a picture."""
PHOTOGRAPHS = ("gravel", "brick", "grass")
PATTERNS = ("cells", "maze")
PAIRS = (
    ("gravel", "phase scramble"),
    ("gravel", "grey noise"),
    ("gravel", "blur"),
    ("gravel", "half scale"),
    ("brick", "phase noise"),
    ("brick", "double scale"),
    ("brick", "half contrast"),
    ("grass", "grey noise"),
    ("grass", "phase scramble"),
    ("grass", "double scale"),
    ("cells", "pixel shuffle"),
    ("maze", "phase scramble"),
)
"""Textures, each with what is done to the copy that must be farther than another piece."""


def pieces(texture: str) -> tuple[Array, Array, Array]:
    """Return a texture, another piece of it, and it at half scale, in [0, 1], [SIDE, SIDE, 3]."""
    if texture in PATTERNS:
        first, other = (draw_pattern(texture, SIDE, seed=seed)[..., :3] for seed in (0, 1))
        return first, other, np.tile(draw_pattern(texture, SIDE // 2)[..., :3], (2, 2, 1))
    import skimage.data

    photograph = np.repeat(getattr(skimage.data, texture)()[..., None] / 255.0, 3, axis=2)
    halved = photograph[: 2 * SIDE, : 2 * SIDE].reshape(SIDE, 2, SIDE, 2, 3).mean(axis=(1, 3))
    return photograph[:SIDE, :SIDE], photograph[-SIDE:, -SIDE:], halved


def rephased(image: Array, share: float) -> Array:
    """Return an image whose waves are shifted by random phases of at most share x π."""
    noise = np.random.default_rng(0).standard_normal(image.shape[:2])
    turned = np.exp(1j * share * np.angle(np.fft.fft2(noise)))
    waves = np.fft.fft2(image, axes=(0, 1))
    means = waves[0, 0].copy()
    waves = waves * turned[..., None]
    waves[0, 0] = means
    return np.fft.ifft2(waves, axes=(0, 1)).real.clip(0.0, 1.0)


def grey_noise(image: Array) -> Array:
    """Return blurred noise with the pixels of an image: the brighter, the higher the noise."""
    noise = np.random.default_rng(0).standard_normal(image.shape[:2])
    order = gaussian_filter(noise, 2.0, mode="wrap").ravel().argsort()
    pixels = image.reshape(-1, 3)
    result = np.empty_like(pixels)
    result[order] = pixels[pixels.sum(1).argsort(kind="stable")]
    return result.reshape(image.shape)


def shuffled(image: Array) -> Array:
    """Return an image whose pixels are in random order."""
    pixels = image.reshape(-1, 3)
    return pixels[np.random.default_rng(0).permutation(len(pixels))].reshape(image.shape)


def doubled(image: Array) -> Array:
    """Return the middle quarter of an image, twice as large."""
    start, side = len(image) // 4, len(image)
    middle = torch.tensor(image[start : start + side // 2, start : start + side // 2])
    channels = middle.movedim(-1, 0)[None]
    large = torch.nn.functional.interpolate(channels, size=(side, side), mode="bilinear")
    return large[0].movedim(0, -1).numpy()


SPOILED: dict[str, Callable[[Array], Array]] = {
    "phase scramble": lambda image: rephased(image, 1.0),
    "phase noise": lambda image: rephased(image, 0.5),
    "pixel shuffle": shuffled,
    "blur": lambda image: gaussian_filter(image, (4.0, 4.0, 0.0), mode="wrap"),
    "double scale": doubled,
    "half contrast": lambda image: 0.5 * (image + image.mean(axis=(0, 1))),
    "grey noise": grey_noise,
}
"""What is done to copies, but for half scale, which needs more of the photograph."""


def task_of(image: Array, *, tiles: bool) -> Texture:
    """Return the task whose target is an image."""
    count = round(PARTICLES * (len(image) / SIDE) ** 2)
    picture = np.concatenate((image, np.ones_like(image[..., :1])), axis=2)
    target = TextureTarget("piece", torch.tensor(picture).float(), tiles)
    config = TextureConfig(particle_count=count, resolution=len(image))
    return Texture(config, target=target)


def distances(target: Array, others: dict[str, Array], *, tiles: bool) -> dict[str, float]:
    """Return the metric's ratios of images, each drawn by particles, by their names."""
    metric = TextureMetric(task_of(target, tiles=tiles))
    drawn = {name: task_of(image, tiles=tiles).drawing(7) for name, image in others.items()}
    return {name: float(metric(picture).mean()) for name, picture in drawn.items()}


def main() -> None:
    """Run the command line."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--all", action="store_true", help="every spoiled copy of every texture")
    everything = parser.parse_args().all
    right, count, started = 0, 0, time.process_time()
    print("| texture | other piece | spoiled copy | its ratio | right |\n|---|---|---|---|---|")
    for texture in PHOTOGRAPHS + PATTERNS:
        kinds = [kind for name, kind in PAIRS if name == texture]
        if everything:
            kinds = [*SPOILED, "half scale"]
        target, other, halved = pieces(texture)
        images = {"other": other, "half scale": halved}
        images |= {kind: spoil(target) for kind, spoil in SPOILED.items()}
        wanted = {name: images[name] for name in ("other", *kinds)}
        found = distances(target, wanted, tiles=texture in PATTERNS)
        for kind in kinds:
            nearer = found["other"] < found[kind]
            right, count = right + nearer, count + 1
            near, far = f"{found['other']:.2f}", f"{found[kind]:.2f}"
            print(f"| {texture} | {near} | {kind} | {far} | {'yes' if nearer else 'no'} |")
    print(f"\n{right} of {count} right, {time.process_time() - started:.0f} s of CPU time")


if __name__ == "__main__":
    main()
