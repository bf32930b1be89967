"""Wrappers that damage worlds at chosen steps of their episodes."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from npa_envs.checks import as_list
from npa_envs.envs.core.base import to_output
from npa_envs.errors import NPAError
from npa_envs.tasks.damage import DamageEvent, damage_worlds, parse_damage
from npa_envs.world.particles import Particles
from npa_envs.world.randomness import StreamId
from npa_envs.wrappers.base import (
    AnyWrapper,
    EpisodeWrapper,
    VectorStep,
    WrapperBase,
    world_indices,
)

Event = str | DamageEvent
"""An event: "STEP:KIND", "STEP:KIND:SIZE", or a `DamageEvent`."""


class _DamagesWorlds(WrapperBase):
    """Mixin that damages worlds at the steps of `events`, for one world or many."""

    def __init__(self, env: Any, events: Event | Sequence[Event]) -> None:
        several = as_list(events)
        if several is None:
            several = [events]
        if not several:
            raise NPAError("events must have at least one event, got none: for example '100:cut'")
        for event in several:
            if not isinstance(event, str | DamageEvent):
                raise NPAError(
                    f"an event must be text or a DamageEvent, got {type(event).__name__}: "
                    "for example '100:cut'"
                )
        self.events = tuple(parse_damage(e) if isinstance(e, str) else e for e in several)
        """The events; those of one step are applied in this order."""
        super().__init__(env, events=[str(event) for event in self.events])
        space, base_space = (getattr(e, self.space_name) for e in (env, env.unwrapped))
        if space != base_space:
            raise NPAError(
                f"env must give observations as the environment makes them, {base_space}, got "
                f"{space}: put {type(self).__name__} under the wrappers that change observations"
            )
        # Events of nested wrappers have different numbers, so that they draw different positions.
        self._first = 0
        while hasattr(env, "env"):
            if isinstance(env, _DamagesWorlds):
                self._first += len(env.events)
            env = env.env

    def _due(self, elapsed: NDArray[np.int64]) -> NDArray[np.bool_]:
        """Return whether each event is due in each world, [E, B], after `elapsed` [B] steps."""
        due: NDArray[np.bool_] = np.array([[event.step] for event in self.events]) == elapsed
        return due

    def _damaged_particles(self, due: NDArray[np.bool_]) -> Particles:
        """Return new particles of all worlds, damaged by the events in the mask `due` [E, B]."""
        worlds = self._base.worlds
        particles = Particles(worlds.x.clone(), worlds.s.clone())
        for k, (event, mask) in enumerate(zip(self.events, due, strict=True), self._first):
            if mask.any():
                chosen = world_indices(mask, worlds.x.device)
                stream = worlds.random.take(chosen).substream(StreamId.DAMAGE).substream(k)
                damaged = damage_worlds(
                    particles.take(chosen), kind=event.kind, size=event.size,
                    box=worlds.physics.periodic_box, generator=stream,
                )  # fmt: skip
                particles.put_(chosen, damaged)
        return particles


class DamageEvents(_DamagesWorlds, AnyWrapper):
    """Damage the world after certain steps of each episode.

    An event happens after its step: the observation of that step shows the damage, its reward does
    not include it. Step 0 damages the initial world. Position and angle of damage come from the
    world's seed, and are the same in a vector environment (`VectorDamageEvents`). A world whose
    episode is over is not damaged, so put the wrapper around the result of `gym.make`, which
    includes the step limit.

    On such steps `info["loss_damage"]` is the rise of the loss; `info["loss"]`, its terms and
    further entries are those of the damaged world. Nested wrappers act as one with all their
    events, the innermost first.

    Args:
        env: An environment of this package, without wrappers that change observations.
        events: "STEP:KIND", "STEP:KIND:SIZE" or `DamageEvent`; one or several.
    """

    _elapsed = 0

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Any, dict[str, Any]]:
        """Start an episode; events at step 0 damage its initial world."""
        observation, info = self.env.reset(seed=seed, options=options)
        self._elapsed = 0
        return self._damaged(observation, info)

    def step(self, action: Any) -> tuple[Any, Any, bool, bool, dict[str, Any]]:
        """Step the world, then damage it by the events of this step, unless the episode is over.

        Observation and info are those of the damaged world.
        """
        observation, reward, terminated, truncated, info = self.env.step(action)
        self._elapsed += 1
        if not (terminated or truncated):
            observation, info = self._damaged(observation, info)
        return observation, reward, terminated, truncated, info

    def _damaged(self, observation: Any, info: dict[str, Any]) -> tuple[Any, dict[str, Any]]:
        due = self._due(np.array([self._elapsed]))
        if not due.any():
            return observation, info
        worlds = self._base.worlds
        before = float(worlds.loss[0])
        x, s, *_ = self._damaged_particles(due)
        observation = self._base.place_particles(x[0], s[0])
        losses = self._base.losses_of(worlds.episodes.report.numbers[:, 0].tolist())
        losses["loss_damage"] = info.get("loss_damage", 0.0) + losses["loss"] - before
        return observation, info | losses | self._base._of_world(worlds.extra_info())


class VectorDamageEvents(_DamagesWorlds, EpisodeWrapper):
    """`DamageEvents` for vector environments; steps are counted in each world's own episode.

    World k is damaged as the single environment with the same seed, bit for bit. Arguments and
    errors are those of `DamageEvents`, except `env`, a vector environment of this package.
    """

    def after_reset(self, observations: Any, infos: dict[str, Any]) -> tuple[Any, dict[str, Any]]:
        """Damage the restarted worlds that have an event at step 0; return the changed results."""
        due = self._due(self.clock.elapsed) & self.clock.restarted
        return self._damaged(due, observations, infos) if due.any() else (observations, infos)

    def after_step(self, outcome: VectorStep) -> VectorStep:
        """Damage the worlds that have an event at this step; return the changed results."""
        observations, rewards, terminations, truncations, infos = outcome
        due = self._due(self.clock.elapsed) & (self.clock.restarted | ~self.clock.ended)
        if due.any():
            # With copy=False `place_particles` overwrites these buffers.
            rewards, terminations, truncations = map(_copy, (rewards, terminations, truncations))
            observations, infos = self._damaged(due, observations, infos)
        return observations, rewards, terminations, truncations, infos

    def _damaged(
        self, due: NDArray[np.bool_], observations: Any, infos: dict[str, Any]
    ) -> tuple[Any, dict[str, Any]]:
        base, worlds = self._base, self._base.worlds
        infos = {name: _copy(value) for name, value in infos.items()}
        before = worlds.loss.clone()
        damaged = np.asarray(due.any(axis=0))
        chosen = world_indices(damaged, base.task.device)
        x, s, *_ = self._damaged_particles(due)
        observations = base.place_particles(x[chosen], s[chosen], chosen)
        output = base.config.output
        # Arrays are float64, as in environments, and differences equal those of single ones.
        dtype = torch.float64 if output == "numpy" else torch.float32
        now = base.losses_of(worlds.episodes.report.numbers.to(dtype, copy=True))
        now["loss_damage"] = now["loss"] - before.to(dtype)
        now["_loss_damage"] = torch.from_numpy(damaged).to(base.task.device)
        changed = {name: to_output(value, output) for name, value in now.items()}
        if "loss_damage" in infos:
            changed["loss_damage"] = changed["loss_damage"] + infos["loss_damage"]
            changed["_loss_damage"] = changed["_loss_damage"] | infos["_loss_damage"]
        return observations, infos | changed | base._returned_values(worlds.extra_info())


def _copy(value: Any) -> Any:
    if isinstance(value, Tensor):
        return value.clone()
    return value.copy() if isinstance(value, np.ndarray) else value
