"""Random calls, right and wrong, of every environment in every form, by a model of what they owe.

What is refused leaves the worlds as they were; what is not keeps the documented types, shapes,
limits, rewards, episode ends and reasons.
"""

from __future__ import annotations

import copy
import os
import random
import resource
import time
from typing import Any, ClassVar

import gymnasium
import numpy as np
import pytest
import torch
from crowds import few, small
from fuzz_values import wrong
from gymnasium.vector import AutoresetMode
from small_envs import IDS, assert_same
from small_envs import small as small_keywords

from npa_envs import DivergedError, NPAError
from npa_envs.envs import multispecies_v0, particles_v0

QUICK, THOROUGH = 60, 20_000
"""Calls of each id; its forms share them."""

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
        "particle_count": draw.choice((2, 3, 5, 12)),
        "eps": draw.choice((0.1, 0.3, 1.0)),
        "alpha": draw.choice((0.5, 0.5, 20.0)),
        "state_scale": draw.choice((1.0, 1.0, 40.0)),
        "update_prob": draw.choice((0.5, 1.0)),
        "position_noise": draw.choice((0.0, 0.05)),
        "moment_inverse": draw.choice(("threshold", "smooth")),
        "observation_limit": draw.choice((64.0, 3.0)),
        "boundary": draw.choice(("open", "open", "periodic", "reflecting")),
        "output": draw.choice(("numpy", "torch")),
        "render_mode": draw.choice((None, "rgb_array")),
        "render_size": 8,
    }


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


def check_array(value: Any, shape: tuple[int, ...], limit: float, output: str) -> None:
    """Check what particles perceive."""
    assert type(value) is (torch.Tensor if output == "torch" else np.ndarray)
    found = host(value)
    assert found.shape == shape
    assert found.dtype == np.float32
    assert np.abs(found).max(initial=0.0) <= limit  # NaN fails as well.


class Played:
    """An environment that is called at random, and what is known of its worlds."""

    env: Any
    worlds: int
    fields: dict[str, Any]
    started = False
    often: dict[str, int]
    """How often each method is called."""
    lost: str
    """What an error says where numbers ran away."""

    def call(self, draw: random.Random) -> None:
        """Make a call; check what it does."""
        (kind,) = draw.choices(list(self.often), list(self.often.values()))
        getattr(self, kind)(draw)

    def refused(self, call: Any) -> Any:
        """Return what a call gives, or None where it is refused: the worlds are as they were."""
        before = self.snapshot() if self.started else ()
        try:
            return call()
        except DivergedError as error:
            if self.lost in str(error):
                assert self.fields["on_divergence"] == "raise"
                self.settle()
                return None
        except REFUSALS:
            pass
        assert_same(before, self.snapshot() if self.started else ())
        return None

    def settle(self) -> None:
        self.expect_reset(self.env.reset(seed=5), np.ones(self.worlds, bool))

    def render(self, draw: random.Random) -> None:
        pictures = self.refused(self.env.render)
        for picture in pictures if isinstance(pictures, list | tuple) else [pictures]:
            if picture is not None:
                assert self.fields["render_mode"] == "rgb_array"
                assert (picture.shape, picture.dtype) == ((8, 8, 3), np.uint8)


