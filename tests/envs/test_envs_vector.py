"""Batches, worlds that diverge, and torch's modes: each world is like a single environment."""

import functools
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest
import torch
from support.crowds import still
from support.refusals import refused
from support.slow import slow
from support.small_envs import IDS, assert_batch_of_singles, assert_same, begun, make, make_vec

import npa_envs
from npa_envs.envs import multispecies_v0
from npa_envs.errors import DivergedError


def batches(env, count, seed=0, scale=1.0):
    random = np.random.default_rng(seed)
    shape = (env.num_envs, *env.single_action_space.shape)
    return [random.uniform(-scale, scale, shape).astype(np.float32) for _ in range(count)]


@pytest.mark.parametrize(
    ("name", "changes"),
    [
        *((name, {"reward": "particle"}) for name in IDS),
        *(slow(name, {"reward": "marginal"}) for name in IDS[1:]),
        (IDS[0], {"reward": "marginal"}),
        (IDS[0], {"reward": "dense"}),
        (IDS[0], {"reward": "sparse"}),
        (IDS[0], {"on_divergence": "reset", "autoreset_mode": "next-step"}),
        (IDS[0], {"on_divergence": "ignore", "reward": "particle"}),
    ],
)
def test_vector_equals_single_over_episodes_with_autoresets(name, changes, device):
    """Some worlds succeed, some diverge, the others run into the limit."""
    keywords = {"observation_limit": 3.5, "max_episode_steps": 13, "tell_updated": True}
    keywords |= changes | {"device": str(device)}
    going_on = "on_divergence" in changes
    if going_on:
        keywords |= {"position_noise": 1e-3, "update_prob": 0.8}
    elif "Morphogenesis" in name:
        # In 3D losses from 0.0907 on were seen, of worlds that begin with 0.0931.
        keywords |= {"success_loss": 0.0909 if "3D" in name else 1.2}
    envs = make_vec(name, 3, **keywords)
    mode = keywords.pop("autoreset_mode", "same-step")
    singles = [make(name, episode_steps=13, **keywords) for _ in range(3)]
    # Then each ending has been seen.
    actions = batches(envs, 13 * {IDS[0]: 4, "npa/Morphogenesis3D-v0": 5}.get(name, 3))
    for t, action in enumerate(actions):
        # One world in three lives to the step limit, one may succeed, one soon diverges.
        action[t // 13 % 3] *= 0.05
        action[(t // 13 + 1) % 3, :, 2:] *= 0.5
    reasons, diverged = assert_batch_of_singles(envs, singles, actions, mode)
    assert diverged >= (3 if going_on else 1)
    assert reasons >= {None, "time limit"}
    assert ("diverged" in reasons) == (not going_on)
    assert ("success" in reasons) == ("success_loss" in keywords)


def test_action_of_a_restarting_world_may_be_anything():
    envs = begun(make_vec(IDS[0], 2, max_episode_steps=1, autoreset_mode="next-step"))
    action = np.zeros((2, *envs.single_action_space.shape), np.float32)
    envs.step(action)
    envs.step(action * np.nan)
    with pytest.raises(DivergedError, match="action must be finite"):
        envs.step(action * np.nan)


@pytest.mark.gpu
@pytest.mark.parametrize("name", IDS)
def test_cpu_and_cuda_agree(name):
    cpu, cuda = make_vec(name, 3), make_vec(name, 3, device="cuda")
    left, _ = cpu.reset(seed=0)
    right, _ = cuda.reset(seed=0)
    assert np.allclose(left, right, atol=1e-4)
    for action in batches(cpu, 20, scale=0.2):
        left, right = cpu.step(action), cuda.step(action)
        assert np.allclose(left[0], right[0], atol=2e-3)
        assert np.allclose(left[1], right[1], rtol=1e-3, atol=1e-4)


# Worlds whose numbers run away


NAME = "npa/Morphogenesis2D-v0"
LIMIT, LAST = 3.5, 4
"""States grow by 1 a step where they are pushed, and so leave the limit in step 4."""


def pushed(env, world=1):
    """Return actions that do nothing but push all states of one world."""
    shape = env.action_space.shape
    action = np.zeros(shape, dtype=np.float32)
    (action if len(shape) == 2 else action[world])[:, -env.unwrapped.config.state_dim :] = 1.0
    return action


def vector(device, way, name=NAME, **keywords):
    keywords = {"observation_limit": LIMIT, "update_prob": 1.0, "device": str(device)} | keywords
    return make_vec(name, 3, on_divergence=way, **keywords)


def stepped(envs, count=LAST, seed=5):
    """Return what the last of some steps gave, the states of one world pushed."""
    envs.reset(seed=seed)
    for _ in range(count):
        result = envs.step(pushed(envs))
    return result


@pytest.mark.parametrize("name", [NAME, "npa/Texture-v0"])
def test_an_error_names_world_step_number_and_cure(name, device):
    envs = vector(device, "raise", name)
    with pytest.raises(DivergedError) as caught:
        stepped(envs)
    text = str(caught.value)
    assert "observation_limit = 3.5, but left them in world 1 in step 4: states channel" in text
    assert "of particle 0 got to 3.5 (" in text
    assert "on_divergence='terminate' or 'reset'" in text
    observations, _ = envs.reset(seed=5)
    assert np.array_equal(observations, vector(device, "raise", name).reset(seed=5)[0])


def test_a_world_that_left_is_named_by_its_coordinate(device):
    env = begun(make(NAME, on_divergence="raise", position_limit=0.21, update_prob=1.0))
    action = np.zeros(env.action_space.shape, dtype=np.float32)
    action[:, 1] = 1.0
    # Half of eps in a step takes particles of a disk of radius 0.2 out of 0.21.
    with pytest.raises(DivergedError, match="in step 1: positions coordinate 1 of particle"):
        env.step(action)


@pytest.mark.parametrize(
    ("name", "reward"), [(name, "dense") for name in IDS] + [(NAME, "particle"), (NAME, "sparse")]
)
def test_a_reset_world_begins_its_next_episode_within_this_one(name, reward, device):
    keywords = {"max_episode_steps": LAST + 2, "reward": reward}
    envs, other = vector(device, "reset", name, **keywords), vector(device, "terminate", name)
    observations, rewards, _, _, infos = stepped(envs)
    other.reset(seed=5)
    first, start = other.reset(options={"reset_mask": np.array([False, True, False])})
    assert np.array_equal(observations[1], first[1])
    assert infos["loss"][1] == start["loss"][1]
    assert infos["diverged"][1]
    if reward == "dense":
        assert rewards[1] == stepped(other)[1][1] <= 0.0
    if reward == "particle":
        assert infos["particle_reward"][1] == pytest.approx(rewards[1])
    if reward == "sparse":
        assert rewards.tolist() == [0.0, 0.0, 0.0]
    still = 0.0 * pushed(envs)
    _, rewards, terminations, truncations, infos = envs.step(still)
    assert not infos["diverged"].any()
    assert not (terminations | truncations).any()
    if reward == "dense":
        assert rewards[1] == start["loss"][1] - infos["loss"][1]
    *_, truncations, infos = envs.step(still)
    assert truncations.all()
    assert infos["final_info"]["reason"].tolist() == ["time limit"] * 3


SPECIES = {"particle_count": 40, "state_dim": 4, "observation_limit": LIMIT, "update_prob": 1.0}


@pytest.mark.parametrize("way", ["terminate", "ignore", "raise"])
def test_species_that_diverge_are_terminated_named_or_continue(way, device):
    keywords = SPECIES | {"on_divergence": way, "device": str(device)}
    envs = begun(multispecies_v0.batched("mixing", world_count=2, **keywords))
    action = still(envs)
    action["species_1"][1, :, 2:] = 1.0
    for _ in range(LAST - 1):
        envs.step(action)
    if way == "raise":
        with pytest.raises(DivergedError, match="species_1 of world 1 had none after step 4: take"):
            envs.step(action)
        return
    observations, _, terminations, _, infos = envs.step(action)
    assert terminations["species_1"].tolist() == [False, way == "terminate"]
    assert infos["species_1"]["live"].tolist() == [True, way == "ignore"]
    assert not terminations["species_0"].any()
    assert all(np.isfinite(rows).all() for rows in observations.values())
    assert way == "terminate" or (envs.state()[1, 20:, 2:-1] == LIMIT).all()


# Among torch's modes, in threads, and made again and again


NAMES = ("npa/Morphogenesis2D-v0", "npa/Texture-v0")


def made(name, device, count=2):
    return make_vec(name, count, max_episode_steps=3, device=device.type, output="torch")


def play(envs, steps=6, *, reset=True):
    """Return all that is observed and rewarded."""
    seen = [envs.reset(seed=3)[0].clone()] if reset else []
    for step in range(steps):
        generator = torch.Generator().manual_seed(step)
        action = torch.rand(envs.action_space.shape, generator=generator, device="cpu") * 2 - 1
        observation, reward, *_ = envs.step(action)
        seen += [observation.clone(), reward.clone()]
    return seen


@pytest.mark.parametrize("name", NAMES)
def test_environments_go_on_outside_of_inference_mode(name, device):
    expected = made(name, device)
    with torch.inference_mode():
        envs = made(name, device)
        first = play(envs)
    assert_same(first, play(expected))
    assert_same(play(envs, reset=False), play(expected, reset=False))
    with torch.inference_mode():
        assert_same(play(envs, reset=False), play(expected, reset=False))
    assert_same(play(envs), play(expected))


@pytest.mark.parametrize("name", NAMES)
def test_environments_do_not_mind_the_default_device(name, device):
    expected = play(made(name, device))
    torch.set_default_device("meta" if device.type == "cpu" else device)
    try:
        found = play(made(name, device))
    finally:
        torch.set_default_device(None)
    assert_same(found, expected)


@pytest.mark.parametrize("name", NAMES)
def test_environments_refuse_another_default_dtype(name, device):
    envs = made(name, device)
    torch.set_default_dtype(torch.float64)
    try:
        for call in (functools.partial(made, name, device), envs.reset):
            refused(r"default dtype to be torch\.float32, got", call)
    finally:
        torch.set_default_dtype(torch.float32)
    play(envs)


@pytest.mark.gpu
def test_environments_in_threads_are_as_alone():
    device = torch.device("cuda")
    kinds = [(NAMES[k % 2], 2 + k % 3) for k in range(4)]
    expected = [play(made(name, device, count)) for name, count in kinds]

    def work(k):
        with torch.cuda.stream(torch.cuda.Stream()):
            for _ in range(4):
                result = play(made(kinds[k][0], device, kinds[k][1]))
                torch.cuda.current_stream().synchronize()
                assert_same(result, expected[k])

    def roll():
        rule = npa_envs.NPARule(2, 8, 32, eps0=0.3).to(device)
        # Environments look whether torch's own generators move.
        random = torch.Generator().manual_seed(0)
        with torch.cuda.stream(torch.cuda.Stream()):
            for count in range(40, 70):
                x, s = (torch.rand(2, count, k, generator=random).to(device) for k in (2, 8))
                for _ in range(3):
                    generator = torch.Generator(device).manual_seed(0)
                    npa_envs.rollout(rule, x, s, 4, generator=generator)[1].sum().backward()

    with ThreadPoolExecutor(5) as pool:
        futures = [pool.submit(roll), *(pool.submit(work, k) for k in range(4))]
    for future in futures:
        future.result()


@pytest.mark.gpu
def test_environments_made_again_and_again_keep_no_memory():
    device = torch.device("cuda")
    taken = []
    for number in range(60):
        play(made(NAMES[0], device), 4)
        if number in (9, 59):
            torch.cuda.synchronize()
            taken.append(torch.cuda.memory_reserved())
    assert taken[1] <= taken[0] + 2**26
