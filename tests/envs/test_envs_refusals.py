"""Wrong configurations and calls of environments are refused in words that help."""

import functools
import warnings

import gymnasium
import numpy as np
import pytest
import torch
from support.crowds import drawn, few, still
from support.crowds import make as make_species
from support.crowds import small as small_species
from support.refusals import refused
from support.small_envs import IDS, assert_same, begun, make, make_vec, small

from npa_envs.envs import gardeners_v0, multispecies_v0, particles_v0

GARDENER, SHAPESHIFTER = "npa/Gardener2D-v0", "npa/Shapeshifter2D-v0"
POINTS, SOLID = "npa/PointClassification-v0", "npa/Morphogenesis3D-v0"
every_id = pytest.mark.parametrize("name", IDS)

OF_ALL = [
    ({"particle_coumt": 5}, "argument 'particle_coumt': did you mean 'particle_count'"),
    ({"seed": 3}, "unexpected keyword argument 'seed': give it to reset"),
    ({"max_episode_step": 3}, "did you mean 'max_episode_steps'"),
    ({"episode_steps": 0}, "episode_steps must be a whole number of at least 1, got 0"),
    ({"particle_count": 0}, "particle_count must be a whole number of at least 1, got 0"),
    ({"particle_count": 10**9}, "particle_count (is too large|must be at most 16777216)"),
    ({"device": "cuda:99"}, "device must be one that torch sees"),
    ({"device": "tpu"}, "device must"),
    ({"reward": "denze"}, "did you mean 'dense'"),
    ({"boundary": "periodic", "box_size": 0.1}, "box_size must be at least 2 eps"),
    ({"render_mode": "ansi"}, "render_mode must be None, 'rgb_array' or 'human'"),
    ({"eps": -1.0}, "eps must be"),
    ({"update_prob": 0.0}, "update_prob must lie in"),
    ({"seed_pool": -1}, "seed_pool must be"),
    ({"state_dim": 2}, "state_dim must be"),
    ({"boundary": "periodic", "box_size": 9.0}, "position_limit must be at least half of box"),
    ({"success_loss": 1e308}, "success_loss must be at most"),
]
"""Keywords of every environment of one species, and what is said of them."""

