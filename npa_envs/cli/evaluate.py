"""`npa-envs evaluate RULE`: how good a rule is, in numbers."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import tyro

from npa_envs.errors import NPAError


@dataclass(frozen=True, kw_only=True)
class EvaluateOptions:
    """Measure loss, PSNR, overflow and extent of a rule over thousands of steps."""

    rule: Annotated[str, tyro.conf.Positional, tyro.conf.arg(metavar="RULE")]
    """A shipped rule (`npa-envs list`), a file of ours or the authors' (.safetensors, .pth), or a
    rule of their web demo (models.json#name)."""

    target: str | None = None
    """The target to measure against; default: the one that the rule was trained on."""

    loss: str | None = None
    """Textures only: the loss to measure by (`npa-envs list`); default: as trained."""

    checkpoints: tuple[int, ...] = (64, 128, 256, 512, 1024, 2048, 4096)
    """Steps from the seed to measure at, increasing."""

    seed_count: int = 8
    """Worlds to measure, each from a seed of its own."""

    first_seed: int = 1_000_000
    """The first world's number; training uses others."""

    healing: bool = False
    """Also cut the grown worlds and erase a part, and measure how they heal."""

    particle_count: int | None = None
    """Particles N; default: as trained."""

    eps: float | None = None
    """Perception radius [length units]; default: as trained."""

    update_prob: float | None = None
    """Probability of each particle's update in a step; default: as trained."""

    json: Path | None = None
    """Also write the table to this JSON file."""

    device: str = "cpu"
    """Where to run: cpu, cuda, cuda:1."""

    progress: bool = True
    """Show a progress bar."""


def main(arguments: Sequence[str]) -> int:
    """Run the command.

    Args:
        arguments: The words after `npa-envs evaluate`.

    Returns:
        0.

    Raises:
        NPAError: The rule or a value is wrong, its target is not known, or the JSON file cannot
            be written.
    """
    options = tyro.cli(EvaluateOptions, prog="npa-envs evaluate", args=arguments)
    return run(options)


def run(options: EvaluateOptions) -> int:
    """Measure and print.

    Args:
        options: What the command line said.

    Raises:
        NPAError: As for `main`.
    """
    from npa_envs.cli.progress import StepBar
    from npa_envs.cli.worlds import task_of_rule
    from npa_envs.evaluation import check_steps, evaluate, healing, table_text, tables_json
    from npa_envs.files import write_text
    from npa_envs.rule_io import load_rule
    from npa_envs.training import check_device

    check_steps("checkpoints", options.checkpoints)
    if options.seed_count < 1:
        raise NPAError(f"seed_count must be at least 1, got {options.seed_count}")
    device = check_device(options.device)
    rule = load_rule(options.rule, device=device).float()
    trained = task_of_rule(
        options.rule,
        rule,
        device,
        particle_count=options.particle_count,
        target=options.target,
        loss=options.loss,
        eps=options.eps,
        update_prob=options.update_prob,
    )
    if trained.doubt is not None:
        raise NPAError(
            f"cannot measure {options.rule!r}: {trained.doubt}: "
            "give --target, a built-in name or a picture"
        )
    seeds = range(options.first_seed, options.first_seed + options.seed_count)
    with StepBar(max(options.checkpoints), show=options.progress) as bar:
        rows = evaluate(
            rule,
            trained.task,
            checkpoints=options.checkpoints,
            seeds=seeds,
            device=device,
            progress=bar.advance,
        )
    measure = trained.task.metric_name
    print(f"{options.rule}: {options.seed_count} worlds, loss: {measure}")
    print(table_text(rows, missing="-"))
    tables: dict[str, Sequence[Any]] = {"growth": rows}
    if options.healing:
        with StepBar(None, show=options.progress) as bar:
            healed = healing(rule, trained.task, seeds=seeds, device=device, progress=bar.advance)
        print(table_text(healed))
        tables["healing"] = healed
    if options.json is not None:
        write_text(options.json, tables_json(tables, metric=measure))
        print(f"wrote {options.json}")
    return 0
