"""Every shipped rule for 100 000 steps: extent, overflow, drift and energy stay bounded."""

from __future__ import annotations

from functools import partial

import torch
from torch import Tensor

from npa_envs.measure.accuracy.checks import Check, Finding, Session
from npa_envs.measure.accuracy.habitats import Habitat, LongRun, habitat, rule_names
from npa_envs.world.rollout import rollout

STEPS, QUICK_STEPS = 100_000, 200
"""How long a rule is run."""

SETTLED = 512
"""Step whose worlds later ones are compared with; half of the run where that is sooner."""

MARKS = 16
"""How often worlds are measured after that."""

LIMITS = {
    "not_finite": 0.0,
    "extent": 2.0,
    "overflow": 0.1,
    "largest_state": 8.0,
    "energy": 4.0,
    "drift": 1.0,
}
"""Bounds of the figures that `endurance_checks` describes."""


def endurance_checks() -> list[Check]:
    """Return the checks of the group `time`.

    Figures are the largest after the world has settled. `extent`: longest side of the bounding box,
    over that of the settled world. `overflow`: mean |s − clip(s, −1, 1)|. `largest_state`: the
    largest |s|. `energy`: mean over particles of |Δx|²/ε² + mean Δs² of one step, over that of the
    settled world. `drift`: how far the centroid is from where it was, in extents of the settled
    world; where a rule moves its particles in open space.
    """
    expected = (
        "no number becomes infinite or NaN; the extent at most doubles, updates have at most four "
        "times the energy of the settled world's, states stay within 8 and on average within 1.1, "
        "the centroid moves by an extent at most"
    )
    return [Check(f"time/{name}", expected, partial(_run, name)) for name in rule_names()]


def measured(home: Habitat, x: Tensor, s: Tensor, generator: torch.Generator) -> dict[str, float]:
    """Return the figures of worlds x [B, N, D], s [B, N, C], none of them compared with others.

    One more step, with masks from the generator, tells the energy.
    """
    with torch.no_grad():
        not_finite = (~x.isfinite()).sum() + (~s.isfinite()).sum()
        if int(not_finite):
            return {"not_finite": float(not_finite)}
        new_x, new_s = rollout(home.rule, x, s, 1, generator=generator, **home.options())
        moved = new_x - x
        if home.task.box is not None:
            sides = torch.tensor(home.task.box, dtype=x.dtype, device=x.device)
            moved = moved - sides * torch.round(moved / sides)
        energy = (moved / home.task.eps).square().sum(-1).mean() + (new_s - s).square().mean()
        return {
            "not_finite": 0.0,
            "extent": float((x.amax(1) - x.amin(1)).amax()),
            "overflow": float((s - s.clamp(-1.0, 1.0)).abs().mean()),
            "largest_state": float(s.abs().max()),
            "energy": float(energy),
        }


def _run(name: str, session: Session) -> Finding:
    home = habitat(session, name, looks=False)
    steps = QUICK_STEPS if session.quick else STEPS
    settled = min(SETTLED, steps // 2)
    # Evenly spread on a logarithmic scale.
    marks = [round(settled * (steps / settled) ** (k / MARKS)) for k in range(MARKS + 1)]
    run = LongRun(home, session.generator(1), home.options())
    own_steps = session.generator(2)
    open_space = home.task.box is None and not home.rule.static
    figures: dict[str, float] = {"steps": float(steps), "particles": float(home.x.shape[1])}
    limits = {key: limit for key, limit in LIMITS.items() if key != "drift" or open_space}
    first: dict[str, float] = {}
    centroid = home.x.mean(1)
    note = ""
    for step, x, s in run.marks(marks):
        found = measured(home, x, s, own_steps)
        if not first and not found["not_finite"]:
            first, centroid = dict(found), x.mean(1)
        if not found["not_finite"]:
            if open_space:
                found["drift"] = float((x.mean(1) - centroid).norm(dim=-1).max())
            for key, unit in (("extent", "extent"), ("energy", "energy"), ("drift", "extent")):
                if key in found:
                    # A world that has come to rest: what it does then is rounding.
                    found[key] /= max(first[unit], 1e-12)
        for key, value in found.items():
            figures[key] = max(value, figures.get(key, 0.0))
        over = [key for key, limit in limits.items() if not found.get(key, 0.0) <= limit]
        if over and not note:
            note = f"{', '.join(over)} above the bound at step {step}"
        if found["not_finite"]:
            break
    return Finding(figures, limits, note=note)
