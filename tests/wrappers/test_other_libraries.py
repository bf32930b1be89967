"""PettingZoo's and RLlib's ways to train on environments; skipped where libraries are missing."""

import numpy as np
import pytest
from support import small_envs
from support.crowds import drawn, small, still
from support.refusals import refused
from support.small_envs import begun

from npa_envs.envs import gardeners_v0, multispecies_v0, particles_v0
from npa_envs.registration import ALL, SPECIES_SIZES

pytestmark = pytest.mark.filterwarnings("ignore::DeprecationWarning", "ignore::UserWarning")
DEATH = {"deaths": ((1, 3),), "max_cycles": 6}


def test_infos_are_numbers_and_have_the_same_entries_at_reset_and_in_every_step():
    env = multispecies_v0.parallel_env(**small("co_morphogenesis", **DEATH))
    _, first = env.reset(seed=0)
    terms = {f"{kind}_{part}" for kind in ("loss", "reward") for part in ("density", "colour")}
    names = {"species", "reason", "loss"} | terms
    while env.agents:
        *_, infos = env.step(still(env))
        for agent, info in infos.items():
            assert set(info) == set(first[agent]) == names
            assert all(type(value) in (int, float) for value in info.values())


@pytest.mark.parametrize(
    ("module", "keywords", "each"),
    [
        (multispecies_v0, {"particle_counts": (6, 6)}, False),
        (multispecies_v0, {"particle_counts": (6, 6)} | DEATH, False),
        (multispecies_v0, {"particle_counts": (5, 7)}, True),
        (particles_v0, {"particle_count": 9} | DEATH, False),
    ],
)
def test_torchrl_finds_the_specs_right_and_rolls_out(module, keywords, each):
    torchrl = pytest.importorskip("torchrl.envs")
    groups = {"group_map": torchrl.MarlGroupMapType.ONE_GROUP_PER_AGENT} if each else {}
    fields = small("mixing", **keywords)
    env = torchrl.PettingZooWrapper(
        module.parallel_env(**fields), use_mask="deaths" in keywords, **groups
    )
    torchrl.check_env_specs(env)
    env.set_seed(3)
    rolled = env.rollout(20)
    single = begun(module.parallel_env(**fields), seed=3)
    # TorchRL resets to set the seed, and again to begin.
    observations, _ = single.reset()
    group = next(iter(env.group_map))
    agent = single.possible_agents[0]
    for t in range(len(rolled)):
        assert np.array_equal(rolled[group, "observation"][t, 0].numpy(), observations[agent])
        acting = {
            name: rolled[g, "action"][t, names.index(name)].numpy()
            for g, names in env.group_map.items()
            for name in names
            if name in single.agents
        }
        observations, rewards, *_ = single.step(acting)
        paid = rolled["next", group, "reward"][t, 0].item()
        assert paid == np.float32(rewards[agent])


@pytest.mark.parametrize(
    ("make", "keywords"),
    [
        (multispecies_v0, small("mixing", max_cycles=5)),
        (particles_v0, small("mixing", particle_count=9, **DEATH)),
        (gardeners_v0, small_envs.small("npa/Gardener2D-v0", max_cycles=5)),
    ],
)
def test_supersuit_skips_frames_and_agents_may_end_meanwhile(make, keywords):
    supersuit = pytest.importorskip("supersuit")
    env, plain = make.parallel_env(**keywords), begun(make.parallel_env(**keywords))
    skipped = begun(supersuit.frame_skip_v0(env, 2))
    generator = np.random.default_rng(0)
    while skipped.agents:
        actions = drawn(skipped, generator)
        observations, rewards, *_ = skipped.step(actions)
        paid = dict.fromkeys(plain.agents, 0.0)
        for _ in range(2):
            expected, gains, *_ = plain.step({a: actions[a] for a in plain.agents})
            paid |= {agent: paid[agent] + gain for agent, gain in gains.items()}
        assert paid == dict(rewards)
        for agent, seen in expected.items():
            assert np.array_equal(observations[agent], seen)
    in_turns = begun(supersuit.frame_skip_v0(make.env(**keywords), 2))
    for agent in in_turns.agent_iter(1000):
        *_, ended, cut, _ = in_turns.last()
        in_turns.step(None if ended or cut else in_turns.action_space(agent).sample())
    assert not in_turns.agents


