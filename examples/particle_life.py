"""Particle Life: six kinds of particles that attract or flee each other build cells that swim.

    pip install npa-envs
    python examples/particle_life.py  # 10 s; writes particle_life.webp

The force is that of T. Mohr (particle-life.com, after J. Ventrella's Clusters). At a distance r, in
units of `RADIUS`, all repel each other below β by 1 - r/β; from β to 1 kind a is drawn to kind b by
a number of a table, times a tent: 0 at β and 1, 1 in the middle.

Both are sums of ramps Σ (c - r) over neighbours nearer than c, and a ramp is half the slope, by c,
of Σ (c - r)², which is the density gradient at ε = c without its factor. The slope is a
quotient of differences in float64; the force then differs from the formula by about as much as a
float32 does.
"""

import argparse
import math
from pathlib import Path

import torch

import npa_envs
from npa_envs.render import draw_worlds, write_webp

BOX = 1.0
"""Side of the periodic box [length units]."""
KINDS, RADIUS, BETA = 6, 0.1, 0.3
TIME_STEP, HALF_LIFE, FORCE = 0.02, 0.04, 10.0
"""Time step and the time in which friction halves a velocity [units of time]; factor of forces."""
COLOURS = [[10, 2, 2], [10, 8, 2], [2, 9, 3], [2, 9, 9], [3, 4, 10], [10, 3, 10]]
"""Tenths of red, green and blue."""


def start(count, generator):
    """Return places x [1, KINDS count, 2], kind after kind, and a table [KINDS, KINDS]."""
    x = BOX * (torch.rand(1, KINDS * count, 2, generator=generator).double() - 0.5)
    return x, 2.0 * torch.rand(KINDS, KINDS, generator=generator).double() - 1.0


def ramps(x, reach):
    """Return Σ (reach - r) r̂ of the nearer neighbours of each kind, [1, N, KINDS, 2]."""
    width = 1e-6 * RADIUS

    def squares(eps):
        counts = [x.shape[1] // KINDS] * KINDS
        gradient = npa_envs.species_fields(x, counts, eps=eps, box=BOX).drho
        return math.pi / 30.0 * eps**5 * gradient  # Σ (eps - r)² r̂

    return (squares(reach + width) - squares(reach - width)) / (4.0 * width)


def force(x, table):
    """Return the sum of forces on each particle, dimensionless, [1, N, 2]."""
    near, middle, far = (ramps(x, c * RADIUS) / RADIUS for c in (BETA, (1.0 + BETA) / 2.0, 1.0))
    tent = 2.0 / (1.0 - BETA) * (near - 2.0 * middle + far)
    drawn = table.repeat_interleave(x.shape[1] // KINDS, dim=0)[..., None]
    return (drawn * tent - near / BETA).sum(dim=2)


def step(x, v, table):
    """Return places and velocities [length units / unit of time] after a step."""
    v = v * 0.5 ** (TIME_STEP / HALF_LIFE) + TIME_STEP * RADIUS * FORCE * force(x, table)
    return torch.remainder(x + TIME_STEP * v + BOX / 2, BOX) - BOX / 2, v


def picture(x):
    """Return a frame of the film; colours are kinds."""
    colour = (torch.tensor(COLOURS).to(x) / 10).repeat_interleave(x.shape[1] // KINDS, dim=0)
    options = {"periodic": True, "half_width": BOX / 2, "background": "#10131a"}
    size = {"pixel_size": 0.014, "sigma": 0.5, "resolution": 192}
    return draw_worlds(x, colour[None] - 0.5, **size, **options)[0]


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--steps", type=int, default=360)
    parser.add_argument("--seed", type=int, default=0, help="of the table and the places")
    parser.add_argument("--film", type=Path, default=Path("particle_life.webp"), help="to write")
    given = parser.parse_args()
    torch.set_num_threads(1)  # enough for small worlds
    x, table = start(200, torch.Generator().manual_seed(given.seed))
    v, frames = torch.zeros_like(x), [picture(x)]
    for k in range(given.steps):
        x, v = step(x, v, table)
        if (k + 1) % 6 == 0:
            frames.append(picture(x))
    write_webp(given.film, frames, fps=12.5, quality=30)
    print(f"mean speed {v.norm(dim=-1).mean():.3f}")


if __name__ == "__main__":
    main()
