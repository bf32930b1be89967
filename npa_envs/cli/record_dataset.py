"""`npa-envs record-dataset`: writes episodes of a policy as a Minari dataset."""

from __future__ import annotations

import os
import sys
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import tyro

from npa_envs.cli import common
from npa_envs.errors import NPAError

if TYPE_CHECKING:
    from npa_envs.agents.learning import Problem


@dataclass(frozen=True, kw_only=True)
class RecordOptions(common.RunOptions):
    """Write episodes of a policy as a Minari dataset, to learn from without the environment.

    `minari.load_dataset` reads it; `npa_envs.agents.learning.train("clone", ..., dataset=ID)`
    learns from it.

    Examples:
      npa-envs record-dataset npa/Morphogenesis2D-v0 --keywords target=heart --dataset npa/a-v0
      npa-envs record-dataset npa/Gardener2D-v0 --policy scripted --dataset npa/gardener/scripted-v0
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
    """Seed of the first episode; the others have the seeds after it."""
    num_envs: int = 16
    """Worlds that run at the same time."""
    keywords: Annotated[tuple[str, ...], tyro.conf.arg(metavar="NAME=VALUE")] = ()
    """Keywords of the environment, values as JSON or plain text: target=heart."""
    root: Path | None = None
    """Folder of datasets; default: Minari's, which MINARI_DATASETS_PATH sets."""


def main(arguments: Sequence[str]) -> int:
    """Record the episodes and write the dataset."""
    options = common.parse_options(RecordOptions, "record-dataset", arguments)
    common.check_numbers(options, episodes=1, num_envs=1)
    from npa_envs.agents.evaluation import bound_to
    from npa_envs.measure.benchmark_records import command_text
    from npa_envs.wrappers.minari import ROOT, record_episodes, spec_of, write_dataset

    problem = common.problem_of(options, min(options.num_envs, options.episodes))
    if problem.controlled == "species":
        raise NPAError(
            f"env must be of one species, as Minari keeps one agent's episodes, got {options.env}"
        )
    envs: Any = problem.make_envs(device=options.device)
    policy = bound_to(envs, policy_of(options, problem))
    seeds = range(options.first_seed, options.first_seed + options.episodes)
    returns: list[float] = []
    if options.root is not None:
        os.environ[ROOT] = str(common.writable_folder(options.root, "root").resolve())
    with common.progress_bar(options.episodes, show=options.progress, unit="episode") as advance:

        def episodes() -> Iterator[Any]:
            for episode in record_episodes(envs, policy, seeds):
                returns.append(float(sum(episode.rewards)))
                yield episode
                advance(1)

        folder = write_dataset(
            options.dataset, spec_of(problem.env_id, dict(problem.keywords), problem.episode_steps),
            episodes(), algorithm=options.policy,
            description=command_text("record-dataset", arguments, "--root"),
        )  # fmt: skip
    print(f"{options.episodes} episodes, mean return {sum(returns) / len(returns):.3f}: {folder}")
    return 0


def policy_of(options: RecordOptions, problem: Problem) -> Callable[[Any], Any]:
    """Return the policy named by `options.policy`, loaded or made for the environment."""
    from npa_envs.agents.learning import Budget, RuleSet, train
    from npa_envs.agents.learning.problem import WORLDS_PER_SEED

    known: tuple[str, ...] = ("zero", "random", "scripted")
    known += ("gradient",) if problem.controlled == "brushes" else ()
    if options.policy in known:
        # These learn nothing: `train` plays each scripted policy once and returns the best.
        seed = 0
        if options.policy == "scripted" and options.first_seed < WORLDS_PER_SEED:
            # The next seed after those of the recorded worlds.
            last = options.first_seed + options.episodes - 1
            seed = last // WORLDS_PER_SEED + 1
        return train(
            options.policy,
            problem,
            Budget(particle_steps=sys.maxsize),
            seed,
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
