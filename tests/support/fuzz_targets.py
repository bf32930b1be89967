"""Fuzz test: the calls of the public API, each with legal arguments."""

import contextlib
import dataclasses
import functools
import gzip
import io
import json
import random
import re
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import torch
from PIL import Image
from support import crowds, small_envs
from torch import Tensor

import npa_envs
from npa_envs import agents, wrappers
from npa_envs.envs import multispecies_v0, particles_v0
from npa_envs.measure.quality import scores
from npa_envs.ops import Cameras, orbit, periodic_splat, render_gaussians, splat
from npa_envs.ops.pictures.cameras import cameras_of_poses, look_at
from npa_envs.render import draw_worlds, to_uint8, turntable_frames, write_gif, write_png
from npa_envs.tasks.damage import damage_worlds, parse_damage
from npa_envs.tasks.seeds import uniform_ball, uniform_box
from npa_envs.tasks.targets.digit_clouds import read_idx
from npa_envs.tasks.targets.picture_points import load_target
from npa_envs.tasks.targets.textures import load_texture
from npa_envs.tasks.targets.views import load_views
from npa_envs.training import TASKS, load_config, override, preset
from npa_envs.training.task_table import config_to_dict
from npa_envs.world.particles import Particles


@dataclasses.dataclass(frozen=True)
class Target:
    """Something public that can be called."""

    function: Callable[..., Any]
    legal: Callable[[random.Random], dict[str, Any]]
    """Returns legal arguments."""
    weight: float = 1.0
    """How often it is called."""
    documented: tuple[type[BaseException], ...] = ()
    """Exceptions that its documentation names besides `NPAError`."""
    constant: tuple[str, ...] = ()
    """Arguments that stay legal."""


def fixed(function: Callable[..., Any], weight: float = 1.0, **arguments: Any) -> Target:
    """Return a target whose legal arguments are always the same."""
    return Target(function, lambda draw: dict(arguments), weight)


# Operators, rules, pictures and cameras.


def world(draw: random.Random, dim: int | None = None, channels: int = 4) -> dict[str, Any]:
    dim = dim or draw.choice((2, 3))
    dtype = draw.choice((torch.float32, torch.float64))
    return {"x": torch.rand(2, 5, dim, dtype=dtype), "s": torch.rand(2, 5, channels, dtype=dtype)}


PERCEIVED = {"eps": 0.3, "eps0": 0.2, "box": 1.0, "detach_positions": False}
FIELDS = {"eps": 0.3, "box": (1.0, 2.0)}


def rule_of(x: Tensor, **options: Any) -> npa_envs.NPARule:
    return npa_envs.NPARule(x.shape[2], 4, 6, **options).to(x.dtype)


STEPPED: dict[str, Any] = {
    "eps": 0.3, "box": None, "update_prob": 0.5, "dt": 1.0, "position_noise": 0.01,
    "detach_positions": True,
}  # fmt: skip


def stepped(draw: random.Random) -> dict[str, Any]:
    worlds = world(draw)
    generator = draw.choice((None, torch.Generator(), npa_envs.WorldRandom([0, 1])))
    rule = rule_of(worlds["x"], static=draw.random() < 0.3)
    return {"rule": rule, **worlds, **STEPPED, "generator": generator}


def rolled(draw: random.Random) -> dict[str, Any]:
    return stepped(draw) | {"steps": draw.choice((0, 1, 4)), "memory": "recompute"}


def rolled_species(draw: random.Random) -> dict[str, Any]:
    arguments = rolled(draw)
    static, per_species = arguments.pop("rule").static, draw.random() < 0.5
    options = {"species_count": 2} if per_species else {}
    rules = [rule_of(arguments["x"], static=static, **options) for _ in range(2)]
    return arguments | {
        "rules": rules, "counts": [2, 3], "update_prob": [0.5, 1.0], "density_counts": [2, 3],
        "perception": "per_species" if per_species else "shared",
    }  # fmt: skip


