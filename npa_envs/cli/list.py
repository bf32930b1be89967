"""`npa-envs list`: prints the names of tasks, environments, targets and rules."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from npa_envs.cli import common


@dataclass(frozen=True)
class ListOptions:
    """List tasks, presets, environments, targets, texture losses, data sets, rules with scores.

    Examples:
      npa-envs list
    """


def main(arguments: Sequence[str]) -> int:
    """Print the names of tasks, environments, targets, losses and rules; return 0."""
    common.parse_options(ListOptions, "list", arguments)
    from npa_envs.measure.quality import score_line, scores
    from npa_envs.registration import ALL, SPECIES, SPECIES_SIZES
    from npa_envs.rule.files import load_rule, shipped_rules
    from npa_envs.tasks.losses.texture import TEXTURE_LOSSES
    from npa_envs.tasks.targets.digit_clouds import BUILT_IN
    from npa_envs.training import TASKS

    print("tasks (npa-envs train TASK --preset PRESET)")
    for name, entry in TASKS.items():
        print(f"  {name}: {entry.summary}")
        for preset, config in entry.presets.items():
            seconds = entry.expected_seconds(config) or 0.0
            repeats = "" if config.repeats == 1 else f" ({config.repeats} x {config.iterations})"
            print(
                f"    {preset}: {config.total_iterations} iterations{repeats} of "
                f"{config.world_count} worlds, about {common.duration(seconds)} on one core"
            )
    print("environments (import npa_envs; gymnasium.make(NAME) or make_vec(NAME, num_envs=64))")
    for environment in ALL:
        print(f"  {environment.id}: episodes of {environment.max_episode_steps} steps")
    print("several species (npa_envs.envs.multispecies_v0.parallel_env(NAME); needs PettingZoo)")
    print(f"  {', '.join((*SPECIES, *(size.id for size in SPECIES_SIZES)))}")
    print("targets (--target NAME, or the path of a picture; for morphogenesis also one emoji)")
    for name, entry in TASKS.items():
        if entry.targets():
            print(f"  {name}: {', '.join(entry.targets())}")
    print("texture losses (--loss NAME)")
    for name, loss in TEXTURE_LOSSES.items():
        print(f"  {name}: {loss.summary}")
    print("data sets of point clouds (--data NAME, or the path of a folder with MNIST's IDX files)")
    print(f"  point_classification: {', '.join(BUILT_IN)}")
    print("rules (npa-envs rollout NAME)")
    for task_name in TASKS:
        for name in shipped_rules(task_name):
            weights = load_rule(name).weight_count
            print(f"  {name}: {task_name}, {weights} weights; {score_line(scores(name))}")
    return 0
