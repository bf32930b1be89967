"""Draw the figures of the page on concepts, `docs/images/concept_*.webp`, from a growing gecko.

    python docs/scripts/draw_concepts.py

It takes half a minute on a CPU and needs matplotlib. Draw anew when the gecko's rule changes.
"""

from __future__ import annotations

import math
from typing import Any

import matplotlib.pyplot as plt
import torch
from films import IMAGES
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Circle, Rectangle
from torch import Tensor

import npa_envs
from npa_envs.atomic_files import atomic_path
from npa_envs.reference import smoothing_kernel
from npa_envs.training.task_of_rule import task_of_rule

SEED = 1_000_001
GROWN = 40
"""Steps after which the gecko is looked at: it has a shape, and still moves."""

PLACE = (0.16, 0.28)
"""Near which particle the figures look [length units]."""

BLUE, RED, GREY = "#1f5fbf", "#c0392b", "#c8ccd2"

plt.rcParams.update({"font.size": 10, "axes.titlesize": 11, "figure.dpi": 150})


def growing_world() -> tuple[npa_envs.NPARule, Any, Tensor, Tensor]:
    """Return the gecko's rule and task, and a world that is about to become one."""
    rule = npa_envs.load_rule("gecko")
    task = task_of_rule("gecko", rule, torch.device("cpu")).task
    generator = torch.Generator().manual_seed(SEED)
    x, s, *_ = task.seed(1, generator=generator)
    with torch.no_grad():
        x, s = npa_envs.rollout(rule, x, s, GROWN, update_prob=0.5, generator=generator)
    return rule, task, x, s


def colours(s: Tensor) -> Tensor:
    """Return the colours of states [B, N, C] of the first world, shape [N, 3]."""
    return (s[0, :, -3:] + 0.5).clamp(0.0, 1.0)


def bare(axes: Axes, title: str) -> None:
    """Leave only the picture and its title."""
    axes.set_title(title)
    axes.set_aspect("equal")
    axes.set_xticks([])
    axes.set_yticks([])
    for spine in axes.spines.values():
        spine.set_color(GREY)


def look_at(axes: Axes, centre: Tensor, half_width: float) -> None:
    """Show a square around a place."""
    axes.set_xlim(float(centre[0]) - half_width, float(centre[0]) + half_width)
    axes.set_ylim(float(centre[1]) - half_width, float(centre[1]) + half_width)


def arrow(axes: Axes, start: Tensor, along: Tensor, length: float, colour: str) -> None:
    """Draw an arrow of a length from a place."""
    step = along / along.norm() * length
    axes.annotate(
        "",
        xy=(start + step).tolist(),
        xytext=start.tolist(),
        arrowprops={"arrowstyle": "-|>", "color": colour, "lw": 2.0, "shrinkA": 0, "shrinkB": 0},
    )


def save(figure: Figure, name: str) -> None:
    """Write a figure to the pages' images."""
    figure.tight_layout()
    with atomic_path(IMAGES / f"concept_{name}.webp") as temporary:
        figure.savefig(
            temporary, format="webp", facecolor="white", pil_kwargs={"quality": 88, "method": 6}
        )
    plt.close(figure)


def draw_perception(task: Any, x: Tensor, s: Tensor) -> None:
    """Draw a world, a particle's neighbours, and the four things that it perceives."""
    eps, (places, colour) = task.eps, (x[0], colours(s))
    fields = npa_envs.perception_fields(x, s, eps)
    who = int((places - torch.tensor(PLACE)).norm(dim=1).argmin())
    centre = places[who]
    distance = (places - centre).norm(dim=1)
    near = distance < eps
    figure, (whole, close, seen) = plt.subplots(1, 3, figsize=(10.0, 3.7))

    whole.scatter(*places.T, c=colour, s=1.2, linewidths=0)
    side = 3.2 * eps
    corner = (float(centre[0]) - side / 2, float(centre[1]) - side / 2)
    whole.add_patch(Rectangle(corner, side, side, fill=False, color="black", lw=1.0))
    look_at(whole, places.mean(dim=0), 0.95)
    bare(whole, f"A world of {len(places)} particles")

    close.scatter(*places[~near].T, c=GREY, s=9, linewidths=0)
    close.scatter(*places[near].T, c=colour[near], s=14, linewidths=0)
    close.add_patch(Circle(centre.tolist(), eps, fill=False, color="black", lw=1.2))
    close.scatter(*centre, c="black", s=40, zorder=3)
    close.annotate("ε", (centre + torch.tensor([0.45, -0.2]) * eps).tolist(), fontsize=13)
    close.plot(*zip(centre.tolist(), (centre + torch.tensor([eps, 0.0])).tolist(), strict=True),
               color="black", lw=1.0)  # fmt: skip
    look_at(close, centre, side / 2)
    bare(close, f"One of them has {int(near.sum()) - 1} neighbours")

    seen.add_patch(Circle(centre.tolist(), eps, fill=False, color="black", lw=1.2))
    weight = smoothing_kernel(distance.square(), eps, 2)
    seen.scatter(*places[near].T, c=-weight[near], cmap="Blues_r", s=14, linewidths=0,
                 vmax=float(weight.max()) * 0.35)  # fmt: skip
    # The channel that changes most here stands for all of them.
    change = fields.grad1[0, who]
    arrow(seen, centre, fields.drho[0, who], 0.85 * eps, RED)
    arrow(seen, centre, change[change.norm(dim=1).argmax()], 0.85 * eps, BLUE)
    seen.scatter(*centre, c="black", s=40, zorder=3)
    words = (
        ("own state s", "black"),
        ("mean state around it, s̄", "#5b8fc7"),
        ("where states change, ∇s", BLUE),
        ("where it gets denser, ∇ρ", RED),
    )
    for k, (text, tone) in enumerate(words):
        seen.text(0.03, 0.98 - 0.07 * k, text, transform=seen.transAxes, color=tone, va="top")
    look_at(seen, centre - torch.tensor([0.0, -0.5]) * eps, side / 2)
    bare(seen, "What it perceives")
    save(figure, "perception")


