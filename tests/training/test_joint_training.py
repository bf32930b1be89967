"""Rules that are trained together: the task of several species, and the run it makes."""

import pytest
import torch
from support.refusals import refused

from npa_envs.rule.files import load_rule
from npa_envs.tasks.co_morphogenesis2d import CoMorphogenesis2D, CoMorphogenesis2DConfig
from npa_envs.tasks.morphogenesis2d import Morphogenesis2DConfig
from npa_envs.tasks.train_config import tiny_run
from npa_envs.training import train_together
from npa_envs.world.particles import Particles


def small(target, count=48, **fields):
    usual = {"hidden_dim": 24, "eps": 0.3, "resolution": 24, "state_dim": 6}
    usual |= {"particle_count": count, "target_point_count": count}
    return Morphogenesis2DConfig(target=target, **usual | fields)


def pair(**fields):
    usual = {"species": (small("ring"), small("heart", 32)), "distance": 0.8}
    return CoMorphogenesis2DConfig(**usual | fields)


def run_config(out, **fields):
    usual = {"iterations": 4, "pool_size": 6, "steps": (4, 8), "milestones": (), "out": out}
    usual |= {"seed_interval": 2, "picture_interval": 2, "checkpoint_interval": 2}
    return tiny_run(task=pair(), **usual | fields)


@pytest.fixture(scope="module")
def task():
    return CoMorphogenesis2D(pair())


def worlds(task, seed=0):
    generator = torch.Generator().manual_seed(seed)
    x, s, *_ = task.seed(3, generator=generator)
    return x, 0.3 * torch.randn(s.shape, generator=generator), generator


class TestTask:
    """The task of every species on its own particles."""

    def test_seeds_lie_in_a_row_around_the_origin(self, task):
        x, s, *_ = task.seed(4, generator=torch.Generator().manual_seed(0))
        assert x.shape == (4, 80, 2)
        assert not s.any()
        for part, centre in zip(x.split([48, 32], dim=1), (-0.4, 0.4), strict=True):
            away = part - torch.tensor([centre, 0.0])
            assert away.norm(dim=-1).max() <= 0.2
            assert away.mean(dim=1).abs().max() < 0.1

    def test_the_loss_is_the_sum_of_the_species_own(self, task):
        x, s, _ = worlds(task)
        x = 3.0 * x  # Some leave the bounds around their seed.
        path = torch.rand(3, 80, generator=torch.Generator().manual_seed(1))
        total, parts = task.loss(Particles(x, s, path))
        one, other = Particles(x, s, path).split([48, 32])
        shift = torch.tensor([0.4, 0.0])
        first, first_parts = task.tasks[0].loss(one._replace(x=one.x + shift))
        second, second_parts = task.tasks[1].loss(other._replace(x=other.x - shift))
        assert first_parts["bound"] > 0.0
        assert total.item() == pytest.approx((first + second).item(), rel=1e-6)
        expected = {f"0.{k}": v.item() for k, v in first_parts.items()}
        expected |= {f"1.{k}": v.item() for k, v in second_parts.items()}
        assert {k: v.item() for k, v in parts.items()} == pytest.approx(expected, rel=1e-6)

    def test_the_picture_shows_all_species_where_they_are(self, task):
        x, s, _ = worlds(task)
        density = task.picture(x + torch.tensor([0.1, -0.1]), s)[..., 3]
        axis = torch.linspace(-1.0, 1.0, density.shape[1])
        total = density.sum(dim=(1, 2))
        middle = torch.stack(
            ((density.sum(1) * axis).sum(1) / total, (density.sum(2) * axis).sum(1) / total), dim=1
        )
        expected = x.mean(dim=1) + torch.tensor([0.1, -0.1])
        assert (middle - expected).abs().max() < 0.02

    @pytest.mark.parametrize(
        ("fields", "message"),
        [
            ({"species": (small("ring"),)}, "or more, got Morphogenesis2DConfig: one for"),
            ({"species": (small("ring"), "heart")}, "got Morphogenesis2DConfig, str: one for"),
            (
                {"species": (small("ring"), small("heart", eps=0.2))},
                r"agree in eps, got \[0\.3, 0\.2\]",
            ),
            ({"distance": -1.0}, "distance"),
        ],
    )
    def test_species_that_do_not_fit_are_refused(self, fields, message):
        refused(message, pair, **fields)

    def test_one_rule_is_not_enough(self, task):
        refused("2 species need as many rules, not one", task.make_rule, torch.Generator())


class TestRun:
    def test_new_rules_take_the_runs_options_and_initial_ones_keep_their_dead_zone(self, tmp_path):
        options = {"moment_inverse": "smooth", "dead_zone": 0.01}
        config = run_config(tmp_path / "run", iterations=1, **options)
        initial = CoMorphogenesis2D(pair()).make_rules(torch.Generator())
        initial[1].dead_zone = 0.5
        for rules, dead_zones in ((None, [0.01, 0.01]), (initial, [0.0, 0.5])):
            result = train_together(config, rules, overwrite=True, progress=False)
            assert [rule.moment_inverse for rule in result.rule] == ["smooth", "smooth"]
            assert [rule.dead_zone for rule in result.rule] == dead_zones
            saved = load_rule(tmp_path / "run" / "rule-1.safetensors")
            assert (saved.moment_inverse, saved.dead_zone) == ("smooth", dead_zones[1])

    @pytest.mark.parametrize(
        ("species", "count", "fields", "message"),
        [
            (("heart", {}), 1, {}, "one for each of 2 species, got 1"),
            (
                ("heart", {"hidden_dim": 8}),
                2,
                {},
                r"rule 1 differs in hidden_dim \(8, .* of species 1",
            ),
            (None, 0, {"initial_rule": "gecko"}, "initial_rule is for one rule, got 'gecko'"),
        ],
    )
    def test_rules_that_do_not_fit_are_refused(self, tmp_path, species, count, fields, message):
        rules = None
        if species is not None:
            target, own = species
            other = pair(species=(small("ring"), small(target, 32, **own)))
            rules = CoMorphogenesis2D(other).make_rules(torch.Generator())[:count]
        refused(message, train_together, run_config(tmp_path, **fields), rules, progress=False)
