"""A small network that tells formula-made pictures apart, as a source of features for textures.

After Kataoka et al., arXiv 2101.08515: pictures are drawn by formula as they are needed, so no data
set is downloaded. A class is a formula: an iterated function system, a shape in rows, stripes,
cells or noise; where, how large, how turned and in which colours is drawn anew for each picture.
Pictures have the channels of `Texture.joint_image`: colours, black where nothing is, and the root
of density.

    python benchmarks/formula_network.py train --out formula.safetensors   # minutes of one core
    python benchmarks/formula_network.py draw --out pictures.png
"""

from __future__ import annotations

import argparse
import math
import time
from collections.abc import Callable
from pathlib import Path

import torch
import torch.nn.functional as F
from PIL import Image
from safetensors.torch import load_file, save_file
from torch import Tensor, nn

SIDE = 32
"""Pixels along each side of a picture."""

FRACTALS, SHAPES, STRIPES, CELLS, NOISES = 48, 48, 32, 16, 16
"""Classes of each kind."""

CLASSES = FRACTALS + SHAPES + STRIPES + CELLS + NOISES
"""Formulas that are told apart."""

WIDTHS = (24, 48, 80, 112)
"""Features of each level; each level has half the resolution of the one before."""

POINTS = 4096
"""Points of a fractal that are kept."""


def plane(count: int, generator: torch.Generator, turn: float) -> tuple[Tensor, Tensor]:
    """Return coordinates of pixels [pixels], [count, SIDE, SIDE] each, turned and shifted.

    Args:
        count: Pictures.
        generator: What is drawn from.
        turn: Largest turn to either side [radians].
    """
    axis = torch.arange(SIDE) + 0.5
    down, across = torch.meshgrid(axis, axis, indexing="ij")
    angle = between(-turn, turn, count, generator=generator)
    shift = between(0.0, 64.0, 2, count, generator=generator)
    cos, sin = angle.cos(), angle.sin()
    return cos * across - sin * down + shift[0], sin * across + cos * down + shift[1]


def between(low: float, high: float, *shape: int, generator: torch.Generator) -> Tensor:
    """Return uniform numbers, of the shape with two more axes of length 1."""
    return low + (high - low) * torch.rand(*shape, 1, 1, generator=generator)


def edge(height: Tensor) -> Tensor:
    """Return what is covered where a height [pixels] above an edge is given: 0 to 1."""
    return (height + 0.5).clamp(0.0, 1.0)


Drawing = Callable[[Tensor, torch.Generator], tuple[Tensor, Tensor]]
"""Draws what is covered, and where in the second colour, from classes of one kind; [B, SIDE, SIDE]
each."""