class OneSpecies(Played):
    """An environment of one species, "single" or "vector"."""

    often: ClassVar = {"step": 12, "reset": 3, "place": 2, "render": 1}
    lost = "numbers must stay"

    def __init__(self, name: str, form: str, draw: random.Random) -> None:
        self.single = form == "single"
        fields = small_keywords(name) | world_fields(draw)
        fields |= {
            "position_limit": draw.choice((4.0, 1.5)),
            "reward": draw.choice(("dense", "dense", "sparse", "particle", "marginal")),
            "on_divergence": draw.choice(("terminate", "terminate", "reset", "raise", "ignore")),
            "seed_pool": draw.choice((0, 0, 2)),
            "success_loss": draw.choice((None, 0.0, 0.2)),
            "max_episode_steps": draw.choice((1, 3, 8)),
        }
        if name == "npa/Pictures2D-v0":
            fields |= {"observe_target": draw.random() < 0.5}
            fields |= {"split": draw.choice(("train", "train", "test"))}
        self.worlds, self.mode = 1, None
        checked = self.single and draw.random() < 0.5
        if self.single:
            self.env = gymnasium.make(name, disable_env_checker=not checked, **fields)
        else:
            self.worlds = draw.choice((1, 2, 3))
            fields |= {"copy": draw.random() < 0.7}
            fields |= {"autoreset_mode": draw.choice(("same-step", "next-step", "disabled"))}
            self.env = gymnasium.make_vec(name, self.worlds, "vector_entry_point", **fields)
            self.mode = self.env.metadata["autoreset_mode"]
        self.fields = fields
        self.steps = np.zeros(self.worlds, int)
        """Steps of each world's episode."""
        self.loss = np.zeros(self.worlds, np.float32)
        self.over = np.zeros(self.worlds, bool)
        self.was_lost = np.zeros(self.worlds, bool)
        """Whether the last step ended the episode by divergence, and no reset followed."""
        if checked:
            # The checker of Gymnasium 1.4 fails itself after a first reset that was refused.
            self.settle()

    def snapshot(self) -> Any:
        return self.env.unwrapped.particles()

    def reset(self, draw: random.Random) -> None:
        seed, options, chosen = draw.randrange(99), draw.choice((None, None, {})), None
        if draw.random() < 0.3:
            seed = draw.choice((None, np.int64(3), np.uint8(4), 2**31))
        if not self.single and draw.random() < 0.4:
            chosen = np.array([draw.random() < 0.6 for _ in range(self.worlds)])
            if chosen.any():
                options = {"reset_mask": chosen}
                seed = draw.choice((seed, None))
            else:
                chosen = None
        if draw.random() < 0.25:
            seed = wrong(draw, "seed", 3)
        if draw.random() < 0.2:
            options, chosen = wrong(draw, "options", None), None
        given = copy.copy(options)
        found = self.refused(lambda: self.env.reset(seed=seed, options=given))
        if found is None:
            return
        assert not options or chosen is not None, "unknown options were taken without a word"
        self.expect_reset(found, np.ones(self.worlds, bool) if chosen is None else chosen)

    def expect_reset(self, found: Any, chosen: np.ndarray) -> None:
        observation, info = found
        self.started = True
        self.check_observation(observation)
        self.steps[chosen], self.over[chosen], self.was_lost[chosen] = 0, False, False
        for k in np.flatnonzero(chosen):
            told = self.told(info, k)
            assert "reason" not in told
            self.loss[k] = self.checked_loss(told)

    def step(self, draw: random.Random) -> None:
        action = actions_of(draw, self.env.action_space.shape)
        found = self.refused(lambda: self.env.step(action))
        if found is None:
            return
        assert self.started, "a step before the first reset"
        observation, rewards, terminated, truncated, infos = found
        self.check_observation(observation)
        if self.single:
            assert [type(v) for v in (rewards, terminated, truncated)] == [float, bool, bool]
            rewards, terminated, truncated = ([v] for v in (rewards, terminated, truncated))
        else:
            kind = np.float32 if self.fields["output"] == "torch" else np.float64
            arrays = [host(v) for v in (rewards, terminated, truncated)]
            assert [a.dtype for a in arrays] == [kind, bool, bool]
            assert all(a.shape == (self.worlds,) for a in arrays)
            rewards, terminated, truncated = arrays
        again = self.over.copy() if self.mode is AutoresetMode.NEXT_STEP else [False] * self.worlds
        for k in range(self.worlds):
            self.expect_step(k, rewards[k], terminated[k], truncated[k], infos, again[k])

    def expect_step(
        self, k: int, reward: Any, terminated: Any, truncated: Any, infos: Any, again: Any
    ) -> None:
        """Check what a step brought world k."""
        told = self.told(infos, k)
        if again:
            assert (reward, terminated, truncated) == (0.0, False, False)
            self.steps[k], self.over[k], self.loss[k] = 0, False, self.checked_loss(told)
            return
        ended = bool(terminated or truncated)
        following = told
        if ended and self.mode is AutoresetMode.SAME_STEP:
            final = infos["final_obs"][k]
            check_array(final, host(final).shape, self.limit, self.fields["output"])
            told = self.told(infos["final_info"], k)
        self.steps[k] += 1
        limit, way = self.fields["max_episode_steps"], self.fields["on_divergence"]
        loss = self.checked_loss(told)
        success, diverged = bool(told["success"]), bool(told["diverged"])
        lost = diverged and way == "terminate"
        assert bool(truncated) == (self.steps[k] >= limit)
        assert bool(terminated) == (success or lost)
        expected = "diverged" if lost else "success" if success else "time limit"
        assert told.get("reason") == (expected if ended else None)
        assert np.isfinite(reward)
        if not (diverged and way == "reset"):
            self.check_reward(k, np.float32(reward), loss, told, diverged, terminated)
        self.loss[k] = loss
        self.over[k], self.was_lost[k] = ended, lost and self.single
        if ended and self.mode is AutoresetMode.SAME_STEP:
            self.steps[k], self.over[k] = 0, False
            self.loss[k] = self.checked_loss(following)

    def check_reward(
        self, k: int, reward: Any, loss: Any, told: Any, diverged: bool, terminated: Any
    ) -> None:
        fell = self.loss[k] - loss
        if self.fields["reward"] == "sparse":
            last = terminated or self.steps[k] == self.fields["max_episode_steps"]
            assert reward == (-loss if last else 0.0)
        else:
            assert reward == fell
        if not diverged:
            parts = [v for name, v in told.items() if name.startswith("loss_")]
            assert np.isclose(loss, sum(parts), rtol=1e-5, atol=1e-6)
        # Rewards of particles add up as long as the episode lasts.
        if self.fields["reward"] in ("particle", "marginal") and not self.was_lost[k]:
            own = host(told["particle_reward"])
            assert own.shape == (self.fields["particle_count"],)
            size = max(abs(self.loss[k]), abs(loss), np.abs(own).max())
            assert abs(own.mean(dtype=np.float64) - reward) <= 1e-4 * size + 1e-6

    def place(self, draw: random.Random) -> None:
        """Put particles into worlds, which is no part of Gymnasium's interface."""
        env, lead = self.env.unwrapped, self.env.observation_space.shape[:-1]
        physics = env.worlds.physics
        given = {
            "x": torch.rand(*lead, physics.space_dim) - 0.5,
            "s": torch.rand(*lead, physics.state_dim) - 0.5,
        }
        if draw.random() < 0.4:
            name = draw.choice(("x", "s"))
            given[name] = wrong(draw, name, given[name])
        if self.refused(lambda: env.place_particles(**given)) is not None:
            self.loss[:], self.was_lost[:] = host(env.worlds.loss), False
            assert np.isfinite(self.loss).all()

    @property
    def limit(self) -> float:
        return self.fields["observation_limit"]

    def check_observation(self, observation: Any) -> None:
        shape = self.env.observation_space.shape
        check_array(observation, shape, self.limit, self.fields["output"])

    def told(self, infos: Any, k: int) -> dict[str, Any]:
        if self.single:
            return infos
        names = [name for name in infos if not name.startswith(("_", "final_"))]
        return {name: infos[name][k] for name in names if bool(infos[f"_{name}"][k])}

    def checked_loss(self, told: Any) -> np.float32:
        assert np.isfinite(float(told["loss"]))
        return np.float32(float(told["loss"]))


