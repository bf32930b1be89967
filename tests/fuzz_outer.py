"""Fuzz test: calls of configurations, environments, wrappers, policies and the command line."""

import contextlib
import dataclasses
import functools
import gzip
import io
import json
import random
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import gymnasium
import small_envs
import torch
from fuzz_values import Target, read_file, wrong
from PIL import Image

import npa_envs
from npa_envs import agents, wrappers
from npa_envs.cli import COMMANDS, main
from npa_envs.envs import multispecies_v0, particles_v0
from npa_envs.tasks.targets.clouds import read_idx
from npa_envs.tasks.targets.points import load_target
from npa_envs.tasks.targets.textures import load_texture
from npa_envs.tasks.targets.views import load_views
from npa_envs.training import TASKS, load_config, override, preset
from npa_envs.training.presets import config_to_dict


def configured(draw: random.Random) -> dict[str, Any]:
    task = draw.choice(tuple(TASKS))
    config = TASKS[task].presets["tiny"]
    known = [f.name for level in (config, config.task) for f in dataclasses.fields(level)]
    name = draw.choice([*known, "", "itertions"])
    return {"name": "tiny", "task": task, "field": name, "value": getattr(config, name, 1)}


def configure(name: Any, task: Any, field: str, value: Any) -> None:
    preset(name, task, **{str(field): value})


def reconfigure(name: Any, task: Any, field: str, value: Any) -> None:
    """Make a configuration as a program does, whose types nobody converts."""
    config = override(preset(name, task))
    for level in (config, config.task):
        if field in {f.name for f in dataclasses.fields(level)}:
            dataclasses.replace(level, **{field: value})


def configure_by(path: Path) -> Any:
    return load_config(path, preset("tiny"))


FILES: dict[str, tuple[str, Callable[[Path], Any]]] = {
    ".png": ("picture", lambda path: load_target(path, point_count=50)),
    **{
        f".{suffix}": ("picture", lambda path: load_texture(path, resolution=8))
        for suffix in ("jpg", "webp", "gif", "bmp", "tiff", "ppm")
    },
    ".safetensors": ("rule", npa_envs.load_rule),
    ".pth": ("state dict", npa_envs.load_rule),
    ".json": ("configuration", configure_by),
    ".yaml": ("configuration", configure_by),
    ".toml": ("TOML", configure_by),
    ".idx": ("IDX", read_idx),
    ".gz": ("IDX", read_idx),
    ".obj": ("mesh", lambda path: load_views(path, resolution=8, training_count=1)),
}
"""Content and reader of a file of each suffix."""


@functools.cache
def whole_file(suffix: str) -> bytes:
    """Return an undamaged file of a format."""
    content, _ = FILES[suffix]
    buffer = io.BytesIO()
    if content == "picture":
        picture = Image.new("RGB", (12, 12), "white")
        picture.paste("red", (3, 3, 9, 9))
        picture.save(buffer, {".jpg": "JPEG", ".tiff": "TIFF"}.get(suffix, suffix[1:].upper()))
    elif content == "rule":
        return npa_envs.rule.files.shipped_rules()["heart"].read_bytes()
    elif content == "state dict":
        shapes = {"model.0.weight": (8, 22), "model.0.bias": (8,), "model.2.weight": (7, 8)}
        weights = {name: torch.zeros(shape) for name, shape in shapes.items()}
        torch.save(weights | {"eps0": 0.1, "alpha": 0.2}, buffer)
    elif content == "IDX":
        sizes = b"".join(size.to_bytes(4, "big") for size in (2, 3, 3))
        data = b"\0\0\x08\x03" + sizes + bytes(18)
        return gzip.compress(data) if suffix == ".gz" else data
    elif content == "mesh":
        return b"v 0 0 0\nv 1 0 0\nv 0 1 0\nv 0 0 1\nf 1 2 3\nf 1 2 4\nf 2 3 4\n"
    elif content == "TOML":
        return b'iterations = 5\nsteps = [3, 6]\n[task]\ntarget = "heart"\neps = 0.1\n'
    else:
        return json.dumps(config_to_dict(preset("tiny"))).encode()
    return buffer.getvalue()


WORDS = (b"0", b"-1", b"1e400", 5000 * b"9", b"nan", b"null", b"[]", b"{}", b"true", b"[", b"\0")
SIZES = (b"\xff\xff\xff\xff", b"\x7f\xff\xff\xff", b"\xff\xff\xff\x7f", bytes(4), b"\0\0\x40\0")