OF_ONE = {
    functools.partial(make, IDS[0]): [({"target": "geko"}, "did you mean 'gecko'")],
    functools.partial(make_vec, IDS[0], 1): [
        ({"max_episode_steps": 0}, "max_episode_steps must be"),
        ({"autoreset_mode": "disable"}, "did you mean 'disabled'"),
    ],
    functools.partial(make_vec, IDS[0]): [({"world_count": 0}, "num_envs must be")],
    functools.partial(make, IDS[1]): [
        ({"seed_radius": 6.0}, "seed_radius must be below position_limit"),
        ({"target": "ring", "rule": None}, r"rule must say what .*\(butterfly, .*, octopus\)"),
        ({"state_dim": 8, "rule": None}, "rule must have state_dim=8"),
        ({"healed_share": 0.0}, "healed_share must lie in"),
        (
            {"split": "test", "rule": None, "seed_pool": 0},
            "be 'train' where seed_pool=0",
        ),
        # The millionth world is where those of the test split begin.
        ({"seed_pool": 1_000_001}, "seed_pool must be at most 1000000, got 1000001"),
    ],
    functools.partial(make, "npa/Texture-v0"): [
        ({"boundary": "open"}, "boundary must be 'periodic' for textures"),
        ({"loss": "swd"}, "known: joint_swd, patch_ot, patch_swd"),
    ],
    functools.partial(make, POINTS): [
        ({"boundary": "periodic"}, "boundary must be 'open' for"),
        ({"state_dim": 9}, "state_dim must be a whole number of at"),
        ({"rule": "gecko"}, "rule must be a rule with a read-out of state_dim"),
    ],
    functools.partial(make, SOLID): [
        ({"readout": "gecko"}, "read-out of state_dim = 16 channels, but .gecko. has 16"),
        ({"readout": 3}, "for example readout='mushroom'"),
        ({"seed_radius": 5.0}, "seed_radius must be below"),
    ],
    functools.partial(gymnasium.make, "npa/Pictures2D-v0"): [
        ({"targets": ("heart",), "test_targets": ("heart",)}, "among targets, got 'heart' in both"),
        ({"targets": ()}, "targets and test_targets must name a picture each"),
        ({"picture_size": 5}, "picture_size must divide resolution = 64"),
        ({"observe_target": 1}, "observe_target must be True or False"),
    ],
    functools.partial(make, GARDENER): [
        ({"tell_updated": True}, "actions do not belong to particles"),
        ({"tools": ("pull",)}, "tools must be some of"),
        ({"tools": ("rate", "push")}, "in this order"),
        ({"inject_channels": (16,)}, r"inject_channels must lie in \[-16, 15\]"),
        ({"inject_channels": (-1, 15)}, "inject_channels must be different"),
        ({"picture_size": 7}, "picture_size must divide resolution = 16"),
        ({"reward": "particle"}, "reward must be 'dense' or 'sparse'"),
        ({"alpha": 0.25}, "alpha must be the rule's, 0.5, got 0.25"),
        ({"target": "ring"}, "no shipped rule grows 'ring'"),
        ({"rule": "seven-pictures", "state_dim": 24}, "rule must have code_dim=0"),
        ({"place_count": 1}, "place_count must be"),
        ({"brush_radius": 0.0}, "brush_radius must be a finite number greater than 0"),
    ],
    functools.partial(make, SHAPESHIFTER): [
        ({"rule": "gecko"}, "one of two pictures or more, got 'gecko'"),
        ({"state_dim": 9}, r"state_dim must be the rule's, \d+, got 9"),
        ({"picture_size": 5}, "picture_size must divide"),
    ],
    gardeners_v0.parallel_env: [
        ({"max_cycles": number}, "max_cycles must be an integer of at least 1")
        for number in (0, -1, 1.5, None, True, "3")
    ],
    multispecies_v0.parallel_env: [
        ({"task": "mixin"}, "task must be a known word, got 'mixin': did you mean 'mixing'"),
        ({"task": 3}, "task must be a known word, got 3"),
        ({"species_count": 0}, "species_count must be a whole number of at least 1, got 0"),
        ({"species_count": 1}, "species_count must be at least 2 in this task, got 1"),
        ({"species_count": 65}, "species_count must be at most 64, got 65"),
        ({"particle_count": 1}, "particle_count must be at least species_count = 2, got 1"),
        ({"particle_counts": (3,)}, r"particle_counts must be 2 whole numbers .* got \(3,\)"),
        ({"particle_counts": (3, 0)}, "particle_counts must be 2 whole numbers of at least 1"),
        ({"particle_count": 9, "particle_counts": (3, 6)}, "exclude each other"),
        ({"seed_radius": 4.0}, "seed_radius and seed_distance must keep all disks within 4"),
        ({"seed_distance": -1.0}, "seed_distance must be a finite number of at least 0"),
        ({"deaths": ((2, 5),)}, "each species from 0 to 1 at most once, each step at least 1"),
        ({"deaths": ((1, 0),)}, r"deaths must be pairs .* got \(\(1, 0\),\)"),
        ({"deaths": ((1, 5), (1, 6))}, "deaths must be pairs"),
        ({"deaths": (1, 5)}, "deaths must be pairs"),
        ({"deaths": (("species_2", 5),)}, r"deaths must be pairs .* got \(\('species_2', 5\),\)"),
        ({"deaths": ((1, 5), ("species_1", 6))}, "at most once"),
        ({"task": "invasion", "reward": "team"}, "reward must be 'individual' in invasion"),
        ({"task": "co_morphogenesis", "targets": ("heart",)}, "targets must be 2 names"),
        ({"task": "symbiosis", "target": "hart"}, "did you mean 'heart'"),
        ({"task": "symbiosis", "state_dim": 2}, "state_dim must be a whole number of at least 3"),
        ({"task": "symbiosis", "sigma": 1e20}, r"sigma must be at most 1e\+09, got 1e\+20"),
        ({"max_cycles": 0}, "max_cycles must be a whole number of at least 1"),
        ({"seed": 1}, r"unexpected keyword argument 'seed': give it to reset\(seed=...\)"),
        ({"on_divergence": "reset"}, "on_divergence must be 'terminate', 'raise' or 'ignore'"),
    ],
    multispecies_v0.batched: [
        ({"world_count": 0}, "world_count must be an integer of at least 1, got 0"),
        ({"autoreset_mode": "next-step"}, "autoreset_mode must be 'same-step' or 'disabled'"),
        ({"world_count": 10**7, "particle_count": 10**4}, "particle_count is too large"),
    ],
    particles_v0.parallel_env: [
        ({"task": "npa/MixingParticleSmall-v0"}, "did you mean 'npa/MixingParticlesSmall-v0'"),
        ({"particle_count": 513}, "particle_count must be at most 512 .* got 513"),
        ({"particle_counts": (500, 20)}, "particle_count must be at most 512 .* got 520"),
    ],
}


