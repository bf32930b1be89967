"""The loss of 2D morphogenesis on pictures that are blurred and halved."""

from __future__ import annotations

import pytest
import torch

from npa_envs.tasks.morphogenesis2d import Morphogenesis2D, Morphogenesis2DConfig

SMALL = {"target": "heart", "target_point_count": 64, "particle_count": 64, "resolution": 32}


def task_of(levels, **fields):
    return Morphogenesis2D(Morphogenesis2DConfig(blur_levels=levels, **SMALL | fields))


def world(seed=0, dtype=torch.float64):
    generator = torch.Generator().manual_seed(seed)
    x = 1.2 * torch.rand(2, 64, 2, generator=generator, dtype=dtype) - 0.6
    return x, 0.5 * torch.randn(2, 64, 16, generator=generator, dtype=dtype)


def halved_by_hand(picture):
    """Means of 4 x 4 pixels around every second corner; outside there is nothing."""
    side = picture.shape[1] // 2
    padded = torch.nn.functional.pad(picture, (0, 0, 1, 1, 1, 1))
    rows = [padded[:, 2 * r : 2 * r + 4] for r in range(side)]
    return torch.stack(
        [
            torch.stack([row[:, :, 2 * c : 2 * c + 4].mean((1, 2)) for c in range(side)], dim=1)
            for row in rows
        ],
        dim=1,
    )


def test_the_loss_is_the_mean_over_the_pictures():
    (x, s), task = world(), task_of(2)
    difference = task.picture(x, s) - task.target_picture
    densities, colours = [], []
    for _ in range(3):
        growth = difference.abs() + difference.square()
        densities.append(growth[..., 3].mean())
        colours.append((growth[..., :3].mean(-1) * (-growth[..., 3]).exp()).mean())
        difference = halved_by_hand(difference)
    total, parts = task.compare(x, s)
    assert parts["density"].item() == pytest.approx(sum(densities).item() / 3, rel=1e-6)
    assert parts["colour"].item() == pytest.approx(sum(colours).item() / 3, rel=1e-6)
    assert total.item() == pytest.approx(
        2.0 * (parts["density"] + 5.0 * parts["colour"]).item(), rel=1e-6
    )
    # What is measured is the sharp picture.
    assert torch.equal(task.metric(x, s), task_of(0).metric(x, s))


def test_a_stray_is_drawn_to_where_particles_are_missing_only_by_blurred_pictures():
    """Where spots do not overlap, sharp pictures differ as much wherever a stray is."""
    target = task_of(0).target
    s = torch.zeros(1, len(target.points), 16, dtype=torch.float64)
    s[..., -3:] = target.colours - 0.5
    lowest, highest = target.points[:, 1].argmin(), target.points[:, 1].argmax()
    losses = []
    for away in (0.3, 0.4):
        # The tip's point leaves to the left; another one balances the mean.
        x = target.points[None].double().clone()
        x[0, lowest, 0] -= away
        x[0, highest, 0] += away
        sharp, blurred = (
            task_of(levels, sigma=0.3, resolution=128).compare(x, s)[0].item() for levels in (0, 5)
        )
        losses.append((sharp, blurred))
    (sharp_near, blurred_near), (sharp_far, blurred_far) = losses
    assert sharp_near == pytest.approx(sharp_far, rel=1e-2)
    assert blurred_near < 0.95 * blurred_far


def test_gradients_of_blurred_pictures_are_their_derivatives():
    (x, s), task = world(3), task_of(2)
    direction = torch.randn(s.shape, generator=torch.Generator().manual_seed(4), dtype=s.dtype)
    s.requires_grad_()
    (gradient,) = torch.autograd.grad(task.compare(x, s)[0], s)
    step = 1e-6
    with torch.no_grad():
        ahead, behind = (task.compare(x, s + h * direction)[0] for h in (step, -step))
    slope = ((ahead - behind) / (2 * step)).item()
    assert (gradient * direction).sum().item() == pytest.approx(slope, rel=1e-4)
