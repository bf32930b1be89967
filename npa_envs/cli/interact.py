"""`npa-envs interact`: grows rules in one world and measures how each changes the other."""

from __future__ import annotations

import functools
import itertools
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import tyro

from npa_envs.cli import common
from npa_envs.errors import NPAError

if TYPE_CHECKING:
    import torch

    from npa_envs.measure.interaction import RuleUnderTest

TASK = "morphogenesis2d"
"""The task of all rules."""

QUICK: dict[str, Any] = {
    "seed_count": 2,
    "distances": (0.0, 0.5),
    "steps": 32,
    "particle_count": 512,
}
"""Defaults of `--quick`."""


@dataclass(frozen=True, kw_only=True)
class InteractOptions(common.RunOptions):
    """Grow every rule next to every other one, and measure how that changes it.

    For every ordered pair of rules, distance, ratio and radius it measures: the first rule's task
    loss on its own particles, together and alone; how much both mix; how far its centroid moves.
    "cooperates": the loss falls by more than the margin; "disrupted": it rises by more; "mixes":
    the mixing index is 0.25 or more. Densities of each rule are divided by its own particles. The
    folder gets a JSON file, a heat map, a filmstrip of each pair, and phase diagrams if there are
    several ratios or radii. A stopped run continues.
    """

    rules: Annotated[tuple[str, ...], tyro.conf.Positional, tyro.conf.arg(metavar="RULE")] = ()
    """Rules of 2D morphogenesis: shipped ones (`npa-envs list`) or files; default: all shipped."""
    seed_count: int = 8
    """Worlds of each pair, each from its own seed."""
    first_seed: int = 1_000_000
    """The first world's seed; training uses others."""
    distances: tuple[float, ...] = (0.0, 0.5, 1.0)
    """Distances between the centres of the two seeds [length units]."""
    ratios: tuple[float, ...] = (0.5,)
    """Fractions of the particles that are the measured rule's."""
    eps_factors: tuple[float, ...] = (1.0,)
    """Perception radii as multiples of the rules' own."""
    itself: bool = True
    """Also pair each rule with itself."""
    steps: int = 512
    """Steps from the seeds."""
    particle_count: int | None = None
    """Particles of both together; default: the most that one of the rules was trained with."""
    update_prob: float | None = None
    """Probability of each particle's update in a step; default: of each rule as trained."""
    margin: float = 0.2
    """Fraction by which a loss must change to count as changed."""
    quick: bool = False
    """Two rules, two seeds and distances, few particles and steps: only shows that it runs."""
    out: Path = Path("runs/interact")
    """Folder to write to; created where missing."""


def main(arguments: Sequence[str]) -> int:
    """Grow pairs of rules that have no record yet; write record and pictures, print a table."""
    options = common.parse_options(InteractOptions, "interact", arguments)
    from npa_envs.files import plain_numbers
    from npa_envs.measure import interaction
    from npa_envs.measure.plots import write_plots
    from npa_envs.render import write_filmstrip
    from npa_envs.rule.files import rule_digest, shipped_rules

    if options.quick:
        few = InteractOptions(**QUICK)
        options = common.parse_options(InteractOptions, "interact", arguments, default=few)
    common.check_numbers(options, seed_count=1)
    shipped = list(shipped_rules(TASK))[: 2 if options.quick else None]
    device = options.checked_device()
    rules = _rules(options.rules or shipped, device)
    pairs: dict[str, tuple[RuleUnderTest, RuleUnderTest]] = {}
    for first, second in itertools.product(rules, rules):
        if options.itself or first is not second:
            name = f"{first.name}-{second.name}"
            # Different pairs can have the same name if those of rules contain hyphens.
            pairs[f"{name}-2" if name in pairs else name] = first, second
    if not pairs:
        raise NPAError(
            f"rules must be two or more without itself, got {rules[0].name}: name another one, "
            "or leave out --no-itself"
        )
    own = ("distances", "ratios", "eps_factors", "steps", "update_prob", "margin")
    settings = interaction.InteractionSettings(
        particle_count=max(rule.particle_count for rule in rules)
        if options.particle_count is None
        else options.particle_count,
        seeds=tuple(range(options.first_seed, options.first_seed + options.seed_count)),
        **{name: getattr(options, name) for name in own},
    )
    folder = common.writable_folder(options.out)
    weights = {rule.name: rule_digest(rule.rule) for rule in rules}
    facts = {**plain_numbers(asdict(settings)), "rules": weights}
    path = folder / "interactions.json"
    record = interaction.InteractionRecord(facts, path).read()
    done = {(row.rule, row.beside) for row in record.rows}
    missing = {n: (a, b) for n, (a, b) in pairs.items() if (a.name, b.name) not in done}
    if done:
        print(f"{len(pairs) - len(missing)} of {len(pairs)} pairs were measured before")
    # A rule is grown alone once for each ratio and radius.
    runs = len(missing) * len(settings.distances) + len(
        {first.name for first, _ in missing.values()}
    )
    total = runs * len(settings.ratios) * len(settings.eps_factors) * settings.steps
    with common.StepBar(total, show=options.progress) as bar:
        encounters = interaction.Encounters(settings, device=device, progress=bar.advance)
        encounters.check(rules)
        for name, pair in missing.items():
            rows, scenes = encounters.meet(*pair)
            columns = len(scenes.frames) // len(rows)
            write_filmstrip(folder / f"{name}.png", scenes.frames, scenes.captions, columns=columns)
            record.add(*rows)

    def phases() -> dict[str, bytes]:
        return {
            name: interaction.phase_diagram(
                [row for row in record.rows if (row.rule, row.beside) == (a.name, b.name)]
            )
            for name, (a, b) in pairs.items()
        }

    print(record.table())
    print(f"wrote {path} and a filmstrip of each pair")
    plots = write_plots(
        lambda: {"": interaction.heat_map(record.rows)}, folder / "interactions.png", "heat map"
    )
    if len(settings.ratios) > 1 or len(settings.eps_factors) > 1:
        plots += write_plots(phases, folder / "phases-*.png", "phase diagrams")
    print("\n".join(plots))
    return 0


def _rules(sources: Sequence[str], device: torch.device) -> list[RuleUnderTest]:
    """Return the rules with their tasks, each under a different name."""
    from npa_envs.measure.interaction import RuleUnderTest
    from npa_envs.rule.files import load_rule
    from npa_envs.training.task_of_rule import task_of_rule

    rules: dict[str, RuleUnderTest] = {}
    for source in dict.fromkeys(sources):
        rule = load_rule(source, device=device).float().requires_grad_(False)
        trained = task_of_rule(source, rule, device)
        if trained.task_name != TASK:
            raise NPAError(f"rules must be of the task {TASK}, got {source!r}: leave it out")
        if trained.doubt is not None:
            raise NPAError(f"cannot measure {source!r}: {trained.doubt}: leave it out")
        name = source.rpartition("#")[2] if "#" in source else Path(source).stem
        if name in rules:
            name = f"{name}-{len(rules) + 1}"

        @functools.cache
        def task_of(count: int, source: str = source, rule: Any = rule) -> Any:
            return task_of_rule(source, rule, device, particle_count=count).task

        config = trained.task.config
        rules[name] = RuleUnderTest(
            name, rule, task_of, trained.task.update_prob, config.particle_count
        )
    return list(rules.values())
