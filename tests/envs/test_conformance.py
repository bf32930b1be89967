"""What holds for every environment of one species, alone and batched: one class over all ids."""

import json
import pickle
import re
import warnings
from pathlib import Path

import gymnasium
import numpy as np
import pytest
import small_envs
import torch
from gymnasium.utils.env_checker import check_env
from refusals import refused
from small_envs import IDS, SPECIAL, assert_batch_of_singles, assert_same, begun

from npa_envs.registration import GARDENS, SIZES
from npa_envs.registration import SMALL as SMALL_GARDENS

PICTURES, SHAPESHIFTER = "npa/Pictures2D-v0", "npa/Shapeshifter2D-v0"
TOOLS = {"tools": ("push", "wipe", "inject", "rate")}
FORMS = {
    "grid": TOOLS,
    "discrete": TOOLS | {"actions": "discrete", "observe": "picture"},
    "free": {"actions": "free", "brush_count": 3, "observe": "moments"},
}
CASES = {name: (name, {}) for name in IDS}
CASES["pictures-seen"] = (PICTURES, {"observe_target": True})
for garden in GARDENS:
    CASES |= {f"{garden.id}-{form}": (garden.id, given) for form, given in FORMS.items()}
for form in ("code", "choice"):
    CASES[f"{SHAPESHIFTER}-{form}"] = (SHAPESHIFTER, {"actions": form})

SIZED = {row.id: (row.id, {"seed_pool": 2, "grow_steps": 4}) for row in SMALL_GARDENS} | {
    row.id: (row.id, {} if "Small" in row.id else small_envs.small(row.id.replace("Large", "")))
    for row in SIZES
}
"""Small forms as they are registered; large ones with few particles."""

MODES = ("same-step", "next-step")
every_case = pytest.mark.parametrize("case", CASES)


