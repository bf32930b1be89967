"""Fuzz test: calls of operators, rules, pictures and cameras, with legal arguments."""

import functools
import random
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import torch
from fuzz_values import Target, read_file
from torch import Tensor

import npa_envs
from npa_envs.measure.quality import scores
from npa_envs.ops import Cameras, orbit, periodic_splat, render_gaussians, splat
from npa_envs.ops.pictures.cameras import cameras_of_poses, look_at
from npa_envs.render import draw_worlds, to_uint8, turntable_frames, write_gif, write_png
from npa_envs.tasks.damage import damage_worlds, parse_damage
from npa_envs.tasks.seeds import uniform_ball, uniform_box


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


ONE_STEP = object()


def run_rule(steps: Any = ONE_STEP, **arguments: Any) -> None:
    """Run a rule, and back-propagate if any argument requires gradients."""
    run = npa_envs.step if steps is ONE_STEP else functools.partial(npa_envs.rollout, steps=steps)
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


def load_bytes(data: Any, suffix: Any) -> None:
    read_file(npa_envs.load_rule, f"rule{suffix}", data)


@functools.cache
def shipped_bytes() -> bytes:
    return npa_envs.shipped_rules()["gecko"].read_bytes()


def garbage(draw: random.Random) -> dict[str, Any]:
    data = bytearray(shipped_bytes())
    for _ in range(draw.choice((0, 1, 5, 50))):
        data[draw.randrange(min(len(data), draw.choice((16, 1200, 10**6))))] = draw.randrange(256)
    suffix = draw.choice((".safetensors", ".pth", ".pt", ".json"))
    return {"data": bytes(data[: draw.choice((0, 7, 8, 300, len(data)))]), "suffix": suffix}


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


def damaged(draw: random.Random) -> dict[str, Any]:
    kind = draw.choice(("wipe", "cut", "clump", "noise"))
    return world(draw) | {"kind": kind, "size": 0.1, "generator": None}


def fixed(function: Callable[..., Any], weight: float = 1.0, **arguments: Any) -> Target:
    """Return a target whose legal arguments are always the same."""
    return Target(function, lambda draw: dict(arguments), weight)


CAMERAS = orbit(2, width=6, height=5)
DRAWN: dict[str, Any] = {
    "x": torch.rand(2, 5, 2), "colour": torch.rand(2, 5, 3), "sigma": 1.0, "resolution": 8,
    "pixel_size": 0.2, "lo": -1.0, "hi": 1.0,
}  # fmt: skip
STREAMS: dict[str, Any] = {"seeds": [0, 1], "device": "cpu", "size": 3, "extra": 1}

ENGINE: dict[str, Target] = {
    "perceive": Target(npa_envs.perceive, lambda d: world(d) | PERCEIVED, 4),
    "perception_fields": Target(npa_envs.perception_fields, lambda d: world(d) | FIELDS, 2),
    "perceive_species": Target(
        npa_envs.perceive_species, lambda d: world(d) | PERCEIVED | {"counts": [2, 3]}, 2
    ),
    "species_fields": Target(
        npa_envs.species_fields, lambda d: {"x": world(d)["x"], "counts": [2, 3]} | FIELDS, 2
    ),
    "step": Target(run_rule, stepped, 3),
    "rollout": Target(run_rule, rolled, 5),
    "rollout_species": Target(npa_envs.rollout_species, rolled_species, 5),
    "NPARule": Target(npa_envs.NPARule, hyper_parameters, 2),
    "save_rule": fixed(
        save_and_load, 2, rule=npa_envs.NPARule(2, 3, 4), path="a.safetensors",
        metadata={"a": "b"}, device="cpu",
    ),
    "load_rule": fixed(npa_envs.load_rule, 2, source="gecko", device="cpu"),
    "load_rule of a file": Target(load_bytes, garbage, 3),
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
    "damage_worlds": Target(damage_worlds, damaged, 2),
    "parse_damage": fixed(parse_damage, text="300:cut:0.1"),
    "uniform_ball": fixed(uniform_ball, world_count=2, particle_count=5, space_dim=2, radius=0.2),
    "uniform_box": fixed(uniform_box, world_count=2, particle_count=5, box=(1.0, 2.0)),
}  # fmt: skip
"""Targets by name."""
