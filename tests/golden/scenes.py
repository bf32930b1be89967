"""Small scenes whose results must not change, computed through public names alone.

A scene returns arrays by name. Its numbers come from stored worlds or from seeds; rollouts are
short, because the dynamics amplify rounding.
"""

import functools
import math
from functools import partial
from pathlib import Path

import numpy as np
import torch
from support import crowds, small_envs
from torch import Tensor

import npa_envs
from npa_envs.envs import multispecies_v0, particles_v0

GOLDEN = Path(__file__).resolve().parent / "golden.npz"
"""Stored worlds, and what each scene gave."""

RULES = {
    "gecko": {"eps": 0.1, "box": None},
    "dots": {"eps": 0.2, "box": (2.0, 2.0)},
    "duck": {"eps": 0.1, "box": None},
    "digits": {"eps": 0.1, "box": None},
}
"""Shipped rules with the radius [length units] and the box of the task of each."""

FORMER_RULES = {
    "dots": GOLDEN.with_name("dots.safetensors"),
    "duck": "duck-v0",
    "gecko": "gecko-v0",
    "heart": "heart-first",
}
"""The former versions of rules that have changed since their worlds were stored."""

DTYPES = {"f32": torch.float32, "f64": torch.float64}


def thinned(values, limit=512):
    """Return an array, or evenly spaced numbers of it if it is larger than a limit."""
    array = values.detach().numpy() if isinstance(values, Tensor) else np.asarray(values)
    if array.size <= limit:
        return array.copy()
    # A step that shares no factor with rows visits all columns.
    stride = math.ceil(array.size / limit)
    while math.gcd(stride, math.prod(array.shape[1:])) > 1:
        stride += 1
    return array.reshape(-1)[::stride].copy()


def functional(*tensors):
    """Return a fixed linear functional of tensors."""
    parts = []
    for k, tensor in enumerate(tensors):
        weights = np.random.default_rng(90 + k).standard_normal(tensor.shape)
        parts.append((torch.from_numpy(weights).to(tensor) * tensor).sum())
    return torch.stack(parts).sum()


def rule_named(name, dtype=torch.float32):
    """Return the rule whose world is stored under a name."""
    return npa_envs.load_rule(FORMER_RULES.get(name, name)).to(dtype)


def stored_world(name, dtype):
    """Return the stored world of a rule: positions and states."""
    with np.load(GOLDEN) as stored:
        return [torch.from_numpy(stored[f"world/{name}/{part}"]).to(dtype) for part in "xs"]


def random_world(seed, particle_count, sides, channels, dtype):
    """Return two worlds uniform in a box around the origin, with normal states."""
    generator = np.random.default_rng(seed)
    shape = (2, particle_count, len(sides))
    x = (generator.uniform(size=shape) - 0.5) * np.array(sides)
    s = 0.5 * generator.standard_normal((2, particle_count, channels))
    # Rounded first, so that both precisions see the same world.
    return [torch.from_numpy(values.astype(np.float32)).to(dtype) for values in (x, s)]


def watched(x, s):
    """Return positions and states that require gradients."""
    return x.detach().requires_grad_(), s.detach().requires_grad_()


def gradients(loss, x, s, *rules):
    """Return gradients of a scalar by worlds and all weights."""
    named = {"x": x, "s": s}
    for k, rule in enumerate(rules):
        prefix = f"rule{k}." if len(rules) > 1 else ""
        named |= {prefix + name: parameter for name, parameter in rule.named_parameters()}
    got = torch.autograd.grad(loss, list(named.values()), allow_unused=True)
    return {f"grad/{n}": thinned(g) for n, g in zip(named, got, strict=True) if g is not None}


def by_precision(scene):
    """Make of a scene in one precision a scene in float32 and in float64."""

    @functools.wraps(scene)
    def both(*args, **options):
        results = {word: scene(dtype, *args, **options) for word, dtype in DTYPES.items()}
        return {f"{word}/{name}": a for word, found in results.items() for name, a in found.items()}

    return both


# Rollouts of one rule.


@by_precision
@torch.no_grad()
def grown(dtype, name, steps):
    """Some steps of a shipped rule from its stored world."""
    rule, (x, s) = rule_named(name, dtype), stored_world(name, dtype)
    options = {"generator": npa_envs.WorldRandom([7, 8]), "return_path_length": True}
    x, s, path = npa_envs.rollout(rule, x, s, steps, **options, **RULES[name])
    found = {"x": x, "s": s, "path": path, "outputs": rule.read_out(s), "colour": rule.colour(s)}
    return {name: thinned(tensor) for name, tensor in found.items()}


