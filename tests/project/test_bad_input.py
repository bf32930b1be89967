"""What the operators, the dynamics and errors reject, and what they say."""

import gymnasium
import numpy as np
import pytest
import torch
from support.refusals import calls, refused

import npa_envs
from npa_envs import (
    NPAError,
    NPARule,
    perceive,
    perception_fields,
    rollout,
    rollout_species,
    save_rule,
    species_fields,
)
from npa_envs.agents.learning import Budget, Problem
from npa_envs.agents.learning import train as learn
from npa_envs.envs import multispecies_v0
from npa_envs.errors import shown, suggest
from npa_envs.measure.quality import scores
from npa_envs.ops import orbit, periodic_splat, splat, warmup
from npa_envs.render import write_gif
from npa_envs.tasks.damage import damage_worlds, parse_damage
from npa_envs.tasks.seeds import uniform_ball, uniform_box
from npa_envs.tasks.texture import TextureConfig
from npa_envs.training import preset, train
from npa_envs.web.export import export_web
from npa_envs.world.brushes import wipe_state
from npa_envs.world.particles import Particles
from npa_envs.wrappers import RowPolicy, TorchNormalizeReward

X, X3, S = torch.zeros(1, 4, 2), torch.zeros(1, 4, 3), torch.zeros(1, 4, 16)
ONE_STEP = Budget(particle_steps=1)
NAN, INF = float("nan"), float("inf")
HOLED = X.clone()
HOLED[0, 2, 1] = NAN
NO_NUMBER, NOT_POSITIVE = "eps must be a number", "eps must be positive and finite"
BEYOND, SMALL_BOX = r"eps must lie in .* for torch\.float32", r"at least 2 eps = 0\.2"


@pytest.mark.parametrize("function", [perceive, perception_fields])
@pytest.mark.parametrize(
    ("x", "s", "eps", "box", "message"),
    [
        (X[0], S, 0.1, None, r"x must have shape \[B, N, D\], got \(4, 2\).*x\[None\]"),
        (X, S[0], 0.1, None, r"s must have shape \[B, N, C\]"),
        (torch.zeros(1, 4, 5), S, 0.1, None, "2 or 3 coordinates"),
        (X, S[:, :3], 0.1, None, "agree in worlds and particles"),
        (X[:, :0], S[:, :0], 0.1, None, "at least one particle"),
        (X.numpy(), S, 0.1, None, "must be a torch tensor"),
        (X.int(), S, 0.1, None, "float32 or float64"),
        (X, S.half(), 0.1, None, "float32 or float64"),
        (X.double(), S, 0.1, None, "share dtype and device"),
        (HOLED, S, 0.1, None, r"x must be finite.*world 0, particle 2"),
        (HOLED.nan_to_num(nan=INF), S, 0.1, None, r"x must be finite.*world 0, particle 2"),
        (HOLED.nan_to_num(nan=-INF), S, 0.1, None, r"x must be finite.*world 0, particle 2"),
        *((X, S, eps, None, NOT_POSITIVE) for eps in (0.0, -0.1, NAN, INF)),
        *((X, S, eps, None, NO_NUMBER) for eps in ("a", None, [0.1], True)),
        *((X, S, eps, None, BEYOND) for eps in (1e-170, 1e-20, 1e20, 1e200)),
        *((X, S, 0.1, box, "must be a number") for box in ("ab", ("a", 1.0), object())),
        *((X, S, 0.1, box, SMALL_BOX) for box in (0.19, (1.0, 0.1), (1.0, NAN))),
        (X, S, 0.1, (1.0, 1.0, 1.0), "box must have 2 sides, got 3"),
    ],
)
def test_operators_name_what_they_reject(function, x, s, eps, box, message):
    with pytest.raises(NPAError, match=message):
        function(x, s, eps, box=box)


def test_a_call_that_was_allowed_does_not_let_similar_ones_pass():
    box, rule = [4.0, 4.0], NPARule()
    for _ in range(2):
        perceive(X, S, 1), perceive(X, S, 1.0, box=box), rollout(rule, X, S, 1, dt=1)
        refused(NO_NUMBER, perceive, X, S, True)
        refused("share dtype", perceive, X, S.double(), 1)
        refused("agree in worlds", perceive, X, S[:, :3], 1)
        refused("dense tensor", perceive, X, SPARSE, 1)
        refused("dt must be a number", rollout, rule, X, S, 1, dt=True)
        refused("must have the rule's", rollout, WIDE, X, S, 1)
    box[0] = 1.0
    refused("at least 2 eps", perceive, X, S, 1.0, box=box)
    rule.to(torch.float64)
    refused("the rule must share dtype", rollout, rule, X, S, 1, dt=1)


@pytest.mark.parametrize("function", [perceive, perception_fields])
@pytest.mark.parametrize("box", [np.float32(2.0), torch.tensor(2.0), np.array([2.0, 3.0])])
def test_numbers_of_other_libraries_are_numbers(function, box):
    assert torch.isfinite(function(X, S, np.float64(0.1), box=box)[0]).all()


