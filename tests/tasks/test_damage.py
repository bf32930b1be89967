"""Damages: what they do to a world, to worlds of the pool, and particles that are thrown out."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from support import small_envs
from support.worlds import seeded

from npa_envs import load_rule
from npa_envs.errors import NPAError
from npa_envs.render.world_film import film_world
from npa_envs.tasks import damage
from npa_envs.tasks.base import GrowthConfig, GrowthTask
from npa_envs.tasks.damage import DAMAGE_CHANCE, FARTHEST, NEAREST, damage_worlds, parse_damage
from npa_envs.tasks.morphogenesis2d import Morphogenesis2D, Morphogenesis2DConfig
from npa_envs.tasks.seeds import uniform_ball
from npa_envs.tasks.texture import Texture, TextureConfig
from npa_envs.training.task_of_rule import task_of_rule
from npa_envs.web.rule_world import RuleWorld
from npa_envs.world import brushes
from npa_envs.world.brushes import nearest_image
from npa_envs.world.particles import Particles
from npa_envs.world.randomness import WorldRandom, normal_draws
from npa_envs.wrappers import DamageEvents

B, N, C = 3, 257, 5


@pytest.fixture(params=[(2, torch.float32), (3, torch.float64)], ids=["2d", "3d"])
def world(request, device):
    space_dim, dtype = request.param
    g = torch.Generator().manual_seed(3)
    x = 2 * torch.rand(B, N, space_dim, generator=g, dtype=dtype) - 1
    return x.to(device), torch.randn(B, N, C, generator=g, dtype=dtype).to(device)


@pytest.mark.gpu
def test_generator_of_another_device_is_a_clear_error():
    x = torch.zeros(1, 4, 2, device="cuda")
    with pytest.raises(NPAError, match=r"generator must be on the worlds' device"):
        damage_worlds(Particles(x, x), kind="wipe", generator=torch.Generator())


def worlds(count, space_dim=2, particles=200):
    x = uniform_ball(count, particles, space_dim, 0.8, generator=seeded(1))
    return Particles(x, torch.ones(count, particles, 3))


def damaged_in_pool(before, generator, **fields):
    task = GrowthTask()
    task.config = GrowthConfig(target="", **fields)
    return task.damage(before, generator)


def changed(before, after):
    return (before != after).flatten(1).any(dim=1)


@pytest.mark.parametrize("space_dim", [2, 3])
def test_a_ball_of_states_is_wiped_in_every_world(space_dim):
    before = worlds(40, space_dim)
    damaged = damaged_in_pool(before, seeded(2), damage_radius=0.3)
    assert damaged.x is before.x
    for positions, blank in zip(damaged.x, (damaged.s == 0.0).all(dim=-1), strict=True):
        assert 0 < int(blank.sum()) < 150
        assert float(torch.cdist(positions[blank], positions[blank]).max()) <= 0.6


@pytest.mark.parametrize(
    ("fields", "fraction"),
    [
        *(({name: 0.5}, DAMAGE_CHANCE) for name in ("clump_radius", "cut_gap", "flake_radius")),
        ({"cut_gap": 0.5, "cut_share": 0.7}, 0.7),
    ],
)
@pytest.mark.parametrize("space_dim", [2, 3])
def test_as_many_worlds_are_hit_as_asked_for(fields, fraction, space_dim):
    before = worlds(400, space_dim, 60)
    damaged = damaged_in_pool(before, seeded(2), **fields)
    # Five standard deviations of a share of 400 worlds; some are hit where nobody is.
    assert fraction - 0.13 < float(changed(before.x, damaged.x).float().mean()) < fraction + 0.11
    assert torch.equal(damaged.s, before.s)


@pytest.mark.parametrize("anywhere", [False, True])
def test_cuts_run_through_the_middle_or_anywhere(anywhere):
    before = worlds(60)
    fields = {"cut_gap": 0.4, "cut_share": 1.0, "cut_anywhere": anywhere}
    damaged = damaged_in_pool(before, seeded(2), **fields)
    # A slit through the centroid moves half of the particles to each side.
    moved = (damaged.x - before.x).norm(dim=-1)
    fewer = (moved > 0.1).float().mean(dim=1)
    assert (float(fewer.std()) > 0.04) == anywhere


def test_a_clump_is_one_point():
    x, s, *_ = worlds(40)
    damaged, *_ = damaged_in_pool(Particles(x, s), seeded(2), clump_radius=0.3)
    hit = changed(x, damaged)
    assert hit.any()
    for before, after in zip(x[hit], damaged[hit], strict=True):
        moved = (before != after).any(dim=1)
        middle = after[moved].mean(dim=0)
        at_one_point = (after - middle).norm(dim=1) < 1e-6
        assert torch.equal(at_one_point, (before - middle).norm(dim=1) <= 0.3)
        assert int(at_one_point.sum()) > 1


@pytest.mark.parametrize("space_dim", [2, 3])
def test_a_flake_leaves_as_it_is(space_dim):
    before = worlds(120, space_dim)
    x, damaged = before.x, damaged_in_pool(before, seeded(3), flake_radius=0.3).x
    hit = changed(x, damaged)
    assert 15 <= int(hit.sum()) <= 45
    sizes = []
    for before, after in zip(x[hit], damaged[hit], strict=True):
        torn = (before != after).any(dim=1)
        shift = (after - before)[torn]
        torch.testing.assert_close(shift, shift[:1].expand_as(shift), rtol=0.0, atol=1e-6)
        distance = after[torn].norm(dim=1)
        assert (distance > NEAREST - 0.3).all()
        assert (distance < FARTHEST + 0.3).all()
        sizes.append(int(torn.sum()))
    # Some are single particles, some are not.
    assert min(sizes) <= 3 < max(sizes)


def test_each_world_suffers_what_it_would_suffer_alone(device):
    every = {"damage_radius": 0.1, "clump_radius": 0.3, "cut_gap": 0.2, "flake_radius": 0.3}
    every["escape_share"] = 0.05
    before = worlds(6).map(lambda value: value.to(device))
    together = damaged_in_pool(before, WorldRandom(range(6), device=device), **every)
    for k in range(6):
        random = WorldRandom([k], device=device)
        alone = damaged_in_pool(before.map(lambda v, k=k: v[k : k + 1]), random, **every)
        torch.testing.assert_close(alone.x, together.x[k : k + 1], rtol=0.0, atol=2e-7)
        assert torch.equal(alone.s, together.s[k : k + 1])
    untouched = damaged_in_pool(before, torch.Generator())
    assert (untouched.x, untouched.s) == (before.x, before.s)


@pytest.mark.parametrize("kind", ["wipe", "cut", "clump"])
@pytest.mark.parametrize("boxed", [False, True])
def test_damage_is_as_its_formula_says_and_continues_across_the_edges_of_a_box(
    world, device, kind, boxed
):
    x, s = world
    sides = x.new_tensor((2.0, 2.6, 2.4)[: x.shape[2]])
    x, box, size = 0.5 * sides * x, tuple(sides.tolist()) if boxed else None, 0.5
    normal = normal_draws(seeded(2, device), (B, len(sides)), x)
    centre = x.mean(dim=1) if kind == "cut" else damage.random_particle(x, seeded(2, device))
    shifts = sides * torch.cartesian_prod(*[x.new_tensor([-1.0, 0.0, 1.0])] * len(sides))
    # The offset to the nearest of all images, [B, N, D].
    images = (x - centre[:, None])[..., None, :] + (shifts if boxed else 0.0 * shifts)
    nearest = images.norm(dim=-1).argmin(dim=-1)
    offset = images.take_along_dim(nearest[..., None, None], dim=2)[:, :, 0]
    inside = offset.norm(dim=-1, keepdim=True) <= size
    moved, states = x, s
    if kind == "wipe":
        states = torch.where(inside, 0.0, s)
    elif kind == "clump":
        moved = torch.where(inside, x - 0.9 * offset, x)
    else:
        unit = torch.nn.functional.normalize(normal, dim=-1)[:, None]
        height = (offset * unit).sum(-1, keepdim=True)
        inside = height.abs() < size
        moved = torch.where(inside, x + 0.5 * (size * height.sign() - height) * unit, x)
    # Of some particles that are hit another image is the nearest.
    across = (inside[..., 0] & (shifts[nearest] != 0.0).any(dim=-1)).sum()
    assert int(inside.sum()) > 10
    assert int(across) > 2 or not boxed
    options = {"kind": kind, "size": size, "box": box, "generator": seeded(2, device)}
    found = damage_worlds(Particles(x, s), **options)
    torch.testing.assert_close(found.x, moved, rtol=1e-5, atol=1e-6)
    assert torch.equal(found.s, states)
    if kind == "cut":
        blank = torch.zeros_like(centre)
        assert torch.equal(brushes.cut(x, s, centre=centre, normal=blank, gap=size)[0], x)


def wiped_in_the_viewer():
    world = RuleWorld("dots", device=torch.device("cpu"), particle_count=300)
    world.particles.s.fill_(1.0)
    world.particles.x[:] = nearest_image(
        0.3 * torch.rand(1, 300, 2, generator=seeded(1)) + 0.85, (2.0, 2.0)
    )
    world.handle({"type": "damage", "name": "wipe"})
    return world.particles.x, world.particles.s, 0.2


def wiped_in_a_film():
    rule = load_rule("dots")
    task = task_of_rule("dots", rule, torch.device("cpu"), particle_count=300).task
    x = task.seed(1, generator=seeded(1)).x
    worlds, events = Particles(x, torch.ones(1, 300, rule.state_dim)), [parse_damage("0:wipe:0.6")]
    options = {"generator": seeded(3), "stop": lambda: True}
    worlds, _ = film_world(rule, task, worlds, 1, damages=events, **options)
    return worlds.x, worlds.s, 0.6


def wiped_in_a_pool():
    task = Texture(TextureConfig(target="dots", particle_count=300, damage_radius=0.6))
    worlds = task.seed(1, generator=seeded(1))
    worlds = task.damage(worlds._replace(s=worlds.s + 1.0), seeded(3))
    assert task.damage(worlds, seeded(3)).x is worlds.x
    return worlds.x, worlds.s, 0.6


def wiped_by_a_wrapper():
    env = DamageEvents(small_envs.make("npa/Texture-v0", update_prob=1.0), "1:wipe:0.6")
    env.reset(seed=0)
    env.step(np.ones(env.action_space.shape, np.float32))
    return *(value[None] for value in env.unwrapped.particles()), 0.6


def wiped_at_the_start():
    fields = {"boundary": "periodic", "box_size": 1.7, "damage": "wipe", "damage_size": 0.7}
    env = small_envs.begun(small_envs.make("npa/Regeneration2D-v0", **fields))
    return *(value[None] for value in env.unwrapped.particles()), 0.7


@pytest.mark.parametrize(
    "wiped",
    [
        wiped_in_the_viewer,
        wiped_in_a_film,
        wiped_in_a_pool,
        wiped_by_a_wrapper,
        wiped_at_the_start,
    ],
)
def test_whoever_damages_a_periodic_world_wipes_a_whole_disk(wiped):
    (x,), (s,), radius = wiped()
    side = 1.7 if wiped is wiped_at_the_start else 2.0
    away = x[:, None] - x
    disks = [v.norm(dim=-1) <= radius for v in (away, nearest_image(away, (side, side)))]
    is_disk = [bool((disk == (s == 0.0).all(dim=-1)).all(dim=-1).any()) for disk in disks]
    assert is_disk == [False, True]


TINY = {"state_dim": 6, "hidden_dim": 24, "eps": 0.3, "resolution": 24, "particle_count": 96}
SMALL = Morphogenesis2DConfig(target="ring", target_point_count=96, escape_weight=1.0, **TINY)


@pytest.mark.parametrize("by_world", [False, True])
@pytest.mark.parametrize("space_dim", [2, 3])
def test_as_many_are_thrown_out_as_was_said_and_on_all_sides(device, by_world, space_dim):
    x = torch.zeros(2, 4000, space_dim, device=device)
    random = WorldRandom([4, 5], device=device) if by_world else torch.Generator(device)
    damaged = damaged_in_pool(Particles(x, x), random, escape_share=0.25).x
    distance = damaged.norm(dim=-1)
    out = distance > 0.0
    assert ((distance[out] >= NEAREST) & (distance[out] <= FARTHEST)).all()
    # Five standard deviations of a share of 8000, and of the mean of vectors as long as 4.
    assert float(out.float().mean()) == pytest.approx(0.25, abs=0.025)
    assert damaged[out].mean(dim=0).abs().max() < 0.4
    assert torch.equal(damaged[~out], x[~out])


def test_only_the_paths_of_those_outside_count():
    task, s = Morphogenesis2D(SMALL), torch.zeros(1, 3, 6)
    x = torch.tensor([[[0.5, 0.2], [1.5, 0.0], [0.0, -3.0]]])
    path = torch.tensor([[7.0, 1.0, 2.0]], requires_grad=True)
    weight, motion = task.penalties(Particles(x, s, path))["stray"]
    assert (weight, float(motion.detach())) == (1.0, 1.5)
    motion.backward()
    assert path.grad.tolist() == [[0.0, 0.5, 0.5]]
    inside = Particles(0.1 * x, s, path)
    assert float(task.penalties(inside)["stray"][1].detach()) == 0.0
    assert "stray" not in Morphogenesis2D(replace(SMALL, escape_weight=0.0)).penalties(inside)


def test_the_distance_of_the_centroid_from_where_worlds_begin_is_paid_for():
    task = Morphogenesis2D(replace(SMALL, drift_weight=2.0))
    x, s, *_ = task.seed(1, generator=seeded(0))
    moved = (x + torch.tensor([0.3, -0.4])).requires_grad_()
    still = Particles(x - x.mean(1, keepdim=True), s).with_zero_paths()
    near, there = task.loss(still), task.loss(still._replace(x=moved))
    assert float(near[1]["drift"]) < 2e-6
    assert float(there[1]["drift"].detach()) == pytest.approx(0.5, abs=0.05)
    (pull,) = torch.autograd.grad(there[1]["drift"], moved)
    # Every particle is pulled back along the way that the centroid has gone.
    torch.testing.assert_close(
        pull.sum(1), moved.mean(1) / moved.mean(1).norm(dim=-1), rtol=1e-5, atol=1e-6
    )
    assert "drift" not in Morphogenesis2D(SMALL).loss(still)[1]