@by_precision
def differentiated(dtype, name, steps, **options):
    """A few steps of a shipped rule, and gradients by the worlds and all weights."""
    rule, (x, s) = rule_named(name, dtype), watched(*stored_world(name, dtype))
    options = RULES[name] | {"return_path_length": True} | options
    generator = torch.Generator().manual_seed(3)
    after_x, after_s, path = npa_envs.rollout(rule, x, s, steps, generator=generator, **options)
    loss = functional(after_x, after_s, rule.read_out(after_s))
    if path.requires_grad:
        loss = loss + functional(path)
    results = {"x": thinned(after_x), "s": thinned(after_s), "path": thinned(path)}
    return results | gradients(loss, x, s, rule)


@by_precision
def untrained(dtype, space_dim, box, **parts):
    """Three steps of a small random rule with other parts of perception, at another radius."""
    x, s = watched(*random_world(11, 96, box or (1.0, 0.8, 0.9)[:space_dim], 5, dtype))
    torch.manual_seed(5)
    rule = npa_envs.NPARule(space_dim, 5, 24, eps0=0.2, **parts).to(dtype)
    options = {"generator": npa_envs.WorldRandom([1, 2]), "detach_positions": False}
    after = npa_envs.rollout(rule, x, s, 3, eps=0.25, box=box, **options)
    one = npa_envs.step(rule, x.detach(), s.detach(), eps=0.25, box=box, update_prob=1.0)
    results = {"x": after[0], "s": after[1], "step/x": one[0], "step/s": one[1]}
    results = {name: thinned(tensor) for name, tensor in results.items()}
    return results | gradients(functional(*after), x, s, rule)


# Perception.


@by_precision
def perceived(dtype, sides, periodic):
    """Perception vectors with gradients, and fields, of a random world."""
    count, eps = (300, 0.2) if len(sides) == 2 else (200, 0.3)
    x, s = random_world(21, count, sides, 5, dtype)
    box = sides if periodic else None
    results = {}
    for inverse in ("threshold", "smooth"):
        fields = npa_envs.perception_fields(x, s, eps, box, moment_inverse=inverse)
        names = fields._fields if inverse == "threshold" else ("grad1",)
        results |= {f"{inverse}/{n}": thinned(getattr(fields, n), 400) for n in names}
        own, options = watched(x, s), {"detach_positions": False, "moment_inverse": inverse}
        z = npa_envs.perceive(*own, eps, 0.8 * eps, box, **options)
        found = {"z": thinned(z)} | gradients(functional(z), *own)
        results |= {f"{inverse}/{name}": array for name, array in found.items()}
    results["detached/z"] = thinned(npa_envs.perceive(x, s, eps, box=box, state_gradient=False))
    results["plain/z"] = thinned(npa_envs.perceive(x, s, eps, box=box, moment_correction=False))
    return results | {"mean": thinned(npa_envs.world_mean(s))}


@by_precision
def perceived_by_species(dtype, sides, periodic):
    """Perception vectors and fields of three species in a random world."""
    x, s = watched(*random_world(31, 120, sides, 4, dtype))
    box, counts = sides if periodic else None, (60, 47, 13)
    fields = npa_envs.species_fields(x.detach(), counts, eps=0.3, box=box)
    results = {name: thinned(getattr(fields, name)) for name in fields._fields}
    z = npa_envs.perceive_species(x, s, counts, 0.3, 0.25, box, detach_positions=False)
    return results | {"z": thinned(z)} | gradients(functional(z), x, s)


# Rollouts of several rules.


@by_precision
def together(dtype, perception, box, steps, **options):
    """A few steps of two or three rules in one world, with gradients."""
    shared = perception == "shared"
    counts = (60, 36) if shared else (50, 30, 16)
    x, s = watched(*random_world(41, 96, box or (0.9, 0.7), 5, dtype))
    torch.manual_seed(6)
    species = {"eps0": 0.2, "species_count": 0 if shared else len(counts)}
    rules = [npa_envs.NPARule(2, 5, 16 + 8 * k, **species).to(dtype) for k in range(len(counts))]
    options |= {"counts": counts, "eps": 0.25, "box": box, "perception": perception}
    options |= {"generator": npa_envs.WorldRandom([5, 9]), "return_path_length": True}
    after = npa_envs.rollout_species(rules, x, s, steps, **options)
    results = {n: thinned(a) for n, a in zip(("x", "s", "path"), after, strict=True)}
    return results | gradients(functional(*after), x, s, *rules)


