"""What holds for every environment of one species, alone and batched: one class over all ids."""

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
from small_envs import IDS, assert_batch_of_singles, assert_same

import npa_envs
from npa_envs.registration import GARDENS

PICTURES, SHAPESHIFTER = "npa/Pictures2D-v0", "npa/Shapeshifter2D-v0"
LIVING = {"particle_count": 48, "eps": 0.2, "resolution": 16, "picture_size": 8, "render_size": 24}
LIVING |= {"seed_pool": 3, "grow_steps": 4, "rule_steps": 2}
TOOLS = {"tools": ("push", "wipe", "inject", "rate")}
FORMS = {
    "grid": TOOLS,
    "discrete": TOOLS | {"actions": "discrete", "observe": "picture"},
    "free": {"actions": "free", "brush_count": 3, "observe": "moments"},
}
CODED = {"state_dim": 8, "eps": 0.3, "eps0": 0.3, "hold_steps": 2}
CASES = {name: (name, {}) for name in IDS}
CASES["pictures-seen"] = (PICTURES, {"observe_target": True})
for garden in GARDENS:
    CASES |= {f"{garden.id}-{form}": (garden.id, LIVING | given) for form, given in FORMS.items()}
for form in ("code", "choice"):
    CASES[f"{SHAPESHIFTER}-{form}"] = (SHAPESHIFTER, LIVING | CODED | {"actions": form})


@pytest.fixture(scope="module")
def rule_path(tmp_path_factory):
    """A rule of three pictures that has learned nothing."""
    torch.manual_seed(0)
    codes = {"code_dim": 3, "code_names": ("heart", "ring", "letter-a")}
    rule = npa_envs.NPARule(state_dim=8, hidden_dim=8, eps0=0.3, **codes).requires_grad_(False)
    rule.output.weight *= 30.0
    path = tmp_path_factory.mktemp("rule") / "rule.safetensors"
    npa_envs.save_rule(rule, path)
    return str(path)


@pytest.mark.parametrize("case", CASES)
class TestEveryEnvironment:
    @pytest.fixture(autouse=True)
    def _case(self, case, rule_path, monkeypatch):
        monkeypatch.setenv("SDL_VIDEODRIVER", "dummy")
        self.name, self.given = CASES[case]
        if self.name == SHAPESHIFTER:
            self.given = self.given | {"rule": rule_path}
        if self.name in IDS:
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

    def sampled(self, env, count):
        env.action_space.seed(0)
        return [env.action_space.sample() for _ in range(count)]

    def test_gymnasium_and_sb3_find_nothing_to_complain_of(self):
        checker = pytest.importorskip("stable_baselines3.common.env_checker")
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            check_env(self.make().unwrapped)
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always")
            checker.check_env(self.make().unwrapped)
        # Pictures are no images of bytes, and rows are no vectors: it advises to flatten both.
        assert [str(w.message) for w in caught if "flatten" not in str(w.message)] == []

    @pytest.mark.parametrize("mode", ["same-step", "next-step"])
    def test_vector_equals_single_over_autoresets(self, mode, device):
        keywords = {"max_episode_steps": 4, "device": str(device)}
        if mode == "next-step":
            keywords |= {"reward": "sparse"}
        envs = self.make_vec(3, autoreset_mode=mode, **keywords)
        singles = [self.make(**keywords) for _ in range(3)]
        reasons, _ = assert_batch_of_singles(envs, singles, self.sampled(envs, 10), mode)
        assert "time limit" in reasons

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
                    assert_same(list(left[4][key]), list(value), key)

    def test_an_episode_follows_from_its_seed_and_survives_pickling(self):
        env, other = self.make(), self.make()
        actions = self.sampled(env, 4)
        first = [env.reset(seed=5), *(env.step(action) for action in actions)]
        again = [other.reset(seed=5), *(other.step(action) for action in actions)]
        assert_same(first, again)
        copied = pickle.loads(pickle.dumps(env.unwrapped))
        assert_same(env.unwrapped.step(actions[0]), copied.step(actions[0]))
        other.reset(seed=6)
        assert other.step(actions[0])[4]["loss"] != first[1][4]["loss"]

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

    def test_masked_reset_leaves_other_worlds_alone(self):
        envs, others = (self.make_vec(3) for _ in range(2))
        actions = self.sampled(envs, 2)
        for batch in (envs, others):
            batch.reset(seed=0)
            batch.step(actions[0])
        envs.reset(seed=9, options={"reset_mask": np.array([False, True, False])})
        left, right = envs.step(actions[1]), others.step(actions[1])
        assert np.array_equal(left[4]["loss"][[0, 2]], right[4]["loss"][[0, 2]])
        assert left[4]["loss"][1] != right[4]["loss"][1]