def damaged_files(draw: random.Random) -> dict[str, Any]:
    """Make a file of which one to eight places are wrong."""
    suffix = draw.choice(tuple(FILES))
    content = bytearray(whole_file(suffix))
    for _ in range(draw.choice((1, 1, 2, 8))):
        place = draw.randrange(len(content))
        if draw.random() < 0.5:
            place = min(place, draw.randrange(200))
        change = draw.choice(("bit", "cut", "drop", "size", "word", "repeat"))
        if change == "bit":
            content[place] ^= 1 << draw.randrange(8)
        elif change == "cut" and place:
            del content[place:]
        elif change == "drop" and place:
            del content[place : place + draw.randrange(32)]
        elif change == "size":
            content[place : place + 4] = draw.choice(SIZES)
        elif change == "repeat":
            content[place:place] = content[: draw.randrange(64)]
        else:
            words = list(re.finditer(rb"[-\w.]+", content))
            if words:
                begin, end = draw.choice(words).span()
                content[begin:end] = draw.choice(WORDS)
    return {"kind": suffix, "content": bytes(content)}


def read_damaged(kind: str, content: bytes) -> None:
    read_file(FILES[kind][1], f"file{kind}", content)


def config_files(draw: random.Random) -> dict[str, Any]:
    texts = ("iterations: 5", "{}", "[1]", "iterations = nan", '{"steps": [1, "a"]}', "\0", "a: [")
    content = draw.choice(texts).encode()
    return {"content": content, "name": "config" + draw.choice((".yaml", ".toml", ".json", ".txt"))}


def env_fields(draw: random.Random) -> dict[str, Any]:
    name = draw.choice(small_envs.IDS)
    known = sorted(field.name for field in dataclasses.fields(config_type(name)))
    # Unknown ones come alone: Gymnasium itself repeats all keywords then, whole.
    unknown = draw.choice(("seed", "rules"))
    fields = draw.sample(known, draw.choice((1, 1, 2))) if draw.random() < 0.9 else [unknown]
    made = {field: getattr(config_type(name), field, None) for field in fields}
    id = draw.choice((name, name, name, name, "npa/Texture-v9", "npa/None", ""))
    return {"id": id, "world_count": draw.choice((None, 2)), **(made | small_envs.small(name))}


@functools.cache
def config_type(name: str) -> type:
    return type(small_envs.make(name).unwrapped.config)


def run_env(id: Any, world_count: Any, **keywords: Any) -> None:
    """Make an environment and act in it once."""
    if world_count is None:
        env = gymnasium.make(id, disable_env_checker=True, **keywords)
    else:
        mode = "vector_entry_point"
        env = gymnasium.make_vec(id, num_envs=world_count, vectorization_mode=mode, **keywords)
    with contextlib.closing(env):
        env.reset(seed=0)
        env.step(env.action_space.sample())


@functools.cache
def standing(kind: str) -> Any:
    """Return an environment that all calls share."""
    if kind == "single":
        return small_envs.make(small_envs.IDS[0], render_mode="rgb_array").unwrapped
    if kind == "vector":
        return small_envs.make_vec(small_envs.IDS[0], 2, render_mode="rgb_array").unwrapped
    return multispecies_v0.parallel_env(particle_count=10, eps=0.3, render_size=24)


def act(kind: str, seed: Any, options: Any, action: Any, x: Any, s: Any) -> None:
    """Reset an environment, put particles into it, and act."""
    env = standing(kind)
    env.reset(seed=seed, options=options)
    env.place_particles(x, s)
    env.step(action)


def acted(draw: random.Random) -> dict[str, Any]:
    kind = draw.choice(("single", "vector", "species"))
    env = standing(kind)
    env.reset(seed=0)
    lead = {"single": (61,), "vector": (2, 61), "species": (10,)}[kind]
    if kind == "species":
        action = {agent: env.action_space(agent).sample() for agent in env.agents}
        agent = draw.choice(env.agents)
        action[agent] = wrong(draw, "action", torch.as_tensor(action[agent]))
        action = draw.choice((action, {"species_0": action["species_0"]}))
    else:
        action = torch.as_tensor(env.action_space.sample())
    particles = {"x": torch.rand(*lead, 2), "s": torch.rand(*lead, 16)}
    return {"kind": kind, "seed": 0, "options": None, "action": action, **particles}


def crowd_fields(draw: random.Random) -> dict[str, Any]:
    task = draw.choice(tuple(multispecies_v0.ENVIRONMENTS.values()))
    known = sorted(species_config(task).__dataclass_fields__)
    fields = draw.sample([*known, "seed"], draw.choice((1, 1, 2)))
    made = {f: getattr(species_config(task), f, None) for f in fields if f != "species_count"}
    fixed = {"particle_count": 12, "eps": 0.3, "max_cycles": 3, "render_size": 24}
    maker = draw.choice(("parallel_env", "particles", "batched", "env"))
    return {"maker": maker, "task": task, "species_count": 2, **(made | fixed)}


