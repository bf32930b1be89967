"""What wrappers refuse to wrap, to be made of and to be called with, and what they say."""

import gymnasium as gym
import numpy as np
import pytest
import torch
from gymnasium.wrappers import FlattenObservation, TimeAwareObservation
from gymnasium.wrappers.vector import FlattenObservation as FlattenAll
from support.crowds import make as make_species
from support.crowds import small
from support.refusals import refused
from support.wrapped_envs import ACTIONS, batched, single

import npa_envs
from npa_envs.cli import main
from npa_envs.envs import gardeners_v0, multispecies_v0
from npa_envs.tasks.damage import DamageEvent, parse_damage
from npa_envs.wrappers import (
    DamageEvents,
    NormalizePerception,
    ParticleRows,
    SpeciesTags,
    TorchNormalizeObservation,
    TorchNormalizeReward,
    TorchRecordEpisodeStatistics,
    VectorDamageEvents,
    VectorNormalizePerception,
    VectorSpeciesTags,
)


def living(name):
    return gym.make_vec(f"npa/{name}-v0", num_envs=2, autoreset_mode="next-step")


def started(wrapper, *args, **kwargs):
    env = wrapper(*args, **kwargs)
    env.reset()
    return env


STATE = {"mean": torch.zeros(3), "var": torch.zeros(3), "count": 1.0}
NEXT = {"autoreset_mode": "next-step"}
DISABLED = {"autoreset_mode": "disabled"}
FOREIGN = "rows need an environment that gives and takes one for"

REFUSALS = [
    (lambda: DamageEvent(-1, "cut"), "whole number of at least 0"),
    (lambda: DamageEvent(1, "cut", 0.0), "size must be a finite number greater than 0"),
    (lambda: parse_damage("1:cut:nan"), "STEP:KIND"),
    (lambda: parse_damage("1:cut:0.1:2"), "STEP:KIND"),
    (lambda: DamageEvents(single(), []), "at least one event"),
    (lambda: DamageEvents(single(), ["3:burn"]), "unknown damage 'burn'"),
    (lambda: DamageEvents(single(), [3]), "text or a DamageEvent"),
    (lambda: DamageEvents(single(), 5), "text or a DamageEvent, got int"),
    (lambda: DamageEvents(batched(), "3:cut"), "use VectorDamageEvents"),
    (lambda: VectorDamageEvents(single(), "3:cut"), "use DamageEvents for a single"),
    (lambda: DamageEvents(gym.make("CartPole-v1"), "3:cut"), "environment of npa_envs"),
    (lambda: DamageEvents(NormalizePerception(single()), "3:cut"), "put DamageEvents under the wr"),
    (lambda: VectorDamageEvents(VectorNormalizePerception(batched()), "3:cut"), "put VectorDam"),
    (lambda: NormalizePerception(single(), clip=0.0), "clip must be positive and finite"),
    (lambda: NormalizePerception(single(), epsilon=-1.0), "epsilon must be"),
    (lambda: NormalizePerception(batched()), "use VectorNormalizePerception"),
    (lambda: VectorNormalizePerception(single()), "use NormalizePerception"),
    (lambda: NormalizePerception(SpeciesTags(single())), "normalise before other wrappers"),
    (lambda: NormalizePerception(FlattenObservation(single())), "normalise before other wrappers"),
    (lambda: NormalizePerception(single()).load_state_dict({}), "missing statistic"),
    (lambda: NormalizePerception(single()).load_state_dict(STATE), r"shape \(49,\), got \(3,\)"),
    *(
        (
            lambda cls=cls: started(cls, batched()).step(np.zeros((3, 64, ACTIONS), np.float32)),
            f"vector.{cls.__name__.removeprefix('Torch')}",
        )
        for cls in (TorchRecordEpisodeStatistics, TorchNormalizeObservation, TorchNormalizeReward)
    ),
    (lambda: TorchRecordEpisodeStatistics(batched(), 0), "buffer_length must be"),
    (lambda: TorchNormalizeObservation(batched(), epsilon=0.0), "epsilon must be"),
    (lambda: TorchNormalizeReward(batched(), gamma=1.5), r"gamma must lie in \[0, 1\]"),
    (lambda: SpeciesTags(single(), 0), "species_count must be an integer of at least 1"),
    (lambda: SpeciesTags(single(), 65), "species_count must be at most 64, got 65"),
    (lambda: SpeciesTags(FlattenObservation(single())), "each of 64 particles.* put SpeciesTags"),
    (lambda: SpeciesTags(TimeAwareObservation(single(), flatten=False)), "particles, got Dict"),
    (lambda: VectorSpeciesTags(FlattenAll(batched(**DISABLED))), "put VectorSpeciesTags"),
    (lambda: ParticleRows(batched(2)), "make it with autoreset_mode='next-step'"),
    (lambda: ParticleRows(single()), "env must be a vector environment of npa_envs, got"),
    (
        lambda: started(ParticleRows, batched(2, **NEXT)).step(np.zeros((2, 64, ACTIONS))),
        r"actions must have shape \[rows, A\] = \(128, 18\), got",
    ),
    (lambda: ParticleRows(living("Gardener2DSmall")), FOREIGN),
    (lambda: ParticleRows(living("Shepherd2DSmall")), FOREIGN),
    (lambda: batched(render_mode="rgb_array").render(), "render needs worlds: call reset first"),
]


