"""Colours of particles by state, density, species, speed or update mask."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from npa_envs.errors import NPAError, shown, suggest
from npa_envs.ops import species_fields
from npa_envs.render.colours import GOLDEN_ANGLE, STATE_CHROMA, STATE_GAIN, ramp, srgb

SHOWS = ("colours", "density", "components", "species", "speed", "mask")
"""Choices of the page, followed by the state channels: "state 0", "state 1", ..."""

DARK = (0.05, 0.06, 0.09)
"""First colour of the ramp of densities and speeds."""

MASK_COLOURS = (0.98, 0.78, 0.36), (0.29, 0.33, 0.42)
"""Red, green and blue of updated particles, and of the others."""

BALANCE = 0.9
"""Weight of earlier frames in the moving average of the covariance behind "components"."""


class ColouredWorld(NamedTuple):
    """A world whose particles are coloured."""

    x: Tensor
    s: Tensor
    colours: Callable[[Tensor], Tensor]
    """Own colours [1, N, 3] of particles with states [1, N, C]; they may exceed [0, 1]."""
    eps: float
    box: tuple[float, ...] | None
    counts: Sequence[int]
    """Particles of each species, species after species."""
    full: int
    """Particles of the fresh world."""
    travelled: Tensor | None
    """Path of each particle in the last step over the longest possible one, [1, N]."""
    updated: Tensor | None
    """Which particles the last step updated, bool, shape [1, N]."""


class Colouring:
    """Colours of the particles of one world, frame after frame."""

    def __init__(self) -> None:
        self._covariance: Tensor | None = None
        self._basis: Tensor | None = None

    def __call__(self, show: str, world: ColouredWorld) -> NDArray[np.uint8]:
        """Return red, green and blue of each particle, uint8, [N, 3], by one of `shows_of`."""
        if world.x.shape[1] == 0:
            return np.zeros((0, 3), dtype=np.uint8)
        match show.split():
            case ["colours"]:
                return _bytes(world.colours(world.s)[0])
            case ["density"]:
                # 1 is a world whose particles fill [-1, 1]^D, or its box, evenly.
                rho = species_fields(world.x, [world.x.shape[1]], eps=world.eps, box=world.box).rho
                volume = float(np.prod(world.box or (2.0,) * world.x.shape[2]))
                crowding = rho[0].sum(dim=-1) * (volume / world.full)
                # Worlds in open space fill a part of it, and are denser.
                return _ramp(1.0 - torch.exp2(-crowding / (1.0 if world.box else 4.0)))
            case ["components"]:
                return _bytes(self._components(world.s[0]))
            case ["species"]:
                return species_colours(len(world.counts)).repeat(world.counts, axis=0)
            case ["speed"]:
                share = _known(world.travelled, world)
                return _ramp(share.clamp(0.0, 1.0).sqrt())
            case ["mask"]:
                updated = _known(world.updated, world).bool()[:, None]
                on, off = (updated.new_tensor(tint, dtype=torch.float32) for tint in MASK_COLOURS)
                return _bytes(torch.where(updated, on, off))
            case ["state", number] if number.isdecimal() and int(number) < world.s.shape[2]:
                return _bytes(signed_colours(world.s[0, :, int(number)]))
        raise NPAError(
            f"show must be one of the world's, got {shown(show)}: "
            f"{suggest(show, shows_of(world.s.shape[2]))}"
        )

    def _components(self, s: Tensor) -> Tensor:
        """Return the first three principal components as colours; the basis moves slowly."""
        # One NaN in the moving average would stay there.
        known = s[s.isfinite().all(dim=-1)].double()
        mean = known.mean(dim=0)
        covariance = (known - mean).T @ (known - mean) / max(len(known), 1)
        if self._covariance is None or self._covariance.shape != covariance.shape:
            self._covariance, self._basis = covariance, None
        self._covariance = BALANCE * self._covariance + (1.0 - BALANCE) * covariance
        values, vectors = torch.linalg.eigh(self._covariance.cpu())
        count = min(3, len(values))
        basis = vectors[:, -count:].flip(-1).to(s.device)
        if self._basis is not None:
            # An eigenvector's sign is arbitrary: colours must not flip between frames.
            sign = (basis * self._basis).sum(dim=0, keepdim=True).sign()
            basis = basis * torch.where(sign == 0, 1.0, sign)
        self._basis = basis
        width = values[-count:].flip(0).clamp_min(1e-12).sqrt().to(s.device)
        parts = 0.5 + 0.22 * ((s.double() - mean) @ basis) / width
        return torch.nn.functional.pad(parts, (0, 3 - count), value=0.5)


def shows_of(state_dim: int, *, species: bool = True) -> list[str]:
    """Return what `Colouring` can show of particles with so many state channels."""
    own = SHOWS if species else ("colours", "density", "components", "speed")
    return [*own, *(f"state {k}" for k in range(state_dim))]


def signed_colours(values: Tensor) -> Tensor:
    """Return colours of numbers [...]: blue below 0, grey at 0, orange above; [..., 3]."""
    pull = torch.tanh(0.5 * STATE_GAIN * values)
    lab = (0.62 + 0.18 * pull.abs(), 0.5 * STATE_CHROMA * pull, STATE_CHROMA * pull)
    return srgb(torch.stack(lab, dim=-1))


def species_colours(count: int) -> NDArray[np.uint8]:
    """Return distinct colours of any number of species, uint8, shape [count, 3]."""
    hue = 0.9 + GOLDEN_ANGLE * torch.arange(count, dtype=torch.float64)
    lab = (torch.full_like(hue, 0.72), 0.13 * hue.cos(), 0.13 * hue.sin())
    return _bytes(srgb(torch.stack(lab, dim=-1)))


def _known(values: Tensor | None, world: ColouredWorld) -> Tensor:
    """Return values of the last step [N], or zeros before the first one."""
    if values is None or values.shape[1] != world.x.shape[1]:
        return torch.zeros(world.x.shape[1], device=world.x.device)
    return values[0]


def colour_ramp() -> NDArray[np.uint8]:
    """Return the colours of densities and speeds from low to high, uint8, shape [entries, 3]."""
    table = ramp(DARK)
    # The darkest colours would vanish on a dark background.
    return table[len(table) // 6 :]


def _ramp(share: Tensor) -> NDArray[np.uint8]:
    table = colour_ramp()
    entry = (share.nan_to_num(0.0) * (len(table) - 1)).round()
    colours: NDArray[np.uint8] = table[entry.to(torch.int32).cpu().numpy()]
    return colours


def _bytes(colours: Tensor) -> NDArray[np.uint8]:
    scaled = (colours.detach().nan_to_num(0.0).clamp(0.0, 1.0) * 255.0).round()
    pixels: NDArray[np.uint8] = scaled.to(torch.uint8).cpu().numpy()
    return pixels
