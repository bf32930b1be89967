"""The task of many pictures by one rule: each world has its own target, which a code names."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any, Self

import torch
from torch import Tensor

from npa_envs.atomic_files import home_path
from npa_envs.errors import NPAError, shown
from npa_envs.rule.picture_codes import Codes, replace_code
from npa_envs.rule.rule import NPARule
from npa_envs.tasks.morphogenesis2d import Morphogenesis2D, Morphogenesis2DConfig
from npa_envs.tasks.seeds import drawn_indices, drawn_worlds
from npa_envs.tasks.targets.images import looks_like_path
from npa_envs.tasks.targets.picture_points import builtin_targets
from npa_envs.world.particles import Particles
from npa_envs.world.randomness import Randomness

PICTURE_SUFFIXES = (".png", ".jpg", ".jpeg", ".webp", ".avif", ".heic", ".gif", ".tif", ".tiff")
"""Suffixes of the files in a folder that are targets."""


def named_targets(targets: Sequence[str]) -> dict[str, str]:
    """Return the targets by name: built-in names, emoji, and paths of picture files.

    A folder in `targets` stands for its picture files.
    """
    named: dict[str, str] = {}
    for target in targets:
        for source in _pictures_of(target):
            is_file = source not in builtin_targets() and looks_like_path(source)
            name = home_path(source).stem if is_file else source
            if name in named:
                raise NPAError(
                    f"targets must have different names, got {shown(name)} twice: leave one out, "
                    "or rename a file"
                )
            named[name] = source
    return named


def _pictures_of(target: str) -> list[str]:
    folder = home_path(target)
    if target in builtin_targets() or not folder.is_dir():
        return [target]
    files = sorted(path for path in folder.iterdir() if path.suffix.lower() in PICTURE_SUFFIXES)
    if not files:
        raise NPAError(
            f"a folder of targets must hold pictures ({', '.join(PICTURE_SUFFIXES)}), "
            f"{shown(target)} does not"
        )
    return [str(path) for path in files]


class ManyPictures(Morphogenesis2D):
    """Morphogenesis of several targets by one rule; each world has one of the targets.

    A world's goal is the index of its target in `names`. The target's code, a learned vector, is in
    the first state channels of its particles. Particles are drawn equally large for all targets,
    and pictures are then multiplied by a number that makes each target's density about 1.
    """

    _codes: Codes | None = None

    def __init__(
        self, config: Morphogenesis2DConfig, *, device: str | torch.device = "cpu"
    ) -> None:
        named = named_targets(config.targets)
        if not named:
            raise NPAError("targets must name something to grow, got none: --targets gecko heart")
        if config.equivariant:
            raise NPAError(
                "targets need a rule that knows directions, got equivariant=True: leave one out"
            )
        tasks = [
            Morphogenesis2D(replace(config, target=source, targets=()), device=device)
            for source in named.values()
        ]
        super().__init__(config, target=tasks[0].target, device=device)
        self.names = tuple(named)
        """Names of the targets."""
        sizes = torch.tensor([task.target.pixel_size for task in tasks])
        self._pixel_size = float(sizes.square().mean().sqrt())
        self._scales = (sizes / self._pixel_size).square().to(device)
        self.goal_count = len(named)
        drawn = [
            self._splat(task.target.points[None], task.target.colours[None])[0] for task in tasks
        ]
        self._target_pictures = torch.stack(drawn) * self._scales[:, None, None, None]
        self._target_mean = torch.zeros_like(self._target_mean)

    @property
    def rule_shape(self) -> dict[str, Any]:
        """Arguments of `NPARule` in addition to hidden_dim and eps0."""
        config = self.config
        return super().rule_shape | {
            "state_dim": config.code_dim + config.state_dim,
            "code_dim": config.code_dim,
            "code_names": self.names,
            "encoder": config.encoder,
        }

    def for_rule(self, rule: NPARule) -> Self:
        """Return a copy of the task whose worlds have the codes of a rule.

        If the rule has an encoder, it computes them now and at each call of `with_target_code`.
        """
        if rule.codes is not None:
            with torch.no_grad():
                self._read_codes(rule.codes)
        return self._copy_with(_codes=rule.codes)

    def seed(
        self, world_count: int, *, generator: Randomness, device: str | torch.device = "cpu"
    ) -> Particles:
        """Return initial worlds with random goals; states begin with the code of the target."""
        x, s, *_ = super().seed(world_count, generator=generator, device=device)
        goal = drawn_indices(len(self.names), world_count, generator, torch.device(device))
        blank = s.new_zeros(*s.shape[:2], self.config.code_dim)
        s = torch.cat((blank, s), dim=-1)
        if self._codes is not None:
            s = replace_code(s, self._codes.table.detach().index_select(0, goal)[:, None])
        return Particles(x, s, goal=goal)

    def damage(self, worlds: Particles, generator: Randomness) -> Particles:
        """Return worlds after random damage; a fraction `switch_share` gets another goal."""
        worlds = super().damage(worlds, generator)
        x, goal = worlds.x, worlds.goal
        if goal is None or self.config.switch_share == 0.0:
            return worlds
        other = drawn_indices(len(self.names), len(x), generator, x.device)
        switched = drawn_worlds(x, generator, self.config.switch_share)
        return worlds._replace(goal=torch.where(switched, other, goal))

    def with_target_code(self, s: Tensor) -> Tensor:
        """Return states with the codes of their worlds' goals; differentiable in the codes."""
        if self._codes is None or self._goal is None:
            return s
        return replace_code(s, self._read_codes(self._codes).index_select(0, self.goal)[:, None])

    def _read_codes(self, codes: Codes) -> Tensor:
        """Return the codes of all T targets, shape [T, K].

        If an encoder computes them, they are also copied to `codes.table`.
        """
        if codes.encoder is None:
            return codes.table
        read = codes.encode(self._target_pictures)
        with torch.no_grad():
            codes.table.copy_(read)
        return read

    @property
    def target_picture(self) -> Tensor:
        """Each world's target, shape [B, R, R, 4]; channels are as in `picture`."""
        return self._target_pictures.index_select(0, self.goal)

    def picture(self, x: Tensor, s: Tensor, *, centred: bool = True) -> Tensor:
        """Return each world's picture: red, green, blue (sums over splats), density, [B, R, R, 4].

        It is multiplied by the factor that makes the density of the world's target about 1, or by 1
        if the task has no goals yet.
        """
        picture = super().picture(x, s, centred=centred)
        if self._goal is None:
            return picture
        return picture * self._scales.index_select(0, self._goal).to(picture)[:, None, None, None]
