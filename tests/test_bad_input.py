"""What the operators and the dynamics refuse, and what they say."""

import numpy as np
import pytest
import torch

import npa_envs
from npa_envs import NPAError, NPARule, perceive, perception_fields, rollout


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