@functools.cache
def species_config(task: str) -> type:
    return type(multispecies_v0.parallel_env(task, particle_count=12, eps=0.3).config)


def run_species(maker: str, **keywords: Any) -> None:
    """Make an environment of several species and act in it once."""
    particles = maker == "particles"
    make = particles_v0.parallel_env if particles else getattr(multispecies_v0, maker)
    env = make(**keywords)
    env.reset(seed=0)
    if maker in ("parallel_env", "particles"):
        env.step({agent: env.action_space(agent).sample() for agent in env.agents})


WRAPPERS: dict[str, dict[str, Any]] = {
    "DamageEvents": {"events": ["1:cut"]},
    "NormalizePerception": {"clip": 5.0, "epsilon": 1e-8, "training": True},
    "SpeciesTags": {"species_count": 2},
    "VectorDamageEvents": {"events": ["1:cut"]},
    "VectorNormalizePerception": {"clip": 5.0, "epsilon": 1e-8, "training": True},
    "VectorSpeciesTags": {"species_count": 2},
    "TorchRecordEpisodeStatistics": {"buffer_length": 10, "stats_key": "episode"},
    "TorchNormalizeObservation": {"epsilon": 1e-8},
    "TorchNormalizeReward": {"gamma": 0.9, "epsilon": 1e-8},
    "ParticleVecEnv": {"bootstrap": True},
    "SpeciesVecEnv": {"others": None},
}


def wrapped(draw: random.Random) -> dict[str, Any]:
    name = draw.choice(sorted(WRAPPERS))
    single = not name.startswith(("Vector", "Torch", "Particle", "SpeciesVec"))
    return {"name": name, "env": standing("single" if single else "vector"), **WRAPPERS[name]}


def wrap(name: str, env: Any, **options: Any) -> None:
    """Make a wrapper, reset and act through it."""
    made = getattr(wrappers, name)(env, **options)
    if name in ("ParticleVecEnv", "SpeciesVecEnv") or name.startswith("Torch"):
        return
    made.reset(seed=0)
    made.step(env.action_space.sample())


def policies(draw: random.Random) -> dict[str, Any]:
    name = draw.choice(("ZeroPolicy", "RandomPolicy", "SpreadPolicy", "PaintPolicy", "RulePolicy"))
    own = {"RandomPolicy": {"seed": 0}, "SpreadPolicy": {"gain": 0.1}}.get(name, {})
    if name == "RulePolicy":
        own = {"rule": npa_envs.NPARule(), "state_scale": 1.0}
    if name == "PaintPolicy":
        own = {"colour": (0.1, 0.2, 0.3)}
    return {"name": name, "env": standing("single"), **own}


def make_policy(name: str, **options: Any) -> None:
    policy = getattr(agents, name)(**options)
    observation, _ = standing("single").reset(seed=0)
    policy(observation)


def command_line(draw: random.Random) -> dict[str, Any]:
    command = draw.choice([*COMMANDS, "", "no-such"])
    begun = {
        "train": ["morphogenesis2d", "--preset", "tiny"],
        "rollout": ["gecko"],
        "evaluate": ["gecko"],
        "interact": ["gecko", "heart"],
    }.get(command, [])
    options = (
        "--steps", "--iterations", "--out", "--device", "--seed", "--damage", "--particle-count",
        "--resolution", "--update-prob", "--only", "--config", "--loss", "--resume", "--no-such",
    )  # fmt: skip
    values = ("nan", "-1", "", "a", "None", "[]", "--", "é", "1e400", "cuda:99", "0", "100:cut:a")
    words = [command, *begun, draw.choice(options), draw.choice(values)]
    # Nothing that is legal may begin to work: this is refused by every command.
    return {"words": [*words, "--no-such-option"]}


def run_command(words: Any) -> None:
    if "warmup" in words:
        return
    code = main(words)
    assert code in (0, 2), f"exit code {code}"


OUTER: dict[str, Target] = {
    "preset": Target(configure, configured, 4),
    "TrainConfig": Target(reconfigure, configured, 4),
    "load_config": Target(functools.partial(read_file, configure_by), config_files),
    "damaged files": Target(read_damaged, damaged_files, 6),
    "gymnasium.make": Target(run_env, env_fields, 5, (gymnasium.error.Error,)),
    "reset, place_particles and step": Target(act, acted, 5, (gymnasium.error.Error,)),
    "multispecies_v0": Target(run_species, crowd_fields, 5),
    "wrappers": Target(wrap, wrapped, 3),
    "agents": Target(make_policy, policies, 2),
    "npa-envs": Target(run_command, command_line, 1, (SystemExit,)),
}
"""Targets by name."""