def test_numbers_of_other_libraries_survive_in_a_rule(tmp_path):
    rule = NPARule(alpha=np.float32(0.5))
    assert all(torch.isfinite(t).all() for t in rollout(rule, X, S, np.int64(2)))
    save_rule(rule, tmp_path / "rule.safetensors")
    assert npa_envs.load_rule(tmp_path / "rule.safetensors").alpha == 0.5


rule = calls(NPARule)
rolled = calls(rollout, NPARule(), x=X, s=S, steps=1)
splatted = calls(splat, X, S[..., :3], resolution=8, pixel_size=0.2)
camera = calls(orbit, 1, width=4, height=4)
small = calls(gymnasium.make, "npa/Texture-v0", particle_count=16)
damaged = calls(damage_worlds, Particles(X, S), kind="wipe")
crowd = multispecies_v0.parallel_env
PROBLEM = Problem(env_id="npa/Morphogenesis2DSmall-v0", episode_steps=4)
SPARSE, META = X.to_sparse(), X.to("meta")
WIDE = NPARule(state_dim=2)


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (rolled(update_prob=0.0), r"update_prob must lie in \(0, 1\], got 0.0"),
        (rolled(update_prob=NAN), "update_prob"),
        (rolled(dt=0.0), "dt must be positive"),
        (rolled(position_noise=-1.0), "position_noise"),
        (rolled(eps=-0.1), "eps must be positive"),
        (rolled(box=0.1), "box sides"),
        (rolled(dt="fast"), "dt must be a number"),
        (rolled(generator=3), "generator must be a torch.Generator or a WorldRandom, got int"),
        (rolled(memory="forget"), "memory must be 'store', 'recompute' or 'minimal'"),
        *((rolled(steps=steps), "steps must be an integer") for steps in (-1, 2.0, True, "3")),
        (rolled(s=S[..., :8]), "the rule's 2 coordinates and 16 channels"),
        (rolled(x=X.double(), s=S.double()), "share dtype and device"),
        (rolled(x=HOLED), "x must be finite"),
        (lambda: rollout(3, X, S, 1), "rule must be an NPARule, got int"),
        (lambda: warmup(space_dims=2), r"space_dims must be some of \(2, 3\), got 2"),
        (lambda: warmup(dtypes=[torch.float16]), "dtypes must be some of"),
        (lambda: warmup("tpu"), "device must"),
        (lambda: perceive(SPARSE, SPARSE, 0.1), "x must be a dense tensor"),
        (lambda: perceive(META, META, 0.1), "x must be a dense tensor on 'cpu' or 'cuda'"),
        (lambda: perceive(X, S, 0.1, detach_positions=X), "detach_positions must be True or False"),
        (lambda: perceive(X, S, 1e7, 1e-7), "eps / eps0 must be a moderate"),
        (lambda: perceive(X.double(), S.double(), 1e60, 1e-60), "eps / eps0 must be a moderate"),
        (lambda: perceive(X3, S, 1e-7), r"eps .* \[1e-06, 1e\+06\] .* for torch\.float32 in 3D"),
        (lambda: perceive(X, S, 0.1, box=1e39), "box sides must be at most 3.40282e\\+32"),
        (lambda: perceive(X, S, 0.1, 0.0), "eps0 must be positive"),
        (lambda: species_fields(X, torch.tensor(4), eps=0.1), "counts must have one number"),
        (lambda: rollout_species(np.array(1.0), X, S, 1, counts=[4]), "rules must"),
        (rule(state_dims=8), "keyword argument .state_dims.: did you mean .state_dim.\\?"),
        (rule(state_dim=0), "state_dim must be a whole number of at least 1"),
        (rule(alpha=INF), "alpha"),
        (rule(alpha=[]), "alpha must be a number"),
        (rule(readout_dim=3), "readout_hidden_dim"),
        (rule(space_dim=2.0), "space_dim must be 2 or 3, got 2.0"),
        (rule(hidden_dim=True), "hidden_dim must be a whole number of at least 1, got True"),
        (rule(hidden_dim=2**31), "at most 65536"),
        (rule(species_count="2"), "species_count must be a whole number of at least 0, got '2'"),
        (lambda: WIDE.colour(S[..., :2]), "the last three outputs .* got 2: make the rule"),
        (lambda: NPARule().colour(S[..., :2]), "got 2: give all 16 channels"),
        (lambda: train("fast"), "config must be a TrainConfig of .*, got 'fast'"),
        (lambda: train(preset("tiny"), "texture"), "config must .* of the task 'texture'"),
        (lambda: train(preset("tiny"), max_seconds="3"), "max_seconds must be a number"),
        (lambda: learn("gradient", "npa/X-v0", ONE_STEP, 0), "a Problem, got 'npa/X-v0'"),
        (lambda: learn("gradient", PROBLEM, 1000, 0), "budget must be a Budget, got 1000"),
        (lambda: export_web("gecko", "p.html"), "sources must be a list of rules, got 'gecko'"),
        (lambda: export_web([NPARule()], "p.html"), "names or files of rules, got a NPARule"),
        (lambda: export_web(["gecko"], "p.html", title=3), "title must be text"),
        (lambda: wipe_state(X, S, centre=(0.0, 0.0), radius=0.2), "centre must have shape"),
        (lambda: RowPolicy("model.zip"), "model must be one of Stable-Baselines3"),
        (
            lambda: multispecies_v0.batched("npa/MixingSmall-v0", num_envs=2),
            "'num_envs': many worlds at once .* world_count=8",
        ),
        (lambda: crowd("npa/MixingSmal-v0"), "did you mean 'npa/MixingSmall-v0'"),
        (lambda: save_rule(3, "a.safetensors"), "rule must be an NPARule"),
        (lambda: save_rule(WIDE, {}), "a path must be text"),
        (lambda: save_rule(WIDE, "a.safetensors", metadata=[1]), "metadata must map text to text"),
        (lambda: npa_envs.shipped_rules(np.zeros(2)), "task must be the name of one"),
        (lambda: npa_envs.world_mean(3.0), "values must be a torch tensor"),
        (lambda: npa_envs.WorldRandom(0, device=2**31), "device must be text"),
        (lambda: npa_envs.WorldRandom(0).uniform(2**64), "a draw must have at most"),
        (lambda: scores(["a"]), "unknown rule"),
        (splatted(resolution="8"), "resolution must be an integer"),
        (splatted(resolution=2**31), r"resolution must lie in \[1, 16384\]"),
        (splatted(hi=[1.0]), "hi must be a number"),
        (splatted(hi=1e300), "must have a size in"),
        (
            lambda: periodic_splat(X, S[..., :3], resolution=8, pixel_size=0.2, sigma=1e5),
            "stay within 16384 pixels",
        ),
        (camera(fov=[1]), "fov must be a number"),
        (camera(width=(4,)), "width must be an integer"),
        (lambda: uniform_ball(2, None, 2, 0.1), "particle_count must be an integer"),
        (lambda: uniform_ball(2, 2**31, 2, 0.1), "coordinates must be at most"),
        (lambda: uniform_box(2, 3, 1.0), "box must hold a side"),
        (lambda: parse_damage(3), "damage must be text"),
        (damaged(size={}), "size must be a number"),
        (damaged(size=1e300), "at least 0"),
        (lambda: preset("tiny", 3), "unknown task 3"),
        (lambda: TextureConfig(eps=10**400), "eps must be a finite number"),
        (lambda: write_gif("a.gif", 3), "frames must be a sequence"),
        (small(eps=5e-324), "eps must be at least 1e-09"),
        (lambda: TorchNormalizeReward(()), "needs a vector environment, got tuple"),
    ],
)
def test_what_else_is_rejected_is_a_clear_error(call, message):
    with pytest.raises(NPAError, match=message):
        call()


