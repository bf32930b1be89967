"""Random calls, right and wrong, of every single environment, by a model of correct answers.

What is refused leaves the worlds as they were; what is not keeps the documented types, shapes,
limits, rewards, episode ends and reasons. Many worlds have no model of their own, as they equal
single ones in other tests.
"""

from __future__ import annotations

import os
import random
import resource
from typing import Any, ClassVar

import gymnasium
import numpy as np
import pytest
import torch
from support.crowds import few, small
from support.fuzz_values import wrong
from support.small_envs import IDS, assert_same
from support.small_envs import small as small_keywords

from npa_envs import DivergedError, NPAError
from npa_envs.envs import multispecies_v0, particles_v0
from npa_envs.envs.multi import AGENT_REASONS

QUICK, THOROUGH = 30, 10_000
"""Calls of each environment."""

FIRST_SEED = int(os.environ.get("NPA_ENVS_FUZZ_SEED", "0"))

LIFE = 60
"""Calls of one environment; then another is made."""

MEMORY = 4 * 2**30
"""Bytes that the process may allocate."""

REFUSALS = (NPAError, gymnasium.error.Error)


@pytest.fixture(autouse=True)
def limited_memory():
    """Refuse more memory than that; what is refused is an undocumented error."""
    before = resource.getrlimit(resource.RLIMIT_DATA)
    resource.setrlimit(resource.RLIMIT_DATA, (MEMORY, before[1]))
    yield
    resource.setrlimit(resource.RLIMIT_DATA, before)


def world_fields(draw: random.Random) -> dict[str, Any]:
    """Keywords that all environments have; some make worlds diverge within a few steps."""
    return {
        "particle_count": draw.choice((3, 5, 12)),
        "eps": draw.choice((0.1, 0.3, 1.0)),
        "alpha": draw.choice((0.5, 0.5, 20.0)),
        "state_scale": draw.choice((1.0, 1.0, 40.0)),
        "update_prob": draw.choice((0.5, 1.0)),
        "position_noise": draw.choice((0.0, 0.05)),
        "position_limit": draw.choice((4.0, 1.5)),
        "moment_inverse": draw.choice(("threshold", "smooth")),
        "observation_limit": draw.choice((64.0, 3.0)),
        "boundary": draw.choice(("open", "open", "periodic", "reflecting")),
        "on_divergence": draw.choice(("terminate", "terminate", "raise", "ignore")),
        "output": draw.choice(("numpy", "torch")),
        "render_mode": draw.choice((None, "rgb_array")),
        "render_size": 8,
    }


def one_species_fields(name: str, draw: random.Random) -> dict[str, Any]:
    fields = small_keywords(name) | world_fields(draw)
    fields |= {
        "reward": draw.choice(("dense", "dense", "sparse", "particle", "marginal")),
        "seed_pool": draw.choice((0, 0, 2)),
        "success_loss": draw.choice((None, 0.0, 0.2)),
        "max_episode_steps": draw.choice((1, 3, 8)),
    }
    if draw.random() < 0.2:
        fields["on_divergence"] = "reset"
    if name == "npa/Pictures2D-v0":
        fields |= {"observe_target": draw.random() < 0.5}
        fields |= {"split": draw.choice(("train", "train", "test"))}
    return fields


def species_fields(task: str, draw: random.Random, *, by_particle: bool) -> dict[str, Any]:
    fields = (few if by_particle else small)(task) | world_fields(draw)
    fields |= {
        "species_count": draw.choice((2, 2, 3)),
        "max_cycles": draw.choice((1, 3, 8)),
        "reward": "individual" if task == "invasion" else draw.choice(("individual", "team")),
        "perception": draw.choice(("shared", "per_species")),
        "deaths": draw.choice(((), (), ((1, 2),), ((0, 1), (1, 3)))),
    }
    if task == "invasion":
        fields |= {"opponent": draw.choice((None, "random"))}
    return fields


