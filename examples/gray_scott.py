"""Gray and Scott's reaction on particles that are stirred: spots divide while a flow carries them.

    pip install npa-envs
    python examples/gray_scott.py  # 2 min; writes gray_scott.webp

Yellow is V, which feeds on U (U + 2 V → 3 V) and decays: J. E. Pearson, "Complex patterns in a
simple system", Science 261 (1993). Particles carry both, so a flow mixes nothing.

Diffusion is the difference of smoothed and own state, Σ_j W_ij (s_j - s_i) / ρ_j. By Taylor it is
∇²s times half of ∫ W x² = ε²/10 (Poly6, in the plane). A wave of wavenumber k decays too slowly,
by the fraction (kε)²/48. At kε = 0.5 that is 0.5 %; on particles that the flow stirs it is at most
1 %. Particles must lie evenly (`spread`): at random places it is 31 %. The gradient of the gradient
takes two passes, errs by (kε)²/14, and at random places it grows without bound.
"""

import argparse
import math
from pathlib import Path

import torch

import npa_envs
from npa_envs.render import draw_worlds, write_webp

BOX = 2.0
"""Side of the periodic box [length units]."""
NEIGHBOURS = 20
"""Particles within ε."""
DIFFUSION = torch.tensor([0.2, 0.1]) / 3.6**2
"""Of U and V [ε² in a unit of time], so that a spot is about as wide as ε."""
FEED, KILL = 0.0367, 0.0649
"""Pearson's F and k [1 / unit of time]."""
STIRRING = 0.005
"""Speed of the flow [ε in a unit of time]."""


def start(count, generator):
    """Return places x [1, count, 2], U and V [1, count, 2], and ε [length units]."""
    eps = BOX * math.sqrt(NEIGHBOURS / (math.pi * count))
    x = BOX * (torch.rand(1, count, 2, generator=generator) - 0.5)
    for _ in range(200):
        x = spread(x, eps, 0.02)
    near = [(x - torch.tensor(place)).norm(dim=-1) < 0.15 for place in ((0.15, 0.2), (-0.5, -0.4))]
    seeded = (near[0] | near[1])[..., None]
    return x, torch.where(seeded, torch.tensor([0.5, 0.25]), torch.tensor([1.0, 0.0])), eps


def spread(x, eps, rate=0.01):
    """Return particles that made way for each other, down the density gradient."""
    fields = npa_envs.perception_fields(x, x, eps, box=BOX)
    return wrapped(x - rate * eps**2 * fields.drho / fields.rho[..., None])


def wrapped(x):
    return torch.remainder(x + BOX / 2, BOX) - BOX / 2


def laplacian(x, s, eps):
    """Return ∇²s [1 / length²] of states s [1, N, C]; Σ s/ρ does not change by s + dt D ∇²s."""
    with_ones = torch.cat((s, torch.ones_like(s[..., :1])), dim=-1)
    groups = {"state_gradient": False, "density_gradient": False}
    _, smoothed = npa_envs.perceive(x, with_ones, eps, box=BOX, **groups).chunk(2, dim=-1)
    return 20.0 / eps**2 * (smoothed[..., :-1] - smoothed[..., -1:] * s)


def step(x, s, eps, *, stirring=STIRRING):
    """Return places and states after ten units of time."""
    right, up = (math.pi * x).unbind(-1)
    flow = torch.stack((right.sin() * up.cos(), -right.cos() * up.sin()), dim=-1)
    x = spread(wrapped(x + 10.0 * stirring * eps * flow), eps)
    for _ in range(10):
        u, v = s.split(1, dim=-1)
        made = u * v * v
        reaction = torch.cat((FEED * (1.0 - u) - made, made - (FEED + KILL) * v), dim=-1)
        s = s + reaction + DIFFUSION * eps**2 * laplacian(x, s, eps)
    return x, s


def picture(x, s, eps):
    """Return a frame of the film; V is yellow on blue."""
    v = s[..., 1:]
    colour = torch.cat((2.4 * v, 0.12 + 1.8 * v, 0.3 - 0.2 * v), dim=-1)
    options = {"periodic": True, "half_width": BOX / 2, "background": "#001e4c"}
    size = {"pixel_size": 0.45 * eps, "sigma": 0.6, "resolution": 192}
    return draw_worlds(x, colour - 0.5, **size, **options)[0]


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--steps", type=int, default=480, help="of ten units of time each")
    parser.add_argument("--particles", type=int, default=8192, help="more: a larger world")
    parser.add_argument("--film", type=Path, default=Path("gray_scott.webp"), help="to write")
    given = parser.parse_args()
    torch.set_num_threads(1)  # enough for small worlds
    x, s, eps = start(given.particles, torch.Generator().manual_seed(0))
    frames = [picture(x, s, eps)]
    for k in range(given.steps):
        x, s = step(x, s, eps)
        if (k + 1) % 8 == 0:
            frames.append(picture(x, s, eps))
        if (k + 1) % 80 == 0:
            print(f"step {k + 1}: standard deviation of V {s[..., 1].std():.3f}", flush=True)
    write_webp(given.film, frames, fps=12.5, quality=30)


if __name__ == "__main__":
    main()
