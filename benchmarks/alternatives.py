"""The library against other ways to perceive and other precisions: time and error.

    python benchmarks/alternatives.py --device cuda --output FILE --plot PNG
    python benchmarks/alternatives.py --quick --check benchmarks/results/ratios.json

Errors of perception are relative to the library in float64 on the same device; `dense` in float64
is an independent implementation, whose error shows how accurate that is. Worlds are chaotic: two
that differ in the last bit diverge, so that long rollouts are compared by the picture grown, not by
distances of particles. `--check` ends with code 1 if a ratio of times is less than a third of the
stored one.
"""

from __future__ import annotations

import json
import math
import sys
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import torch
from drift import drawn_like, relative_error
from precisions import PRECISIONS, Precision
from scripts import script_facts, script_parser
from strategies import STRATEGIES, Strategy
from torch import Tensor

from npa_envs.atomic_files import read_json, write_bytes, write_text
from npa_envs.checks import check_device
from npa_envs.errors import NPAError, shown
from npa_envs.measure.plots import new_figure, number_plainly, png
from npa_envs.measure.quality import psnr
from npa_envs.measure.speed.suites import BenchReport
from npa_envs.measure.speed.timing import (
    Cost,
    Tables,
    Timing,
    TimingSession,
    Workload,
)
from npa_envs.rule.files import load_rule
from npa_envs.rule.rule import NPARule
from npa_envs.tasks.morphogenesis2d import Morphogenesis2D, Morphogenesis2DConfig
from npa_envs.world.rollout import rollout, step


class Gecko(NamedTuple):
    """The shipped rule `gecko`, its task with as many target points as particles, start worlds."""

    rule: NPARule
    task: Morphogenesis2D
    x: Tensor
    s: Tensor

    def grown(self, steps: int) -> Gecko:
        """Return a copy whose worlds are `steps` float32 steps older."""
        generator = torch.Generator(self.x.device).manual_seed(1)
        with torch.no_grad():
            x, s = rollout(
                self.rule,
                self.x,
                self.s,
                steps,
                eps=self.task.eps,
                update_prob=self.task.update_prob,
                generator=generator,
            )
        return self._replace(x=x, s=s)


def gecko(world_count: int, particle_count: int, device: torch.device) -> Gecko:
    """Return the shipped rule `gecko` with `world_count` start worlds of its task."""
    config = Morphogenesis2DConfig(particle_count=particle_count, target_point_count=particle_count)
    task = Morphogenesis2D(config, device=device)
    generator = torch.Generator(device).manual_seed(0)
    x, s, *_ = task.seed(world_count, generator=generator, device=device)
    return Gecko(load_rule("gecko", device=device).float(), task, x, s)


@dataclass
class Alternatives(TimingSession):
    """A `TimingSession` with the methods that are compared."""

    strategies: list[Strategy] = field(default_factory=lambda: list(STRATEGIES.values()))
    """Strategies to measure."""
    precisions: list[Precision] = field(default_factory=lambda: list(PRECISIONS.values()))
    """Precisions to measure."""

    def usable_precisions(self) -> Iterator[Precision]:
        """Yield the precisions that can be measured on the device."""
        for precision in self.precisions:
            why = precision.obstacle(self.device)
            if why is None:
                yield precision
            else:
                self.left_out[precision.name] = why

    def usable_strategies(self, x: Tensor) -> Iterator[Strategy]:
        """Yield the strategies that can be measured on worlds like `x`, [B, N, D]."""
        for strategy in self.strategies:
            why = strategy.obstacle(x)
            if why is None:
                yield strategy
            else:
                number = str(x.dtype).removeprefix("torch.")
                shape = f"{x.shape[2]}D ({x.shape[0]}, {x.shape[1]})"
                self.left_out[f"{strategy.name}, {number}, {shape}"] = why


def accuracy(session: Alternatives) -> Tables:
    """Return tables of time and error: of perception and of rollouts."""
    geckos = [1024] if session.small else [1024, 4096]
    flat = Workload(2, 1, 1024, 1)
    worlds = [flat, Workload(3, 1, 512 if session.small else 1024, 1)]
    if not session.small:
        larger = [(2, 1, 4096), (2, 1, 65536 if session.cuda else 16384), (2, 8, 4096)]
        worlds[1:1] = (Workload(*sizes, 1) for sizes in larger)
        worlds.append(Workload(3, 1, 16384, 1))
    return {
        "perception": [row for world in worlds for row in perception_rows(session, world)],
        "rollouts": [row for count in geckos for row in rollout_rows(session, count)],
    }


