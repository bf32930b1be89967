"""Rules grown alone and beside each other, from the same seeds."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from npa_envs.errors import NPAError
from npa_envs.interaction import InteractionRow, InteractionSettings, mixing_index, verdict
from npa_envs.render import draw_worlds
from npa_envs.rule.rule import NPARule
from npa_envs.tasks.base import PictureTask
from npa_envs.world.randomness import Purpose, WorldRandom
from npa_envs.world.species import rollout_species

PROGRESS_STEPS = 32
"""Steps between two reports of progress."""

FRAME_SHARES = (0.0, 0.125, 0.25, 0.5, 1.0)
"""When pictures are taken, as shares of the run."""

FRAME_RESOLUTION = 160
"""Pixels on each side of a picture."""


@dataclass(frozen=True)
class Organism:
    """A trained rule that grows in 2D, and what it grows."""

    name: str
    """What tables call it."""

    rule: NPARule
    """The rule, on the device to run on."""

    task_of: Callable[[int], PictureTask]
    """Returns its task with a number of particles, of which seeds are made and losses taken."""

    update_prob: float
    """Probability of a particle's update in a step, as trained (dimensionless)."""


@dataclass
class Scenes:
    """Pictures of the first world of each encounter."""

    frames: list[NDArray[np.uint8]] = field(default_factory=list)
    """Pictures, uint8, shape [R, R, 3] each; `len(FRAME_SHARES)` of each encounter."""

    captions: list[str] = field(default_factory=list)
    """One for each frame."""


class _Solo(NamedTuple):
    """A rule grown alone."""

    losses: Tensor
    """Its metric, shape [B]; infinite where a world blew up."""
    centroids: Tensor
    """Where it ends [length units], shape [B, 2]."""


class Encounters:
    """Grows rules alone and beside each other; what was grown alone is kept.

    Args:
        settings: How rules are brought together.
        device: Where to run.
        progress: Called with the number of steps done since its last call.
    """

    def __init__(
        self,
        settings: InteractionSettings,
        *,
        device: torch.device,
        progress: Callable[[int], None] = lambda _: None,
    ) -> None:
        self.settings = settings
        self._device = device
        self._progress = progress
        self._solos: dict[tuple[str, int], _Solo] = {}

    def check(self, organisms: Sequence[Organism]) -> None:
        """Check that any two of the rules can share a world.

        Raises:
            NPAError: They cannot.
        """
        for other in organisms:
            weight = other.rule.hidden.weight
            x, s = weight.new_zeros(1, 2, 2), weight.new_zeros(1, 2, other.rule.state_dim)
            try:
                rollout_species([organisms[0].rule, other.rule], x, s, 0, counts=[1, 1])
            except NPAError as error:
                raise NPAError(
                    f"{organisms[0].name} and {other.name} cannot share a world: {error}"
                ) from error

    @torch.no_grad()
    def meet(self, first: Organism, second: Organism) -> tuple[list[InteractionRow], Scenes]:
        """Grow one rule beside another, at every distance and ratio.

        Args:
            first: The rule that is measured.
            second: The rule beside it; it may be the same.

        Returns:
            One row for each ratio and distance, and pictures.
        """
        rows, scenes = [], Scenes()
        for ratio in self.settings.ratios:
            solo = self._solo(first, self.settings.counts(ratio)[0])
            for distance in self.settings.distances:
                rows.append(self._row(first, second, ratio, distance, solo, scenes))
        return rows, scenes

    def _row(
        self,
        first: Organism,
        second: Organism,
        ratio: float,
        distance: float,
        solo: _Solo,
        scenes: Scenes,
    ) -> InteractionRow:
        counts = self.settings.counts(ratio)
        task = first.task_of(counts[0])
        half_width = 1.2 + 0.5 * distance

        def shoot(x: Tensor, s: Tensor, step: int) -> None:
            spacing = math.sqrt(4.0 / self.settings.particle_count)
            (picture,) = draw_worlds(
                x[:1],
                s[:1],
                resolution=FRAME_RESOLUTION,
                pixel_size=0.5 * spacing,
                half_width=half_width,
            )
            scenes.frames.append(picture)
            scenes.captions.append(f"d {distance:g}, r {ratio:g}, step {step}")

        x, s, lost = self._grow([first, second], counts, distance, shoot)
        own = x[:, : counts[0]]
        losses = task.metric(own, s[:, : counts[0]]).masked_fill(lost, math.inf)
        away = (own.mean(dim=1) - solo.centroids).norm(dim=-1)
        alone, together = solo.losses.mean().item(), losses.mean().item()
        change = together / alone if alone > 0.0 else math.inf
        mixing = mixing_index(x, counts, eps=first.rule.eps0).mean().item()
        return InteractionRow(
            rule=first.name,
            beside=second.name,
            distance=distance,
            ratio=ratio,
            alone=alone,
            together=together,
            change=change,
            mixing=mixing,
            displacement=away.mean().item(),
            verdict=verdict(change, mixing, self.settings.margin),
        )

    def _solo(self, organism: Organism, count: int) -> _Solo:
        key = organism.name, count
        if key not in self._solos:
            x, s, lost = self._grow([organism], (count,), 0.0)
            losses = organism.task_of(count).metric(x, s).masked_fill(lost, math.inf)
            self._solos[key] = _Solo(losses, x.mean(dim=1))
        return self._solos[key]

    def _grow(
        self,
        organisms: Sequence[Organism],
        counts: tuple[int, ...],
        distance: float,
        shoot: Callable[[Tensor, Tensor, int], None] = lambda x, s, step: None,
    ) -> tuple[Tensor, Tensor, Tensor]:
        """Grow one or two species from their seeds; also say which worlds blew up on the way.

        The first species is seeded around the origin, the second one `distance` from it along the
        first axis. The first draws what it draws alone.
        """
        settings = self.settings
        random = WorldRandom(settings.seeds, device=self._device)
        streams = (random, random.beside(Purpose.SPECIES))
        parts = [
            organism.task_of(count).seed(len(settings.seeds), generator=stream, device=self._device)
            for organism, count, stream in zip(organisms, counts, streams, strict=False)
        ]
        for number, (place, _) in enumerate(parts):
            place[..., 0] += number * distance
        like = organisms[0].rule.hidden.weight
        x, s = (torch.cat(of_all, dim=1).to(like) for of_all in zip(*parts, strict=True))
        lost = torch.zeros(len(x), dtype=torch.bool, device=x.device)
        frames = {round(share * settings.steps) for share in FRAME_SHARES}
        stops = sorted({*range(0, settings.steps, PROGRESS_STEPS), *frames})
        for now, then in zip([0, *stops], stops, strict=False):
            new_x, new_s = rollout_species(
                [organism.rule for organism in organisms],
                x,
                s,
                then - now,
                counts=counts,
                update_prob=[settings.update_prob or own.update_prob for own in organisms],
                generator=random,
                density_counts=counts,
            )
            # A world that blew up must not keep the others from being measured.
            fine = new_x.isfinite().all(dim=(1, 2)) & new_s.isfinite().all(dim=(1, 2))
            x = torch.where(fine[:, None, None], new_x, x)
            s = torch.where(fine[:, None, None], new_s, s)
            lost |= ~fine
            self._progress(then - now)
            if then in frames:
                # The middle of the two seeds is the middle of the picture.
                shift = x.new_zeros(x.shape[2])
                shift[0] = 0.5 * distance
                shoot(x - shift, s, then)
        return x, s, lost
