"""What must matter little or not at all: order, batches, repetition, devices, short numbers."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from functools import partial

import torch
from torch import Tensor

from npa_envs.measure.accuracy.checks import (
    Check,
    Finding,
    Session,
    Skipped,
    in_2d_and_3d,
)
from npa_envs.measure.accuracy.habitats import WORKS, Habitat, habitat
from npa_envs.measure.accuracy.scenes import (
    EPS,
    STATE_DIM,
    Perceived,
    Scene,
    error_limits,
    functional_weights,
    perceived,
    relative_error,
    scenes,
)
from npa_envs.measure.accuracy.values import differing
from npa_envs.measure.speed.strategies import PRECISIONS, Precision
from npa_envs.ops import perceive
from npa_envs.rule.files import load_rule
from npa_envs.world.cuda_graph import capture
from npa_envs.world.randomness import WorldRandom
from npa_envs.world.rollout import rollout

SHORT = ("tf32", "bf16_storage", "mixed")
"""Precisions below float32, as `npa-envs bench` has them."""

RULES = ("gecko", "dots", "digits")
"""Rules that are run in them."""

QUICK_RULES = ("heart", "dots")
"""Those of a quick run."""

TWO_ERRORS = 2.0
"""Two answers that are each as far off as the group `geometry` allows are this far apart."""

STEPS = 16
"""Steps of rollouts that are compared bit by bit."""


def precision_checks(*, quick: bool) -> list[Check]:
    """Return the checks of the group `precision`; when quick only of some rules."""
    checks = [
        Check(
            f"precision/{name}/{rule}",
            f"the rule at its horizon is finite, its metric at most {WORKS:g} times that of "
            f"float32, with {PRECISIONS[name].summary}",
            partial(_run_short, PRECISIONS[name], rule),
        )
        for name in SHORT
        for rule in (QUICK_RULES if quick else RULES)
    ]
    by_dimension = {
        "order": (
            "particles in another order perceive the same but for rounding, in every hard scene",
            _run_order,
        ),
        "repeated": (
            "perception and gradients of every hard scene are the same bits when repeated",
            _run_repeated,
        ),
        "batch": (
            "every world of a batch perceives the bits that it perceives alone",
            _run_batch,
        ),
    }
    return [
        *checks,
        *in_2d_and_3d("precision", by_dimension),
        Check(
            "precision/devices",
            "a CUDA device perceives what the CPU does but for rounding, in every hard scene",
            _run_devices,
        ),
        Check(
            "precision/graph",
            f"a rollout of {STEPS} steps recorded in a CUDA graph has the bits of one that is not",
            _run_graph,
        ),
    ]


def _every_scene(space_dim: int, session: Session) -> Iterator[Scene]:
    for periodic in (False, True):
        yield from scenes(space_dim, periodic=periodic, seed=session.seed)


def _on(scene: Scene, device: torch.device) -> tuple[Tensor, Tensor]:
    """Return positions and states of a scene in float32."""
    return scene.x.to(device, torch.float32), scene.s.to(device, torch.float32)


def _run_short(precision: Precision, name: str, session: Session) -> Finding:
    why = precision.obstacle(session.device)
    if why is not None:
        raise Skipped(why)
    home = habitat(session, name)
    found = _metric(home, precision, session)
    base = _metric(home, PRECISIONS["float32"], session)
    figures = {"metric": found, "metric_float32": base, "ratio": found / base}
    return Finding(figures, {"ratio": WORKS})


@torch.no_grad()
def _metric(home: Habitat, precision: Precision, session: Session) -> float:
    """Return the metric at the horizon; NaN where worlds are not finite."""
    rule = precision.rule(home.rule)
    x, s = home.x, precision.kept(home.s)
    generator = session.generator(1)
    at_once = 1 if precision.short_states else home.horizon
    with precision.active():
        for _ in range(home.horizon // at_once):
            x, s = rollout(rule, x, s, at_once, generator=generator, **home.options())
            s = precision.kept(s)
    finite = bool(x.isfinite().all()) and bool(s.isfinite().all())
    return home.metric(x, s) if finite else float("nan")


def _difference(scene: Scene, found: Perceived, other: Perceived) -> float:
    """Return how far two perceptions of a scene are apart, over the error that one may have."""
    exact = perceived(scene.x, scene.s, scene.box, by_reference=True)
    allowed = error_limits(scene.x, scene.s, scene.box, exact)
    shares = [
        relative_error(a, b) / allowed[f"{what}_float32"]
        for what, a, b in zip(Perceived._fields, found, other, strict=True)
    ]
    # NaN must not be skipped.
    return float(torch.tensor(shares).max())


def _compared(pairs: Iterable[tuple[Scene, Perceived, Perceived]]) -> Finding:
    """Return the largest distance of two perceptions, and the scenes where it is too large."""
    shares = {
        f"{scene.name}/{'open' if scene.box is None else 'periodic'}": _difference(scene, a, b)
        for scene, a, b in pairs
    }
    largest = float(torch.tensor(list(shares.values())).max())
    wrong = [name for name, share in shares.items() if not share <= TWO_ERRORS]
    return Finding(
        {"over_allowed_error": largest},
        {"over_allowed_error": TWO_ERRORS},
        note=f"too far apart: {', '.join(wrong)}" if wrong else "",
    )


def _run_order(space_dim: int, session: Session) -> Finding:
    def pairs() -> Iterator[tuple[Scene, Perceived, Perceived]]:
        for scene in _every_scene(space_dim, session):
            x, s = _on(scene, session.device)
            order = torch.randperm(x.shape[1], generator=torch.Generator().manual_seed(7))
            order = order.to(session.device)
            weights = functional_weights(x, s)
            found = perceived(x[:, order], s[:, order], scene.box, weights=weights[:, order])
            back = order.argsort()
            found = Perceived(*(tensor[:, back] for tensor in found))
            yield scene, found, perceived(x, s, scene.box, weights=weights)

    return _compared(pairs())


def _run_devices(session: Session) -> Finding:
    if not session.cuda:
        raise Skipped("there is one device only: run it with --device cuda")

    def pairs() -> Iterator[tuple[Scene, Perceived, Perceived]]:
        for space_dim in (2, 3):
            for scene in _every_scene(space_dim, session):
                found = perceived(*_on(scene, session.device), scene.box)
                yield scene, found, perceived(*_on(scene, torch.device("cpu")), scene.box)

    return _compared(pairs())


def _run_repeated(space_dim: int, session: Session) -> Finding:
    figures = dict.fromkeys(Perceived._fields, 0.0)
    for scene in _every_scene(space_dim, session):
        x, s = _on(scene, session.device)
        first, second = (perceived(x, s, scene.box) for _ in range(2))
        for what, a, b in zip(Perceived._fields, first, second, strict=True):
            figures[what] += differing(a, b)
    return Finding(figures, dict.fromkeys(figures, 0.0))


def _run_batch(space_dim: int, session: Session) -> Finding:
    """Worlds of other scenes stand beside each, so that all have the same number of particles."""
    figures = {"open": 0.0, "periodic": 0.0}
    for periodic in (False, True):
        some = [
            scene
            for scene in scenes(space_dim, periodic=periodic, seed=session.seed)
            if scene.name != "tight_box"
        ]
        # Each scene over and over until the world is full.
        count = max(scene.x.shape[1] for scene in some)
        x = torch.cat([scene.x.repeat(1, count, 1)[:, :count] for scene in some])
        x = x.to(session.device, torch.float32)
        s = torch.randn(*x.shape[:2], STATE_DIM, generator=torch.Generator().manual_seed(5))
        s = s.to(session.device)
        together = perceive(x, s, EPS, box=some[0].box)
        for k in range(len(x)):
            alone = perceive(x[k : k + 1], s[k : k + 1], EPS, box=some[0].box)
            figures["periodic" if periodic else "open"] += differing(together[k], alone[0])
    return Finding(figures, dict.fromkeys(figures, 0.0))


@torch.no_grad()
def _run_graph(session: Session) -> Finding:
    if not session.cuda:
        raise Skipped("graphs are CUDA's: run it with --device cuda")
    rule = load_rule("gecko", device=session.device).float()
    home = habitat(session, "gecko", world_count=3, looks=False)
    random = WorldRandom([0, 1, 2], device=session.device)
    x, s = torch.empty_like(home.x), torch.empty_like(home.s)

    def run() -> None:
        worlds = rollout(rule, home.x, home.s, STEPS, generator=random, **home.options())
        x.copy_(worlds[0])
        s.copy_(worlds[1])

    run()
    eager = x.clone(), s.clone()
    figures = {"positions": 0.0, "states": 0.0}
    graph = capture(run, session.device, warm_up=run)
    for _ in range(2):
        random.steps.zero_()
        x.zero_()
        s.zero_()
        graph.replay()
        figures["positions"] += differing(x, eager[0])
        figures["states"] += differing(s, eager[1])
    return Finding(figures, dict.fromkeys(figures, 0.0))