def run_rule(run: Callable[..., Any], **arguments: Any) -> None:
    """Run a rule, and back-propagate if any argument requires gradients."""
    total = sum(tensor.sum() for tensor in run(**arguments))
    if total.requires_grad:
        total.backward()


def hyper_parameters(draw: random.Random) -> dict[str, Any]:
    return {
        "space_dim": 2, "state_dim": 4, "hidden_dim": 8, "eps0": 0.1, "alpha": 0.5, "static": False,
        "readout_dim": 3, "readout_hidden_dim": 4, "moment_correction": True,
        "species_count": draw.choice((0, 2)),
    }  # fmt: skip


def save_and_load(rule: Any, path: Any, metadata: Any, device: Any) -> None:
    """Write a rule in a temporary folder, and read it."""
    with tempfile.TemporaryDirectory() as folder:
        target = Path(folder) / path if isinstance(path, str) and "/" not in path else path
        npa_envs.save_rule(rule, target, metadata=metadata)
        npa_envs.load_rule(target, device=device)


def draw_numbers(seeds: Any, device: Any, method: Any, size: Any, extra: Any) -> None:
    """Make streams and draw from them."""
    streams = npa_envs.WorldRandom(seeds, device=device)
    extras = () if method in ("uniform", "normal") else (extra,)
    getattr(streams, method)(*extras, size)
    streams.substream(extra).advance()


def painted(draw: random.Random) -> dict[str, Any]:
    return world(draw) | {
        "style": draw.choice(("particles", "density", "states")), "resolution": 8,
        "pixel_size": 0.1, "sigma": 1.0, "centre": None, "half_width": 1.0, "periodic": False,
        "azimuth": 0.0, "elevation": 20.0, "background": "white",
    }  # fmt: skip


def write_pictures(path: Any, frames: Any, fps: Any) -> None:
    """Write a GIF or PNG in a temporary folder."""
    with tempfile.TemporaryDirectory() as folder:
        if not isinstance(path, str) or "/" in path:
            return  # Nothing is written elsewhere.
        target = Path(folder) / path
        if fps is None:
            write_png(target, frames)
        else:
            write_gif(target, frames, fps)


def damage(x: Any, s: Any, **options: Any) -> Particles:
    return damage_worlds(Particles(x, s), **options)


def damaged(draw: random.Random) -> dict[str, Any]:
    kind = draw.choice(("wipe", "cut", "clump", "noise"))
    return world(draw) | {"kind": kind, "size": 0.1, "generator": None}


CAMERAS = orbit(2, width=6, height=5)
DRAWN: dict[str, Any] = {
    "x": torch.rand(2, 5, 2), "colour": torch.rand(2, 5, 3), "sigma": 1.0, "resolution": 8,
    "pixel_size": 0.2, "lo": -1.0, "hi": 1.0,
}  # fmt: skip
STREAMS: dict[str, Any] = {"seeds": [0, 1], "device": "cpu", "size": 3, "extra": 1}


# Configurations, files, environments, wrappers and policies.


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
        start = draw.randrange(len(content))
        if draw.random() < 0.5:
            start = min(start, draw.randrange(200))
        change = draw.choice(("bit", "cut", "drop", "size", "word", "repeat"))
        if change == "bit":
            content[start] ^= 1 << draw.randrange(8)
        elif change == "cut" and start:
            del content[start:]
        elif change == "drop" and start:
            del content[start : start + draw.randrange(32)]
        elif change == "size":
            content[start : start + 4] = draw.choice(SIZES)
        elif change == "repeat":
            content[start:start] = content[: draw.randrange(64)]
        else:
            words = list(re.finditer(rb"[-\w.]+", content))
            if words:
                begin, end = draw.choice(words).span()
                content[begin:end] = draw.choice(WORDS)
    return {"suffix": suffix, "content": bytes(content)}


def read_damaged(suffix: str, content: bytes) -> None:
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / f"file{suffix}"
        path.write_bytes(content)
        FILES[suffix][1](path)