class Pictures:
    """Formulas, and pictures of them.

    Args:
        seed: What the formulas are drawn from.
    """

    def __init__(self, seed: int) -> None:
        generator = torch.Generator().manual_seed(seed)
        self.fractals = torch.stack([_fractal(generator) for _ in range(FRACTALS)])
        """Points of each fractal and which map each came from, [FRACTALS, POINTS, 3]."""
        rows = torch.rand(SHAPES, 3, generator=generator)
        corners = torch.arange(SHAPES) // 2 % 6 + 1.0
        self.shapes = torch.cat((corners[:, None], rows), 1)
        """Corners and three exponents of each shape, [SHAPES, 4]; every second one is a rim."""

    def draw(self, classes: Tensor, generator: torch.Generator) -> tuple[Tensor, Tensor]:
        """Return pictures, [B, 4, SIDE, SIDE], and the colours of thing and ground, [B, 6].

        Args:
            classes: The formula of each, shape [B].
            generator: What else is drawn from.
        """
        count = len(classes)
        cover = torch.zeros(count, SIDE, SIDE)
        second = torch.zeros(count, SIDE, SIDE)
        first = 0
        kinds: tuple[tuple[int, Drawing], ...] = (
            (FRACTALS, self._draw_fractals),
            (SHAPES, self._draw_shapes),
            (STRIPES, _draw_stripes),
            (CELLS, _draw_cells),
            (NOISES, _draw_noises),
        )
        for size, drawn in kinds:
            chosen = ((classes >= first) & (classes < first + size)).nonzero()[:, 0]
            if len(chosen):
                cover[chosen], second[chosen] = drawn(classes[chosen] - first, generator)
            first += size
        colours = torch.rand(count, 3, 3, generator=generator)
        one, two, ground = colours[..., None, None].unbind(1)
        mixed = torch.lerp(one, two, second[:, None])
        filled = (torch.rand(count, 1, 1, 1, generator=generator) < 0.5).float()
        cover = cover[:, None]
        behind = ground * filled
        density = torch.maximum(cover, filled)
        images = torch.cat((cover * mixed + (1.0 - cover) * behind, density), 1)
        # As soft as particles draw, and as uneven.
        soft = F.avg_pool2d(F.pad(images, (1, 1, 1, 1), mode="replicate"), 3, stride=1)
        images = torch.lerp(images, soft, between(0.0, 1.0, count, 1, generator=generator))
        images = images * (1.0 + 0.1 * torch.randn(count, 1, SIDE, SIDE, generator=generator))
        images = images.clamp(0.0, 1.5)
        images[:, 3] = (images[:, 3] + 1e-6).sqrt()
        return images, torch.cat((colours[:, 0], behind[:, :, 0, 0]), 1)

    def _draw_fractals(self, classes: Tensor, generator: torch.Generator) -> tuple[Tensor, Tensor]:
        points = self.fractals[classes]
        count = len(classes)
        angle = between(-0.3, 0.3, count, generator=generator)[..., 0]
        size = between(0.2, 0.4, count, generator=generator)[..., 0] * SIDE
        across = size * (angle.cos() * points[..., 0] - angle.sin() * points[..., 1])
        down = size * (angle.sin() * points[..., 0] + angle.cos() * points[..., 1])
        shift = SIDE * torch.rand(2, count, 1, generator=generator)
        column = (across + shift[0]).floor().long() % SIDE
        row = (down + shift[1]).floor().long() % SIDE
        place = row * SIDE + column
        hits = torch.zeros(count, SIDE * SIDE)
        hits.scatter_add_(1, place, torch.ones_like(across))
        marked = torch.zeros(count, SIDE * SIDE).scatter_add_(1, place, points[..., 2].contiguous())
        cover = 1.0 - torch.exp(-hits * 0.5)
        shape = (count, SIDE, SIDE)
        return cover.view(shape), (marked / hits.clamp_min(1.0)).view(shape)

    def _draw_shapes(self, classes: Tensor, generator: torch.Generator) -> tuple[Tensor, Tensor]:
        count = len(classes)
        x, y = plane(count, generator, 0.2)
        size = between(3.0, 8.0, count, generator=generator)
        gap = size * between(2.2, 3.2, count, generator=generator)
        line = (y / gap).floor()
        x = x + 0.5 * gap * (line % 2.0) * (torch.rand(count, 1, 1, generator=generator) < 0.5)
        cell = (x / gap).floor()
        x, y = x - (cell + 0.5) * gap, y - (line + 0.5) * gap
        distance, angle = torch.hypot(x, y), torch.atan2(y, x)
        corners, bend, one, two = (part[:, None, None] for part in self.shapes[classes].T)
        # Gielis' superformula (2003).
        wave = 0.25 * corners * (angle + 0.5 * math.pi)
        lobes = wave.cos().abs() ** (1.0 + 6.0 * one) + wave.sin().abs() ** (1.0 + 6.0 * two)
        radius = size * (lobes.clamp_min(1e-3) ** (-1.0 / (0.8 + 4.0 * bend))).clamp_max(1.6) / 1.2
        cover = edge(radius - distance)
        inner = edge(radius * 0.6 - distance)
        rim = (classes % 2)[:, None, None] == 1
        other = torch.where(rim, torch.zeros_like(cover), ((cell + line) % 2.0))
        return torch.where(rim, cover - inner, cover), other


def _fractal(generator: torch.Generator) -> Tensor:
    """Return points of an iterated function system that fills enough and not too much."""
    while True:
        maps = 3 + int(torch.randint(2, (), generator=generator))
        angles = 2.0 * math.pi * torch.rand(maps, 2, generator=generator)
        sizes = 0.3 + 0.5 * torch.rand(maps, 2, generator=generator)
        turns = torch.stack((angles.cos(), -angles.sin(), angles.sin(), angles.cos()), -1)
        turns = turns.view(maps, 2, 2, 2)
        linear = turns[:, 0] @ torch.diag_embed(sizes) @ turns[:, 1]
        offset = 2.0 * torch.rand(maps, 2, generator=generator) - 1.0
        points = torch.zeros(POINTS, 2)
        for _ in range(24):
            chosen = torch.randint(maps, (POINTS,), generator=generator)
            points = (linear[chosen] @ points[..., None])[..., 0] + offset[chosen]
        points = points - points.mean(0)
        points = points / points.square().mean().sqrt()
        place = ((points + 2.5) * 0.2 * SIDE).long().clamp(0, SIDE - 1)
        filling = len(torch.unique(place[:, 0] * SIDE + place[:, 1])) / SIDE**2
        if 0.12 < filling < 0.45:
            return torch.cat((points, (chosen[:, None] % 2).float()), 1)