@every_id
@pytest.mark.parametrize(("keywords", "message"), OF_ALL)
def test_a_wrong_keyword_of_every_environment_is_refused(name, keywords, message):
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        for factory in (gymnasium.make, gymnasium.make_vec):
            refused(message, factory, name, **small(name) | keywords)


@pytest.mark.parametrize(
    ("make", "keywords", "message"), [(make, *row) for make in OF_ONE for row in OF_ONE[make]]
)
def test_a_wrong_configuration_is_refused(make, keywords, message):
    refused(message, make, **keywords)


@every_id
def test_an_unknown_keyword_is_a_type_error_in_pythons_words(name):
    for factory in (gymnasium.make, gymnasium.make_vec):
        with pytest.raises(TypeError, match=r"got an unexpected keyword argument 'frameskip': "):
            factory(name, frameskip=1)


@pytest.mark.parametrize(
    "keywords", [{"particle_count": 10**5}, {"resolution": 4096}, {"seed_pool": 10**6}]
)
def test_worlds_beyond_memory_are_refused_before_they_are_made(keywords, monkeypatch):
    monkeypatch.setattr("npa_envs.envs.core.world_state.free_bytes", lambda device: 10**8)
    make(IDS[0])
    refused("particle_count must fit into memory: 1 world", make, IDS[0], **keywords)


def zeros(env):
    """Actions of a world or of many that do nothing."""
    return np.zeros(env.action_space.shape, np.float32)


def placing(change):
    """Return a call that places what a change makes of particles where they are."""
    return lambda env: env.place_particles(*change(*env.particles()))


def acting(change):
    """Return a call that steps with what a change makes of actions that do nothing."""

    def call(env):
        actions = still(env) if hasattr(env, "possible_agents") else zeros(env)
        changed = change(actions)
        env.step(actions if changed is None else changed)

    return call


def spoilt(place, number):
    return acting(lambda actions: actions.__setitem__(place, number))


def filled(agent, place, number):
    return acting(lambda actions: actions[agent].__setitem__(place, number))


NO_NUMBERS = "action must be real numbers"
SHAPE = r"action must be real numbers of shape \[N, A\] = \(61, "
WORLDS = "worlds must be indices below 3, each once"
CUTS = np.s_[:, 0], np.s_[:60], np.s_[:, 1:], np.s_[None]
NO_WORLD = [(lambda env: env.step(zeros(env)), "call reset first")]
ONE_WORLD = [
    *((lambda env, cut=cut: env.step(zeros(env)[cut]), SHAPE) for cut in CUTS),
    (lambda env: env.step("left"), NO_NUMBERS),
    (lambda env: env.step(zeros(env) + 1j), NO_NUMBERS),
    (lambda env: env.step(torch.from_numpy(zeros(env) + 1j)), NO_NUMBERS),
    (lambda env: env.step(zeros(env).astype("datetime64[s]")), NO_NUMBERS),
    (lambda env: env.step(np.ma.masked_array(zeros(env), mask=zeros(env) == 0)), NO_NUMBERS),
    (spoilt((7, 3), np.nan), "action must be finite, got nan at world 0, particle 7, entry 3"),
    (spoilt((7, 3), np.inf), "action must be finite, got inf at world 0, particle 7, entry 3"),
    (lambda env: env.reset(options=3), "options must be a dict or None, got int"),
    (placing(lambda x, s: (x[:1], s)), "x must have shape"),
    (placing(lambda x, s: (x, s[:60])), "s must have shape"),
    (placing(lambda x, s: (x, s * torch.nan)), "s must be finite and within observation_limit"),
    (placing(lambda x, s: (x + 9.0, s)), "x must be finite and within position_limit"),
]


