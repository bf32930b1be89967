"""Errors of strategies and precisions beside their times: of perception, of rollouts, of drift.

Errors of perception are against the library in float64 on the same device; `dense` in float64 is an
independent implementation and shows how far that can be trusted. Worlds are chaotic: two that
differ in the last bit drift apart, and after enough steps distances say how long they have run, not
how well each was computed. The picture grown says that.
"""

from __future__ import annotations

# One perception of every particle.
import importlib
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from functools import partial
from typing import Any, NamedTuple

import torch
from torch import Tensor
from torch.utils.checkpoint import checkpoint

from npa_envs import reference
from npa_envs.measure.quality import psnr
from npa_envs.measure.speed.hash_grid import grid_fields
from npa_envs.measure.speed.strategies import PRECISIONS, STRATEGIES, Precision, Strategy
from npa_envs.measure.speed.timing import NO_TIME, Cost, Session, Timing, relative_error
from npa_envs.measure.speed.workloads import Gecko, Workload, gecko
from npa_envs.ops import perception_fields
from npa_envs.rule.rule import NPARule
from npa_envs.runtime import quiet_warp, start_warp
from npa_envs.world.rollout import rollout


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
    """Densities [B, N], perception z [B, N, P], gradient of a functional of z by the states."""

    density: Tensor
    perception: Tensor
    cotangent: Tensor | None


def perception_rows(session: Session, workload: Workload) -> list[PerceptionRow]:
    """Return a row for each strategy and for each precision that perception knows of."""
    x, s = workload.worlds(session.device)
    exact = perceived(STRATEGIES["library"], x.double(), s.double(), workload.eps)
    rows: list[PerceptionRow] = []
    for precision in session.usable_precisions():
        if not precision.reaches_perception:
            session.leave_out(f"perception in {precision.name}", "only the rule's products differ")
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
    """Return what a strategy makes of worlds x [B, N, D] and s [B, N, C]."""
    z = strategy.perceive(x, s, eps)
    cotangent = None
    if strategy.differentiable:
        cotangent = _cotangent(strategy, x, s, eps, drawn_like(z))
    return Perceived(strategy.density(x, s, eps), z, cotangent)


def drawn_like(like: Tensor) -> Tensor:
    """Return the weights of a random linear functional, the same numbers in every dtype."""
    generator = torch.Generator(like.device).manual_seed(2)
    return torch.randn(like.shape, generator=generator, device=like.device).to(like.dtype)


def _cotangent(strategy: Strategy, x: Tensor, s: Tensor, eps: float, weights: Tensor) -> Tensor:
    states = s.detach().requires_grad_()
    loss = (strategy.perceive(x, states, eps) * weights).sum()
    return torch.autograd.grad(loss, states)[0]