def draw_step(rule: npa_envs.NPARule, task: Any, x: Tensor, s: Tensor) -> None:
    """Draw a step of some particles: density, perceived gradient, the rule's answer, the update."""
    eps, places = task.eps, x[0]
    centre = places[int((places - torch.tensor(PLACE)).norm(dim=1).argmin())]
    shown = ((places - centre).abs() < 1.3 * eps).all(dim=1)
    few = shown & (torch.arange(len(places)) % 2 == 0)
    fields = npa_envs.perception_fields(x, s, eps)
    with torch.no_grad():
        z = npa_envs.perceive(x, s, eps=eps, eps0=rule.eps0)
        wish = rule(z)[0, :, :2]
        wish = wish / (1.0 + wish.norm(dim=1, keepdim=True))
        moved, _ = npa_envs.step(
            rule, x, s, update_prob=0.5, generator=torch.Generator().manual_seed(0)
        )
    awake = (moved[0] - places).norm(dim=1) > 0
    figure, parts = plt.subplots(1, 4, figsize=(10.0, 2.9))
    titles = (
        "1  How dense is it here?",
        "2  Which way does it change?",
        "3  The network answers",
        "4  About half of them obey",
    )
    for axes, title in zip(parts, titles, strict=True):
        look_at(axes, centre, 0.75 * eps)
        bare(axes, title)
    dots = {"s": 26, "linewidths": 0}
    parts[0].scatter(*places[shown].T, c=fields.rho[0, shown], cmap="viridis", **dots)
    for axes, vectors, tone in ((parts[1], fields.drho[0], RED), (parts[2], wish, BLUE)):
        axes.scatter(*places[shown].T, c=GREY, **dots)
        axes.quiver(*places[few].T, *vectors[few].T, color=tone, width=0.008)
    parts[3].scatter(*places[shown & ~awake].T, c=GREY, **dots)
    parts[3].scatter(*moved[0, shown & awake].T, c=colours(s)[shown & awake], **dots)
    ways = moved[0] - places
    parts[3].quiver(*places[shown & awake].T, *ways[shown & awake].T, color="black", width=0.006,
                    angles="xy", scale_units="xy", scale=1.0)  # fmt: skip
    save(figure, "step")


def draw_hydrodynamics() -> None:
    """Draw why sums over neighbours are weighted, and why gradients are corrected."""
    eps = 0.2
    figure, (grid, free, slope) = plt.subplots(1, 3, figsize=(10.0, 3.4))
    axis = torch.arange(-3, 4).float()
    cells = torch.cartesian_prod(axis, axis)
    near = cells.abs().amax(dim=1) <= 1
    grid.scatter(*cells[~near].T, c=GREY, s=230, marker="s", linewidths=0)
    grid.scatter(*cells[near].T, c="#8fb4e3", s=230, marker="s", linewidths=0)
    grid.scatter(0, 0, c="black", s=230, marker="s", linewidths=0)
    look_at(grid, torch.zeros(2), 3.4)
    bare(grid, "A grid: fixed neighbours")

    generator = torch.Generator().manual_seed(3)
    radius = torch.rand(900, generator=generator).sqrt()
    angle = 2 * math.pi * torch.rand(900, generator=generator)
    x = torch.stack((radius * angle.cos(), radius * angle.sin()), dim=1)[None]
    x[0, 0] = 0.0
    weight = smoothing_kernel(x[0].square().sum(dim=1), eps, 2)
    far = weight == 0
    free.scatter(*x[0, far].T, c=GREY, s=10, linewidths=0)
    free.scatter(*x[0, ~far].T, c=-weight[~far], cmap="Blues_r", s=26, linewidths=0)
    free.scatter(0, 0, c="black", s=34)
    free.add_patch(Circle((0.0, 0.0), eps, fill=False, color="black", lw=1.2))
    look_at(free, torch.zeros(2), 2.0 * eps)
    bare(free, "Particles: near ones weigh more")

    # States that grow by 1 from left to right, from one end of a length unit to the other.
    fields = npa_envs.perception_fields(x, x[..., :1].contiguous(), eps)
    reach = x[0].norm(dim=1)
    slope.scatter(reach, fields.grad0[0, :, 0, 0], s=6, c=RED, linewidths=0, label="plain sum")
    slope.scatter(reach, fields.grad1[0, :, 0, 0], s=6, c=BLUE, linewidths=0, label="corrected")
    slope.axhline(1.0, color="black", lw=0.8)
    slope.set(xlabel="distance from the middle of a disk", ylim=(0.0, 2.0))
    slope.set_title("A gradient that should be 1")
    slope.legend(loc="lower left", markerscale=2.0, frameon=False)
    save(figure, "sph")


def main() -> None:
    """Draw all figures."""
    rule, task, x, s = growing_world()
    draw_perception(task, x, s)
    draw_step(rule, task, x, s)
    draw_hydrodynamics()


if __name__ == "__main__":
    main()
