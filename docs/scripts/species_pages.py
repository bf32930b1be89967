"""The pages of PettingZoo's environments; `build_environment_pages.py` writes them."""

from __future__ import annotations

import typing
from dataclasses import fields

from draw_species_pictures import CAPTION, FILM, IMAGE
from page_parts import (
    NOTE,
    default_text,
    field_meanings,
    film_and_strip,
    kind_text,
    sections,
    table,
)

from npa_envs.envs import multispecies_v0, particles_v0
from npa_envs.envs.core.config import WorldConfig
from npa_envs.envs.multi import TASKS, SpeciesConfig
from npa_envs.envs.multi.parallel import CrowdEnv

MADE = NOTE.format(script="build_environment_pages.py", source="docstrings")
MODULES = {"MultiSpecies": multispecies_v0, "Particles": particles_v0}
"""Modules by the names of their pages."""

SINGLE = "Of every environment, with their [meanings](Morphogenesis2D.md#arguments)"
SAME = "The worlds are those of `multispecies_v0`, such as these; here every particle is an agent."
EXAMPLE = """\
```python
from npa_envs.envs import {module}

env = {module}.parallel_env("mixing", species_count=2)
observations, infos = env.reset(seed=0)
while env.agents:
    actions = {{agent: env.action_space(agent).sample() for agent in env.agents}}
    observations, rewards, terminations, truncations, infos = env.step(actions)
```"""
RULES = """

Two geckos grow side by side, each by the shipped rule:

```python
import npa_envs
from npa_envs.agents import RulePolicy

policy = RulePolicy(npa_envs.load_rule("gecko"))
env = multispecies_v0.parallel_env("co_morphogenesis", targets=("gecko", "gecko"), max_cycles=200)
observations, infos = env.reset(seed=0)
while env.agents:
    actions = {agent: policy(observation) for agent, observation in observations.items()}
    observations, rewards, terminations, truncations, infos = env.step(actions)
print({agent: round(info["loss"], 2) for agent, info in infos.items()})
```"""


def env_class(name: str) -> type[CrowdEnv]:
    """Return the class that a page is about."""
    found: type[CrowdEnv] = typing.get_type_hints(MODULES[name].parallel_env)["return"]
    return found


def argument_tables() -> str:
    """Return the fields that all tasks have, and of each task those that are its own or differ."""
    single = {field.name: field.default for field in fields(WorldConfig)}
    listed = ", ".join(
        f"`{row[0].strip('`')}={row[2].strip('`')}`" for row in rows(WorldConfig, {})
    )
    tables = [("Of every task, besides or instead", rows(SpeciesConfig, single))]
    usual = {field.name: field.default for field in fields(SpeciesConfig)}
    for task, task_type in TASKS.items():
        if own := rows(task_type.config_type, usual):
            tables.append((f'Of `"{task}"`, besides or instead', own))
    heading = ("Name", "Type", "Default", "Meaning")
    listings = (f"{title}:\n\n{table(heading, own)}" for title, own in tables)
    return "\n\n".join((f"{SINGLE}: {listed}.", *listings))


def rows(config_type: type[WorldConfig], usual: dict[str, typing.Any]) -> list[tuple[str, ...]]:
    """Return rows for the fields of a configuration that `usual` does not hold as they are."""
    meanings, kinds = field_meanings(config_type), typing.get_type_hints(config_type)
    return [
        (
            f"`{field.name}`",
            kind_text(kinds[field.name]),
            default_text(field.default),
            meanings[field.name],
        )
        for field in fields(config_type)
        if field.name not in usual or usual[field.name] != field.default
    ]


def page(name: str) -> str:
    """Return a page, Markdown."""
    module = MODULES[name]
    own, first = (sections(env_class(page)) for page in (name, "MultiSpecies"))
    # What a page does not say is as on the first one.
    link = "As for [several species](MultiSpecies.md#{})."
    text = {
        heading: own.get(heading) or link.format(heading.lower().replace(" ", "-"))
        for heading in first
    }
    if name == "MultiSpecies":
        text["Arguments"] += "\n\n" + argument_tables()
    env = module.parallel_env()
    agent = env.possible_agents[0]
    short = module.__name__.rpartition(".")[2]
    facts = table(
        ("", "By default"),
        [
            ("Agents", f"`{agent}` to `{env.possible_agents[-1]}`"),
            ("Observation space", f"`{env.observation_space(agent)}`"),
            ("Action space", f"`{env.action_space(agent)}`"),
            ("State space", f"float32, shape {env.state_space.shape}"),
            ("Steps of an episode", str(env.max_cycles)),
            ("Functions", "`parallel_env`, `env`, `raw_env`, `batched`"),
            ("Learned by", f"`SpeciesVecEnv({short}.batched(...))`"),
        ],
    )
    example = EXAMPLE.format(module=short) + (RULES if name == "MultiSpecies" else "")
    film = FILM.name
    picture = film_and_strip(CAPTION, film, IMAGE.name)
    shown = picture if name == "MultiSpecies" else f"![{SAME}](../images/{film})\n\n*{SAME}*"
    opening = (f"# npa_envs.envs.{short}", text.pop(""), shown, facts, example)
    body = [f"## {heading}\n\n{content}" for heading, content in text.items()]
    return "\n\n".join((MADE, *opening, *body)) + "\n"


def pages() -> dict[str, str]:
    """Return the pages by their file names."""
    return {f"{name}.md": page(name) for name in MODULES}


def index_rows() -> list[tuple[str, str]]:
    """Return rows for the list of all pages."""
    return [
        (f"[`{module.__name__}`]({name}.md)", sections(env_class(name))[""])
        for name, module in MODULES.items()
    ]
