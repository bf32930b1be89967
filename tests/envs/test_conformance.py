"""What holds for every environment, single and batched: one class over all ids."""

import importlib.util
import json
import pickle
import re
import warnings
from pathlib import Path

import gymnasium
import numpy as np
import pytest
import torch
from gymnasium.utils.env_checker import check_env
from gymnasium.wrappers import AddRenderObservation, GrayscaleObservation, ResizeObservation
from support import crowds, small_envs
from support.refusals import refused
from support.slow import slow
from support.small_envs import IDS, SPECIAL, assert_same, begun

from npa_envs.envs import multispecies_v0
from npa_envs.registration import ALL, CENTRAL, GARDENS, SIZES
from npa_envs.registration import SMALL as SMALL_GARDENS

PICTURES, SHAPESHIFTER = "npa/Pictures2D-v0", "npa/Shapeshifter2D-v0"
TOOLS = {"tools": ("push", "wipe", "inject", "rate")}
FORMS = {
    "grid": TOOLS,
    "discrete": TOOLS | {"actions": "discrete", "observe": "picture"},
    "free": {"actions": "free", "action_shape": "brushes", "brush_count": 3, "observe": "moments"},
}
CASES = {name: (name, {}) for name in IDS}
CASES["pictures-seen"] = (PICTURES, {"observe_target": True})
for garden in GARDENS:
    CASES |= {f"{garden.id}-{form}": (garden.id, given) for form, given in FORMS.items()}
for form in ("code", "choice"):
    CASES[f"{SHAPESHIFTER}-{form}"] = (SHAPESHIFTER, {"actions": form})
for name in ("npa/Morphogenesis2D-v0", "npa/PointClassification-v0"):
    CASES[f"{name}-central"] = (name, {"control": "central", "place_count": 3, "picture_size": 5})

SIZED = {row.id: (row.id, {"seed_pool": 2, "grow_steps": 4}) for row in SMALL_GARDENS} | {
    row.id: (row.id, {} if "Small" in row.id else small_envs.small(row.id.replace("Large", "")))
    for row in (*SIZES, *CENTRAL)
}
"""Small forms as they are registered; large ones with few particles."""

SPECIES = "species"
"""The case of several species, one of which is removed in an episode."""

ALIKE = [f"{garden.id}-{form}" for garden in GARDENS[1:] for form in list(FORMS)[1:]]
"""Forms of the other gardens, which are those of the first one."""

QUICK = [slow(case) if case in ALIKE else case for case in CASES]
every_case = pytest.mark.parametrize("case", QUICK)
every_case_and_species = pytest.mark.parametrize("case", [*QUICK, SPECIES])


def paired(second, *cases):
    return [slow(c, second) if c in {*ALIKE, *SIZED} else (c, second) for c in cases]


def leaves(result):
    """Return all arrays and tensors of what a step or a reset returned."""
    if isinstance(result, dict):
        result = result.values()
    elif isinstance(result, np.ndarray | torch.Tensor):
        return [result]
    elif not isinstance(result, tuple):
        return []
    return [leaf for part in result for leaf in leaves(part)]


def losses(infos):
    """Return the losses of worlds, summed over agents, [B]."""
    infos = [infos] if "loss" in infos else infos.values()
    return np.sum([np.asarray(info["loss"]) for info in infos], axis=0)