@pytest.mark.parametrize(("call", "message"), REFUSALS)
@pytest.mark.filterwarnings("error::pytest.PytestUnraisableExceptionWarning")
def test_a_mistake_is_named(call, message):
    refused(message, call)


def still(observations):
    """A policy of five particles that change nothing."""
    return np.zeros((2, 5, 18), np.float32)


def species(**keywords):
    fields = {"particle_counts": (3, 5), **keywords}
    return multispecies_v0.batched(world_count=2, **small("mixing", **fields))


OTHER = {"others": {"species_1": still}}
ALL_OTHERS = {"others": {"species_0": still, "species_1": still}}
SAME_STEP = "autoreset_mode='same-step'"
SB3_REFUSALS = [
    (lambda w: w.ParticleVecEnv(batched(**NEXT)), SAME_STEP),
    (lambda w: w.ParticleVecEnv(batched(**DISABLED)), SAME_STEP),
    (lambda w: w.SpeciesVecEnv(species(**DISABLED)), SAME_STEP),
    (lambda w: w.ParticleVecEnv(single()), "vector_entry_point"),
    (lambda w: w.WorldVecEnv(single()), "env must be a vector environment"),
    (
        lambda w: w.WorldVecEnv(gym.make_vec("npa/Gardener2DSmall-v0", 2, "sync")),
        f"vectorization_mode='vector_entry_point', {SAME_STEP}",
    ),
    (
        lambda w: w.WorldVecEnv(gardeners_v0.batched(particle_count=64, grow_steps=1, seed_pool=1)),
        r"one agent, got GardenersVectorEnv with \['keeper_0', 'raider_0'\]",
    ),
    (
        lambda w: started(w.WorldVecEnv, batched(2)).step(np.zeros((2, 63, ACTIONS), np.float32)),
        r"got \(2, 63, 18\)",
    ),
    # As many numbers as wanted, but of twelve rows.
    (
        lambda w: started(w.SpeciesVecEnv, species(), **OTHER).step(np.zeros((12, 9))),
        r"\[rows, A\] = \(6, 18\), got \(12, 9\): one for each row",
    ),
    (lambda w: w.SpeciesVecEnv(species(), **OTHER).step(np.zeros((6, 18))), "call reset first"),
    (lambda w: w.SpeciesVecEnv(make_species()), "a batch of worlds .* got MultiSpeciesEnv"),
    (lambda w: w.SpeciesVecEnv(species(), others={"species_7": still}), "species, got 'species_7'"),
    (lambda w: w.SpeciesVecEnv(species(), **ALL_OTHERS), "others must not name all species"),
    (lambda w: w.SpeciesVecEnv(species(), **OTHER).policy(None, "species_1"), "must be one whose"),
    (
        lambda w: w.SpeciesVecEnv(species(), others={"species_0": object()}),
        r"got object for 'species_0': RowPolicy\(model\) makes one",
    ),
    (lambda w: w.ParticleVecEnv(batched()).set_attr("a", 1, [0]), "indices must be all rows"),
]


@pytest.mark.parametrize(("call", "message"), SB3_REFUSALS)
def test_a_mistake_with_rows_of_stable_baselines_is_named(call, message):
    pytest.importorskip("stable_baselines3")
    refused(message, call, npa_envs.wrappers)


def test_an_unknown_wrapper_is_an_attribute_error():
    with pytest.raises(AttributeError, match="no attribute 'Absent'"):
        npa_envs.wrappers.Absent  # noqa: B018


GROWTH, GARDEN = "npa/Morphogenesis2D-v0", "npa/Gardener2DSmall-v0"


@pytest.mark.parametrize(
    ("words", "message"),
    [
        ("npa/Morphogenesis2D-v1", "did you mean 'npa/Morphogenesis2D-v0'"),
        ("npa/Mixing-v0", "must be of one species"),
        (f"{GROWTH} --keywords target", "NAME=VALUE"),
        (f"{GROWTH} --episodes 0", "episodes must be at least 1"),
        ("npa/Gardener2DSmal-v0", "did you mean 'npa/Gardener2DSmall-v0'"),
        (f"{GARDEN} --policy heart", "policy must be one of"),
        (f"{GARDEN} --policy none/sac.zip", "must be of a file sac.zip or ppo.zip that exists"),
        (f"{GARDEN} --policy best.zip", "must be of a file sac.zip or ppo.zip"),
        (f"{GARDEN} --episodes 1 --dataset heart", "must be an id with a version"),
        (f"{GARDEN} --episodes 1 --dataset ../heart-first", "must be an id"),
    ],
)
def test_what_cannot_be_recorded_is_named(words, message, capsys):
    pytest.importorskip("minari")
    assert main(["record-dataset", "--dataset", "npa/test-v0", *words.split()]) == 2
    assert message in capsys.readouterr().err
