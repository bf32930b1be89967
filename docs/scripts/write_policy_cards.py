"""Measure the shipped policies on held-out seeds, and write their cards, `agents/shipped/*.md`.

python docs/scripts/write_policy_cards.py
"""

from __future__ import annotations

import math
from collections.abc import Callable
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import torch

from npa_envs.agents import NetworkPolicy, load_policy, shipped_policies
from npa_envs.agents.network_policies import FORMAT_NAME
from npa_envs.atomic_files import write_bytes
from npa_envs.measure.benchmark_records import machine
from npa_envs.rule.files import read_tensors

SEEDS = range(2_000_000, 2_000_016)
METRICS = ("loss", "accuracy", "distance", "is_success")
GARDENS = ("Gardener", "Shepherd")


def episode(env: Any, policy: Callable[[Any], Any], seed: int) -> list[float]:
    """Return the return of an episode, and the metrics after its last step that infos have."""
    observation, info = env.reset(seed=seed)
    total, over = 0.0, False
    while not over:
        observation, reward, terminated, truncated, info = env.step(policy(observation))
        total, over = total + float(reward), terminated or truncated
    return [total, *(float(info[name]) for name in METRICS if name in info)]


def card(id: str, path: Path) -> str:
    """Return the text of a policy's card, with its measurements."""
    header, _ = read_tensors(path, FORMAT_NAME)
    env = gymnasium.make(id)
    _, info = env.reset(seed=0)
    names = ["return", *(name for name in METRICS if name in info)]
    known = ["shipped", "zero", "random", *["scripted"] * any(name in id for name in GARDENS)]
    lines = []
    for name in known:
        policy = load_policy(name, env)
        values = np.array([episode(env, policy, seed) for seed in SEEDS])
        errors = values.std(axis=0, ddof=1) / math.sqrt(len(values))
        cells = (f"{m:.3g} ± {e:.2g}" for m, e in zip(values.mean(axis=0), errors, strict=True))
        lines.append(f"| {name} | {' | '.join(cells)} |")
    layers = NetworkPolicy.load(path).network[::2]
    sizes = [layers[0].in_features, *(layer.out_features for layer in layers)]
    return f"""# {id}

The policy `shipped` of `{id}`: PPO of Stable-Baselines3, without noise.

| | |
|---|---|
| network | {" → ".join(map(str, sizes))}, tanh between layers, float32 |
| made by | `{header["command"]} --policy {path.name}` |
| watched by | `npa-envs view {id} --policy shipped` |

Measured in {len(SEEDS)} held-out episodes, from the seeds {SEEDS[0]} to {SEEDS[-1]}: means with
standard errors; metrics are those after the last step. {machine(torch.device("cpu"))}, one thread.

| policy | {" | ".join(names)} |
|---|{"---|" * len(names)}
{chr(10).join(lines)}
"""


if __name__ == "__main__":
    torch.set_num_threads(1)
    for id, path in shipped_policies().items():
        text = card(id, path)
        print(text)
        write_bytes(path.with_suffix(".md"), text.encode())