def _draw_stripes(classes: Tensor, generator: torch.Generator) -> tuple[Tensor, Tensor]:
    count = len(classes)
    x, y = plane(count, generator, math.pi / 20.0)
    angle = (classes % 8 * (math.pi / 8.0))[:, None, None]
    length = torch.where((classes // 8 % 2 == 0)[:, None, None], 5.0, 10.0)
    length = length * between(0.8, 1.25, count, generator=generator)
    along, beside = x * angle.cos() + y * angle.sin(), y * angle.cos() - x * angle.sin()
    wavy = (classes // 16 == 1)[:, None, None]
    bend = torch.where(
        wavy, 0.25 * length * torch.sin(2.0 * math.pi * beside / (2.0 * length)), 0.0
    )
    share = between(0.25, 0.65, count, generator=generator)
    place = (along + bend) / length
    height = length * (0.5 * share - (place % 1.0 - 0.5).abs())
    return edge(height), place.floor() % 2.0


def _draw_cells(classes: Tensor, generator: torch.Generator) -> tuple[Tensor, Tensor]:
    count = len(classes)
    x, y = plane(count, generator, math.pi)
    size = torch.where((classes % 2 == 0)[:, None, None], 6.0, 11.0)
    size = size * between(0.85, 1.2, count, generator=generator)
    x, y = x / size, y / size
    jitter = (0.3 + 0.7 * (classes // 2 % 2))[:, None, None]
    column, row = x.floor(), y.floor()
    salt = between(0.0, 100.0, 2, count, generator=generator)
    distances, colours = [], []
    for down in (-1.0, 0.0, 1.0):
        for across in (-1.0, 0.0, 1.0):
            i, j = column + across, row + down
            p, q = _hash(i, j, salt[0]), _hash(j, i, salt[1])
            away = torch.hypot(i + 0.5 + jitter * (p - 0.5) - x, j + 0.5 + jitter * (q - 0.5) - y)
            distances.append(away)
            colours.append((p > 0.5).float())
    found = torch.stack(distances)
    nearest = found.topk(2, dim=0, largest=False)
    first, second = nearest.values
    kind = (classes // 4)[:, None, None]
    heights = torch.where(kind == 0, 0.35 - first, second - first - 0.12)
    heights = torch.where(kind == 2, 0.12 - (second - first), heights)
    heights = torch.where(kind == 3, 0.08 - (first - 0.35).abs(), heights)
    colour = torch.stack(colours).gather(0, nearest.indices[:1])[0]
    return edge(heights * size), colour


def _hash(i: Tensor, j: Tensor, salt: Tensor) -> Tensor:
    """Return a number from 0 to 1 for each cell, always the same."""
    return (torch.sin(12.9898 * i + 78.233 * j + salt) * 43758.5453).frac().abs()


def _draw_noises(classes: Tensor, generator: torch.Generator) -> tuple[Tensor, Tensor]:
    count = len(classes)
    down = torch.fft.fftfreq(SIDE)[:, None]
    across = torch.fft.rfftfreq(SIDE)
    octave = torch.log2(torch.hypot(down, across).clamp_min(1e-6) / 0.25)
    away = octave + (classes % 4)[:, None, None] * 0.75
    turn = torch.atan2(down, across)
    leaning = (classes // 4 % 2)[:, None, None]
    gain = torch.exp(-4.0 * away.square()) * torch.where(leaning == 1, turn.cos() ** 8, 1.0)
    waves = torch.fft.rfft2(torch.randn(2, count, SIDE, SIDE, generator=generator)) * gain
    fields = torch.fft.irfft2(waves, s=(SIDE, SIDE))
    fields = fields / fields.square().mean(dim=(-1, -2), keepdim=True).sqrt()
    sharp = torch.where((classes // 8)[:, None, None] == 1, 4.0, 0.8)
    return torch.sigmoid(sharp * fields[0]), (fields[1] > 0.0).float()


class FormulaNetwork(nn.Module):
    """Convolutions with means of 2 x 2 places between them; a class and two colours."""

    def __init__(self) -> None:
        super().__init__()
        layers, width = [], 4
        for following in WIDTHS:
            layers.append(nn.Conv2d(width, following, 3, bias=False))
            width = following
        self.convolutions = nn.ModuleList(layers)
        self.norms = nn.ModuleList(nn.BatchNorm2d(width) for width in WIDTHS)
        self.head = nn.Linear(WIDTHS[-1] + WIDTHS[-2], CLASSES + 6)

    def forward(self, images: Tensor) -> Tensor:
        """Return scores of classes and two colours, [B, CLASSES + 6]."""
        field = images
        means = []
        for number, (layer, norm) in enumerate(zip(self.convolutions, self.norms, strict=True)):
            if number:
                field = F.avg_pool2d(field, 2)
            field = norm(layer(F.pad(field, (1, 1, 1, 1), mode="reflect"))).relu()
            means.append(field.mean(dim=(2, 3)))
        scores: Tensor = self.head(torch.cat(means[-2:], 1))
        return scores

    def folded(self) -> dict[str, Tensor]:
        """Return weights and biases of the convolutions with the normalisation in them."""
        result = {}
        for number, (layer, norm) in enumerate(zip(self.convolutions, self.norms, strict=True)):
            gain = norm.weight / (norm.running_var + norm.eps).sqrt()
            result[f"weight{number}"] = (layer.weight * gain[:, None, None, None]).half()
            result[f"bias{number}"] = (norm.bias - norm.running_mean * gain).half()
        return {name: tensor.detach().contiguous() for name, tensor in result.items()}


class FormulaFeatures:
    """The image and what each level of a trained network sees.

    Args:
        file: The network's weights, as `train` writes them.
        like: An image of the dtype and on the device that is to be described, [4, R, R].
    """

    def __init__(self, file: str | Path, like: Tensor) -> None:
        weights = load_file(file)
        self.layers = [
            (weights[f"weight{number}"].to(like), weights[f"bias{number}"].to(like))
            for number in range(len(WIDTHS))
        ]
        """Weights and biases of the convolutions."""

    def __call__(self, images: Tensor, *, wrap: bool) -> list[Tensor]:
        """Return the images and the fields of all levels, [B, F, R', R'] each, ever coarser.

        Args:
            images: The images, shape [B, 4, R, R].
            wrap: Whether their opposite edges meet; otherwise they are mirrored at their edges.
        """
        mode = "circular" if wrap else "reflect"
        found = [images]
        for number, (weight, bias) in enumerate(self.layers):
            field = F.avg_pool2d(found[-1], 2) if number else images
            found.append(F.conv2d(F.pad(field, (1, 1, 1, 1), mode=mode), weight, bias).relu())
        return found


def train(arguments: argparse.Namespace) -> None:
    """Train the network and write its weights, in float16."""
    torch.manual_seed(arguments.seed)
    generator = torch.Generator().manual_seed(arguments.seed + 1)
    pictures = Pictures(arguments.seed)
    network = FormulaNetwork()
    print(sum(p.numel() for p in network.parameters()), "numbers")
    optimiser = torch.optim.AdamW(network.parameters(), lr=3e-3, weight_decay=0.01)
    schedule = torch.optim.lr_scheduler.OneCycleLR(
        optimiser, max_lr=3e-3, total_steps=arguments.iterations, pct_start=0.1
    )
    begun, right, seen = time.process_time(), 0.0, 0
    for number in range(arguments.iterations):
        classes = torch.randint(CLASSES, (arguments.batch,), generator=generator)
        images, colours = pictures.draw(classes, generator)
        scores = network(images)
        loss = F.cross_entropy(scores[:, :CLASSES], classes, label_smoothing=0.05)
        loss = loss + 3.0 * F.mse_loss(scores[:, CLASSES:], colours)
        optimiser.zero_grad()
        loss.backward()
        optimiser.step()
        schedule.step()
        right += float((scores[:, :CLASSES].argmax(1) == classes).float().sum())
        seen += len(classes)
        if (number + 1) % 100 == 0:
            error = float((scores[:, CLASSES:].detach() - colours).square().mean().sqrt())
            seconds = time.process_time() - begun
            print(f"{number + 1} {right / seen:.3f} {error:.3f} {seconds:.0f} s", flush=True)
            right, seen = 0.0, 0
    network.eval()
    with torch.no_grad():
        classes = torch.arange(CLASSES).repeat(8)
        images, colours = pictures.draw(classes, generator)
        scores = network(images)
        share = float((scores[:, :CLASSES].argmax(1) == classes).float().mean())
        print(f"new pictures: {share:.3f} right of {CLASSES} classes")
    save_file(network.folded(), arguments.out)


def draw(arguments: argparse.Namespace) -> None:
    """Draw a picture of each class."""
    generator = torch.Generator().manual_seed(arguments.seed + 1)
    images, _ = Pictures(arguments.seed).draw(torch.arange(CLASSES), generator)
    colour = images[:, :3].clamp(0.0, 1.0)
    sheet = colour.view(-1, 16, 3, SIDE, SIDE).permute(0, 3, 1, 4, 2).flatten(0, 1).flatten(1, 2)
    Image.fromarray((255.0 * sheet).byte().numpy()).save(arguments.out)


def main() -> None:
    """Read the arguments and do what they say."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("what", choices=("train", "draw"))
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--iterations", type=int, default=3000)
    parser.add_argument("--batch", type=int, default=64)
    parser.add_argument("--seed", type=int, default=0)
    arguments = parser.parse_args()
    {"train": train, "draw": draw}[arguments.what](arguments)


if __name__ == "__main__":
    main()
