"""In how many worlds the device's own PPO acts: as many as keep a GPU busy, where there is room."""

from __future__ import annotations

import torch

from npa_envs.agents.learning.ppo_settings import Settings
from npa_envs.agents.learning.problem import Problem
from npa_envs.agents.learning.progress import Budget
from npa_envs.agents.learning.seeds import WORLDS_PER_SEED
from npa_envs.envs.core.worlds import free_bytes, needed_bytes

MANY_PARTICLES = 2**17
"""Particles of all worlds together on a GPU: a round of fewer takes hardly less time."""

FEWEST_ROUNDS = 128
"""Rounds that a budget of particle-steps is to be enough for."""

ROOM = 0.25
"""Share of the free memory that is taken; other runs may share the device."""


def world_count(problem: Problem, settings: Settings, device: torch.device, budget: Budget) -> int:
    """Return the worlds B to act in.

    They are what the options say; where those say nothing, the problem's on the CPU, and on a GPU
    about `MANY_PARTICLES` particles' worth, if memory and budget allow, never fewer than the
    problem's.

    Args:
        problem: What is to be learned.
        settings: Options.
        device: Where the worlds live.
        budget: What may be spent.
    """
    if settings.worlds is not None:
        return settings.worlds
    if device.type != "cuda":
        return problem.num_envs
    counts = [MANY_PARTICLES // problem.particle_count, WORLDS_PER_SEED]
    free = free_bytes(device)
    if free is not None:
        counts.append(int(ROOM * free) // world_bytes(problem, settings, device))
    if budget.particle_steps is not None:
        round_size = settings.steps * problem.particle_count
        counts.append(budget.particle_steps // (FEWEST_ROUNDS * round_size))
    return max(problem.num_envs, min(counts))


def world_bytes(problem: Problem, settings: Settings, device: torch.device) -> int:
    """Return about how much memory a world takes: itself, its rounds and what is learned [bytes].

    Args:
        problem: What is to be learned.
        settings: Options.
        device: Where it lives.
    """
    interface, count = problem.interface, problem.particle_count
    columns = interface.perception_dim + interface.action_dim
    # Of each step what was seen, done and paid; of a minibatch's besides what gradients need.
    kept = (settings.steps + 1) * (columns + interface.action_dim + 16)
    hidden = 4 * problem.hidden_dim + 8 * settings.critic_width
    learned = -(-settings.steps // settings.minibatches) * (2 * columns + hidden)
    return needed_bytes(1, count, problem.physics, device) + 4 * count * (kept + learned)