class Crowd(Played):
    """An environment of several species: "parallel", or many worlds, "batched"."""

    often: ClassVar = {"step": 14, "reset": 2, "place": 1, "state": 1, "render": 1}
    lost = "agents must have a particle"

    def __init__(self, task: str, form: str, draw: random.Random, *, by_particle: bool) -> None:
        self.form, self.count = form, draw.choice((2, 2, 3))
        fields = (few if by_particle else small)(task) | world_fields(draw)
        fields |= {
            "species_count": self.count,
            "particle_count": draw.choice((3, 5, 9)),
            "max_cycles": draw.choice((1, 3, 8)),
            "on_divergence": draw.choice(("terminate", "terminate", "raise", "ignore")),
            "reward": "individual" if task == "invasion" else draw.choice(("individual", "team")),
            "perception": draw.choice(("shared", "per_species")),
            **({"opponent": draw.choice((None, "random"))} if task == "invasion" else {}),
            "deaths": draw.choice(((), (), ((1, 2),), ((0, 1), (1, 3)))),
            "position_limit": draw.choice((4.0, 1.5)),
        }
        module = particles_v0 if by_particle else multispecies_v0
        if form == "batched":
            self.worlds, self.same = draw.choice((1, 2, 3)), draw.random() < 0.5
            fields |= {"world_count": self.worlds}
            fields |= {"autoreset_mode": "same-step" if self.same else "disabled"}
            self.env = module.batched(**fields)
            self.spaces = self.env.single_action_spaces
        else:
            self.worlds = 1
            self.env = module.parallel_env(**fields)
            self.spaces = self.env.action_spaces
        self.fields = fields
        self.steps = np.zeros(self.worlds, int)
        self.loss: dict[str, np.ndarray] = {}

    def snapshot(self) -> Any:
        return self.env.state()

    def reset(self, draw: random.Random) -> None:
        seed, options = draw.choice((None, 3, np.int64(7))), None
        chosen = np.ones(self.worlds, bool)
        if draw.random() < 0.3:
            seed = wrong(draw, "seed", 3)
        if self.form == "batched" and draw.random() < 0.5:
            options = {"reset_mask": np.array([draw.random() < 0.6 for _ in chosen])}
            chosen = options["reset_mask"]
        elif self.form == "batched" and draw.random() < 0.3:
            options = wrong(draw, "options", None)
        call = {"seed": seed, "options": options}
        done = []
        self.refused(lambda: done.append(self.env.reset(**call)))
        if done:
            self.expect_reset(done[0], chosen)

    def expect_reset(self, found: Any, chosen: np.ndarray) -> None:
        self.started = True
        self.steps[chosen] = 0
        observations, infos = found
        self.check_observations(observations)
        self.loss = {agent: self.checked_loss(info) for agent, info in infos.items()}

    def step(self, draw: random.Random) -> None:
        agents = self.env.agents
        lead = (self.worlds,) if self.form == "batched" else ()
        actions: Any = {}
        for agent in agents:
            shape = (*lead, *self.spaces[agent].shape)
            # One wrong action among many is wrong enough.
            chance = draw.random() < 2.0 / max(2, len(agents))
            actions[agent] = actions_of(draw, shape) if chance else torch.zeros(shape)
        if draw.random() < 0.1:
            changes = (lambda a: a | {"nobody": 1}, lambda a: dict(list(a.items())[1:]), list)
            actions = draw.choice(changes)(actions)
        closed = self.form == "batched" and not self.env.worlds.running.all()
        found = self.refused(lambda: self.env.step(actions))
        if found is None:
            if closed:
                self.settle()
            return
        assert self.started, "a step before the first reset"
        if self.form == "batched":
            self.expect_batch(*found)
        else:
            self.expect_step(agents, *found)

    def expect_step(
        self, acted: list[str], observations: Any, rewards: Any, ended: Any, late: Any, infos: Any
    ) -> None:
        if not acted:
            assert (observations, rewards, ended, late, infos) == ({}, {}, {}, {}, {})
            self.settle()
            return
        self.steps += 1
        for part in (observations, rewards, ended, late, infos):
            assert list(part) == acted
        self.check_observations(observations)
        is_last = bool(self.steps[0] >= self.fields["max_cycles"])
        words = {"removed", "left the world", "no opponent"}
        for agent in acted:
            assert type(rewards[agent]) is float
            assert np.isfinite(rewards[agent])
            assert late[agent] is is_last
            reason = infos[agent].get("reason")
            assert (
                (reason in words) if ended[agent] else reason == ("time limit" if is_last else None)
            )
            loss = self.checked_loss(infos[agent])
            if self.fields["reward"] == "individual" and self.fields["task"] != "invasion":
                fell = self.loss[agent] - loss
                gone = reason == "left the world"
                # A species that leaves the world is not paid for it.
                assert rewards[agent] <= fell + 1e-9 if gone else np.isclose(rewards[agent], fell)
            self.loss[agent] = loss
        assert self.env.agents == [a for a in acted if not (ended[a] or late[a])]
        if any(ended.values()):
            self.loss = {a: self.numbers()[a] for a in self.env.agents}
        if self.fields["task"] == "invasion" and self.fields["opponent"] is None:
            assert abs(sum(rewards.values())) <= 1e-6 * (1 + max(map(abs, rewards.values())))

    def numbers(self) -> dict[str, Any]:
        """Return losses of the world as it is: deaths and placing change them at no charge."""
        losses = sum(part[0].double() for part in self.env.worlds.measured().values())
        # An opponent that the environment plays comes last.
        return dict(zip(self.env.possible_agents, losses.tolist(), strict=False))

    def expect_batch(
        self, observations: Any, rewards: Any, ended: Any, late: Any, infos: Any
    ) -> None:
        """Check what a batch returns; that it equals single worlds is tested elsewhere."""
        self.check_observations(observations)
        self.steps += 1
        over = self.steps >= self.fields["max_cycles"]
        for agent, info in infos.items():
            kinds = ((rewards, np.float32), (ended, bool), (late, bool))
            for part, kind in kinds:
                assert host(part[agent]).dtype == kind
                assert host(part[agent]).shape == (self.worlds,)
            assert np.isfinite(host(rewards[agent])).all()
            assert np.array_equal(host(late[agent]), over & host(info["acted"]))
            self.checked_loss(info)
        if self.same:
            going_on = [host(infos[a]["acted"]) & ~host(ended[a]) for a in infos]
            self.steps[over | ~np.any(going_on, axis=0)] = 0

    def place(self, draw: random.Random) -> None:
        """Put particles into the world, which only single ones have a call for."""
        if self.form == "batched":
            return
        x, s = self.env.particles() if self.started else (torch.zeros(1, 2), torch.zeros(1, 16))
        given = {"x": x.clamp(-1, 1), "s": s.clamp(-1, 1)}
        if draw.random() < 0.4:
            name = draw.choice(("x", "s"))
            given[name] = wrong(draw, name, given[name])
        found = self.refused(lambda: self.env.place_particles(**given))
        if found is not None:
            self.check_observations(found)
            self.loss = {a: self.numbers()[a] for a in self.env.agents}

    def state(self, draw: random.Random) -> None:
        found = self.refused(self.env.state)
        assert (found is not None) == self.started
        if found is not None and self.form != "batched":
            assert self.env.state_space.contains(host(found))

    def check_observations(self, observations: Any) -> None:
        lead = (self.worlds,) if self.form == "batched" else ()
        for agent, rows in observations.items():
            shape = (*lead, *self.space_of(agent).shape)
            check_array(rows, shape, self.fields["observation_limit"], self.fields["output"])

    def space_of(self, agent: str) -> Any:
        if self.form == "batched":
            return self.env.single_observation_spaces[agent]
        return self.env.observation_space(agent)

    def checked_loss(self, told: Any) -> Any:
        loss = host(told["loss"])
        assert np.isfinite(loss).all()
        return loss


