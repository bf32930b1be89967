"""Two gardeners with opposed aims, the way PettingZoo has it: `parallel_env`, `env`, `raw_env`.

Importing this module registers `npa/Gardeners-v0` with PettingZoo (1.27 or newer).
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, ClassVar

import numpy as np
import torch
from gymnasium.spaces import Box
from gymnasium.wrappers import TimeLimit
from numpy.typing import NDArray
from torch import Tensor

from npa_envs.envs.core.vector import checked_count
from npa_envs.envs.garden.brushes import BrushSpaces
from npa_envs.envs.gardener2d import Gardener2DEnv, GardenerTask
from npa_envs.envs.multi.parallel import KnownAgents, Outcome, in_turns, register
from npa_envs.errors import NPAError, shown

AGENTS = ("keeper_0", "raider_0")


class _BothHands(BrushSpaces):
    """Brushes of both gardeners, used at once; what is seen is the same for both."""

    def action(self, action: Any, world_count: int | None) -> Tensor:
        """Return the rows of all brushes, shape [B, 2 K, W], of both gardeners' actions."""
        both = [super(_BothHands, self).action(action[agent], world_count) for agent in AGENTS]
        return torch.cat(both, dim=1)


class _SharedTask(GardenerTask):
    form_type = _BothHands


class _SharedGarden(Gardener2DEnv):
    task_type = _SharedTask


class GardenersEnv(KnownAgents):
    """Two gardeners at one living picture: the keeper keeps it whole, the raider spoils it.

    ## Description

    The world is that of [`npa/Gardener2D-v0`](Gardener2D.md): a trained rule has grown a picture
    from N particles and goes on running them. There is no weather; the raider is the weather. Both
    agents have the same brushes and see the same. All brushes are used at once, and what a particle
    feels of them adds up.

    In `parallel_env` both act at once. In `env` and `raw_env` they act in turn, by PettingZoo's own
    conversion, and the world moves on after the raider. `env` also clips actions into their space.
    The id for `pettingzoo.make`, of PettingZoo 1.27 or newer, is `npa/Gardeners-v0`, once
    `npa_envs.envs.gardeners_v0` is imported.

    `garden` is the world as a Gymnasium environment. Policies of `npa_envs.agents.gardening` take
    it, and what they do is an action of either agent: `ScriptedGardener(env.garden)`.

    ## Observation space

    As that of `npa/Gardener2D-v0`, for both agents.

    ## Action space

    As that of `npa/Gardener2D-v0`, for each agent. Every agent has to give an action. One that is
    missing, of another shape or not finite raises `NPAError` and leaves the world as it was.

    ## Reward

    The keeper is paid what a gardener is: 1 for a picture as good as at the start, 0 for one as bad
    as a grey one, and at least −1. The raider is paid minus that, so rewards sum to zero.

    ## Starting state

    As that of `npa/Gardener2D-v0`. `reset(seed=k)` begins the sequence of episodes that belongs to
    k, and `reset()` goes on with the next one.

    ## Episode end

    After `max_cycles` steps both agents are truncated. A world that diverges terminates both.

    ## Info

    As that of `npa/Gardener2D-v0`, the same for both agents.

    ## Arguments

    `max_cycles`, the steps of an episode, and all arguments of `npa/Gardener2D-v0`. Chances of
    gusts and blights are 0 by default. An unknown name, or a value out of range, raises an
    `NPAError` that says what would be right.

    ## Version history

    - v0: first version.

    Args:
        max_cycles: Steps of an episode.
        config: Fields of the configuration of `npa/Gardener2D-v0`.

    Raises:
        NPAError: A name is unknown, or a value wrong.
    """

    metadata: ClassVar[dict[str, Any]] = {
        "name": "gardeners_v0",
        "is_parallelizable": True,
        **Gardener2DEnv.metadata,
    }

    def __init__(self, max_cycles: int = 32, **config: Any) -> None:
        calm = {"gust_chance": 0.0, "blight_chance": 0.0}
        self.garden = _SharedGarden(**(calm | config))
        """The world as a Gymnasium environment, whose actions are those of both."""
        self.max_cycles = checked_count("max_cycles", max_cycles)
        """Steps of an episode."""
        self._episodes = TimeLimit(self.garden, self.max_cycles)
        self.render_mode = self.garden.render_mode
        self.possible_agents = list(AGENTS)
        self.agents: list[str] = []
        self.observation_spaces = dict.fromkeys(AGENTS, self.garden.observation_space)
        self.action_spaces = dict.fromkeys(AGENTS, self.garden.action_space)

    def reset(
        self, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[dict[str, Any], dict[str, dict[str, Any]]]:
        """Start an episode, as `npa/Gardener2D-v0`; return what both see, and the loss."""
        seen, info = self._episodes.reset(seed=seed)
        self.agents = list(AGENTS)
        return _for_both(seen), {agent: dict(info) for agent in AGENTS}

    def step(self, actions: Mapping[str, Any]) -> Outcome:
        """Use all brushes by the actions of both agents, let the rule run, and judge."""
        if not self.agents and not actions:
            return {}, {}, {}, {}, {}
        if not self.agents or set(actions) != set(self.agents):
            raise NPAError(
                f"actions must be given for the agents {self.agents}, got some for "
                f"{shown(list(actions))}: call reset where there are none"
            )
        seen, earned, ended, late, info = self._episodes.step(actions)
        if ended or late:
            self.agents = []
        return (
            _for_both(seen),
            {"keeper_0": float(earned), "raider_0": -float(earned)},
            dict.fromkeys(AGENTS, ended),
            dict.fromkeys(AGENTS, late),
            {agent: dict(info) for agent in AGENTS},
        )

    def render(self) -> NDArray[np.uint8] | None:
        """Return the world's picture, shape [R, R, 3], in the mode "rgb_array"."""
        return self.garden.render()

    def close(self) -> None:
        """Close the window, if there is one."""
        self.garden.close()


def _for_both(seen: Any) -> dict[str, Any]:
    # Each its own: what one agent does to what it sees is nothing to the other.
    copied = seen.clone if isinstance(seen, Tensor) else seen.copy
    return {agent: copied() for agent in AGENTS}


def parallel_env(max_cycles: int = 32, **config: Any) -> GardenersEnv:
    """Return the environment in which both act at once; arguments are those of `GardenersEnv`."""
    return GardenersEnv(max_cycles, **config)


def raw_env(max_cycles: int = 32, **config: Any) -> Any:
    """Return `parallel_env` with agents that act in turn, and the world after the raider."""
    return in_turns(parallel_env(max_cycles, **config))


def env(max_cycles: int = 32, **config: Any) -> Any:
    """Return `raw_env` with actions that are numbers clipped into their spaces."""
    both = parallel_env(max_cycles, **config)
    return in_turns(both, clips=isinstance(both.action_space("keeper_0"), Box))


register("npa/Gardeners-v0", __name__, {})
