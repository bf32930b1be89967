"""What the operators and the dynamics refuse, and what they say."""

import gymnasium
import numpy as np
import pytest
import torch

import npa_envs
from npa_envs import NPAError, NPARule, perceive, perception_fields, rollout
from npa_envs.measure.quality import scores
from npa_envs.ops import orbit, periodic_splat, splat
from npa_envs.render import to_uint8, write_gif
from npa_envs.tasks.damage import damage_worlds, parse_damage
from npa_envs.tasks.seeds import uniform_ball, uniform_box
from npa_envs.tasks.texture import TextureConfig
from npa_envs.training import preset
from npa_envs.wrappers import TorchNormalizeReward


def world(**options):
    return torch.zeros(1, 4, 2, **options), torch.zeros(1, 4, 16, **options)


@pytest.mark.parametrize("function", [perceive, perception_fields])
class TestOperators:
    def test_missing_world_dimension(self, function):
        x, s = world()
        with pytest.raises(
            NPAError, match=r"x must have shape \[B, N, D\], got \(4, 2\).*x\[None\]"
        ):
            function(x[0], s, 0.1)
        with pytest.raises(NPAError, match=r"s must have shape \[B, N, C\]"):
            function(x, s[0], 0.1)

    def test_wrong_dimension_and_count(self, function):
        x, s = world()
        with pytest.raises(NPAError, match="2 or 3 coordinates"):
            function(torch.zeros(1, 4, 5), s, 0.1)
        with pytest.raises(NPAError, match="agree in worlds and particles"):
            function(x, s[:, :3], 0.1)
        with pytest.raises(NPAError, match="at least one particle"):
            function(x[:, :0], s[:, :0], 0.1)

    def test_wrong_types(self, function):
        x, s = world()
        with pytest.raises(NPAError, match="must be a torch tensor"):
            function(x.numpy(), s, 0.1)
        with pytest.raises(NPAError, match="float32 or float64"):
            function(x.int(), s, 0.1)
        with pytest.raises(NPAError, match="float32 or float64"):
            function(x, s.half(), 0.1)
        with pytest.raises(NPAError, match="share dtype and device"):
            function(x.double(), s, 0.1)

    @pytest.mark.parametrize("value", [float("nan"), float("inf"), -float("inf")])
    def test_positions_that_are_not_finite(self, function, value):
        x, s = world()
        x[0, 2, 1] = value
        with pytest.raises(NPAError, match=r"x must be finite.*world 0, particle 2"):
            function(x, s, 0.1)

    @pytest.mark.parametrize("eps", [0.0, -0.1, float("nan"), float("inf")])
    def test_eps_out_of_range(self, function, eps):
        with pytest.raises(NPAError, match="eps must be positive and finite"):
            function(*world(), eps)

    @pytest.mark.parametrize("eps", ["a", None, [0.1], True])
    def test_eps_that_is_no_number(self, function, eps):
        with pytest.raises(NPAError, match="eps must be a number"):
            function(*world(), eps)

    @pytest.mark.parametrize("eps", [1e-170, 1e-20, 1e20, 1e200])
    def test_eps_beyond_the_dtype(self, function, eps):
        with pytest.raises(NPAError, match=r"eps must lie in .* for torch\.float32"):
            function(*world(), eps)

    @pytest.mark.parametrize("box", [np.float32(2.0), torch.tensor(2.0), np.array([2.0, 3.0])])
    def test_numbers_of_other_libraries_are_numbers(self, function, box):
        x, s = world()
        assert torch.isfinite(function(x, s, np.float64(0.1), box=box)[0]).all()

    @pytest.mark.parametrize("box", ["ab", ("a", 1.0), object()])
    def test_box_that_is_no_number(self, function, box):
        with pytest.raises(NPAError, match="must be a number"):
            function(*world(), 0.1, box=box)

    @pytest.mark.parametrize("box", [0.19, (1.0, 0.1), (1.0, float("nan"))])
    def test_box_too_small(self, function, box):
        with pytest.raises(NPAError, match=r"at least 2 eps = 0\.2"):
            function(*world(), 0.1, box=box)

    def test_box_with_wrong_number_of_sides(self, function):
        with pytest.raises(NPAError, match="box must have 2 sides, got 3"):
            function(*world(), 0.1, box=(1.0, 1.0, 1.0))