class TestEveryEnvironment:
    @pytest.fixture(autouse=True)
    def _case(self, case, coded):
        self.name, self.given = (CASES | SIZED)[case]
        if self.name == SHAPESHIFTER:
            self.given = self.given | coded
        if self.name in SPECIAL or self.name in IDS:
            self.given = small_envs.small(self.name, **self.given)

    def make(self, **keywords):
        return gymnasium.make(self.name, **(self.given | keywords))

    def make_vec(self, world_count, **keywords):
        return gymnasium.make_vec(
            self.name,
            world_count,
            vectorization_mode="vector_entry_point",
            **(self.given | keywords),
        )

    def sampled(self, env, count, seed=0):
        env.action_space.seed(seed)
        return [env.action_space.sample() for _ in range(count)]

    @pytest.mark.parametrize("case", CASES | SIZED)
    def test_gymnasium_and_sb3_find_nothing_to_complain_of(self):
        checker = pytest.importorskip("stable_baselines3.common.env_checker")
        unseen = {"skip_render_check": self.name not in CASES}
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            check_env(self.make().unwrapped, **unseen)
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always")
            checker.check_env(self.make().unwrapped, **unseen)
        # Pictures are no images of bytes, and rows are no vectors: it advises to flatten both.
        assert [str(w.message) for w in caught if "flatten" not in str(w.message)] == []

    @pytest.mark.parametrize(
        ("case", "mode"),
        [(case, mode) for case in CASES for mode in MODES] + [(case, MODES[0]) for case in SIZED],
    )
    def test_vector_equals_single_over_autoresets(self, mode, device):
        keywords = {"max_episode_steps": 4, "device": str(device)}
        if mode == "next-step":
            keywords |= {"reward": "sparse"}
        envs = self.make_vec(3, autoreset_mode=mode, **keywords)
        singles = [self.make(**keywords) for _ in range(3)]
        reasons, _ = assert_batch_of_singles(envs, singles, self.sampled(envs, 10), mode)
        assert "time limit" in reasons

    @every_case
    def test_gymnasiums_own_batches_of_single_worlds_agree(self):
        ours = self.make_vec(2, max_episode_steps=3)
        theirs = gymnasium.vector.SyncVectorEnv(
            [lambda: self.make(max_episode_steps=3)] * 2,
            autoreset_mode=ours.metadata["autoreset_mode"],
        )
        assert ours.observation_space == theirs.observation_space
        assert ours.action_space == theirs.action_space
        assert_same(ours.reset(seed=0)[0], theirs.reset(seed=0)[0])
        for action in self.sampled(ours, 7):
            left, right = ours.step(action), theirs.step(action)
            assert_same(left[:4], right[:4])
            for key, value in right[4].items():
                if key != "final_info":
                    assert_same(list(left[4][key]), list(value))

    @every_case
    def test_an_episode_follows_from_its_seed_or_generator_and_from_nothing_else(self):
        first, second, other = self.make(), self.make(), begun(self.make())
        actions = self.sampled(first, 4)

        def episode(env, seed=5, beside=None):
            trace = [env.reset(seed=seed)]
            for action in actions:
                trace.append(env.step(action))
                if beside is not None:
                    beside.step(beside.action_space.sample())
            return trace

        trace = episode(first)
        assert_same(trace, episode(second, beside=other))
        following = first.reset(), first.step(actions[0])
        assert_same(trace, episode(first))
        assert_same(following, (first.reset(), first.step(actions[0])))
        losses = (run[1][4]["loss"] for run in (trace, following, episode(second, seed=6)))
        assert len(set(losses)) == 3
        first.unwrapped.np_random = np.random.default_rng(5)
        assert_same(first.reset(), trace[0])

    @every_case
    def test_its_spec_survives_pickling_and_json(self):
        spec = self.make().spec
        assert pickle.loads(pickle.dumps(spec)) == spec
        read = gymnasium.envs.registration.EnvSpec.from_json(spec.to_json())
        assert json.loads(read.to_json()) == json.loads(spec.to_json())
        env, again = self.make(), gymnasium.make(read)
        assert_same(env.reset(seed=3), again.reset(seed=3))
        for action in self.sampled(env, 2):
            assert_same(env.step(action), again.step(action))
        batched = pickle.loads(pickle.dumps(self.make_vec(2).spec))
        assert gymnasium.make_vec(batched).num_envs == 2

    @every_case
    def test_it_survives_pickling_in_the_midst_of_an_episode(self, device):
        given = {"device": str(device), "max_episode_steps": 5}
        kept = [self.make(**given).unwrapped]
        kept += [self.make_vec(2, copy=copy, **given) for copy in (True, False)]
        begun(*kept)
        actions = [self.sampled(env, 7) for env in kept]
        for env, given in zip(kept, actions, strict=True):
            for action in given[:3]:
                env.step(action)
        again = pickle.loads(pickle.dumps(kept))
        # Episodes of the batches end meanwhile.
        for env, copied, given in zip(kept, again, actions, strict=True):
            for action in given[3:]:
                assert_same(env.step(action), copied.step(action))

    @every_case
    def test_info_has_the_keys_that_the_page_lists(self):
        page = Path(__file__).parents[2] / "docs" / "environments" / f"{self.name[4:-3]}.md"
        section = page.read_text(encoding="utf-8").split("## Info\n")[1].split("\n## ")[0]
        rows = [line.split("|")[1:3] for line in section.splitlines() if line.startswith("| `")]
        listed = [(key, when) for keys, when in rows for key in re.findall("`([^`]+)`", keys)]
        listed = [pair for pair in listed if pair[0] not in ("particle_reward", "updated")]
        env = self.make(success_loss=1e6)
        _, at_reset = env.reset(seed=0)
        *_, at_step = env.step(env.action_space.sample())
        assert sorted(key for key, when in listed if "reset" in when) == sorted(at_reset)
        assert sorted(key for key, _ in listed) == sorted(at_step)

    @every_case
    def test_disabled_mode_resets_only_the_worlds_of_the_mask(self):
        given = {"autoreset_mode": "disabled", "output": "torch"}
        ended = begun(self.make_vec(4, max_episode_steps=3, **given))
        envs, others = begun(*(self.make_vec(4, **given) for _ in range(2)))
        actions = self.sampled(envs, 6)
        for action in actions[:3]:
            *_, truncated, _ = ended.step(action)
            envs.step(action)
            _, _, _, _, before = others.step(action)
        assert truncated.all()
        mask = np.array([True, False, False, True])
        _, fresh = self.make_vec(4).reset(seed=0)
        for batch in (ended, envs):
            _, infos = batch.reset(options={"reset_mask": torch.from_numpy(mask)})
            assert (np.asarray(infos["loss"] == before["loss"]) != mask).all()
            assert np.asarray(infos["_loss"]).tolist() == mask.tolist()
        refused(r"the episodes of worlds \[1, 2\] are over", ended.step, actions[3])
        # Where the others may go on, they go on as if nothing had happened to their neighbours.
        for action in actions[3:]:
            left, right = envs.step(action)[4]["loss"], others.step(action)[4]["loss"]
            assert (np.asarray(left == right) != mask).all()
        _, again = envs.reset(seed=0, options={"reset_mask": mask})
        assert ((np.asarray(again["loss"]) == fresh["loss"]) == mask).all()

    @pytest.mark.parametrize(
        ("case", "style"),
        [(case, "particles") for case in CASES]
        + [(name, style) for name in IDS for style in ("density", "states")],
    )
    def test_pictures_show_each_world(self, style):
        given = {"render_mode": "rgb_array", "render_style": style}
        env, envs = begun(self.make(**given), seed=1), begun(self.make_vec(3, **given))
        actions = self.sampled(envs, 1)[0]
        envs.step(actions)
        env.step(small_envs.world_of(actions, 1))
        pictures, picture = envs.render(), env.render()
        assert [(one.shape, one.dtype) for one in pictures] == [((24, 24, 3), np.uint8)] * 3
        assert np.array_equal(pictures[1], picture)
        assert (picture != 255).any()
        # Grown pictures leave the corners empty.
        assert (picture[0, 0] == 255).all() or env.unwrapped.config.box is not None

    @pytest.mark.parametrize("case", IDS)
    def test_frames_come_as_a_list_and_windows_close_twice(self):
        env = begun(self.make(render_mode="rgb_array_list"))
        for action in self.sampled(env, 3):
            env.step(action)
        frames = env.render()
        assert [(frame.shape, frame.dtype) for frame in frames] == [((24, 24, 3), np.uint8)] * 4
        assert (frames[0] != frames[-1]).any()
        for env in (self.make(render_mode="human"), self.make_vec(3, render_mode="human")):
            env.reset(seed=0)
            env.step(env.action_space.sample())
            assert env.render() is None
            env.close()
            env.close()
