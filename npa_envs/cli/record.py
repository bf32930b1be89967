"""`npa-envs record`: writes episodes of a policy as a Minari dataset."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import tyro

from npa_envs.cli import common
from npa_envs.errors import NPAError

if TYPE_CHECKING:
    from npa_envs.agents.learning import Problem

UNTRAINED = ("zero", "random", "scripted")
"""Policies that need no file."""


@dataclass(frozen=True, kw_only=True)
class RecordOptions(common.RunOptions):
    """Write episodes of a policy as a Minari dataset, to learn from without the environment.

    `minari.load_dataset` reads it; `npa_envs.agents.learning.train("clone", ..., dataset=ID)`
    learns from it.
    """

    env: Annotated[str, tyro.conf.Positional, tyro.conf.arg(metavar="ENV")]
    """Id of an environment of one species, such as npa/Morphogenesis2D-v0."""
    dataset: Annotated[str, tyro.conf.arg(metavar="ID")]
    """Name of the dataset: NAMESPACE/NAME-v0."""
    policy: str = "random"
    """The policy: "zero", "random", "scripted", or a rule (shipped, a file, or a run's
    folder). In gardens also "gradient", or a run's sac.zip or ppo.zip."""
    episodes: int = 16
    """Episodes to record, each from a different seed."""
    first_seed: int = 0
    """The first one's seed; the others follow."""
    num_envs: int = 16
    """Worlds that run at the same time."""
    options: Annotated[tuple[str, ...], tyro.conf.arg(metavar="NAME=VALUE")] = ()
    """Keywords of the environment, values as JSON or plain text: target=heart."""
    root: Path | None = None
    """Folder of datasets; default: Minari's, which MINARI_DATASETS_PATH sets."""


def main(arguments: Sequence[str]) -> int:
    """Record the episodes and write the dataset."""
    options = common.parse_options(RecordOptions, "record", arguments)
    common.check_numbers(options, episodes=1, num_envs=1)
    from npa_envs.agents.evaluation import policy_in
    from npa_envs.measure.benchmark_records import command_text
    from npa_envs.wrappers.minari import ROOT, record_episodes, spec_of, write_dataset

    problem = problem_of(options)
    envs: Any = problem.make_envs(device=options.device)
    policy = policy_in(envs, policy_of(options, problem))
    seeds = range(options.first_seed, options.first_seed + options.episodes)
    returns: list[float] = []
    if options.root is not None:
        os.environ[ROOT] = str(common.writable_folder(options.root, "root").resolve())
    with common.StepBar(options.episodes, show=options.progress, unit="episode") as bar:

        def episodes() -> Iterator[Any]:
            for episode in record_episodes(envs, policy, seeds):
                returns.append(float(sum(episode.rewards)))
                yield episode
                bar.advance(1)

        folder = write_dataset(
            options.dataset,
            spec_of(problem.env_id, dict(problem.keywords), problem.episode_steps),
            episodes(),
            algorithm=options.policy,
            description=command_text("record", arguments, "--root"),
        )
    print(f"{options.episodes} episodes, mean return {sum(returns) / len(returns):.3f}: {folder}")
    return 0


def problem_of(options: RecordOptions) -> Problem:
    """Return the environment with its keywords."""
    from npa_envs.agents.learning.problem import Problem, registration_of

    problem = Problem(
        env_id=options.env,
        keywords=common.named_values("options", options.options),
        episode_steps=registration_of(options.env).steps,
        num_envs=min(options.num_envs, options.episodes),
    )
    if problem.controlled == "species":
        raise NPAError(
            f"env must be of one species, as Minari keeps one agent's episodes, got {options.env}"
        )
    return problem


def policy_of(options: RecordOptions, problem: Problem) -> Callable[[Any], Any]:
    """Return the policy that the options name."""
    from npa_envs.agents.learning import Budget, RuleSet, train

    known = (*UNTRAINED, "gradient") if problem.controlled == "brushes" else UNTRAINED
    if options.policy in known:
        # These learn nothing: `train` only chooses among them, by seeds that are not recorded.
        return train(
            options.policy,
            problem,
            Budget(particle_steps=10**12),
            _choice_seed(options) if options.policy == "scripted" else 0,
            device=options.device,
            evaluation_seeds=[2**31],  # Its episode only checks that the policy runs.
            curve_points=1,
        ).policy
    source = options.policy
    if source.endswith(".zip") and problem.controlled == "brushes":
        from npa_envs.agents.learning.sb3 import GardenPolicy

        return GardenPolicy.load(source)
    if problem.controlled == "brushes":
        raise NPAError(
            f"policy must be one of {known} or a file sac.zip or ppo.zip, got {source!r}"
        )
    return RuleSet.of(problem, source).to(options.device).policy()


def _choice_seed(options: RecordOptions) -> int:
    """Return the seed of a run whose worlds are none of the recorded ones."""
    from npa_envs.agents.learning.problem import RUNS, WORLDS_PER_SEED

    first, last = options.first_seed, options.first_seed + options.episodes - 1
    for seed in range(RUNS):
        if last < seed * WORLDS_PER_SEED or first >= (seed + 1) * WORLDS_PER_SEED:
            return seed
    raise NPAError(
        f"episodes must leave {WORLDS_PER_SEED} seeds below {RUNS * WORLDS_PER_SEED} to choose a "
        f"scripted policy by, got seeds {first} to {last}: record fewer"
    )