@by_precision
@torch.no_grad()
def shipped_together(dtype):
    """Four steps of two shipped rules in the worlds of one, side by side."""
    x, s = stored_world("gecko", dtype)
    counts = (x.shape[1] // 2, x.shape[1] - x.shape[1] // 2)
    rules = [rule_named(name, dtype) for name in ("gecko", "heart")]
    options = {"counts": counts, "density_counts": counts, "update_prob": (0.5, 0.8)}
    generator = torch.Generator().manual_seed(2)
    after = npa_envs.rollout_species(rules, x, s, 4, generator=generator, **options)
    return {"x": thinned(after[0]), "s": thinned(after[1])}


# Environments.


def actions(generator, space):
    """Return random small actions of a space."""
    return generator.uniform(-0.3, 0.3, space.shape).astype(np.float32)


def floats(info):
    """Return the losses and rewards of an info, by name in order."""
    return [info[name] for name in sorted(info) if name.startswith(("loss", "reward_"))]


def episode(name, steps=12, **keywords):
    """An episode of one environment by seeded actions."""
    env = small_envs.make(name, particle_count=64, render_mode="rgb_array", **keywords)
    generator = np.random.default_rng(12)
    observation, info = env.reset(seed=5)
    losses = np.array([floats(info)], np.float32)
    observations, reports, ends, shares = [observation], [], [], []
    for _ in range(steps):
        action = actions(generator, env.action_space)
        observation, reward, terminated, truncated, info = env.step(action)
        observations.append(observation)
        # Side by side, because rewards are differences of losses and as exact as those.
        reports.append(np.array([reward, *floats(info)], np.float32))
        ends.append([terminated, truncated, info["success"], info["diverged"]])
        if "particle_reward" in info:
            shares.append(np.append(info["particle_reward"], np.float32(info["loss"])))
        if terminated or truncated:
            observation, info = env.reset()
            observations.append(observation)
    results = {
        "observations": thinned(np.stack(observations), 1100),
        "reset": losses,
        "reports": np.stack(reports),
        "ends": np.array(ends),
        "picture": np.asarray(env.render()),
    }
    if shares:
        results["shares"] = thinned(np.stack(shares))
    particles = zip("xs", env.unwrapped.particles(), strict=True)
    results |= {part: thinned(tensor) for part, tensor in particles}
    env.close()
    return results


# Environments of several species.


def crowd(module, task, **keywords):
    """An episode of several agents, all at once, by seeded actions."""
    if "particle_counts" not in keywords:
        keywords = {"particle_count": 48} | keywords
    fields = crowds.small(task, max_cycles=10, render_mode="rgb_array", **keywords)
    env = module.parallel_env(**fields)
    generator = np.random.default_rng(14)
    observations, infos = env.reset(seed=5)
    seen, ends = [], []
    # At the start nothing has been gained.
    lost = [{n: v for n, v in infos[a].items() if n.startswith("loss")} for a in env.agents]
    reports = [np.array([floats(info) for info in lost], np.float32).ravel()]
    for _ in range(10):
        if not env.agents:
            break
        seen.append(np.concatenate([observations[agent].ravel() for agent in env.agents]))
        chosen = {a: actions(generator, env.action_space(a)) for a in env.agents}
        observations, rewards, terminated, truncated, infos = env.step(chosen)
        report = [[rewards[agent], *floats(infos[agent])] for agent in chosen]
        reports.append(np.array(report, np.float32).ravel())
        ends.append(np.array([[terminated[a], truncated[a]] for a in chosen]).ravel())
    results = {
        "observations": thinned(np.concatenate(seen), 1100),
        "reports": np.concatenate(reports),
        "ends": np.concatenate(ends),
        "state": thinned(env.state()),
        "picture": np.asarray(env.render()),
    }
    env.close()
    return results


def randomness():
    """Numbers that worlds draw."""
    random = npa_envs.WorldRandom([3, 4])
    random.advance()
    return {
        "f32/uniform": random.uniform(20).numpy(),
        "f64/normal": random.normal(7, 2, dtype=torch.float64).numpy(),
        "mask": random.bernoulli(0.4, 30).numpy(),
        "integers": random.integers(10, 9).numpy(),
        "beside": random.substream(2).uniform(4).numpy(),
    }


NOISE = 0.004
"""Standard deviation of position noise [length units]."""

THREE = {
    "species_count": 3,
    "particle_counts": (20, 16, 9),
    "deaths": ((1, 4),),
    "seed_distance": 0.3,
}

MORPHOGENESIS, REGENERATION = "npa/Morphogenesis2D-v0", "npa/Regeneration2D-v0"
TEXTURE, POINTS = "npa/Texture-v0", "npa/PointClassification-v0"
MORPHOGENESIS3D = "npa/Morphogenesis3D-v0"

SCENES = {
    **{f"grown-{n}": partial(grown, n, 6 if n in ("dots", "duck") else 8) for n in RULES},
    **{f"gradients-{name}": partial(differentiated, name, 3, memory="store") for name in RULES},
    "gradients-gecko-all": partial(differentiated, "gecko", 2, update_prob=1.0),
    "gradients-gecko-noise": partial(differentiated, "gecko", 3, position_noise=NOISE),
    "gradients-gecko-attached": partial(differentiated, "gecko", 3, detach_positions=False),
    "gradients-gecko-dt": partial(differentiated, "gecko", 2, dt=0.5, eps=0.13),
    "gradients-dots-recompute": partial(differentiated, "dots", 4, memory="recompute"),
    "gradients-dots-attached": partial(differentiated, "dots", 2, detach_positions=False),
    "gradients-duck-minimal": partial(differentiated, "duck", 3, memory="minimal"),
    "gradients-duck-attached": partial(differentiated, "duck", 2, detach_positions=False),
    "gradients-digits-attached": partial(differentiated, "digits", 3, detach_positions=False),
    "gradients-digits-one": partial(differentiated, "digits", 1),
    "gradients-digits-all": partial(differentiated, "digits", 3, update_prob=1.0),
    "untrained-smooth": partial(untrained, 2, None, moment_inverse="smooth"),
    "untrained-uncorrected": partial(untrained, 2, (1.2, 0.9), moment_correction=False),
    "untrained-densities": partial(untrained, 3, (1.0, 0.8, 0.9), state_gradient=False),
    "untrained-states": partial(untrained, 3, None, density_gradient=False),
    "perception-2d-open": partial(perceived, (2.0, 1.6), False),
    "perception-2d-periodic": partial(perceived, (2.0, 1.3), True),
    "perception-3d-open": partial(perceived, (1.2, 1.0, 1.1), False),
    "perception-3d-periodic": partial(perceived, (1.2, 1.0, 0.7), True),
    "perception-species-2d": partial(perceived_by_species, (1.4, 1.1), True),
    "perception-species-3d": partial(perceived_by_species, (1.0, 0.9, 0.8), False),
    "species-shared": partial(
        together, "shared", None, 3, update_prob=(0.5, 0.9), density_counts=(60, 36)
    ),
    "species-periodic": partial(
        together, "shared", (1.2, 0.9), 3, update_prob=0.6, detach_positions=False
    ),
    "species-told-apart": partial(
        together, "per_species", None, 4, position_noise=NOISE, memory="recompute"
    ),
    "species-shipped": shipped_together,
    "env-morphogenesis": partial(episode, MORPHOGENESIS, target="ring"),
    "env-morphogenesis-periodic": partial(
        episode, MORPHOGENESIS, 6, target="ring", boundary="periodic", moment_inverse="smooth",
        reward="particle",
    ),
    "env-morphogenesis-noise": partial(
        episode, MORPHOGENESIS, 6, target="ring", position_noise=0.01, render_style="states",
        seed_pool=3,
    ),
    "env-regeneration": partial(
        episode, REGENERATION, target="ring", seed_pool=4, split_damage=False
    ),
    "env-texture": partial(episode, TEXTURE, 8),
    "env-texture-shares": partial(episode, TEXTURE, 4, reward="particle"),
    "env-points": partial(episode, POINTS),
    "env-points-shares": partial(episode, POINTS, 4, reward="particle", rotation=20.0, jitter=0.01),
    "env-morphogenesis3d": partial(episode, MORPHOGENESIS3D),
    "env-morphogenesis3d-shares": partial(episode, MORPHOGENESIS3D, 4, reward="particle"),
    "crowd-mixing": partial(crowd, multispecies_v0, "mixing", perception="per_species"),
    "crowd-segregation": partial(crowd, multispecies_v0, "segregation", **THREE),
    "crowd-co_morphogenesis": partial(crowd, multispecies_v0, "co_morphogenesis"),
    "crowd-invasion": partial(crowd, multispecies_v0, "invasion"),
    "crowd-symbiosis": partial(crowd, multispecies_v0, "symbiosis", reward="team"),
    "crowd-particles-mixing": partial(crowd, particles_v0, "mixing", particle_count=12),
    "crowd-particles-invasion": partial(crowd, particles_v0, "invasion", particle_count=12),
    "randomness": randomness,
}  # fmt: skip
"""All scenes by name."""


def compute(name):
    """Return a scene's arrays by their full names."""
    return {f"{name}/{key}": array for key, array in SCENES[name]().items()}