def test_eps0_far_from_eps():
    with pytest.raises(NPAError, match="eps / eps0 must be a moderate ratio"):
        perceive(torch.zeros(1, 4, 3), torch.zeros(1, 4, 2), 1e7, 1e-7)


def test_eps0_out_of_range():
    with pytest.raises(NPAError, match="eps0 must be positive"):
        perceive(*world(), 0.1, 0.0)


class TestRollout:
    def test_counts_of_other_libraries_are_counts(self):
        x, s = rollout(NPARule(), *world(), np.int64(2))
        assert torch.isfinite(x).all()
        assert torch.isfinite(s).all()

    def test_numbers_of_other_libraries_survive_in_a_rule(self, tmp_path):
        rule = NPARule(alpha=np.float32(0.5))
        npa_envs.save_rule(rule, tmp_path / "rule.safetensors")
        assert npa_envs.load_rule(tmp_path / "rule.safetensors").alpha == 0.5

    @pytest.mark.parametrize(
        ("options", "message"),
        [
            ({"update_prob": 0.0}, r"update_prob must lie in \(0, 1\], got 0.0"),
            ({"update_prob": 1.5}, "update_prob"),
            ({"update_prob": float("nan")}, "update_prob"),
            ({"dt": 0.0}, "dt must be positive"),
            ({"position_noise": -1.0}, "position_noise"),
            ({"eps": -0.1}, "eps must be positive"),
            ({"box": 0.1}, "box sides"),
            ({"dt": "fast"}, "dt must be a number"),
            ({"generator": 3}, "generator must be a torch.Generator or a WorldRandom, got int"),
            ({"memory": "forget"}, "memory must be 'store', 'recompute' or 'minimal'"),
        ],
    )
    def test_options_out_of_range(self, options, message):
        with pytest.raises(NPAError, match=message):
            rollout(NPARule(), *world(), 1, **options)

    @pytest.mark.parametrize("steps", [-1, 2.0, True, "3"])
    def test_steps_that_are_no_count(self, steps):
        with pytest.raises(NPAError, match="steps must be an integer"):
            rollout(NPARule(), *world(), steps)

    def test_worlds_that_do_not_fit_the_rule(self):
        x, s = world()
        with pytest.raises(NPAError, match="the rule's 2 coordinates and 16 channels"):
            rollout(NPARule(), x, s[..., :8], 1)
        with pytest.raises(NPAError, match="share dtype and device"):
            rollout(NPARule(), x.double(), s.double(), 1)

    def test_positions_that_are_not_finite(self):
        x, s = world()
        x[0, 0, 0] = float("nan")
        with pytest.raises(NPAError, match="x must be finite"):
            rollout(NPARule(), x, s, 1)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"space_dim": 4}, "space_dim must be 2 or 3"),
        ({"state_dim": 0}, "state_dim must be at least 1"),
        ({"hidden_dim": 0}, "hidden_dim"),
        ({"eps0": 0.0}, "eps0"),
        ({"alpha": float("inf")}, "alpha"),
        ({"readout_dim": 3}, "readout_hidden_dim"),
        ({"space_dim": 2.0}, "dimensions of a rule must be integers"),
        ({"hidden_dim": True}, "dimensions of a rule must be integers"),
    ],
)
def test_rules_out_of_range(options, message):
    with pytest.raises(NPAError, match=message):
        npa_envs.NPARule(**options)


def splatted(**options):
    given = {"resolution": 8, "pixel_size": 0.2} | options
    return splat(torch.zeros(1, 4, 2), torch.zeros(1, 4, 3), **given)