@pytest.fixture
def trained():
    """Builds an algorithm of RLlib's and trains it for some rounds, where RLlib is installed."""
    ray = pytest.importorskip("ray")
    ray.init(num_cpus=3, include_dashboard=False, log_to_driver=False, logging_level="ERROR")
    built = []

    def train(config, rounds=1):
        built.append(config.build_algo())
        for _ in range(rounds):
            results = built[0].train()
        assert results["env_runners"]["episode_len_mean"] == 6
        return built[0], results

    yield train
    for algorithm in built:
        algorithm.stop()
    ray.shutdown()


@pytest.mark.slow
@pytest.mark.parametrize(("shared", "runner_count"), [(False, 0), (True, 0), (False, 2)])
def test_rllib_trains_a_policy_for_each_species_or_one_for_all(shared, runner_count, trained):
    from npa_envs.wrappers.rllib import rllib_config

    keywords = small("mixing", particle_count=8, state_dim=4, **DEATH)
    del keywords["task"]
    config = (
        rllib_config("npa/MixingParticles-v0", shared=shared, **keywords)
        .env_runners(num_env_runners=runner_count, rollout_fragment_length=24)
        .learners(num_learners=0)
        .training(train_batch_size_per_learner=48, minibatch_size=48, num_epochs=1)
    )
    algorithm, results = trained(config)
    names = {"everyone"} if shared else {"species_0", "species_1"}
    assert set(results["learners"]) == names | {"__all_modules__"}
    assert algorithm.env_runner_group.num_remote_env_runners() == runner_count
    for name in names:
        assert results["learners"][name]["num_module_steps_trained"] > 0
    refused("name must be a known id, got 'npa/Mixin-v0'", rllib_config, "npa/Mixin-v0")
    refused("'npa/TextureSmall-v0': take rllib_rows_config", rllib_config, "npa/TextureSmall-v0")


PARTICLES = {"reward": "particle", "particle_count": 16, "eps": 0.3, "resolution": 16}


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "fields", "runner_count", "observed", "acted", "rows"),
    [
        ("npa/Morphogenesis2D-v0", PARTICLES, 0, 66, 18, 32),
        ("npa/Morphogenesis2D-v0", PARTICLES, 2, 66, 18, 32),
        ("npa/TextureSmall-v0", {}, 0, 18, 6, 192),
        ("npa/Gardener2DSmall-v0", {}, 0, 96, 32, 2),
        ("npa/Gardener2DSmall-v0", {"actions": "discrete"}, 0, 96, 4, 2),
        ("npa/Shepherd2DSmall-v0", {}, 0, 30, 8, 2),
    ],
)
def test_rllib_trains_one_policy_on_rows(
    name, fields, runner_count, observed, acted, rows, trained
):
    from npa_envs.wrappers.rllib import rllib_rows_config

    config = (
        rllib_rows_config(name, world_count=2, max_episode_steps=6, **fields)
        .env_runners(
            num_env_runners=runner_count, rollout_fragment_length=14 // (runner_count or 1)
        )
        .training(train_batch_size_per_learner=14 * rows, minibatch_size=12, num_epochs=1)
    )
    assert config.num_envs_per_env_runner == rows
    algorithm, results = trained(config)
    assert results["learners"]["default_policy"]["num_module_steps_trained"] > 0
    module = algorithm.get_module()
    spaces = module.observation_space, module.action_space
    assert [space.shape for space in spaces] == [(observed,), (acted,)]


def test_rllib_knows_every_id():
    pytest.importorskip("ray.rllib")
    pytest.importorskip("sklearn")
    from npa_envs.wrappers.rllib import rllib_config, rllib_rows_config

    for row in ALL:
        rows = rllib_rows_config(row.id, world_count=3, particle_count=64)
        assert rows.num_envs_per_env_runner in (3, 3 * 64)
    for size in SPECIES_SIZES:
        assert "species_0" in rllib_config(size.id).policies


@pytest.mark.parametrize(
    ("name", "keywords", "message"),
    [
        ("npa/Texure-v0", {}, "name must be a known id, got 'npa/Texure-v0': did you mean"),
        ("npa/Texture-v0", {"world_count": 0}, "world_count must be an integer of at least 1"),
        ("npa/MixingParticles-v0", {}, "'npa/MixingParticles-v0': take rllib_config for it"),
        ("npa/Morphogenesis2D-v0", {"targets": "heart"}, "did you mean 'target'"),
    ],
)
def test_rllib_rows_need_a_known_id_and_right_keywords(name, keywords, message):
    pytest.importorskip("ray.rllib")
    from npa_envs.wrappers.rllib import rllib_rows_config

    refused(message, rllib_rows_config, name, **keywords)