@functools.cache
def config_type(name: str) -> type:
    """Return the configuration of an environment: an id, or a task of several species."""
    env = small_envs.make(name).unwrapped if name.startswith("npa/") else crowds.make(name)
    return type(env.config)


def env_fields(draw: random.Random) -> dict[str, Any]:
    one_species = draw.random() < 0.5
    name = draw.choice(small_envs.IDS if one_species else crowds.TASKS)
    known = sorted(field.name for field in dataclasses.fields(config_type(name)))
    # Unknown ones come alone: Gymnasium itself repeats all keywords then, whole.
    unknown = draw.choice(("seed", "rules"))
    fields = draw.sample(known, draw.choice((1, 1, 2))) if draw.random() < 0.9 else [unknown]
    arguments = {field: getattr(config_type(name), field, None) for field in fields}
    if not one_species:
        maker = draw.choice(("parallel_env", "particles", "batched", "env"))
        size = {"particle_count": 12, "max_cycles": 3, "species_count": 2}
        return {"maker": maker} | arguments | crowds.small(name, **size)
    id = draw.choice((name, name, name, name, "npa/Texture-v9", "npa/None", ""))
    call = draw.choice(({"maker": "make"}, {"maker": "make_vec", "num_envs": 2}))
    return call | {"id": id} | arguments | small_envs.small(name)


def run_env(maker: str, **keywords: Any) -> None:
    """Make an environment and act in it once."""
    if maker == "make":
        env = gymnasium.make(disable_env_checker=True, **keywords)
    elif maker == "make_vec":
        env = gymnasium.make_vec(vectorization_mode="vector_entry_point", **keywords)
    elif maker == "particles":
        env = particles_v0.parallel_env(**keywords)
    else:
        env = getattr(multispecies_v0, maker)(**keywords)
    with contextlib.closing(env):
        env.reset(seed=0)
        if maker in ("make", "make_vec"):
            env.step(env.action_space.sample())
        elif maker in ("parallel_env", "particles"):
            env.step({agent: env.action_space(agent).sample() for agent in env.agents})


@functools.cache
def standing(kind: str) -> Any:
    """Return an environment, "single" or "vector", that all calls share."""
    if kind == "single":
        return small_envs.make(small_envs.IDS[0]).unwrapped
    return small_envs.make_vec(small_envs.IDS[0], 2).unwrapped


CONSTRUCTED: dict[str, dict[str, Any]] = {
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
    "ZeroPolicy": {},
    "RandomPolicy": {"seed": 0},
    "SpreadPolicy": {"gain": 0.1},
    "PaintPolicy": {"colour": (0.1, 0.2, 0.3)},
    "RulePolicy": {"rule": npa_envs.NPARule(), "state_scale": 1.0},
}
"""Wrappers and policies of an environment, and their other arguments."""


def constructed(draw: random.Random) -> dict[str, Any]:
    name = draw.choice(sorted(CONSTRUCTED))
    vector = name.startswith(("Vector", "Torch", "ParticleVec", "SpeciesVec"))
    return {"name": name, "env": standing("vector" if vector else "single"), **CONSTRUCTED[name]}


def construct(name: str, env: Any, **options: Any) -> None:
    """Make a wrapper or a policy, and act with it."""
    if name.endswith("Policy"):
        policy = getattr(agents, name)(env=env, **options)
        observation, _ = standing("single").reset(seed=0)
        policy(observation)
        return
    wrapper = getattr(wrappers, name)(env, **options)
    if not name.startswith(("Torch", "ParticleVec", "SpeciesVec")):
        wrapper.reset(seed=0)
        wrapper.step(env.action_space.sample())


