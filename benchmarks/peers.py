"""What `environments.py` compares with: Gymnasium's own vectorisation, and VMAS if installed.

Gymnasium steps B of our single environments one after the other ("sync") or in B processes
("async"). VMAS (github.com/proroklab/VectorizedMultiAgentSimulator) batches worlds of agents in
torch; its scenarios with the most agents are counted in agent-steps a second, without resets.
"""

from __future__ import annotations

import importlib.util
import statistics
import time
from collections.abc import Callable, Iterator
from typing import Any

import gymnasium
import torch

from npa_envs.measure.speed.timing import synchronize

GYMNASIUM_WORLDS, GYMNASIUM_PARTICLES = 8, 1024
EPISODE_STEPS = 64

VMAS_WORLDS = (32, 1024)
VMAS_SCENARIOS: tuple[tuple[str, dict[str, int]], ...] = (
    ("dispersion", {"n_agents": 16, "n_food": 16}),
    ("dispersion", {"n_agents": 64, "n_food": 64}),
    ("flocking", {"n_agents": 16}),
    ("flocking", {"n_agents": 64}),
)
VMAS_SECONDS = 3.0


def median_time(run: Callable[[], None], device: torch.device, seconds: float) -> float:
    """Return the median time of a call in seconds, from at least three and about `seconds`."""
    times: list[float] = []
    run()
    while len(times) < 3 or sum(times) < seconds:
        synchronize(device)
        start = time.perf_counter()
        run()
        synchronize(device)
        times.append(time.perf_counter() - start)
    return statistics.median(times)


def measure_gymnasium(mode: str, quick: bool, calm: float) -> dict[str, Any]:
    """Return the row of Gymnasium's own vectorisation of the single environment, on the CPU."""
    world_count = 2 if quick else GYMNASIUM_WORLDS
    particle_count = 64 if quick else GYMNASIUM_PARTICLES
    # A process that is forked would share locks and a CUDA context with this one.
    options = {"context": "spawn"} if mode == "async" else {}
    env = gymnasium.make_vec(
        "npa_envs:npa/Morphogenesis2D-v0",
        num_envs=world_count,
        vectorization_mode=mode,
        vector_kwargs=options,
        particle_count=particle_count,
        max_episode_steps=EPISODE_STEPS,
    )
    env.action_space.seed(0)
    sets = [calm * env.action_space.sample() for _ in range(4)]
    env.reset(seed=0)

    def run() -> None:
        for k in range(EPISODE_STEPS):
            env.step(sets[k % len(sets)])

    taken = median_time(run, torch.device("cpu"), 0.0 if quick else 2.0) / EPISODE_STEPS
    env.close()
    return {
        "peer": f"gymnasium {mode}",
        "world_count": world_count,
        "particle_count": particle_count,
        "step_us": taken * 1e6,
        "particle_steps_per_s": world_count * particle_count / taken,
    }


def measure_vmas(
    scenario: str, keywords: dict[str, int], world_count: int, device: torch.device, quick: bool
) -> dict[str, Any]:
    """Return the row of one of VMAS's scenarios."""
    from vmas import make_env

    env = make_env(
        scenario=scenario,
        num_envs=world_count,
        device=str(device),
        continuous_actions=True,
        seed=0,
        **keywords,
    )
    env.reset()
    generator = torch.Generator(device).manual_seed(0)
    actions = [
        torch.rand(
            world_count, env.get_agent_action_size(agent), generator=generator, device=device
        )
        * 2.0
        - 1.0
        for agent in env.agents
    ]

    def run() -> None:
        env.step(actions)

    taken = median_time(run, device, 0.0 if quick else VMAS_SECONDS)
    return {
        "peer": f"vmas {scenario}",
        "world_count": world_count,
        "agent_count": len(env.agents),
        "step_us": taken * 1e6,
        "agent_steps_per_s": world_count * len(env.agents) / taken,
    }


def measure_all(device: torch.device, quick: bool, calm: float) -> Iterator[dict[str, Any]]:
    """Yield a row for each peer: Gymnasium's on a CPU, and VMAS's on the device.

    `calm` scales the actions in our environments, as in `environments.py`.
    """
    if device.type == "cpu":
        for mode in ("sync", "async"):
            yield measure_gymnasium(mode, quick, calm)
    if importlib.util.find_spec("vmas") is None:
        print("vmas is not installed, and is left out: pip install vmas")
        return
    for scenario, keywords in VMAS_SCENARIOS[:1] if quick else VMAS_SCENARIOS:
        for world_count in VMAS_WORLDS[:1] if quick else VMAS_WORLDS:
            yield measure_vmas(scenario, keywords, world_count, device, quick)
