"""Environments among torch's modes, in threads, and made again and again."""

import contextlib
import threading

import gymnasium
import pytest
import torch

import npa_envs

NAMES = ("npa/Morphogenesis2D-v0", "npa/Texture-v0")


def make(name, device, count=2):
    return gymnasium.make_vec(
        name,
        num_envs=count,
        vectorization_mode="vector_entry_point",
        particle_count=61,
        eps=0.3,
        resolution=16,
        max_episode_steps=3,
        device=device.type,
        output="torch",
    )


def play(envs, steps=6, *, reset=True):
    """Return all that is observed and rewarded."""
    seen = [envs.reset(seed=3)[0].clone()] if reset else []
    for step in range(steps):
        generator = torch.Generator().manual_seed(step)
        action = torch.rand(envs.action_space.shape, generator=generator, device="cpu") * 2 - 1
        observation, reward, *_ = envs.step(action)
        seen += [observation.clone(), reward.clone()]
    return seen


def same(first, second):
    assert len(first) == len(second)
    assert all(torch.equal(one, other) for one, other in zip(first, second, strict=True))


@pytest.mark.parametrize("name", NAMES)
def test_environments_go_on_outside_of_inference_mode(name, device):
    expected = make(name, device)
    with torch.inference_mode():
        envs = make(name, device)
        first = play(envs)
    same(first, play(expected))
    same(play(envs, reset=False), play(expected, reset=False))
    with torch.inference_mode():
        same(play(envs, reset=False), play(expected, reset=False))
    same(play(envs), play(expected))


@pytest.mark.parametrize("name", NAMES)
def test_environments_do_not_mind_the_default_device(name, device):
    expected = play(make(name, device))
    torch.set_default_device("meta" if device.type == "cpu" else device)
    try:
        found = play(make(name, device))
    finally:
        torch.set_default_device(None)
    same(found, expected)


@contextlib.contextmanager
def doubles():
    torch.set_default_dtype(torch.float64)
    try:
        yield
    finally:
        torch.set_default_dtype(torch.float32)


@pytest.mark.parametrize("name", NAMES)
def test_environments_refuse_another_default_dtype(name, device):
    envs = make(name, device)
    with doubles():
        with pytest.raises(npa_envs.NPAError, match=r"default dtype to be torch\.float32, got"):
            make(name, device)
        with pytest.raises(npa_envs.NPAError, match=r"default dtype to be torch\.float32, got"):
            envs.reset(seed=0)
    play(envs)


@pytest.mark.gpu
def test_environments_in_threads_are_as_alone():
    device = torch.device("cuda")
    kinds = [(NAMES[k % 2], 2 + k % 3) for k in range(4)]
    expected = [play(make(name, device, count)) for name, count in kinds]
    errors = []

    def work(k):
        try:
            with torch.cuda.stream(torch.cuda.Stream()):
                for _ in range(4):
                    name, count = kinds[k]
                    found = play(make(name, device, count))
                    torch.cuda.current_stream().synchronize()
                    same(found, expected[k])
        except BaseException as error:
            errors.append(error)

    def roll():
        try:
            rule = npa_envs.NPARule(2, 8, 32, eps0=0.3).to(device)
            with torch.cuda.stream(torch.cuda.Stream()):
                for count in range(30):
                    # Environments look whether torch's own generators move.
                    random = torch.Generator().manual_seed(count)
                    x, s = (
                        torch.rand(2, 40 + count, width, generator=random).to(device)
                        for width in (2, 8)
                    )
                    for _ in range(3):
                        generator = torch.Generator(device).manual_seed(0)
                        npa_envs.rollout(rule, x, s, 4, generator=generator)[1].sum().backward()
        except BaseException as error:
            errors.append(error)

    threads = [threading.Thread(target=work, args=(k,)) for k in range(4)]
    threads.append(threading.Thread(target=roll))
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert not errors, errors[0]


@pytest.mark.gpu
def test_environments_made_again_and_again_keep_no_memory():
    device = torch.device("cuda")
    taken = []
    for number in range(60):
        play(make(NAMES[0], device), 4)
        if number in (9, 59):
            torch.cuda.synchronize()
            taken.append(torch.cuda.memory_reserved())
    assert taken[1] <= taken[0] + 2**26