TARGETS: dict[str, Target] = {
    "perceive": Target(npa_envs.perceive, lambda d: world(d) | PERCEIVED, 4),
    "perception_fields": Target(npa_envs.perception_fields, lambda d: world(d) | FIELDS, 2),
    "perceive_species": Target(
        npa_envs.perceive_species, lambda d: world(d) | PERCEIVED | {"counts": [2, 3]}, 2
    ),
    "species_fields": Target(
        npa_envs.species_fields, lambda d: {"x": world(d)["x"], "counts": [2, 3]} | FIELDS, 2
    ),
    "step": Target(functools.partial(run_rule, npa_envs.step), stepped, 3),
    "rollout": Target(functools.partial(run_rule, npa_envs.rollout), rolled, 5),
    "rollout_species": Target(npa_envs.rollout_species, rolled_species, 5),
    "NPARule": Target(npa_envs.NPARule, hyper_parameters, 2),
    "save_rule": fixed(
        save_and_load, 2, rule=npa_envs.NPARule(2, 3, 4), path="a.safetensors",
        metadata={"a": "b"}, device="cpu",
    ),
    "load_rule": fixed(npa_envs.load_rule, 2, source="gecko", device="cpu"),
    "shipped_rules": fixed(npa_envs.shipped_rules, task="texture"),
    "scores": fixed(scores, name="gecko"),
    "world_mean": fixed(npa_envs.world_mean, values=torch.rand(2, 3, 4)),
    **{
        f"WorldRandom.{method}": fixed(functools.partial(draw_numbers, method=method), **STREAMS)
        for method in ("uniform", "bernoulli", "integers")
    },
    "WorldRandom.from_keys": fixed(npa_envs.WorldRandom.from_keys, keys=torch.arange(3)),
    "splat": fixed(splat, 2, **DRAWN),
    "periodic_splat": fixed(periodic_splat, 2, **DRAWN),
    "render_gaussians": fixed(
        render_gaussians, 3, means=torch.rand(2, 5, 3), scales=torch.rand(2, 5, 3) * 0.1,
        quaternions=torch.rand(2, 5, 4), opacities=torch.rand(2, 5), colours=torch.rand(2, 5, 3),
        cameras=CAMERAS, background=torch.rand(3), dilation=0.3, pairs_per_particle=20,
    ),
    "Cameras": fixed(Cameras, 2, **vars(CAMERAS)),
    "orbit": fixed(
        orbit, 2, count=2, elevation=20.0, radius=3.0, fov=45.0, width=6, height=5, azimuth=10.0,
        centre=(0.0, 0.0, 0.0), near=0.01,
    ),
    "look_at": fixed(look_at, eyes=torch.rand(2, 3) + 1, targets=(0, 0, 0), up=(0, 1, 0)),
    "cameras_of_poses": fixed(
        cameras_of_poses, camera_to_world=torch.eye(4)[None], angle=0.7, width=4, height=4
    ),
    "draw_worlds": Target(draw_worlds, painted, 3),
    "to_uint8": fixed(to_uint8, picture=torch.rand(2, 4, 4, 4), background=(0.1, 0.2, 0.3)),
    "turntable_frames": fixed(
        functools.partial(turntable_frames, lambda c: torch.rand(1, c.count, c.height, c.width, 4)),
        frame_count=2, resolution=8, elevation=20.0, background="white",
    ),
    "write_gif and write_png": fixed(
        write_pictures, 2, path="a.gif", frames=[np.zeros((8, 6, 3), np.uint8)] * 2, fps=25
    ),
    "damage_worlds": Target(damage, damaged, 2),
    "parse_damage": fixed(parse_damage, text="300:cut:0.1"),
    "uniform_ball": fixed(uniform_ball, world_count=2, particle_count=5, space_dim=2, radius=0.2),
    "uniform_box": fixed(uniform_box, world_count=2, particle_count=5, box=(1.0, 2.0)),
    "preset": Target(configure, configured, 4, constant=("field",)),
    "TrainConfig": Target(reconfigure, configured, 4, constant=("name", "task", "field")),
    "damaged files": Target(read_damaged, damaged_files, 6, constant=("suffix", "content")),
    "environments": Target(
        run_env, env_fields, 10, (gymnasium.error.Error,), constant=("maker", "id")
    ),
    "wrappers and agents": Target(construct, constructed, 5, constant=("name",)),
}  # fmt: skip
"""What is called, by name."""