def actions_of(draw: random.Random, shape: tuple[int, ...]) -> Any:
    """Return actions of a shape: right ones of several kinds, and in one of four cases others."""
    legal = torch.rand(shape, generator=torch.Generator().manual_seed(draw.randrange(2**31)))
    legal = 2.0 * legal - 1.0
    if draw.random() < 0.25:
        return wrong(draw, "action", legal)
    kinds = (legal.numpy(), legal, legal.double().numpy(), legal.sign(), 0.0 * legal, 1e3 * legal)
    return draw.choice(kinds)


def host(value: Any) -> np.ndarray:
    return value.cpu().numpy() if isinstance(value, torch.Tensor) else np.asarray(value)


def by_agent(value: Any) -> dict[str, Any]:
    """Return arrays or spaces by agent; those of one species have no agents."""
    return value if isinstance(value, dict) else {"": value}


def checked_loss(info: Any) -> np.ndarray:
    loss = host(info["loss"])
    assert np.isfinite(loss).all()
    return loss


class Played:
    """An environment that is called at random, and what is known of its worlds."""

    often: ClassVar = {"step": 12, "reset": 3, "place": 2, "render": 1}
    """How often each method is called."""

    def __init__(self, env: Any, fields: dict[str, Any]) -> None:
        self.env, self.fields = env, fields
        self.inner: Any = getattr(env, "unwrapped", env)
        self.started = False
        observations = getattr(env, "observation_spaces", None) or env.observation_space
        actions = getattr(env, "action_spaces", None) or env.action_space
        self.observation_shapes = {a: space.shape for a, space in by_agent(observations).items()}
        self.action_shapes = {a: space.shape for a, space in by_agent(actions).items()}

    def call(self, draw: random.Random) -> None:
        """Make a call; check what it does."""
        (method,) = draw.choices(list(self.often), list(self.often.values()))
        getattr(self, method)(draw)

    def refused(self, call: Any) -> Any:
        """Return what a call returns, or None where it is refused: the worlds are as before."""
        before = self.snapshot() if self.started else ()
        try:
            return call()
        except DivergedError as error:
            if "must be finite" not in str(error):
                assert self.fields["on_divergence"] == "raise"
                self.settle()
                return None
        except REFUSALS:
            pass
        assert_same(before, self.snapshot() if self.started else ())
        return None

    def settle(self) -> None:
        self.expect_reset(*self.env.reset(seed=5))

    def snapshot(self) -> Any:
        return self.inner.particles()

    def reset(self, draw: random.Random) -> None:
        seed = draw.choice((draw.randrange(99), None, 3, np.int64(7), np.uint8(4), 2**31))
        if draw.random() < 0.25:
            seed = wrong(draw, "seed", 3)
        options = self.options(draw)
        result = self.refused(lambda: self.env.reset(seed=seed, options=options))
        if result is not None:
            assert not options, "unknown options were taken without a word"
            self.expect_reset(*result)

    def options(self, draw: random.Random) -> Any:
        return wrong(draw, "options", None) if draw.random() < 0.2 else None

    def expect_reset(self, observation: Any, info: Any) -> None:
        self.started = True
        self.check_observation(observation)

    def step(self, draw: random.Random) -> None:
        actions = self.actions(draw)
        result = self.refused(lambda: self.env.step(actions))
        if result is not None:
            assert self.started, "a step before the first reset"
            self.check_observation(result[0])
            self.expect_step(*result[1:])

    def actions(self, draw: random.Random) -> Any:
        if "" in self.action_shapes:
            return actions_of(draw, self.action_shapes[""])
        self.acted, actions = self.env.agents, {}
        for agent in self.acted:
            shape = self.action_shapes[agent]
            # One wrong action among many is wrong enough.
            is_drawn = draw.random() < 2.0 / max(2, len(self.acted))
            actions[agent] = actions_of(draw, shape) if is_drawn else torch.zeros(shape)
        if draw.random() < 0.1:
            changes = (lambda a: a | {"nobody": 1}, lambda a: dict(list(a.items())[1:]), list)
            return draw.choice(changes)(actions)
        return actions

    def place(self, draw: random.Random) -> None:
        """Put particles into worlds, which is no part of Gymnasium's or PettingZoo's interface."""
        x, s = self.inner.particles() if self.started else (torch.zeros(1, 2), torch.zeros(1, 16))
        particles = {"x": x.clamp(-0.5, 0.5), "s": s.clamp(-0.5, 0.5)}
        if draw.random() < 0.4:
            name = draw.choice(("x", "s"))
            particles[name] = wrong(draw, name, particles[name])
        result = self.refused(lambda: self.inner.place_particles(**particles))
        if result is not None:
            self.check_observation(result)
            self.expect_place()

    def expect_place(self) -> None:
        """Note losses, which placing changes without a reward."""

    def render(self, draw: random.Random) -> None:
        pictures = self.refused(self.env.render)
        for picture in pictures if isinstance(pictures, list | tuple) else [pictures]:
            if picture is not None:
                assert self.fields["render_mode"] == "rgb_array"
                assert (picture.shape, picture.dtype) == ((8, 8, 3), np.uint8)

    def check_observation(self, observation: Any) -> None:
        for agent, rows in by_agent(observation).items():
            assert type(rows) is (torch.Tensor if self.fields["output"] == "torch" else np.ndarray)
            array = host(rows)
            assert array.shape == self.observation_shapes[agent]
            assert array.dtype == np.float32
            # NaN fails as well.
            assert np.abs(array).max(initial=0.0) <= self.fields["observation_limit"]