@dataclass(frozen=True)
class PerceptionRow:
    """One perception of every particle: times [µs], peak of memory [MiB], relative errors.

    Errors are in the Euclidean norm: of the density, the smoothed states, the state and density
    gradients as they are perceived (on a logarithmic scale), and of all of z. `cotangent` is the
    error of the gradient of a random linear functional of z by the states.
    """

    strategy: str
    precision: str
    space_dim: int
    worlds: int
    particles: int
    forward_us: Timing
    gradient_us: Timing | None
    peak_mib: float | None
    density: float
    smoothed: float
    state_gradient: float
    density_gradient: float
    perception: float
    cotangent: float | None


class Perceived(NamedTuple):
    """Densities [B, N], perceptions z [B, N, P], and the gradient of a functional by the states."""

    density: Tensor
    perception: Tensor
    cotangent: Tensor | None


def perception_rows(session: Alternatives, workload: Workload) -> list[PerceptionRow]:
    """Return a row for each strategy and each precision of perception."""
    x, s = workload.worlds(session.device)
    exact = perceived(STRATEGIES["library"], x.double(), s.double(), workload.eps)
    rows: list[PerceptionRow] = []
    for precision in session.usable_precisions():
        if not precision.reaches_perception:
            session.left_out[f"perception in {precision.name}"] = "only the rule's products differ"
            continue
        places, states = x.to(precision.dtype), precision.kept(s.to(precision.dtype))
        for strategy in session.usable_strategies(places):
            name = precision.name
            rows += session.attempt(
                f"{strategy.name} in {name}, {workload.name}",
                partial(_perception_row, session, workload, strategy, name, places, states, exact),
            )
    return rows


def perceived(strategy: Strategy, x: Tensor, s: Tensor, eps: float) -> Perceived:
    """Return what a strategy perceives in worlds x [B, N, D] and s [B, N, C]."""
    z = strategy.perceive(x, s, eps)
    cotangent = None
    if strategy.differentiable:
        cotangent = _cotangent(strategy, x, s, eps, drawn_like(z))
    return Perceived(strategy.density(x, s, eps), z, cotangent)


def _cotangent(strategy: Strategy, x: Tensor, s: Tensor, eps: float, weights: Tensor) -> Tensor:
    states = s.detach().requires_grad_()
    loss = (strategy.perceive(x, states, eps) * weights).sum()
    return torch.autograd.grad(loss, states)[0]


def _perception_row(
    session: Alternatives,
    workload: Workload,
    strategy: Strategy,
    precision: str,
    x: Tensor,
    s: Tensor,
    exact: Perceived,
) -> PerceptionRow:
    eps, graph = workload.eps, strategy.capturable
    found = perceived(strategy, x, s, eps)
    costs = [session.cost(lambda: strategy.perceive(x, s, eps), graph=graph)]
    cotangent = None
    if found.cotangent is not None and exact.cotangent is not None:
        weights = drawn_like(found.perception)
        costs.append(session.cost(lambda: _cotangent(strategy, x, s, eps, weights), graph=graph))
        cotangent = relative_error(found.cotangent, exact.cotangent)
    # States, smoothed states, state gradients, the density gradient.
    state_dim, space_dim = workload.state_dim, workload.space_dim
    widths = [state_dim, state_dim, state_dim * space_dim, space_dim]
    groups = (torch.split(z, widths, -1) for z in (found.perception, exact.perception))
    _, smoothed, *gradients = (relative_error(a, b) for a, b in zip(*groups, strict=True))
    return PerceptionRow(
        strategy=strategy.name,
        precision=precision,
        space_dim=space_dim,
        worlds=workload.world_count,
        particles=workload.particle_count,
        forward_us=costs[0].time,
        gradient_us=costs[1].time if len(costs) > 1 else None,
        peak_mib=peak_of(costs),
        density=relative_error(found.density, exact.density),
        smoothed=smoothed,
        state_gradient=gradients[0],
        density_gradient=gradients[1],
        perception=relative_error(found.perception, exact.perception),
        cotangent=cotangent,
    )


def peak_of(costs: Iterable[Cost]) -> float | None:
    """Return the largest peak of memory of some calls [MiB], None on a CPU."""
    return max((cost.peak_mib for cost in costs if cost.peak_mib is not None), default=None)


