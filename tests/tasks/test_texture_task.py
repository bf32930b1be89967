"""The texture task: its worlds, its loss, and that it is learned."""

import dataclasses

import pytest
import torch
from support.training_runs import worlds_of

from npa_envs.cli import main
from npa_envs.rule.files import load_rule
from npa_envs.tasks.texture import Texture, TextureConfig, colour_image, density_image
from npa_envs.training import override, preset, train

SMALL = TextureConfig(target="bubbles", particle_count=300, resolution=24, eps=0.3)


def lattice(side):
    """Return positions of a particle in the middle of each pixel, [1, side², 2]."""
    axis = (2.0 * torch.arange(side) + 1.0) / side - 1.0
    y, x = torch.meshgrid(axis, axis, indexing="ij")
    return torch.stack((x, y), dim=-1).view(1, -1, 2)


def test_seeds_fill_the_box_evenly():
    task = Texture(dataclasses.replace(SMALL, particle_count=4000, box_size=3.0))
    x, s, *_ = task.seed(2, generator=torch.Generator().manual_seed(0))
    assert task.box == (3.0, 3.0)
    assert float(s.abs().max()) == 0.0
    assert 1.49 < float(x.abs().max()) <= 1.5
    counts = torch.histogramdd(x[0], bins=[4, 4], range=[-1.5, 1.5, -1.5, 1.5]).hist
    # 250 are expected in each; five standard deviations are 79.
    assert float((counts - 250.0).abs().max()) < 79.0
    assert not torch.equal(x[0], x[1])


def test_all_particles_together_have_the_target_s_mean_density():
    task = Texture(SMALL)
    picture = task.picture(*worlds_of(task, 2))
    expected = torch.full((2,), task.target.coverage)
    torch.testing.assert_close(picture[..., 3].mean((1, 2)), expected, rtol=1e-5, atol=0.0)
    assert 0.4 < task.target.coverage < 0.6


def test_eps_is_raised_so_that_particles_see_across_gaps(tmp_path):
    config = TextureConfig(target="hearts", resolution=48, particle_count=64, see_across=True)
    raised = Texture(config).config
    assert raised.eps == pytest.approx(0.3, abs=0.05)
    assert Texture(raised).config == raised, "settled once"
    assert Texture(dataclasses.replace(config, eps=0.5)).config.eps == 0.5, "never lowered"
    assert Texture(dataclasses.replace(config, target="maze")).config.eps == 0.2, "no gaps"
    # The rule's file tells at which it was trained.
    tiny = preset("tiny", "texture", target="hearts", eps=0.1, see_across=True, out=tmp_path)
    result = train(override(tiny, iterations=1, particle_count=32, steps=(1, 2)), "texture")
    assert load_rule(tmp_path / "rule.safetensors").eps0 == result.rule.eps0 > 0.2


def test_density_is_compared_as_its_tenth_root():
    values = density_image(torch.tensor([0.0, 1e-3, 1.0, 2.0], dtype=torch.float64))
    expected = torch.tensor([1e-6, 1.001e-3, 1.000001, 2.000001], dtype=torch.float64) ** 0.1
    torch.testing.assert_close(values, expected)
    assert float(values[0]) == pytest.approx(10.0**-0.6)


def test_colours_are_compared_as_the_mean_where_particles_overlap():
    task = Texture(dataclasses.replace(SMALL, target="cells", particle_count=24**2))
    positions = lattice(24)
    _, s = worlds_of(task, 1)
    colour, density = task.texture_losses(positions, s)
    # Every particle stands twice where it stood: as before, but twice as dense.
    twice = task.texture_losses(positions.repeat(1, 2, 1), s.repeat(1, 2, 1))
    torch.testing.assert_close(twice[0], colour, rtol=1e-4, atol=0.0)
    assert float(density) < 1e-4 < float(twice[1])
    half = torch.tensor([0.1, 0.2, 0.3, 0.5])[:, None, None]
    assert torch.equal(colour_image(half), half[:3])
    torch.testing.assert_close(colour_image(4.0 * half), 2.0 * half[:3])


def test_loss_ignores_which_particle_is_which_and_where_the_world_lies():
    task = Texture(SMALL)
    x, s = worlds_of(task, 1, torch.float64)
    value = task.metric(x, s)
    # The first particle stays the first: the world is looked at from its place.
    order = torch.cat((torch.zeros(1).long(), 1 + torch.randperm(299)))
    torch.testing.assert_close(task.metric(x[:, order], s[:, order]), value, rtol=1e-12, atol=0.0)
    moved = (x + torch.tensor([0.7, -1.3]) + 1.0) % 2.0 - 1.0
    torch.testing.assert_close(task.metric(moved, s), value, rtol=1e-9, atol=0.0)


def test_particles_in_the_target_s_place_are_nearer_than_any_others():
    """Particles on a fine lattice, coloured as the target, against the same colours shuffled."""
    task = Texture(TextureConfig(target="cells", particle_count=48**2, resolution=48))
    s = torch.zeros(1, 48**2, 16)
    s[0, :, -3:] = task.target_picture[..., :3].view(-1, 3) - 0.5
    states = s, s[:, torch.randperm(48**2)], torch.zeros_like(s)
    drawn, shuffled, blank = (float(task.metric(lattice(48), each)) for each in states)
    # 0.07, 0.98 and 3.7 were seen.
    assert drawn < 0.1
    assert min(shuffled, blank) > 5.0 * drawn


def test_a_loss_is_refused_where_there_is_none_to_choose(capsys):
    assert main(["evaluate", "gecko", "--loss", "patch_swd", "--no-progress"]) == 2
    assert "unknown field 'loss'" in capsys.readouterr().err