class TestEveryEnvironment:
    @pytest.fixture(autouse=True)
    def _case(self, case, coded):
        self.is_species = case == SPECIES
        if self.is_species:
            self.name, deaths = SPECIES, {"species_count": 3, "deaths": ((1, 2),)}
            self.given = crowds.small("co_morphogenesis", position_noise=0.01, **deaths)
            return
        self.name, self.given = (CASES | SIZED)[case]
        if self.name == SHAPESHIFTER:
            self.given = self.given | coded
        if self.name in SPECIAL or self.name in IDS:
            self.given = small_envs.small(self.name, **self.given)

    def make(self, **keywords):
        keywords = self.given | keywords
        if self.is_species:
            keywords["max_cycles"] = keywords.pop("max_episode_steps", 6)
            return multispecies_v0.parallel_env(**keywords)
        return gymnasium.make(self.name, **keywords)

    def make_vec(self, world_count, **keywords):
        keywords = self.given | keywords
        if self.is_species:
            keywords["max_cycles"] = keywords.pop("max_episode_steps", 6)
            return multispecies_v0.batched(world_count=world_count, **keywords)
        form = {"vectorization_mode": "vector_entry_point"}
        return gymnasium.make_vec(self.name, world_count, **form, **keywords)

    def sampled(self, env, count, seed=0):
        """Return actions; those of species are of all that are live now."""
        if self.is_species:
            generator = np.random.default_rng(seed)
            return [crowds.drawn(env, generator) for _ in range(count)]
        env.action_space.seed(seed)
        return [env.action_space.sample() for _ in range(count)]

    @pytest.mark.parametrize("case", [*CASES, *map(slow, SIZED)])
    def test_gymnasium_and_sb3_find_nothing_to_complain_of(self):
        checker = pytest.importorskip("stable_baselines3.common.env_checker")
        unseen = {"skip_render_check": self.name not in CASES}
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            check_env(self.make().unwrapped, **unseen)
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always")
            checker.check_env(self.make().unwrapped, **unseen)
        # Rows are no vectors: it advises to flatten them.
        spaces = self.make().observation_space, self.make().action_space
        advice = "flatten" if any(len(space.shape or ()) > 1 for space in spaces) else "none"
        assert [str(w.message) for w in caught if advice not in str(w.message)] == []

    @pytest.mark.parametrize(
        ("case", "mode"),
        paired("same-step", *CASES, *SIZED)
        + [((case, "next-step") if case in IDS else slow(case, "next-step")) for case in CASES],
    )
    def test_gymnasiums_own_batches_of_single_worlds_agree_in_all_they_return(self, mode, device):
        # Some worlds succeed in steps in which others go on.
        loss = float(self.make_vec(2).reset(seed=0)[1]["loss"].mean())
        limits = {"max_episode_steps": 3, "success_loss": loss, "device": str(device)}
        limits |= {"reward": "sparse"} if mode == "next-step" else {}
        ours = self.make_vec(2, autoreset_mode=mode, **limits)
        theirs = gymnasium.vector.SyncVectorEnv(
            [lambda: self.make(episode_steps=3, **limits)] * 2,
            autoreset_mode=ours.metadata["autoreset_mode"],
        )
        assert ours.observation_space == theirs.observation_space
        assert ours.action_space == theirs.action_space
        assert_same(ours.reset(seed=0), theirs.reset(seed=0))
        for action in self.sampled(ours, 7):
            left, right = ours.step(action), theirs.step(action)
            assert_same(left, right)
            types = [[leaf.dtype for leaf in leaves(result)] for result in (left, right)]
            assert sorted(types[0], key=str) == sorted(types[1], key=str)

    @every_case
    def test_an_episode_follows_from_its_seed_or_generator_and_from_nothing_else(self):
        first, second, other = self.make(), self.make(), begun(self.make())
        actions = self.sampled(first, 4)

        def episode(env, seed=5, neighbour=None):
            trace = [env.reset(seed=seed)]
            for action in actions:
                trace.append(env.step(action))
                if neighbour is not None:
                    neighbour.step(neighbour.action_space.sample())
            return trace

        trace = episode(first)
        assert_same(trace, episode(second, neighbour=other))
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

    @every_case_and_species
    def test_it_survives_pickling_in_the_midst_of_an_episode(self, device):
        keywords = {"device": str(device), "max_episode_steps": 5}
        envs = [self.make(**keywords), self.make_vec(2, **keywords)]
        if not self.is_species:
            envs.append(self.make_vec(2, copy=False, **keywords))
        envs = [getattr(env, "unwrapped", env) for env in begun(*envs)]
        for step in range(3):
            for env in envs:
                env.step(self.sampled(env, 1, step)[0])
        # Episodes end meanwhile.
        for env, copied in zip(envs, pickle.loads(pickle.dumps(envs)), strict=True):
            for step in range(4):
                action = self.sampled(env, 1, step)[0]
                assert_same(env.step(action), copied.step(action))
            assert_same(env.reset(), copied.reset())

    @pytest.mark.parametrize(
        ("case", "mode"),
        paired("same-step", *CASES, SPECIES)
        + [(IDS[0], mode) for mode in ("next-step", "disabled")]
        + [slow(name, mode) for name in IDS[1:] for mode in ("next-step", "disabled")]
        + [(SPECIES, "disabled")],
    )
    def test_tensors_and_shared_arrays_are_as_new_arrays_which_are_the_callers(self, mode, device):
        """What was returned stays as it is, and what its owner changes has no effect."""
        steps = 30 if mode == "disabled" else 3
        keywords = {"autoreset_mode": mode, "max_episode_steps": steps, "device": str(device)}
        keywords |= {"reward": "particle"} if self.name in IDS else {}
        arrays, changed = (self.make_vec(3, **keywords) for _ in range(2))
        tensors = self.make_vec(3, output="torch", **keywords)
        shared = changed if self.is_species else self.make_vec(3, copy=False, **keywords)
        calls = [lambda env: env.reset(seed=0)]
        calls += [lambda env, a=a: env.step(a) for a in self.sampled(arrays, 8)]
        calls.append(lambda env: env.reset(options={"reset_mask": np.array([True, False, True])}))
        results, pickled, first = [], [], None
        for call in calls:
            returned = call(arrays), call(tensors)
            results.append(returned)
            pickled.append(pickle.dumps(returned))
            *right, infos = returned[1]
            by_mask = len(right) == 4 and not self.is_species
            assert_same(returned[0], (*right, small_envs.as_arrays(infos) if by_mask else infos))
            for values in (*returned[1][:-1], losses):
                assert all(leaf.device.type == device.type for leaf in leaves(values))
            if not self.is_species:
                result = call(shared)
                assert_same(returned[0], result)
                first = result[0] if first is None else first
                if self.name in IDS and device.type == "cpu":
                    assert np.shares_memory(first, result[0])
            result = call(changed)
            assert_same(returned[0], result)
            for leaf in leaves(result):
                leaf[...] = 0
        assert_same(results, [pickle.loads(then) for then in pickled])

    @every_case
    def test_info_has_the_keys_that_the_page_lists(self):
        page = Path(__file__).parents[2] / "docs" / "environments" / f"{self.name[4:-3]}.md"
        section = page.read_text(encoding="utf-8").split("## Info\n")[1].split("\n## ")[0]
        rows = [line.split("|")[1:3] for line in section.splitlines() if line.startswith("| `")]
        listed = [(key, when) for keys, when in rows for key in re.findall("`([^`]+)`", keys)]
        of_particles = {"reward": "particle", "tell_updated": True} if self.name in IDS else {}
        env = self.make(success_loss=1e6, **of_particles)
        _, at_reset = env.reset(seed=0)
        *_, at_step = env.step(env.action_space.sample())
        assert sorted(key for key, when in listed if "reset" in when) == sorted(at_reset)
        assert sorted(key for key, _ in listed) == sorted(at_step)

    @every_case_and_species
    def test_disabled_mode_resets_only_the_worlds_of_the_mask(self):
        keywords = {"autoreset_mode": "disabled", "output": "torch"}
        ended = begun(self.make_vec(4, max_episode_steps=3, **keywords))
        envs, others = begun(*(self.make_vec(4, **keywords) for _ in range(2)))
        actions = self.sampled(envs, 6)
        for action in actions[:3]:
            ended.step(action)
            envs.step(action)
            *_, before = others.step(action)
        mask = np.array([True, False, False, True])
        _, first = self.make_vec(4).reset(seed=0)
        for batch in (ended, envs):
            _, infos = batch.reset(options={"reset_mask": torch.from_numpy(mask)})
            assert self.is_species or np.asarray(infos["_loss"]).tolist() == mask.tolist()
        assert ((losses(infos) == losses(before)) != mask).all()
        refused(r"the episodes of worlds \[1, 2\] are over", ended.step, actions[3])
        # Where the others may continue, they do as if nothing had happened to their neighbours.
        for action in actions[3:]:
            left, right = losses(envs.step(action)[4]), losses(others.step(action)[4])
            assert ((left == right) != mask).all()
        _, again = envs.reset(seed=0, options={"reset_mask": mask})
        assert ((losses(again) == losses(first)) == mask).all()

    @pytest.mark.parametrize(
        ("case", "style"),
        paired("particles", *CASES, SPECIES)
        + [(SPECIES, "species")]
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

    @every_case_and_species
    def test_after_close_there_are_no_worlds_until_the_next_reset(self):
        for env in (self.make(), self.make_vec(2)):
            actions = self.sampled(begun(env), 1)[0]
            env.close()
            refused("step needs (a )?worlds?, which close has ended: call reset", env.step, actions)
            env.reset(seed=0)
            env.step(actions)


@pytest.mark.parametrize("row", ALL, ids=lambda row: row.id)
def test_gymnasiums_wrappers_make_pictures_the_observations_of_every_id(row):
    usual = f"npa/{row.name}-v0"
    fields = small_envs.small(usual, render_mode="rgb_array", render_size=48)
    env = AddRenderObservation(gymnasium.make(row.id, **fields))
    shape = (48, 48)
    if importlib.util.find_spec("cv2"):
        env, shape = ResizeObservation(env, (21, 24)), (21, 24)
    env = GrayscaleObservation(env)
    first, _ = env.reset(seed=0)
    second, *_ = env.step(env.action_space.sample())
    for picture in (first, second):
        assert env.observation_space.contains(picture)
        assert picture.shape == shape
    assert not np.array_equal(first, second)