# The shipped gecko in motion.

MARKS = (1, 8, 64)
"""Steps after which worlds are compared."""

TIMED_STEPS = 8
"""Steps of a timed rollout."""

GROWN_STEPS = 64
"""Age of the worlds that are compared: a gecko in the making."""

TASK_STEPS = 512
"""Step at which the gecko's picture is compared."""

SLOW = ("dense", "neighbour_cap")
"""Strategies whose rollouts small sessions leave out."""

MAX_SLOW = 1024
"""Particles of the largest gecko that they grow to its end."""


@dataclass(frozen=True)
class RolloutRow:
    """The gecko's next steps: times of one step [µs], and errors after 1, 8 and 64 steps.

    `x_8`: largest distance of a particle from where it should be, over eps; `s_8`: relative error
    of the states; `weights`: that of a functional's gradient by the weights over `TIMED_STEPS`
    steps; `psnr_512`: of the picture grown from the seed in 512 steps against the target [dB].
    """

    strategy: str
    precision: str
    particles: int
    step_us: Timing
    training_us: Timing | None
    peak_mib: float | None
    x_1: float
    s_1: float
    x_8: float
    s_8: float
    x_64: float
    s_64: float
    weights: float | None
    psnr_512: float | None


class Runner:
    """Worlds of the gecko's rule, advanced by one strategy in one precision."""

    def __init__(self, strategy: Strategy, precision: Precision, start: Gecko) -> None:
        self.strategy = strategy
        self.precision = precision
        self.rule = precision.rule(start.rule)
        self.task = start.task
        self.x = start.x.to(precision.dtype)
        self.s = precision.kept(start.s.to(precision.dtype))
        # Drawn before the capture, so that the graph draws nothing.
        self._x_weights = drawn_like(self.x)
        self._s_weights = drawn_like(self.s)

    def advanced(
        self, x: Tensor, s: Tensor, steps: int, generator: torch.Generator
    ) -> tuple[Tensor, Tensor]:
        """Return worlds `steps` steps later; differentiable in the rule if the strategy is.

        `generator` draws the same update masks for every strategy.
        """
        own = self.strategy.name == "library"
        at_once = steps if own and not self.precision.short_states else 1
        with self.precision.active():
            for _ in range(steps // at_once):
                if own:
                    x, s = rollout(
                        self.rule,
                        x,
                        s,
                        at_once,
                        update_prob=self.task.update_prob,
                        generator=generator,
                    )
                else:
                    mask = drawn_mask(x, self.task.update_prob, generator)
                    x, s = composed_step(self.strategy, self.rule, x, s, mask)
                s = self.precision.kept(s)
        return x, s

    @torch.no_grad()
    def marks(self, marks: tuple[int, ...]) -> Iterator[tuple[Tensor, Tensor]]:
        """Yield the worlds after each number of steps; the numbers increase."""
        generator = mask_source(self.x)
        x, s = self.x, self.s
        for before, mark in zip((0, *marks), marks, strict=False):
            x, s = self.advanced(x, s, mark - before, generator)
            yield x, s

    def weight_gradient(self, generator: torch.Generator) -> Tensor:
        """Return the gradient by the weights of a functional of worlds after `TIMED_STEPS`."""
        x, s = self.advanced(self.x, self.s, TIMED_STEPS, generator)
        loss = (x * self._x_weights).sum() + (s * self._s_weights).sum()
        gradients = torch.autograd.grad(loss, list(self.rule.parameters()))
        return torch.cat([gradient.flatten() for gradient in gradients])

    def costs(self, session: Alternatives) -> list[Cost]:
        """Return the costs of a rollout: inference and, if possible, training."""
        generator = mask_source(self.x)

        @torch.no_grad()
        def infer() -> None:
            self.advanced(self.x, self.s, TIMED_STEPS, generator)

        calls: list[Callable[[], object]] = [infer]
        if self.strategy.differentiable:
            calls.append(lambda: self.weight_gradient(generator))
        graph = self.strategy.capturable
        return [session.cost(call, graph=graph, generator=generator) for call in calls]

    def psnr(self) -> float:
        """Return the mean PSNR [dB] of pictures after `TASK_STEPS`, to the target."""
        (worlds,) = self.marks((TASK_STEPS,))
        picture = self.task.picture(*(tensor.float() for tensor in worlds))
        return float(psnr(picture, self.task.target_picture).mean())


def composed_step(
    strategy: Strategy,
    rule: NPARule,
    x: Tensor,
    s: Tensor,
    mask: Tensor,
) -> tuple[Tensor, Tensor]:
    """Return worlds one step later, computed in torch: every particle perceives, some update.

    The perception radius is the rule's `eps0`; `mask`, uint8 [B, N], is 1 where a particle updates.
    """
    active = mask[..., None].to(x.dtype)
    update = rule(strategy.perceive(x.detach(), s, rule.eps0))
    delta = update[..., : rule.space_dim]
    length = torch.linalg.vector_norm(delta, dim=-1, keepdim=True)
    x = x + active * (rule.alpha * rule.eps0) * delta / (1.0 + length)
    return x, s + active * update[..., rule.space_dim :]


def rollout_rows(session: Alternatives, particle_count: int) -> list[RolloutRow]:
    """Return a row for each strategy and precision: the gecko's next steps, and its picture."""
    seed = gecko(1, particle_count, session.device)
    grown = seed.grown(GROWN_STEPS)
    exact = Runner(STRATEGIES["library"], PRECISIONS["float64"], grown)
    expected = list(exact.marks(MARKS)), exact.weight_gradient(mask_source(grown.x))
    rows: list[RolloutRow] = []
    for precision in session.usable_precisions():
        for strategy in session.usable_strategies(grown.x.to(precision.dtype)):
            if session.small and strategy.name in SLOW:
                session.left_out[f"rollouts of {strategy.name}"] = "64 steps of it take too long"
                continue
            runner = Runner(strategy, precision, grown)
            task = _task_runner(session, strategy, precision, seed)
            rows += session.attempt(
                f"rollouts of {strategy.name} in {precision.name}, {particle_count} particles",
                partial(_rollout_row, session, runner, expected, task),
            )
    return rows


def drawn_mask(x: Tensor, update_prob: float, generator: torch.Generator) -> Tensor:
    """Return a step's update mask as `npa_envs.rollout` would draw it, uint8, [B, N]."""
    mask = torch.empty(x.shape[:2], dtype=torch.uint8, device=x.device)
    return mask.bernoulli_(update_prob, generator=generator)


def mask_source(like: Tensor) -> torch.Generator:
    """Return a new generator of update masks on a tensor's device, always with one seed."""
    return torch.Generator(like.device).manual_seed(3)


def _task_runner(
    session: Alternatives, strategy: Strategy, precision: Precision, seed: Gecko
) -> Runner | None:
    """Return the run that grows the picture; None if its 512 steps take too long."""
    particle_count = seed.x.shape[1]
    slow = strategy.name in SLOW and particle_count > MAX_SLOW
    if slow or (strategy.name != "library" and (session.small or not session.cuda)):
        why = f"{TASK_STEPS} steps of {particle_count} particles take too long"
        session.left_out[f"PSNR of {strategy.name}"] = why
        return None
    return Runner(strategy, precision, seed)


def _rollout_row(
    session: Alternatives,
    runner: Runner,
    expected: tuple[list[tuple[Tensor, Tensor]], Tensor],
    task: Runner | None,
) -> RolloutRow:
    costs = runner.costs(session)
    worlds, weight_gradient = expected
    errors = {}
    for mark, (x, s), (right_x, right_s) in zip(MARKS, runner.marks(MARKS), worlds, strict=True):
        distance = (x.double() - right_x.double()).norm(dim=-1).max()
        errors[f"x_{mark}"] = float(distance) / runner.task.eps
        errors[f"s_{mark}"] = relative_error(s, right_s)
    weights = None
    if runner.strategy.differentiable:
        found = runner.weight_gradient(mask_source(runner.x))
        weights = relative_error(found, weight_gradient)
    return RolloutRow(
        strategy=runner.strategy.name,
        precision=runner.precision.name,
        particles=runner.x.shape[1],
        step_us=costs[0].time.divided(TIMED_STEPS),
        training_us=costs[1].time.divided(TIMED_STEPS) if len(costs) > 1 else None,
        peak_mib=peak_of(costs),
        **errors,
        weights=weights,
        psnr_512=None if task is None else task.psnr(),
    )


# Plots: fronts of run time against error.

FLOOR = 1e-16
"""Errors below this, as that of the float64 reference itself, are drawn here."""

COLOURS = dict(zip(STRATEGIES, ("C0", "C4", "C1", "C2", "C3"), strict=True))
"""Colour of each strategy."""

MARKERS = dict(zip(PRECISIONS, ("s", "o", "^", "D", "v"), strict=True))
"""Shape of each precision."""


class Point(NamedTuple):
    """One way to compute something: its error (dimensionless) and its time [µs]."""

    error: float
    time: float
    strategy: str
    precision: str


def front(points: Iterable[Point]) -> list[Point]:
    """Return the points that no other one beats in both time and error, in order of error."""
    best: list[Point] = []
    for point in sorted(points, key=lambda point: (point.error, point.time)):
        if not best or point.time < best[-1].time:
            best.append(point)
    return best


def draw_fronts(perceptions: Sequence[Any], rollouts: Sequence[Any]) -> Any:
    """Return a figure of time against error, of perceptions and of rollouts."""
    largest = _largest_common(perceptions)
    perception = [
        Point(row.perception, row.forward_us.median, row.strategy, row.precision)
        for row in perceptions
        if (row.space_dim, row.worlds, row.particles) == (2, 1, largest)
    ]
    most = max(row.particles for row in rollouts)
    steps = [
        Point(row.s_8, row.step_us.median, row.strategy, row.precision)
        for row in rollouts
        if row.particles == most
    ]
    figure, (axes,) = new_figure(1, 2, (9.2, 3.8))
    _draw_front(axes[0], perception, "relative error of perception z", "time [µs]")
    axes[0].set_title(f"one perception, N {largest}")
    _draw_front(axes[1], steps, "relative error of states after 8 steps", "time of a step [µs]")
    axes[1].set_title(f"gecko, p 0.5, N {most}")
    _add_legend(figure, [*perception, *steps])
    return figure


def _largest_common(rows: Sequence[Any]) -> int:
    """Return the most particles of a 2D world that every strategy was measured on."""
    counts: set[int] = {row.particles for row in rows if (row.space_dim, row.worlds) == (2, 1)}
    names: dict[int, set[str]] = {count: set() for count in counts}
    for row in rows:
        if row.particles in counts:
            names[row.particles].add(row.strategy)
    return max(counts, key=lambda count: (len(names[count]), count))


def _draw_front(axis: Any, points: Sequence[Point], across: str, up: str) -> None:
    """Draw points, coloured by strategy and shaped by precision, over the front of the best."""
    drawn = [point._replace(error=max(point.error, FLOOR)) for point in points]
    best = front(drawn)
    line = [point.error for point in best], [point.time for point in best]
    axis.step(*line, where="post", color="0.8", zorder=1)
    for point in drawn:
        axis.scatter(
            point.error,
            point.time,
            color=COLOURS[point.strategy],
            marker=MARKERS[point.precision],
            s=36,
            zorder=2,
        )
    axis.set(xscale="log", yscale="log", xlabel=across, ylabel=up)
    axis.margins(0.08)
    number_plainly(axis.yaxis)
    axis.grid(alpha=0.3)


def _add_legend(figure: Any, points: Sequence[Point]) -> None:
    """Draw the legend of colours and shapes."""
    from matplotlib.lines import Line2D

    strategies = dict.fromkeys(point.strategy for point in points)
    precisions = dict.fromkeys(point.precision for point in points)
    marks = [
        *(
            Line2D([], [], ls="", marker="o", color=COLOURS[name], label=name)
            for name in strategies
        ),
        *(
            Line2D([], [], ls="", marker=MARKERS[name], color="0.4", label=name)
            for name in precisions
        ),
        Line2D([], [], color="0.8", label="front"),
    ]
    figure.legend(handles=marks, loc="outside lower center", ncols=5, fontsize=8)


# Ratios of times within one run, which are similar on machines of a kind, and their check.

WORKLOAD = Workload(2, 1, 1024, 1)
"""Small enough for dense torch."""

TOLERANCE = 3.0
"""A ratio passes if it is at least the stored one divided by this: other machines, other loads."""


def ratios(session: Alternatives) -> dict[str, float]:
    """Return how many times faster the library is than each thing it is compared with."""
    x, s = WORKLOAD.worlds(session.device)
    rule = WORKLOAD.rule(session.device)
    generator = torch.Generator(session.device).manual_seed(1)

    def time_of(run: Any, graph: bool) -> float:
        session.progress(1)
        return session.cost(run, graph=graph, generator=generator).time.median

    def perceive(name: str) -> float:
        strategy = STRATEGIES[name]
        return time_of(lambda: strategy.perceive(x, s, WORKLOAD.eps), strategy.capturable)

    def pull_back(name: str) -> float:
        strategy, states = STRATEGIES[name], s.clone().requires_grad_()
        return time_of(
            lambda: torch.autograd.grad(strategy.perceive(x, states, WORKLOAD.eps).sum(), states),
            strategy.capturable,
        )

    @torch.no_grad()
    def composed() -> None:
        mask = drawn_mask(x, WORKLOAD.update_prob, generator)
        composed_step(STRATEGIES["library"], rule, x, s, mask)

    @torch.no_grad()
    def fused() -> None:
        step(rule, x, s, update_prob=WORKLOAD.update_prob, generator=generator)

    own = perceive("library")
    return {
        "perceive: dense torch over library": perceive("dense") / own,
        "perceive: hash grid over library": perceive("hash_grid") / own,
        "gradient: dense torch over library": pull_back("dense") / pull_back("library"),
        "step: composed in torch over fused": time_of(composed, True) / time_of(fused, True),
    }


def stored_ratios(path: Path, device: torch.device) -> dict[str, float]:
    """Return the least ratios, of JSON {"cpu": {name: ratio}, "cuda": {...}}.

    Raises:
        NPAError: The file cannot be read or has no ratios for this kind of device.
    """
    cure = "take `ratios` from the JSON of `benchmarks/alternatives.py --quick --output FILE`"
    try:
        loaded = read_json(path)
        return {str(name): float(value) for name, value in loaded[device.type].items()}
    except (NPAError, ValueError, KeyError, TypeError, AttributeError, OverflowError) as error:
        raise NPAError(
            f"{str(path)!r} must hold ratios under {device.type!r}, got {shown(error)}: {cure}"
        ) from error


def missed_ratios(measured: Mapping[str, float], stored: Mapping[str, float]) -> list[str]:
    """Return a line of text for each stored ratio that the measured one falls below."""
    return [
        f"{name}: {measured.get(name, math.nan):.3g}, stored {value:.3g}, "
        f"at least {value / TOLERANCE:.3g} wanted"
        for name, value in stored.items()
        if not measured.get(name, math.nan) >= value / TOLERANCE
    ]


def main() -> int:
    """Measure, print, write and check; return 1 where a ratio was missed."""
    parser = script_parser(__doc__)
    parser.add_argument("--quick", action="store_true", help="small worlds only")
    parser.add_argument("--strategies", nargs="+", choices=list(STRATEGIES), default=[*STRATEGIES])
    parser.add_argument("--precisions", nargs="+", choices=list(PRECISIONS), default=[*PRECISIONS])
    parser.add_argument("--repeats", type=int, default=7, help="readings of every time")
    parser.add_argument("--plot", type=Path, help="PNG of run time against error to write")
    parser.add_argument("--check", type=Path, help="JSON of stored ratios")
    arguments = parser.parse_args()
    device = check_device(arguments.device)
    torch.set_num_threads(arguments.threads)
    stored = {} if arguments.check is None else stored_ratios(arguments.check, device)
    session = Alternatives(
        device=device,
        repeats=arguments.repeats,
        small=arguments.quick,
        strategies=[STRATEGIES[name] for name in arguments.strategies],
        precisions=[PRECISIONS[name] for name in arguments.precisions],
    )
    tables, held = accuracy(session), ratios(session)
    facts = script_facts(arguments)
    report = BenchReport(
        suite="alternatives",
        command=facts["command"],
        commit=facts["commit"],
        threads=arguments.threads,
        session=session,
        tables=tables,
    )
    print(report.text())
    print("\ntimes faster:", *(f"  {name}: {value:.3g}" for name, value in held.items()), sep="\n")
    if arguments.output is not None:
        content = json.loads(report.json()) | {"ratios": held}
        write_text(arguments.output, json.dumps(content, indent=1) + "\n")
    if arguments.plot is not None:
        write_bytes(arguments.plot, png(draw_fronts(tables["perception"], tables["rollouts"])))
    if arguments.check is None:
        return 0
    missed = missed_ratios(held, stored)
    print("\n".join(f"missed: {line}" for line in missed) or "ratios are held")
    return 1 if missed else 0


if __name__ == "__main__":
    sys.exit(main())
