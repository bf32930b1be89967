"""Rewards of species, by numbers computed by hand or by the tasks of single worlds."""

import numpy as np
import pytest
from support.crowds import HALF_WAY, apart, drawn, make, pair, pair_entropy, placed, small, still
from support.small_envs import begun

from npa_envs.envs import multispecies_v0, particles_v0
from npa_envs.tasks.morphogenesis2d import Morphogenesis2D, Morphogenesis2DConfig


def splat_loss(target, x, s, count):
    """The loss of `npa_envs.tasks.morphogenesis2d` by itself."""
    config = Morphogenesis2DConfig(
        target=target, target_point_count=count, particle_count=count, resolution=16
    )
    return float(Morphogenesis2D(config).metric(x[None], s[None])[0])


@pytest.mark.parametrize("reward", ["individual", "team"])
@pytest.mark.parametrize(
    ("task", "part", "sign"), [("mixing", "separation", -1.0), ("segregation", "mixture", 1.0)]
)
@pytest.mark.parametrize(
    ("module", "means"), [(multispecies_v0, [1.0, 0.5]), (particles_v0, [1.0, 1.0, 0.0])]
)
def test_parting_neighbours_costs_or_pays_agents_their_mean_entropy_or_a_team_that_of_all(
    module, means, task, part, sign, reward
):
    fields = small(task, particle_counts=(1, 2), update_prob=1.0, reward=reward)
    env = begun(module.parallel_env(**fields))
    env.place_particles([[0.0, 0.0], [0.15, 0.0], [2.0, 2.0]], np.zeros((3, 16)))
    entropies = HALF_WAY * np.array(means)
    actions, second = still(env), env.agents[1]
    _, rewards, _, _, infos = env.step(actions)
    assert not any(rewards.values())
    losses = entropies if task == "segregation" else 1.0 - entropies
    for agent, loss in zip(env.agents, losses, strict=True):
        assert infos[agent]["loss"] == infos[agent][f"loss_{part}"] == pytest.approx(loss, abs=1e-6)
    # The smoothing weight is zero at a whole radius.
    actions[second][..., 0] = 1.0
    _, rewards, _, _, infos = env.step(actions)
    paid = entropies if reward == "individual" else entropies.mean().repeat(len(means))
    assert list(rewards.values()) == pytest.approx(sign * paid, abs=1e-6)
    assert infos[second][f"reward_{part}"] == pytest.approx(sign * entropies[1], abs=1e-6)


def test_entropy_weighs_neighbours_by_their_volumes():
    env = placed([[0.0, 0.0], [0.15, 0.0], [0.3, 0.0]], particle_counts=(1, 2))
    _, _, _, _, infos = env.step(still(env))
    # Volumes of the outer two and of the middle one, in units of the weight at no distance.
    weight = 0.75**3
    outer, middle = 1.0 / (1.0 + weight), 1.0 / (1.0 + 2.0 * weight)
    first = pair_entropy(outer / (outer + weight * middle))
    second = pair_entropy(weight * outer / (2.0 * weight * outer + middle))
    assert infos["species_0"]["loss"] == pytest.approx(1.0 - first, abs=1e-6)
    assert infos["species_1"]["loss"] == pytest.approx(1.0 - 0.5 * second, abs=1e-6)


def test_entropy_reaches_across_the_edge_of_a_periodic_box():
    box = {"boundary": "periodic", "box_size": 2.0}
    env = placed([[-0.95, 0.0], [0.9, 0.0]], particle_counts=(1, 1), **box)
    _, _, _, _, infos = env.step(still(env))
    assert infos["species_0"]["loss"] == pytest.approx(1.0 - HALF_WAY, abs=1e-5)