# Errors name what came in a few words, never a whole tensor, and suggest the nearest name.


@pytest.mark.parametrize(
    ("value", "text"),
    [
        (torch.zeros(64, 3), "a float32 tensor of shape (64, 3)"),
        (np.zeros((3, 4)), "a float64 array of shape (3, 4)"),
        (torch.zeros(3, 2).tolist(), "3 x 2 numbers"),
        ([torch.zeros(9), 1], "[a float32 tensor of shape (9,), 1]"),
        (torch.zeros(2, device="meta"), "a float32 tensor of shape (2,)"),
        (torch.tensor([1.0, 2.0]), "tensor([1., 2.])"),
        ((0.5, 0.5), "(0.5, 0.5)"),
        (torch.Tensor, "<class 'torch.Tensor'>"),
    ],
)
def test_of_many_numbers_an_error_shows_the_shape(value, text):
    assert shown(value) == text


@pytest.mark.parametrize(
    ("name", "known", "nearest"),
    [
        ("morphogenesis", ["co_morphogenesis2d", "morphogenesis3d", "morphogenesis2d"], 2),
        ("morph", ["co_morphogenesis2d", "morphogenesis3d", "morphogenesis2d"], 2),
        ("GEKO", ["heart", "gecko"], 1),
        ("num_particles", ["particle_count", "position_noise", "species_count"], 0),
        ("target", ["stretch", "state_dim"], None),
        ("lizard", ["gecko", "heart"], None),
        (None, ["gecko"], None),
    ],
)
def test_an_unknown_name_is_answered_by_the_nearest_known_one(name, known, nearest):
    hint = "" if nearest is None else f"did you mean {known[nearest]!r}? "
    assert suggest(name, known) == f"{hint}known: {', '.join(sorted(known))}"


def test_an_error_lists_at_most_forty_known_names():
    text = suggest("a", [f"name{number:03}" for number in range(100)])
    assert text.endswith("name039 and 60 more")