SPARSE = torch.zeros(1, 4, 2).to_sparse()
META = torch.zeros(1, 4, 2, device="meta")


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: rollout(3, *world(), 1), "rule must be an NPARule, got int"),
        (lambda: rollout(NPARule(), *world(), 1, memory=[]), "memory must be 'store'"),
        (lambda: perceive(SPARSE, SPARSE, 0.1), "x must be a dense tensor"),
        (lambda: perceive(META, META, 0.1), "x must be a dense tensor on 'cpu' or 'cuda'"),
        (
            lambda: perceive(*world(), 0.1, detach_positions=torch.ones(2)),
            "detach_positions must be True or False",
        ),
        (
            lambda: npa_envs.species_fields(world()[0], torch.tensor(4), eps=0.1),
            "counts must hold one number",
        ),
        (lambda: npa_envs.rollout_species(np.array(1.0), *world(), 1, counts=[4]), "rules must"),
        (lambda: NPARule(alpha=[]), "alpha must be a number"),
        (lambda: NPARule(hidden_dim=2**31), "at most 65536"),
        (lambda: npa_envs.save_rule(3, "a.safetensors"), "rule must be an NPARule"),
        (lambda: npa_envs.save_rule(NPARule(), {}), "a path must be text"),
        (
            lambda: npa_envs.save_rule(NPARule(), "a.safetensors", metadata=[1]),
            "metadata must map text to text",
        ),
        (lambda: npa_envs.shipped_rules(np.zeros(2)), "task must be the name of one"),
        (lambda: npa_envs.world_mean(3.0), "values must be a torch tensor"),
        (lambda: npa_envs.WorldRandom(0, device=2**31), "device must be text"),
        (lambda: npa_envs.WorldRandom(0).uniform(2**64), "a draw must have at most"),
        (lambda: scores(["a"]), "unknown rule"),
        (lambda: splatted(resolution="8"), "resolution must be an integer"),
        (lambda: splatted(resolution=2**31), r"resolution must lie in \[1, 16384\]"),
        (lambda: splatted(hi=[1.0]), "hi must be a number"),
        (lambda: splatted(hi=1e300), "must have a size in"),
        (
            lambda: periodic_splat(
                torch.zeros(1, 4, 2), torch.zeros(1, 4, 3), resolution=8, pixel_size=0.2, sigma=1e5
            ),
            "stay within 16384 pixels",
        ),
        (lambda: orbit(1, centre=1.0, width=4, height=4), "centre must be 3 numbers"),
        (lambda: orbit(1, fov=[1], width=4, height=4), "fov must be a number"),
        (lambda: orbit(1, width=(4,), height=4), "width must be an integer"),
        (lambda: uniform_ball(2, None, 2, 0.1), "particle_count must be an integer"),
        (lambda: uniform_ball(2, 2**31, 2, 0.1), "coordinates must be at most"),
        (lambda: uniform_box(2, 3, 1.0), "box must hold a side"),
        (lambda: parse_damage(3), "damage must be text"),
        (lambda: damage_worlds(*world(), kind="erase", size={}), "size must be a number"),
        (lambda: damage_worlds(*world(), kind="erase", size=1e300), "at least 0"),
        (lambda: preset("tiny", 3), "unknown task 3"),
        (lambda: preset("tiny", decay=10**400), "decay must be of type float"),
        (lambda: TextureConfig(eps=10**400), "eps must be a finite number"),
        (lambda: to_uint8(torch.zeros(2, 2, 4), background=2.0), "background must be red"),
        (lambda: write_gif("a.gif", 3), "frames must be a sequence"),
        (
            lambda: gymnasium.make("npa/Texture-v0", particle_count=16, eps=5e-324),
            "eps must be at least 1e-09",
        ),
        (
            lambda: gymnasium.make("npa/Texture-v0", particle_count=16, success_loss=2**64),
            "success_loss must be at most",
        ),
        (lambda: TorchNormalizeReward(()), "needs a vector environment, got tuple"),
    ],
)
def test_what_the_fuzz_found_is_a_clear_error(call, message):
    with pytest.raises(NPAError, match=message):
        call()
