"""What species are paid, by numbers computed by hand or by the tasks of single worlds."""

import numpy as np
import pytest
import torch
from crowds import (
    HALF_WAY,
    apart,
    drawn,
    make,
    pair,
    pair_entropy,
    placed,
    still,
)
from small_envs import begun

from npa_envs.envs.multi.worlds import AgentReturns
from npa_envs.tasks.morphogenesis2d import Morphogenesis2D, Morphogenesis2DConfig


def splat_loss(target, x, s, count):
    """The loss of `npa_envs.tasks.morphogenesis2d` by itself."""
    config = Morphogenesis2DConfig(
        target=target, target_point_count=count, particle_count=count, resolution=16
    )
    return float(Morphogenesis2D(config).metric(x[None], s[None])[0])


@pytest.mark.parametrize(("task", "sign"), [("mixing", -1.0), ("segregation", 1.0)])
def test_parting_two_neighbours_costs_or_pays_their_entropy(task, sign):
    env = pair(task)
    _, rewards, _, _, infos = env.step(still(env))
    assert rewards == {"species_0": 0.0, "species_1": 0.0}
    loss = HALF_WAY if task == "segregation" else 1.0 - HALF_WAY
    assert infos["species_0"]["loss"] == pytest.approx(loss, abs=1e-6)
    _, rewards, _, _, infos = env.step(apart(env))
    # The smoothing weight is zero at a whole radius.
    name = "mixture" if task == "segregation" else "separation"
    for agent in ("species_0", "species_1"):
        assert rewards[agent] == pytest.approx(sign * HALF_WAY, abs=1e-6)
        assert infos[agent][f"reward_{name}"] == rewards[agent]
        assert infos[agent][f"loss_{name}"] == infos[agent]["loss"]


@pytest.mark.parametrize("reward", ["individual", "team"])
def test_a_species_is_paid_for_the_mean_of_its_particles_and_a_team_for_that_of_species(reward):
    points = [[0.0, 0.0], [0.15, 0.0], [2.0, 2.0]]
    env = placed(points, particle_counts=(1, 2), reward=reward)
    _, _, _, _, infos = env.step(still(env))
    assert infos["species_0"]["loss"] == pytest.approx(1.0 - HALF_WAY, abs=1e-6)
    assert infos["species_1"]["loss"] == pytest.approx(1.0 - 0.5 * HALF_WAY, abs=1e-6)
    _, rewards, *_ = env.step(apart(env))
    own = {"species_0": -HALF_WAY, "species_1": -0.5 * HALF_WAY}
    team = dict.fromkeys(own, -0.75 * HALF_WAY)
    assert rewards == pytest.approx(own if reward == "individual" else team, abs=1e-6)


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


def test_each_species_of_co_morphogenesis_is_paid_for_its_own_picture():
    env = begun(make("co_morphogenesis", targets=("heart", "ring"), particle_counts=(40, 30)))
    x0, s0 = env.particles()
    actions = drawn(env, np.random.default_rng(0))
    _, rewards, _, _, infos = env.step(actions)
    x1, s1 = env.particles()
    spans = {"species_0": ("heart", slice(0, 40)), "species_1": ("ring", slice(40, 70))}
    for agent, (target, span) in spans.items():
        before, after = (
            splat_loss(target, x[span], s[span], span.stop - span.start)
            for x, s in ((x0, s0), (x1, s1))
        )
        assert infos[agent]["loss"] == pytest.approx(after, rel=1e-5)
        assert rewards[agent] == pytest.approx(before - after, abs=1e-6)
        assert rewards[agent] != 0.0
        parts = infos[agent]["reward_density"] + infos[agent]["reward_colour"]
        assert parts == pytest.approx(rewards[agent], abs=1e-6)
    actions = still(env)
    actions["species_1"][:] = 1.0
    _, rewards, *_ = env.step(actions)
    assert rewards["species_0"] == 0.0
    assert rewards["species_1"] != 0.0


def test_after_a_death_each_survivor_is_still_paid_for_its_own_picture():
    env = make(
        "co_morphogenesis",
        species_count=3,
        targets=("heart", "flower", "ring"),
        particle_counts=(20, 25, 30),
        deaths=((1, 1),),
    )
    env.reset(seed=0)
    generator = np.random.default_rng(0)
    for _ in range(2):
        *_, infos = env.step(drawn(env, generator))
    x, s = env.particles()
    for agent, target, span in (
        ("species_0", "heart", slice(20)),
        ("species_2", "ring", slice(20, 50)),
    ):
        count = len(x[span])
        assert infos[agent]["species"] == int(agent[-1])
        expected = splat_loss(target, x[span], s[span], count)
        assert infos[agent]["loss"] == pytest.approx(expected, rel=1e-5)


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
    # A radius apart, each sees itself alone, and the least loss is reached.
    assert at_start == 0.0 if keywords else at_start > 0.99
    env.place_particles([[0.0, 0.0], [0.15, 0.0]], np.zeros((2, 16)))
    _, rewards, terminations, _, infos = env.step(apart(env))
    assert terminations == {"species_0": False, "species_1": True}
    # Alone at the bound, it would see nobody else: an entropy of almost 0.
    assert infos["species_1"]["loss_mixture"] < 0.01
    assert infos["species_1"]["loss"] == pytest.approx(max(at_start, HALF_WAY), abs=1e-6)
    assert rewards["species_1"] == pytest.approx(min(0.0, HALF_WAY - at_start), abs=1e-6)
    assert rewards["species_0"] == pytest.approx(HALF_WAY, abs=0.01)


@pytest.mark.parametrize("carried", [3.0, 0.5, 1.0])
def test_rewards_of_an_agent_that_left_never_add_up_to_more_than_zero(carried):
    account = AgentReturns(make("mixing").worlds.task, torch.tensor([0, 1]), 1, team=False)

    def losses(*values):
        return {"loss": torch.tensor([values], dtype=torch.float64)}

    def pay(parts, fled):
        return account.step_rewards(
            parts, torch.tensor([[True, True]]), torch.tensor([[fled, False]])
        )[0]

    account.begin(losses(1.0, 1.0), torch.tensor([0]))
    paid = pay(losses(0.8, 1.0), False)
    account.carry_over(losses(carried, 1.0))
    paid = paid + pay(losses(0.0, 0.0), True)
    assert float(paid[0]) == pytest.approx(min(0.0, carried - 0.8), abs=1e-12)
    assert paid[1] == 1.0
    # What an episode left behind is forgotten in the next one.
    account.begin(losses(1.0, 1.0), torch.tensor([0]))
    assert pay(losses(0.0, 1.0), True)[0] == 0.0