def _perception_row(
    session: Session,
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
"""Age at which the gecko's picture is judged."""

SLOW = ("dense", "neighbour_cap")
"""Strategies whose rollouts small sessions leave out."""

LARGEST_SLOW = 1024
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
        # Drawn here: a graph of the functional holds no draws of its own.
        self._x_weights = drawn_like(self.x)
        self._s_weights = drawn_like(self.s)

    def advanced(
        self, x: Tensor, s: Tensor, steps: int, generator: torch.Generator
    ) -> tuple[Tensor, Tensor]:
        """Return worlds some steps later; differentiable in the rule where the strategy is.

        The generator's update masks are the same draws for every strategy.
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
        """Yield the worlds after each number of steps, increasing."""
        generator = mask_source(self.x)
        x, s = self.x, self.s
        for before, mark in zip((0, *marks), marks, strict=False):
            x, s = self.advanced(x, s, mark - before, generator)
            yield x, s

    def weight_gradient(self, generator: torch.Generator) -> Tensor:
        """Return the gradient of a functional of the worlds `TIMED_STEPS` later by the weights."""
        x, s = self.advanced(self.x, self.s, TIMED_STEPS, generator)
        loss = (x * self._x_weights).sum() + (s * self._s_weights).sum()
        gradients = torch.autograd.grad(loss, list(self.rule.parameters()))
        return torch.cat([gradient.flatten() for gradient in gradients])

    def costs(self, session: Session) -> list[Cost]:
        """Return what a timed rollout costs: inference, then training where it can be trained."""
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
        """Return the PSNR of the pictures against the target `TASK_STEPS` later [dB], mean."""
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
    """Return worlds one step later, composed in torch: every particle perceives, some update.

    They perceive at the rule's own radius; the mask, uint8 [B, N], says which are updated.
    """
    active = mask[..., None].to(x.dtype)
    update = rule(strategy.perceive(x.detach(), s, rule.eps0))
    delta = update[..., : rule.space_dim]
    length = torch.linalg.vector_norm(delta, dim=-1, keepdim=True)
    x = x + active * (rule.alpha * rule.eps0) * delta / (1.0 + length)
    return x, s + active * update[..., rule.space_dim :]


def rollout_rows(session: Session, particle_count: int) -> list[RolloutRow]:
    """Return a row for each strategy and precision: the gecko's next steps, and its picture."""
    seed = gecko(1, particle_count, session.device)
    grown = seed.grown(GROWN_STEPS)
    exact = Runner(STRATEGIES["library"], PRECISIONS["float64"], grown)
    expected = list(exact.marks(MARKS)), exact.weight_gradient(mask_source(grown.x))
    rows: list[RolloutRow] = []
    for precision in session.usable_precisions():
        for strategy in session.usable_strategies(grown.x.to(precision.dtype)):
            if session.small and strategy.name in SLOW:
                session.leave_out(f"rollouts of {strategy.name}", "64 steps of it take too long")
                continue
            runner = Runner(strategy, precision, grown)
            task = _task_runner(session, strategy, precision, seed)
            rows += session.attempt(
                f"rollouts of {strategy.name} in {precision.name}, {particle_count} particles",
                partial(_rollout_row, session, runner, expected, task),
            )
    return rows


def drawn_mask(x: Tensor, update_prob: float, generator: torch.Generator) -> Tensor:
    """Return a step's update mask, drawn as `npa_envs.rollout` draws it, uint8, shape [B, N]."""
    mask = torch.empty(x.shape[:2], dtype=torch.uint8, device=x.device)
    return mask.bernoulli_(update_prob, generator=generator)


def mask_source(like: Tensor) -> torch.Generator:
    """Return the generator of the update masks, on the device of a tensor, at its start."""
    return torch.Generator(like.device).manual_seed(3)


def _task_runner(
    session: Session, strategy: Strategy, precision: Precision, seed: Gecko
) -> Runner | None:
    """Return what grows the picture; a run of 512 steps is left out where it takes too long."""
    particle_count = seed.x.shape[1]
    slow = strategy.name in SLOW and particle_count > LARGEST_SLOW
    if slow or (strategy.name != "library" and (session.small or not session.cuda)):
        why = f"{TASK_STEPS} steps of {particle_count} particles take too long"
        session.leave_out(f"PSNR of {strategy.name}", why)
        return None
    return Runner(strategy, precision, seed)


def _rollout_row(
    session: Session,
    runner: Runner,
    expected: tuple[list[tuple[Tensor, Tensor]], Tensor],
    task: Runner | None,
) -> RolloutRow:
    costs = runner.costs(session)
    worlds, weight_gradient = expected
    errors = {}
    for step, (x, s), (right_x, right_s) in zip(MARKS, runner.marks(MARKS), worlds, strict=True):
        distance = (x.double() - right_x.double()).norm(dim=-1).max()
        errors[f"x_{step}"] = float(distance) / runner.task.eps
        errors[f"s_{step}"] = relative_error(s, right_s)
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


# How far float32 has drifted from float64 at the end of the paper's rollouts.

PEER = STRATEGIES["dense"]
"""What any float32 errs by: no approximation, one torch operator after the other."""


@dataclass(frozen=True)
class DriftRow:
    """Relative errors of float32 after all steps of a workload, with float64's update masks.

    Gradients are those of a random linear functional by the states at the start and the weights.
    Their errors come from few particles: where the input of a hidden unit is nearly 0, the unit is
    on in one precision and off in the other, and its gradient is there or is not.
    `state_gradient_median` is the median over the particles, each relative to its own.
    """

    workload: str
    strategy: str
    positions: float
    states: float
    state_gradient: float
    state_gradient_median: float
    weight_gradient: float


def drift_rows(session: Session, workloads: Iterable[Workload]) -> list[DriftRow]:
    """Return a row for each workload, and one of dense torch where it can be."""
    rows: list[DriftRow] = []
    for workload in workloads:
        what = f"drift of {workload.name}"
        for exact in session.attempt(what, partial(_outcome, workload, session, torch.float64)):
            rows += session.attempt(what, partial(_drift_row, workload, session, exact))
            why = PEER.obstacle(workload.worlds(session.device)[0])
            if session.small or why is not None:
                session.leave_out(f"{what}, dense", why or "its steps take too long")
            else:
                rows += session.attempt(what, partial(_drift_row, workload, session, exact, PEER))
    return rows


def _drift_row(
    workload: Workload, session: Session, exact: list[Tensor], peer: Strategy | None = None
) -> DriftRow:
    found = _outcome(workload, session, torch.float32, peer)
    positions, states, by_states, by_weights = (
        relative_error(a, b) for a, b in zip(found, exact, strict=True)
    )
    distance = (found[2].double() - exact[2]).norm(dim=-1)
    median = float((distance / exact[2].norm(dim=-1)).median())
    name = "library" if peer is None else peer.name
    return DriftRow(workload.name, name, positions, states, by_states, median, by_weights)


def _outcome(
    workload: Workload, session: Session, dtype: torch.dtype, peer: Strategy | None = None
) -> list[Tensor]:
    """Return positions and states at the end, and gradients by states and by weights."""
    device = session.device
    rule = workload.rule(device).to(dtype)
    start, states = (tensor.to(dtype) for tensor in workload.worlds(device))
    states.requires_grad_()
    generator = torch.Generator(device).manual_seed(1)
    if peer is None:
        x, s = rollout(
            rule,
            start,
            states,
            workload.steps,
            eps=workload.eps,
            update_prob=workload.update_prob,
            generator=generator,
            memory="recompute",
        )
    else:
        x, s = start, states
        for _ in range(workload.steps):
            mask = drawn_mask(x, workload.update_prob, generator)
            x, s = checkpoint(composed_step, peer, rule, x, s, mask, use_reentrant=False)
    loss = (x * drawn_like(x)).sum() + (s * drawn_like(s)).sum()
    by_states, *by_weights = torch.autograd.grad(loss, [states, *rule.parameters()])
    weights = torch.cat([gradient.flatten() for gradient in by_weights])
    return [tensor.detach() for tensor in (x, s, by_states, weights)]


# Other libraries on the same particles. One that is not installed, or breaks, is left out with the
# reason. Times include the search for neighbours; errors are against `npa_envs.reference`.

OPERATIONS = ("density", "interpolation", "gradient")
"""rho, smoothed states, and state gradients without correction."""

Fields = dict[str, Tensor]
"""Results of operations by their names: [N], [N, C], [N, C, D]."""


@dataclass(frozen=True)
class PeerRow:
    """One or all of `OPERATIONS` of one library on one world, search for neighbours included.

    The error is relative, the largest where several operations are one call.
    """

    peer: str
    operation: str
    space_dim: int
    particles: int
    time_us: Timing
    error: float


@dataclass(frozen=True)
class Call:
    """A call that computes some operations; `capturable` where a CUDA graph can hold it."""

    operation: str
    run: Callable[[], Fields]
    capturable: bool = False


def peer_rows(session: Session, workload: Workload) -> list[PeerRow]:
    """Return rows of every peer that is there, on the first world of a workload."""
    x, s = (tensor[0] for tensor in workload.worlds(session.device))
    exact = _reference_fields(x.double(), s.double(), workload.eps)
    rows: list[PeerRow] = []
    for name, make in PEERS.items():
        if session.enough():
            session.leave_out(name, NO_TIME)
            continue
        try:
            with quiet_warp():
                calls = make(x, s, workload.eps)
                rows += [_row(session, name, call, x, exact) for call in calls]
        except Exception as error:  # Whatever another library raises is a finding, not ours.
            session.leave_out(name, f"{type(error).__name__}: {error}")
        session.progress(1)
    return rows


def _row(session: Session, name: str, call: Call, x: Tensor, exact: Fields) -> PeerRow:
    errors = [relative_error(value, exact[field]) for field, value in call.run().items()]
    cost = session.cost(call.run, graph=call.capturable)
    return PeerRow(name, call.operation, x.shape[1], x.shape[0], cost.time, max(errors))


def _reference_fields(x: Tensor, s: Tensor, eps: float) -> Fields:
    return _named(reference.fields(x[None], s[None], eps))


def _named(fields: Any) -> Fields:
    return dict(zip(OPERATIONS, (fields.rho[0], fields.blur[0], fields.grad0[0]), strict=True))


def _library(x: Tensor, s: Tensor, eps: float) -> list[Call]:
    run = partial(perception_fields, x[None], s[None], eps)
    return [Call("all", lambda: _named(run()), capturable=True)]


def _hash_grid(x: Tensor, s: Tensor, eps: float) -> list[Call]:
    # Its gradient is corrected by the moment matrix, which the peers' is not.
    def run() -> Fields:
        fields = grid_fields(x[None], s[None], eps)
        return {"density": fields.rho[0], "interpolation": fields.blur[0]}

    return [Call("all", run)]


def _dense(x: Tensor, s: Tensor, eps: float) -> list[Call]:
    return [Call("all", lambda: _reference_fields(x, s, eps))]


def _scipy(x: Tensor, s: Tensor, eps: float) -> list[Call]:
    """Pairs from scipy's k-d tree, sums by torch's index_add; the search is on the CPU."""
    spatial = importlib.import_module("scipy.spatial")

    def pairs() -> tuple[Tensor, Tensor]:
        points = x.cpu().numpy()
        found = spatial.cKDTree(points).query_pairs(eps, output_type="ndarray")
        one, other = torch.from_numpy(found).to(x.device).unbind(dim=1)
        itself = torch.arange(len(x), device=x.device)
        return torch.cat((one, other, itself)), torch.cat((other, one, itself))

    def run() -> Fields:
        i, j = pairs()
        r = x[j] - x[i]
        weight = reference.smoothing_kernel((r * r).sum(dim=-1), eps, x.shape[1])
        rho = torch.zeros_like(x[:, 0]).index_add(0, i, weight)
        volume = 1.0 / rho[j]
        blur = torch.zeros_like(s).index_add(0, i, (volume * weight)[:, None] * s[j])
        kernel = volume[:, None] * reference.spiky_gradient(r, eps)
        slopes = (s[j] - s[i])[:, :, None] * kernel[:, None, :]
        gradient = s.new_zeros(*s.shape, x.shape[1]).index_add(0, i, slopes)
        return dict(zip(OPERATIONS, (rho, blur, gradient), strict=True))

    return [Call("all", run)]


def _warp_sph_core(x: Tensor, s: Tensor, eps: float) -> list[Call]:
    """warpSPHCore (fluids.dev): one call for each operation, each with a search of its own."""
    start_warp()
    sph = importlib.import_module("warpSPHCore")
    space_dim = x.shape[1]
    open_space = torch.zeros(space_dim, dtype=torch.bool, device=x.device)
    domain = sph.DomainDescription(x.amin(0) - eps, x.amax(0) + eps, open_space, space_dim)
    radii, masses = torch.full_like(x[:, 0], eps), torch.ones_like(x[:, 0])
    kinds = torch.zeros(len(x), dtype=torch.int32, device=x.device)

    def call(operation: str, kernel: str, density: Tensor | None, **values: Tensor) -> Tensor:
        properties = sph.OperationProperties(
            kernel=sph.KernelFunctions[kernel],
            operation=sph.WarpOperation[operation],
            supportMode=sph.SupportScheme.Gather,
            operationMode=sph.OperationDirection.AllToAll,
            gradientMode=sph.GradientScheme.Difference,
        )
        particles = sph.ParticleState(x, radii, masses, kinds, density)
        result: Tensor = sph.warpOperation(particles, properties, domain, **values)
        return result

    def gradient() -> Tensor:
        found = call("Gradient", "Spiky", rho, **states)
        # Version 0.6.0 labels 3D gradients [N, C, D] and lays them out as [N, D, C].
        return found.reshape(len(x), space_dim, -1).mT if space_dim == 3 else found

    rho = call("Density", "Poly6", None)
    states = {"queryValues": s, "referenceValues": s}
    return [
        Call("density", lambda: {"density": call("Density", "Poly6", None)}),
        Call(
            "interpolation",
            lambda: {"interpolation": call("Interpolate", "Poly6", rho, **states)},
        ),
        Call("gradient", lambda: {"gradient": gradient()}),
    ]


PEERS = {
    "npa-envs": _library,
    "wp.HashGrid": _hash_grid,
    "dense torch": _dense,
    "scipy cKDTree + index_add": _scipy,
    "warpSPHCore": _warp_sph_core,
}
"""Every peer, and what makes its calls from x [N, D], s [N, C] and eps."""