class OneWorld(Played):
    """A world of one species."""

    @classmethod
    def make(cls, name: str, draw: random.Random) -> Played:
        fields = one_species_fields(name, draw)
        steps = {"episode_steps": fields["max_episode_steps"]}
        return cls(gymnasium.make(name, disable_env_checker=True, **fields, **steps), fields)

    def expect_reset(self, observation: Any, info: Any) -> None:
        super().expect_reset(observation, info)
        assert "reason" not in info
        self.steps, self.is_over = 0, False
        self.loss = self.first_loss = np.float32(checked_loss(info))

    def expect_step(self, reward: Any, terminated: Any, truncated: Any, info: Any) -> None:
        assert [type(v) for v in (reward, terminated, truncated)] == [float, bool, bool]
        self.steps += 1
        limit, way = self.fields["max_episode_steps"], self.fields["on_divergence"]
        success, diverged, loss = info["success"], info["diverged"], checked_loss(info)
        ends_by_divergence = diverged and way == "terminate"
        assert truncated == (self.steps >= limit)
        assert terminated == (success or ends_by_divergence)
        reason = "diverged" if ends_by_divergence else "success" if success else "time limit"
        assert info.get("reason") == (reason if terminated or truncated else None)
        assert np.isfinite(reward)
        if not (diverged and way == "reset"):
            self.check_reward(np.float32(reward), np.float32(loss), info, terminated)
        self.loss = np.float32(loss)
        self.is_over = diverged and (terminated or truncated)

    def check_reward(self, reward: Any, loss: Any, info: Any, terminated: bool) -> None:
        if self.fields["reward"] == "sparse":
            is_last = terminated or self.steps == self.fields["max_episode_steps"]
            assert reward == (-loss if is_last else 0.0)
        else:
            assert reward == self.loss - loss
            falls = [v for name, v in info.items() if name.startswith("reward_")]
            size = max(abs(self.loss), abs(loss))
            assert info["diverged"] or self.is_over or abs(sum(falls) - reward) <= 1e-5 * size
        if info["diverged"]:
            assert self.fields["on_divergence"] == "ignore" or loss >= self.first_loss
        else:
            parts = [v for name, v in info.items() if name.startswith("loss_")]
            assert np.isclose(loss, sum(parts), rtol=1e-5, atol=1e-6)
        # Rewards of particles add up as long as the episode lasts.
        if self.fields["reward"] in ("particle", "marginal") and not self.is_over:
            own = host(info["particle_reward"])
            assert own.shape == (self.fields["particle_count"],)
            size = max(abs(self.loss), abs(loss), np.abs(own).max())
            assert abs(own.mean(dtype=np.float64) - reward) <= 1e-4 * size + 1e-6

    def expect_place(self) -> None:
        self.loss, self.is_over = np.float32(self.inner.worlds.loss[0]), False
        assert np.isfinite(self.loss)


