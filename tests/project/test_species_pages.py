"""The pages of PettingZoo's environments name what is there, and their code runs."""

from __future__ import annotations

import re
from dataclasses import fields
from pathlib import Path

import numpy as np
import pytest
from crowds import TASKS, small, still

from npa_envs.envs import multispecies_v0, particles_v0
from npa_envs.envs.multi import TASKS as TABLE

PAGES = Path(__file__).resolve().parents[2] / "docs" / "environments"
MODULES = {"MultiSpecies": multispecies_v0, "Particles": particles_v0}
every_page = pytest.mark.parametrize("name", MODULES)


def text_of(name: str) -> str:
    return (PAGES / f"{name}.md").read_text()


def section(name: str, heading: str) -> str:
    return text_of(name).split(f"\n## {heading}\n")[1].split("\n## ")[0]


def first_cells(text: str) -> list[str]:
    return re.findall(r"^\| `([^`]+)`", text, re.MULTILINE)


@every_page
def test_the_examples_of_a_page_run(name, capsys):
    names = {}
    for block in re.findall(r"^```python\n(.*?)^```", text_of(name), re.MULTILINE | re.DOTALL):
        # Small and short worlds: what is tested is that the calls are right.
        few = "particle_count=40, max_cycles=4)"
        small_block = re.sub(r"species_count=2\)", f"species_count=2, {few}", block)
        small_block = re.sub(r"max_cycles=200\)", few, small_block)
        assert small_block.count(few) == 1
        exec(small_block, names)
    assert names["env"].agents == []
    agent = names["env"].possible_agents[-1]
    assert names["infos"][agent]["reason"] == "time limit"
    if name == "MultiSpecies":
        assert re.fullmatch(
            r"\{'species_0': [\d.]+, 'species_1': [\d.]+\}\n", capsys.readouterr().out
        )


def test_the_page_lists_the_arguments_of_every_task_with_their_defaults():
    shared, *own = section("MultiSpecies", "Arguments").split("\nOf `")
    tables = {part.split('"')[1]: part for part in own}
    for task, task_type in TABLE.items():
        listed = first_cells(shared) + first_cells(tables.get(task, ""))
        config = task_type.config_type()
        assert set(listed) == {field.name for field in fields(config)}
        for field in fields(config):
            row = f"| `{field.name}` |"
            part = tables[task] if row in tables.get(task, "") else shared
            (line,) = [line for line in part.splitlines() if line.startswith(row)]
            value = getattr(config, field.name)
            shown = f'"{value}"' if isinstance(value, str) else str(value)
            assert line.split(" | ")[2] == f"`{shown}`"


@every_page
@pytest.mark.parametrize("task", TASKS)
def test_a_page_names_the_keys_of_info_and_the_parts_of_the_loss(name, task):
    env = MODULES[name].parallel_env(**small(task, particle_count=8, max_cycles=1))
    _, at_reset = env.reset(seed=0)
    *_, at_step = env.step(still(env))
    agent = env.possible_agents[0]
    (row,) = [line for line in section(name, "Reward").splitlines() if f"| {task} |" in line]
    parts = re.findall(r"`(\w+)`", row.split(" | ")[-1])
    assert set(at_reset[agent]) == {"species", "loss", *(f"loss_{part}" for part in parts)}
    gained = {f"reward_{part}" for part in parts}
    assert set(at_step[agent]) == set(at_reset[agent]) | gained | {"reason"}
    assert {"species", "loss", "reason"} <= set(first_cells(section(name, "Info")))


@every_page
def test_a_page_tells_spaces_and_agents_as_they_are(name):
    env = MODULES[name].parallel_env()
    head = text_of(name).split("```")[0]
    for shown in (
        f"`{env.possible_agents[0]}` to `{env.possible_agents[-1]}`",
        f"`{env.observation_space(env.possible_agents[0])}`",
        f"`{env.action_space(env.possible_agents[0])}`",
        f"shape {env.state_space.shape}",
        f"| {env.max_cycles} |",
    ):
        assert shown in head


@every_page
def test_the_page_lists_tasks_with_their_ids(name):
    rows = re.findall(r'^\| `"(\w+)"` \| `([^`]+)` \|', text_of(name), re.MULTILINE)
    assert {id_: task for task, id_ in rows} == MODULES[name].ENVIRONMENTS


def test_the_page_tells_how_episodes_end():
    listed = re.findall(r'`"([^`"]+)"` \|$', section("MultiSpecies", "Episode end"), re.MULTILINE)
    reasons = set()
    for task, keywords in (("invasion", {"deaths": ((1, 1),)}), ("mixing", {"max_cycles": 1})):
        env = multispecies_v0.parallel_env(**small(task, **keywords))
        env.reset(seed=0)
        reasons |= {info["reason"] for info in env.step(still(env))[-1].values()}
    env = multispecies_v0.parallel_env(**small("mixing", particle_counts=(1, 1)))
    env.reset(seed=0)
    env.place_particles(np.full((2, 2), 4.0), np.zeros((2, 16)))
    reasons |= {info["reason"] for info in env.step(still(env))[-1].values()}
    assert set(listed) == reasons
