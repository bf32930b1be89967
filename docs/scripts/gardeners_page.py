"""The page of `npa_envs.envs.gardeners_v0`, and its film.

    python docs/scripts/gardeners_page.py       draw `docs/images/env_gardeners.*`

`build_environment_pages.py` writes the page. Drawing takes a minute on a CPU. Draw anew when the
environment changes.
"""

from __future__ import annotations

import json

import numpy as np
from draw_environment_pictures import FILM_SIZE, PICTURE_SIZE, film_steps
from films import FPS, IMAGES, Frame
from page_parts import NOTE, film_and_strip, sections, table

from npa_envs.agents.garden_policies import RandomGardener, ScriptedGardener, StillGardener
from npa_envs.envs import gardeners_v0
from npa_envs.render import write_filmstrip, write_webp

NAME = "Gardeners"
IMAGE = IMAGES / "env_gardeners_strip.webp"
RESULTS = IMAGES.parents[1] / "benchmarks" / "results"
FILM = IMAGES / "env_gardeners.webp"
STEPS = (0, 4, 8, 16, 24, 32)
CAPTION = (
    "The raider pushes at random. In the first world the keeper does nothing, in the second it is "
    "`ScriptedGardener`."
)
KEEPERS = (StillGardener, ScriptedGardener)
EXAMPLE = """\
```python
from npa_envs.agents.garden_policies import RandomGardener, ScriptedGardener
from npa_envs.envs import gardeners_v0

env = gardeners_v0.parallel_env(max_cycles=32)
policies = {"keeper_0": ScriptedGardener(env.garden), "raider_0": RandomGardener(env.garden)}
observations, infos = env.reset(seed=0)
while env.agents:
    actions = {agent: act(observations[agent]) for agent, act in policies.items()}
    observations, rewards, terminations, truncations, infos = env.step(actions)
print(rewards)  # they sum to zero
```"""


def page() -> str:
    """Return the page, Markdown."""
    text = sections(gardeners_v0.GardenersEnv)
    env = gardeners_v0.parallel_env()
    first = env.possible_agents[0]
    facts = table(
        ("", "By default"),
        [
            ("Agents", f"`{first}` and `{env.possible_agents[1]}`"),
            ("Observation space", f"`{env.observation_space(first)}`"),
            ("Action space", f"`{env.action_space(first)}`"),
            ("Steps of an episode", str(env.max_cycles)),
            ("Functions", "`parallel_env`, `env`, `raw_env`, `batched`"),
            ("Learned by", f"[MAPPO](../recipes_rl.md#many-agents): {keeper_returns()}"),
        ],
    )
    made = NOTE.format(script="build_environment_pages.py", source="docstrings")
    shown = film_and_strip(CAPTION, FILM.name, IMAGE.name)
    opening = ("# npa_envs.envs.gardeners_v0", text.pop(""), shown, facts, EXAMPLE)
    body = [f"## {heading}\n\n{content}" for heading, content in text.items()]
    return "\n\n".join((made, *opening, *body)) + "\n"


def keeper_returns() -> str:
    """Return what the keeper earns, learned and idle, by the record of the programs."""
    record = json.loads((RESULTS / "examples_cpu.json").read_text(encoding="utf-8"))
    (run,) = (run for run in record["runs"] if run["name"] == "mappo_gardeners")
    return f"the keeper's return {run['learned'][0]:.1f}, without action {run['zero'][0]:.1f}"


def index_row() -> tuple[str, str]:
    """Return the row for the list of all pages."""
    return f"[`npa_envs.envs.gardeners_v0`]({NAME}.md)", sections(gardeners_v0.GardenersEnv)[""]


def film(keeper: type[StillGardener | ScriptedGardener], size: int) -> dict[int, Frame]:
    """Return the pictures of one episode, uint8, shape [size, size, 3], by step."""
    last = max(STEPS)
    env = gardeners_v0.parallel_env(last + 1, render_mode="rgb_array", render_size=size)
    policies = dict(
        zip(env.possible_agents, (keeper(env.garden), RandomGardener(env.garden)), strict=True)
    )
    observations, _ = env.reset(seed=3)
    shown = {*STEPS, *film_steps(last)}
    frames = {}
    for step in range(last + 1):
        if step in shown:
            frames[step] = np.asarray(env.render())
        actions = {agent: policy(observations[agent]) for agent, policy in policies.items()}
        observations, *_ = env.step(actions)
    return frames


if __name__ == "__main__":
    strips = [film(keeper, PICTURE_SIZE) for keeper in KEEPERS]
    write_filmstrip(
        IMAGE,
        [frames[step] for frames in strips for step in STEPS],
        [f"step {step}" for _ in strips for step in STEPS],
        columns=len(STEPS),
    )
    worlds = [film(keeper, FILM_SIZE[len(KEEPERS)]) for keeper in KEEPERS]
    write_webp(
        IMAGE.with_suffix(".webp"),
        [np.hstack([frames[step] for frames in worlds]) for step in film_steps(max(STEPS))],
        FPS,
    )