def test_each_species_of_co_morphogenesis_is_paid_for_its_own_picture_also_after_a_death():
    targets, counts = ("heart", "flower", "ring"), (20, 25, 30)
    keywords = {"targets": targets, "particle_counts": counts, "deaths": ((1, 1),)}
    env = begun(make("co_morphogenesis", species_count=3, **keywords))
    generator = np.random.default_rng(0)
    # In the first step the particles of species 1 are removed.
    env.step(drawn(env, generator))
    x0, s0 = env.particles()
    _, rewards, _, _, infos = env.step(drawn(env, generator))
    x1, s1 = env.particles()
    for k, span in ((0, slice(20)), (2, slice(20, 50))):
        agent = f"species_{k}"
        assert infos[agent]["species"] == k
        parts = infos[agent]["reward_density"] + infos[agent]["reward_colour"]
        assert parts == pytest.approx(rewards[agent], abs=1e-6)
        before, after = (
            splat_loss(targets[k], x[span], s[span], counts[k]) for x, s in ((x0, s0), (x1, s1))
        )
        assert infos[agent]["loss"] == pytest.approx(after, rel=1e-5)
        assert rewards[agent] == pytest.approx(before - after, abs=1e-6)
        assert rewards[agent] != 0.0
    actions = still(env)
    actions["species_2"][:] = 1.0
    _, rewards, *_ = env.step(actions)
    assert rewards["species_0"] == 0.0
    assert rewards["species_2"] != 0.0


@pytest.mark.parametrize("species_count", [2, 4])
def test_what_the_invaded_gain_the_invaders_lose(species_count):
    env = begun(make("invasion", species_count=species_count, target="heart"))
    count = env.action_space("species_0").shape[0]
    generator = np.random.default_rng(0)
    for _ in range(5):
        x0, s0 = env.particles()
        _, rewards, *_ = env.step(drawn(env, generator))
        x1, s1 = env.particles()
        gain = splat_loss("heart", x0[:count], s0[:count], count)
        gain -= splat_loss("heart", x1[:count], s1[:count], count)
        assert rewards["species_0"] == pytest.approx(gain, abs=1e-6)
        assert rewards["species_0"] != 0.0
        invaders = [rewards[f"species_{k}"] for k in range(1, species_count)]
        assert invaders == [-rewards["species_0"] / (species_count - 1)] * (species_count - 1)
        assert sum(rewards.values()) == pytest.approx(0.0, abs=1e-15)


def test_all_of_a_symbiosis_are_paid_alike():
    env = begun(make("symbiosis", target="heart", species_count=3))
    x0, s0 = env.particles()
    _, rewards, *_ = env.step(drawn(env, np.random.default_rng(0)))
    gain = splat_loss("heart", x0, s0, 41) - splat_loss("heart", *env.particles(), 41)
    assert list(rewards.values()) == pytest.approx([gain] * 3, abs=1e-6)
    assert gain != 0.0


@pytest.mark.parametrize("keywords", [{}, {"seed_distance": 0.5}])
def test_leaving_the_world_never_pays_nor_gives_back_what_came_at_no_charge(keywords):
    env = pair("segregation", position_limit=0.29, seed_radius=0.01, **keywords)
    at_start = env.reset(seed=0)[1]["species_1"]["loss"]
    # A radius apart, each perceives only itself, and the least loss is reached.
    assert at_start == 0.0 if keywords else at_start > 0.99
    env.place_particles([[0.0, 0.0], [0.15, 0.0]], np.zeros((2, 16)))
    _, rewards, terminations, _, infos = env.step(apart(env))
    assert terminations == {"species_0": False, "species_1": True}
    # Alone at the bound, it would see nobody else: an entropy of almost 0.
    assert infos["species_1"]["loss_mixture"] < 0.01
    assert infos["species_1"]["loss"] == pytest.approx(max(at_start, HALF_WAY), abs=1e-6)
    assert rewards["species_1"] == pytest.approx(min(0.0, HALF_WAY - at_start), abs=1e-6)
    assert rewards["species_0"] == pytest.approx(HALF_WAY, abs=0.01)
