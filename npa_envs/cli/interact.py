"""`npa-envs interact`: what trained rules do to each other in one world."""

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

RESULTS = "interactions.json"
"""The file that says everything, and that a stopped run goes on from."""

TASK = "morphogenesis2d"
"""The task of the rules that are brought together."""

QUICK: dict[str, Any] = {
    "seed_count": 2,
    "distances": (0.0, 0.5),
    "steps": 32,
    "particle_count": 512,
}
"""What `--quick` puts in place of the defaults."""


@dataclass(frozen=True, kw_only=True)
class InteractOptions(common.RunOptions):
    """Grow every rule next to every other one, and measure how that changes it.

    Every ordered pair of rules, also of a rule with itself, at every distance, ratio and radius:
    the first one's task loss on its own particles together and alone, how much both mix, and how
    far its centroid is moved. "cooperates": the loss falls by more than the margin; "disrupted": it
    rises by more; "mixes": the mixing index is 0.25 or more. Each rule sees densities as it does
    alone: divided by its own particles. The folder gets a JSON file, a heat map and a filmstrip of
    each pair, and a phase diagram of each where there are several ratios or radii; a run that was
    stopped goes on where it was.
    """

    rules: Annotated[tuple[str, ...], tyro.conf.Positional, tyro.conf.arg(metavar="RULE")] = ()
    """Rules of 2D morphogenesis: shipped ones (`npa-envs list`) or files; default: all shipped."""
    seed_count: int = 8
    """Worlds of each encounter, each from seeds of its own."""
    first_seed: int = 1_000_000
    """The first world's number; training uses others."""
    distances: tuple[float, ...] = (0.0, 0.5, 1.0)
    """Distances between the centres of the two seeds [length units]."""
    ratios: tuple[float, ...] = (0.5,)
    """Shares of the particles that are the measured rule's."""
    eps_factors: tuple[float, ...] = (1.0,)
    """Perception radii, over that of the rules."""
    itself: bool = True
    """Also bring each rule together with itself."""
    steps: int = 512
    """Steps from the seeds."""
    particle_count: int | None = None
    """Particles of both together; default: the most that one of the rules was trained with."""
    update_prob: float | None = None
    """Probability of each particle's update in a step; default: of each rule as trained."""
    margin: float = 0.2
    """Share by which a loss must change to count as changed."""
    quick: bool = False
    """Two rules, worlds and distances, few particles and steps, unless said otherwise: figures that
    say nothing but that it runs."""
    out: Path = Path("runs/interact")
    """Folder to write to; created where missing."""


def main(arguments: Sequence[str]) -> int:
    """Grow the missing pairs, print, draw and write."""
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
    device = options.place()
    rules = _rules(options.rules or shipped, device)
    count = options.particle_count
    own = ("distances", "ratios", "eps_factors", "steps", "update_prob", "margin")
    settings = interaction.InteractionSettings(
        particle_count=max(rule.particle_count for rule in rules) if count is None else count,
        seeds=tuple(range(options.first_seed, options.first_seed + options.seed_count)),
        **{name: getattr(options, name) for name in own},
    )
    if len(rules) < 2 and not options.itself:
        raise NPAError(
            f"rules must be two or more without itself, got {rules[0].name}: name another one, "
            "or leave out --no-itself"
        )
    folder = common.writable_folder(options.out)
    weights = {rule.name: rule_digest(rule.rule) for rule in rules}
    facts = {**plain_numbers(asdict(settings)), "rules": weights}
    record = interaction.InteractionRecord(facts, folder / RESULTS).read()
    files: dict[str, tuple[RuleUnderTest, RuleUnderTest]] = {}
    for pair in itertools.product(rules, rules):
        if options.itself or pair[0] is not pair[1]:
            # Pairs whose rules' names have hyphens may look alike.
            plain, number = f"{pair[0].name}-{pair[1].name}", 2
            name = plain
            while name in files:
                name, number = f"{plain}-{number}", number + 1
            files[name] = pair
    done = {(row.rule, row.beside) for row in record.rows}
    missing = {n: (a, b) for n, (a, b) in files.items() if (a.name, b.name) not in done}
    if done:
        print(f"{len(files) - len(missing)} of {len(files)} pairs were measured before")
    # A rule is grown alone once for each ratio and radius.
    alone = len({first.name for first, _ in missing.values()})
    runs = len(missing) * len(settings.distances) + alone
    total = runs * len(settings.ratios) * len(settings.eps_factors) * settings.steps
    with common.StepBar(total, show=options.progress) as bar:
        encounters = interaction.Encounters(settings, device=device, progress=bar.advance)
        encounters.check(rules)
        for name, pair in missing.items():
            fresh, scenes = encounters.meet(*pair)
            columns = len(scenes.frames) // len(fresh)
            write_filmstrip(folder / f"{name}.png", scenes.frames, scenes.captions, columns=columns)
            record.add(*fresh)
    rows = record.rows

    def phases() -> dict[str, bytes]:
        return {
            name: interaction.phase_diagram(
                [row for row in rows if (row.rule, row.beside) == (first.name, second.name)]
            )
            for name, (first, second) in files.items()
        }

    print(record.table())
    print(f"wrote {folder / RESULTS} and a filmstrip of each pair")
    place = folder / "interactions.png"
    maps = write_plots(lambda: {"": interaction.heat_map(rows)}, place, "heat map")
    if len(settings.ratios) > 1 or len(settings.eps_factors) > 1:
        maps += write_plots(phases, folder / "phases-*.png", "phase diagrams")
    print("\n".join(maps))
    return 0


def _rules(sources: Sequence[str], device: torch.device) -> list[RuleUnderTest]:
    """Return the rules with their tasks, each under a name of its own."""
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

        task = trained.task
        rules[name] = RuleUnderTest(
            name, rule, task_of, task.update_prob, task.config.particle_count
        )
    return list(rules.values())
