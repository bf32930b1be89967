"""Policies of whole worlds that are networks: shipped ones, their files, their fit."""

import gymnasium
import numpy as np
import pytest
import torch
from support.slow import slow

from npa_envs import NPAError
from npa_envs.agents import NetworkPolicy, evaluate_policy, load_policy, shipped_policies

GARDENER = "npa/Gardener2DSmall-v0"
SEEDS = range(3_000_000, 3_000_016)
SMALL = [id for id in shipped_policies() if "Small" in id]


@pytest.mark.parametrize("id", [n if "Central" in n else slow(n) for n in SMALL])
def test_shipped_policies_do_better_than_nobody_in_episodes_of_other_seeds(id):
    envs = gymnasium.make_vec(id, num_envs=len(SEEDS))
    shipped, nobody = (
        evaluate_policy(envs, load_policy(name, envs), SEEDS) for name in ("shipped", "zero")
    )
    assert shipped.mean_return > nobody.mean_return + 2.0 * shipped.standard_error
    assert "Shepherd" in id or shipped.final_losses.mean() < nobody.final_losses.mean()


def test_every_shipped_policy_has_a_card():
    assert GARDENER in shipped_policies()
    for id, path in shipped_policies().items():
        assert f"npa-envs view {id} --policy shipped" in path.with_suffix(".md").read_text("utf-8")


def test_a_saved_policy_is_loaded_bit_for_bit_and_damage_is_found(tmp_path):
    env = gymnasium.make(GARDENER)
    policy, path = load_policy("shipped", env), tmp_path / "mine.safetensors"
    policy.save(path, {})
    seen, again = np.linspace(-1, 1, 288, dtype="f4").reshape(3, 96), load_policy(str(path), env)
    assert np.array_equal(again(seen), policy(seen))
    np.testing.assert_allclose(again(seen[0]), policy(seen)[0], atol=1e-5)
    np.testing.assert_allclose(again(torch.from_numpy(seen)).numpy(), policy(seen), atol=1e-6)
    content = bytearray(path.read_bytes())
    content[-1] ^= 1
    path.write_bytes(content)
    with pytest.raises(NPAError, match="the checksum must be"):
        load_policy(str(path), env)


def test_a_policy_that_does_not_exist_or_fit_is_refused():
    for name, id, message in [
        ("shipped", "npa/Shapeshifter2D-v0", "has zero, random, or a file, got 'shipped'"),
        ("scripted", "npa/Morphogenesis2DSmall-v0", "has zero, random, or a rule, got 'scripted'"),
        ("scriptd", GARDENER, "has zero, random, scripted, shipped, .* did you mean 'scripted'"),
        ("hart", "npa/Morphogenesis2DSmall-v0", "did you mean 'heart'"),
    ]:
        with pytest.raises(NPAError, match=message):
            load_policy(name, gymnasium.make(id))
    with pytest.raises(NPAError, match="the policy must fit the environment"):
        load_policy("shipped", gymnasium.make(GARDENER, place_count=3))


@pytest.mark.parametrize("id", SMALL)
def test_a_network_acts_as_the_model_of_stable_baselines3_that_it_is_of(id):
    sb3 = pytest.importorskip("stable_baselines3")
    env = gymnasium.make(id)
    kind = "MultiInputPolicy" if "Shepherd" in id else "MlpPolicy"
    model = sb3.PPO(kind, env, seed=0, device="cpu")
    observation = env.reset(seed=0)[0]
    expected, _ = model.predict(observation, deterministic=True)
    np.testing.assert_allclose(NetworkPolicy.of_sb3(model)(observation), expected, atol=1e-6)
