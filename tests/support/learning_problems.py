"""Reinforcement-learning problems that train in a second, and rules with large actions."""

import torch

from npa_envs.agents.learning import Budget, Problem, Progress, RuleSet

WORLD = {"particle_count": 48, "eps": 0.25, "eps0": 0.25, "state_dim": 4}


def heart(episode_steps=8, num_envs=3, **keywords):
    """A heart to grow from a wide disk; it has little else to show than its colour and size."""
    given = {"target": "heart", "seed_radius": 0.4, "resolution": 24, **WORLD, **keywords}
    return Problem(
        env_id="npa/Morphogenesis2D-v0",
        keywords=given,
        episode_steps=episode_steps,
        num_envs=num_envs,
    )


def digits(episode_steps=8, **keywords):
    given = WORLD | {"state_dim": 12, "eps": 0.15, "eps0": 0.15, **keywords}
    return Problem(
        env_id="npa/PointClassification-v0", keywords=given, episode_steps=episode_steps, num_envs=3
    )


def species(name="npa/Mixing-v0", episode_steps=8, **keywords):
    given = {"seed_distance": 0.3, **WORLD, **keywords}
    if "particle_counts" in given:
        del given["particle_count"]
    return Problem(env_id=name, keywords=given, episode_steps=episode_steps, num_envs=3)


def progress_of(problem, device="cpu", **options):
    """The progress of a run that a learner is made with."""
    budget = Budget(particle_steps=1)
    return Progress(problem, budget, device=device, evaluation_seeds=[500], **options)


def wild_rules(problem, seed=0, factor=8.0):
    """Return rules whose actions are far from 0, and that differ from species to species."""
    rules = RuleSet.new(problem, seed)
    generator = torch.Generator().manual_seed(seed)
    with torch.no_grad():
        for rule in rules:
            rule.output.weight.mul_(factor)
            bias = rule.hidden.bias
            bias.copy_(0.3 * torch.randn(bias.shape, generator=generator))
    return rules