def masked(*mask):
    return lambda env: env.reset(options={"reset_mask": np.array(mask)})


def placed_in(worlds):
    """Return a call that places as many worlds as a mask has entries, or as there are indices."""
    count = np.asarray(worlds).size

    def call(env):
        x, s = (part[:1].repeat(count, 1, 1) for part in env.particles())
        env.place_particles(x, s, worlds=worlds)

    return call


NO_INDICES = [3], [-1], [1, 1], [True, False, True], np.array([True] * 3), [0.5], [[0]], 1, []
NO_WORLDS = [*NO_WORLD, (masked(True, False, False), "reset all of them first")]
MANY_WORLDS = [
    (lambda env: env.step(zeros(env)[:2]), r"action must be real numbers of shape \[B, N, A\]"),
    (spoilt((2, 7, 3), np.nan), "action must be finite, got nan at world 2, particle 7, entry 3"),
    (masked(1, 0, 0), "reset_mask must be bool"),
    (masked(False, False, False), "reset_mask must choose"),
    (lambda env: env.reset(seed=[1, 2]), "seed must be one whole number, or one for each of 3"),
    (lambda env: env.reset(seed=1.5), r"seed must be one whole number.*got 1.5"),
    (lambda env: env.reset(options={"reset_masks": 0}), "unknown reset option .*: did you mean"),
    (lambda env: env.place_particles(*env.particles(), worlds="all"), "worlds must be numbers"),
    (lambda env: env.place_particles(*env.particles(), worlds=[0, 1, 3]), WORLDS),
    *((placed_in(worlds), WORLDS) for worlds in NO_INDICES),
]