class Crowd(Played):
    """A world of several species, whose agents are species or particles."""

    often: ClassVar = {"step": 14, "reset": 2, "place": 1, "state": 1, "render": 1}

    @classmethod
    def make(cls, name: str, draw: random.Random) -> Played:
        module = particles_v0 if name in particles_v0.ENVIRONMENTS else multispecies_v0
        by_particle = module is particles_v0
        fields = species_fields(module.ENVIRONMENTS[name], draw, by_particle=by_particle)
        return cls(module.parallel_env(**fields), fields)

    def snapshot(self) -> Any:
        return self.env.state()

    def options(self, draw: random.Random) -> Any:
        """Return none: PettingZoo's environments ignore them."""

    def expect_reset(self, observation: Any, info: Any) -> None:
        super().expect_reset(observation, info)
        self.steps = 0
        self.loss = {agent: checked_loss(of_agent) for agent, of_agent in info.items()}

    def expect_step(self, rewards: Any, ended: Any, late: Any, infos: Any) -> None:
        if not self.acted:
            assert (rewards, ended, late, infos) == ({}, {}, {}, {})
            self.settle()
            return
        self.steps += 1
        for part in (rewards, ended, late, infos):
            assert list(part) == self.acted
        is_last = self.steps >= self.fields["max_cycles"]
        words = {"removed", "left the world", "no opponent"}
        for agent in self.acted:
            assert type(rewards[agent]) is float
            assert np.isfinite(rewards[agent])
            assert late[agent] is is_last
            reason = AGENT_REASONS[infos[agent]["reason"]]
            expected = words if ended[agent] else {"time limit" if is_last else None}
            assert reason in expected
            loss = checked_loss(infos[agent])
            if self.fields["reward"] == "individual" and self.fields["task"] != "invasion":
                fell = self.loss[agent] - loss
                # A species that leaves the world is not paid for it.
                leaves = reason == "left the world"
                assert rewards[agent] <= fell + 1e-9 if leaves else np.isclose(rewards[agent], fell)
            self.loss[agent] = loss
        assert self.env.agents == [a for a in self.acted if not (ended[a] or late[a])]
        # Boxes are two length units wide.
        assert self.fields["boundary"] == "open" or (self.env.particles()[0].abs() <= 1.0).all()
        if self.env.agents and any(ended.values()):
            self.expect_place()
        if self.fields["task"] == "invasion" and self.fields["opponent"] is None:
            assert abs(sum(rewards.values())) <= 1e-6 * (1 + max(map(abs, rewards.values())))

    def expect_place(self) -> None:
        losses = sum(part[0].double() for part in self.env.worlds.loss_terms().values())
        # An opponent that the environment plays comes last.
        now = dict(zip(self.env.possible_agents, losses.tolist(), strict=False))
        self.loss = {agent: now[agent] for agent in self.env.agents}

    def state(self, draw: random.Random) -> None:
        state = self.refused(self.env.state)
        assert (state is not None) == self.started
        if state is not None:
            assert self.env.state_space.contains(host(state))


PLAYED: dict[str, type[Any]] = dict.fromkeys(IDS, OneWorld)
PLAYED |= dict.fromkeys((*multispecies_v0.ENVIRONMENTS, *particles_v0.ENVIRONMENTS), Crowd)
"""Models of all environments, by the ids of both registries."""


def make(name: str, draw: random.Random) -> Played:
    """Return an environment; a choice of keywords that is refused is drawn again."""
    while True:
        try:
            return PLAYED[name].make(name, draw)
        except NPAError:
            continue


@pytest.mark.filterwarnings("ignore")
@pytest.mark.parametrize("total", [QUICK, pytest.param(THOROUGH, marks=pytest.mark.slow)])
@pytest.mark.parametrize("name", PLAYED)
def test_whatever_an_environment_is_given_it_keeps_its_contract(name: str, total: int) -> None:
    for first in range(0, total, LIFE):
        seed = FIRST_SEED + first
        draw = random.Random(f"{name} {seed}")
        torch.manual_seed(seed)
        made = make(name, draw)
        try:
            for call in range(min(LIFE, total - first)):
                try:
                    made.call(draw)
                except Exception as error:
                    error.add_note(f"call {call} of seed {seed}, made with {made.fields}")
                    raise
        finally:
            made.env.close()
