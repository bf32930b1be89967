"""Boids: a thousand birds that fly anywhere gather into flocks, which meet and become one.

    pip install npa-envs
    python examples/boids.py  # 10 s; writes boids.webp

Colours are headings. The three rules of C. Reynolds ("Flocks, herds and schools", SIGGRAPH 1987)
are SPH fields:

- alignment: a bird turns to the mean velocity around it, a quotient of two smoothed states;
- cohesion: it climbs the density gradient, which points to where its neighbours are;
- separation: it descends the density gradient of a smaller ε, away from those that are too near.

So neighbours weigh less the farther away they are; those of Reynolds' cohesion weigh the same.
"""

import argparse
import math
from pathlib import Path

import torch

import npa_envs
from npa_envs.render import draw_worlds, write_webp

BOX = 2.0
"""Side of the periodic box [length units]."""
FAR, NEAR = 0.15, 0.05
"""Perception radii of alignment and cohesion, and of separation [length units]."""
SPEED = 0.008
"""Largest way of a step [length units]; the smallest is 0.6 of it."""


def start(count, generator):
    """Return random places x and velocities v [length units a step], both [1, count, 2]."""
    x = BOX * (torch.rand(1, count, 2, generator=generator) - 0.5)
    heading = 2.0 * math.pi * torch.rand(1, count, 1, generator=generator)
    return x, SPEED * torch.cat((heading.cos(), heading.sin()), dim=-1)


def step(x, v, *, alignment=0.2, cohesion=0.02, separation=0.1):
    """Return places and velocities after a step; the options weigh the rules, dimensionless."""
    far = npa_envs.perception_fields(x, torch.cat((v, torch.ones_like(v)), dim=-1), FAR, box=BOX)
    near = npa_envs.perception_fields(x, v, NEAR, box=BOX)
    mean = far.blur[..., :2] / far.blur[..., 2:]
    v = v + alignment * (mean - v)
    v = v + SPEED * cohesion * FAR * far.drho / far.rho[..., None]
    v = v - SPEED * separation * NEAR * near.drho / near.rho[..., None]
    speed = v.norm(dim=-1, keepdim=True)
    v = v * speed.clamp(0.6 * SPEED, SPEED) / speed.clamp(min=1e-9)
    return torch.remainder(x + v + BOX / 2, BOX) - BOX / 2, v


def polarisation(v):
    """Return the length of the mean heading: 1 if all fly one way, about 1/√N in disorder."""
    return float((v / v.norm(dim=-1, keepdim=True)).mean(dim=1).norm())


def picture(x, v):
    """Return a frame of the film; the hue is the heading."""
    heading = torch.atan2(v[..., 1:], v[..., :1])
    colour = 0.6 + 0.4 * torch.cos(heading - torch.tensor([0.0, 2.1, 4.2]))
    options = {"periodic": True, "half_width": BOX / 2, "background": "#10131a"}
    return draw_worlds(x, colour - 0.5, pixel_size=0.025, sigma=0.5, resolution=192, **options)[0]


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--steps", type=int, default=400)
    parser.add_argument("--film", type=Path, default=Path("boids.webp"), help="to write")
    given = parser.parse_args()
    torch.set_num_threads(1)  # enough for small worlds
    x, v = start(1000, torch.Generator().manual_seed(0))
    frames = [picture(x, v)]
    for k in range(given.steps):
        if k % 80 == 0:
            print(f"step {k}: polarisation {polarisation(v):.2f}", flush=True)
        x, v = step(x, v)
        if (k + 1) % 5 == 0:
            frames.append(picture(x, v))
    print(f"step {given.steps}: polarisation {polarisation(v):.2f}")
    write_webp(given.film, frames, fps=12.5, quality=30)


if __name__ == "__main__":
    main()