NO_SPECIES = [
    (lambda env: env.state(), "call reset first"),
    (lambda env: env.render(), "call reset first"),
    (lambda env: env.step({}), "call reset first"),
    (lambda env: env.place_particles(0, 0), "call reset first"),
]
SECOND = r"actions\['species_1'\] must be "
SPECIES = [
    (acting(lambda a: {"species_0": a["species_0"]}), "got none for species_1"),
    (acting(lambda a: a | {"species_2": a["species_0"]}), "got one for species_2"),
    (
        acting(lambda a: a | {"species_1": np.zeros((3, 18))}),
        SECOND + r"real numbers of shape \(20, 18\), got \(3, 18\)",
    ),
    (acting(lambda a: a | {"species_1": "left"}), SECOND + "real numbers"),
    (filled("species_1", (4, 7), np.nan), SECOND + r"finite, got nan \(1 such"),
    (filled("species_1", ..., np.inf), SECOND + "finite, got inf"),
    (lambda env: env.step([]), r"actions must be a dict .* got list"),
    (lambda env: env.action_space("species_9"), "agent must be one that exists, got 'species_9'"),
    *(
        (lambda env, x=x: env.place_particles(x, np.zeros((41, 16))), "x must be numbers, got")
        for x in ([[0.0, 0.0], [1.0]], "left", None, {})
    ),
]
NO_BATCH = [
    (lambda env: env.step({}), "step needs worlds: call reset first"),
    (lambda env: env.state(), "state needs a world"),
    (masked(True, False, True), "reset_mask needs worlds that have started"),
]
BATCH = [
    (lambda env: env.step({"species_1": np.zeros((3, 20, 18))}), "got none for species_0"),
    (lambda env: env.reset(seed=[1, 2]), "one for each of 3 worlds"),
]
PARTICLES = [
    (lambda env: env.step({}), "got none for particle_0, particle_1, particle_2 and 6"),
    (
        acting(lambda a: a | {"particle_7": np.zeros((1, 18))}),
        r"'particle_7'\] must be real numbers of shape \(18,\)",
    ),
    (filled("particle_7", 17, np.nan), r"'particle_7'\] must be finite, got nan \(1 such"),
]
BRUSHES = r"action must be real numbers of shape \[J,? W\]"
GARDENERS = [
    (
        lambda env: env.action_space("keeper"),
        r"agent must be one that exists, got .*did you mean 'keeper_0'",
    ),
    (acting(lambda a: {"keeper_0": a["keeper_0"]}), r"for the agents .* got some for"),
    (acting(lambda a: dict.fromkeys(a, np.zeros((3, 2), np.float32))), BRUSHES),
]
make_batch = functools.partial(multispecies_v0.batched, world_count=3, **small_species("mixing"))
WRONG_CALLS = {name: (functools.partial(make, name), NO_WORLD, ONE_WORLD) for name in IDS} | {
    f"{name}, batched": (functools.partial(make_vec, name, 3), NO_WORLDS, MANY_WORLDS)
    for name in IDS
}
WRONG_CALLS |= {
    "species": (make_species, NO_SPECIES, SPECIES),
    "species, batched": (make_batch, NO_BATCH, BATCH),
    "particles": (functools.partial(particles_v0.parallel_env, **few("mixing")), [], PARTICLES),
    "gardeners": (functools.partial(gardeners_v0.parallel_env, **small(GARDENER)), [], GARDENERS),
    "garden": (
        functools.partial(make, GARDENER),
        NO_WORLD,
        [(acting(lambda a: a[:1]), BRUSHES), (acting(lambda a: a + np.nan), "finite, got nan at")],
    ),
    "discrete garden": (
        functools.partial(make, GARDENER, actions="discrete"),
        [],
        [
            (lambda env: env.step(np.full(4, 99)), "action must choose below"),
            (lambda env: env.step(np.zeros(4, np.float32)), "whole numbers of shape"),
        ],
    ),
    "codes": (
        functools.partial(make, SHAPESHIFTER),
        NO_WORLD,
        [
            (lambda env: env.step(np.zeros(9, np.float32)), r"real numbers of shape \[code_dim\]"),
            (acting(lambda a: a + np.nan), "action must be finite"),
        ],
    ),
    "choice of codes": (
        functools.partial(make, SHAPESHIFTER, actions="choice"),
        [],
        [
            (lambda env: env.step(7), "number of one of 7 codes"),
            (lambda env: env.step(0.5), "whole numbers of shape"),
        ],
    ),
}  # fmt: skip


@pytest.mark.parametrize("kind", WRONG_CALLS)
def test_a_wrong_call_is_refused_and_leaves_the_world_as_it_was(kind, device):
    make, before_the_reset, after = WRONG_CALLS[kind]
    env, untouched = (make(device=str(device)) for _ in range(2))
    # Below Gymnasium's checkers, which refuse calls in other words.
    env, untouched = (getattr(made, "unwrapped", made) for made in (env, untouched))
    for call, message in before_the_reset:
        refused(message, call, env)
    begun(env, untouched)
    for call, message in after:
        refused(message, call, env)
    if hasattr(env, "possible_agents"):
        actions = drawn(env, np.random.default_rng(0))
    else:
        actions = env.action_space.sample()
    assert_same(env.step(actions), untouched.step(actions))


def test_numbers_of_numpy_and_arrays_that_cannot_be_written_to_are_taken():
    few = {"particle_count": np.int64(9), "eps": np.float32(0.3)}
    env, envs = make(IDS[0], **few), make_vec(IDS[0], np.int64(2), max_episode_steps=-1, **few)
    assert env.observation_space.shape == (9, 66)
    assert type(env.unwrapped.config.particle_count) is int
    observation, _ = env.reset(seed=3, options={})
    for seed in (np.int64(3), np.uint8(3)):
        assert np.array_equal(env.reset(seed=seed)[0], observation)
        assert np.array_equal(envs.reset(seed=seed)[0][0], observation)
    species = make_species()
    first, again = (species.reset(seed=kind(3))[0] for kind in (int, np.int64))
    assert_same(first, again)
    assert gardeners_v0.parallel_env(max_cycles=np.int64(4)).max_cycles == 4
    action = zeros(env)
    action.flags.writeable = False
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        env.step(action)