FORMS: dict[str, tuple[str, ...]] = dict.fromkeys(IDS, ("single", "vector"))
FORMS |= dict.fromkeys(multispecies_v0.ENVIRONMENTS, ("parallel", "batched"))
FORMS |= dict.fromkeys(particles_v0.ENVIRONMENTS, ("parallel",))
"""All environments, by the ids of both registries, and their forms."""


def make(name: str, form: str, draw: random.Random) -> OneSpecies | Crowd:
    """Return an environment; a choice of keywords that is refused is drawn anew."""
    while True:
        try:
            if name in IDS:
                return OneSpecies(name, form, draw)
            tasks = multispecies_v0.ENVIRONMENTS | particles_v0.ENVIRONMENTS
            by_particle = name in particles_v0.ENVIRONMENTS
            return Crowd(tasks[name], form, draw, by_particle=by_particle)
        except NPAError:
            continue


@pytest.mark.filterwarnings("ignore")
@pytest.mark.parametrize("total", [QUICK, pytest.param(THOROUGH, marks=pytest.mark.slow)])
@pytest.mark.parametrize(("name", "form"), [(n, f) for n, forms in FORMS.items() for f in forms])
def test_whatever_an_environment_is_given_it_keeps_its_contract(
    name: str, form: str, total: int
) -> None:
    count, began = total // len(FORMS[name]), time.monotonic()
    for first in range(0, count, LIFE):
        seed = FIRST_SEED + first
        draw = random.Random(f"{name} {form} {seed}")
        torch.manual_seed(seed)
        made = make(name, form, draw)
        try:
            for call in range(min(LIFE, count - first)):
                try:
                    made.call(draw)
                except Exception as error:
                    error.add_note(f"call {call} of seed {seed}, made with {made.fields}")
                    raise
        finally:
            made.env.close()
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss >> 10
    print(f"{name} {form}: {count} calls, {time.monotonic() - began:.0f} s, peak {peak} MiB")
