"""Write the pages of the environments, `docs/environments/`, from docstrings and configurations.

    python docs/scripts/build_environment_pages.py          write the pages
    python docs/scripts/build_environment_pages.py --check  fail where a page is not current

A page is the docstring of an environment's class. Added are the spaces' numbers, which are computed
from the default configuration, and the tables of arguments, whose meanings are the docstrings of
the configuration's fields. After each section comes what `NPAEnv` says there of all environments; a
section that an environment has not is that of `Morphogenesis2DEnv`. What is long and the same for
all stands on the first page alone, and the others link to it.
"""

from __future__ import annotations

import importlib
import inspect
import json
import re
import sys
import typing
from dataclasses import MISSING, fields
from pathlib import Path
from statistics import mean

import gardeners_page
import species_pages
from draw_environment_pictures import FILMS, film_path, picture_path
from page_parts import (
    default_text,
    field_meanings,
    film_and_strip,
    kind_text,
    sections,
    table,
    write_or_check,
)

from npa_envs.envs.core.base import ParticleSpaces
from npa_envs.envs.core.config import EnvConfig
from npa_envs.envs.core.single import NPAEnv
from npa_envs.envs.core.vector import NPAVectorEnv
from npa_envs.envs.garden.base import GardenEnv
from npa_envs.envs.trained_rules import RuleDrivenWorlds
from npa_envs.registration import (
    ALL,
    CENTRAL,
    CODED,
    ENVIRONMENTS,
    GARDENS,
    SIZES,
    SMALL,
    Registration,
)

DOCS = Path(__file__).resolve().parents[1]
PAGES = DOCS / "environments"
EXAMPLE = """\
```python
import gymnasium as gym
import npa_envs

env = gym.make("{id}")
observation, info = env.reset(seed=0)
observation, reward, terminated, truncated, info = env.step(env.action_space.sample())

# Eight worlds as one batch; device="cuda" puts it on a GPU.
envs = gym.make_vec("{id}", num_envs=8)
```"""
FIRST = ENVIRONMENTS[0]
ONCE = {
    "Reward": "The values of `reward` mean the same in [every environment]({page}#reward).",
    "Starting state": "Seeds are those of [every environment]({page}#starting-state).",
    "Episode end": "Causes and reasons are those of [every environment]({page}#episode-end).",
    "Central control": "It is as in [every environment]({page}#central-control).",
    "Rendering": "Modes and styles are those of [every environment]({page}#rendering).",
    "Vectorized environment": "Batches of worlds and the arguments of `gym.make_vec` are those of "
    "[every environment]({page}#vectorized-environment).",
    "References": "See [the paper]({page}#references).",
}
"""Sections whose common part is on the first page alone, and what the others have instead."""

MEASURED = "[measured](../training.md#defaults-that-learn)"
COLUMNS = re.compile(r"\| `([^`]+) : ([^`]+)` \|")


def environment_class(registration: Registration) -> type[NPAEnv]:
    """Return the class of a single environment."""
    found: type[NPAEnv] = getattr(
        importlib.import_module(registration.module), f"{registration.name}Env"
    )
    return found


def resolved_sections(env_class: type) -> dict[str, str]:
    """Return the sections with what is said of all environments, in one order."""
    own = sections(env_class)
    first = sections(environment_class(FIRST))
    shared = sections(NPAEnv)
    if "control" in env_class.task_type.config_type.fixed:
        del shared["Central control"]
    order = [name for name in (first | shared) if name]
    if env_class.task_type.worlds_type is RuleDrivenWorlds:
        # They pay and tell otherwise; all else that they do not say is said of all environments.
        del shared["Reward"], shared["Info"]
        first = {}
    if env_class is not environment_class(FIRST):
        shared |= {
            heading: link.format(page=f"{FIRST.name}.md")
            for heading, link in ONCE.items()
            if heading in shared
        }
    if issubclass(env_class, GardenEnv):
        gardens = {heading: text for heading, text in sections(GardenEnv).items() if heading}
        if env_class is not environment_class(GARDENS[0]):
            page = f"{GARDENS[0].name}.md"
            gardens = {
                heading: f"As in [every garden]({page}#{heading.lower().replace(' ', '-')})."
                for heading in gardens
                if heading != "Info"
            } | {"Info": gardens["Info"]}
        shared |= gardens
    found = {"": own[""]}
    for heading in order:
        said = own.get(heading) or first.get(heading)
        if heading == "Observation space" and first and said and "| Columns |" not in said:
            # The first page says what a row begins with.
            said = f"{first[heading]}\n\n{said}"
        parts = said, shared.get(heading)
        found[heading] = "\n\n".join(part for part in parts if part)
    return found


def argument_tables(config_type: type[EnvConfig]) -> str:
    """Return the fields of a configuration as tables: the task's own, then those that all have."""
    meanings, kinds = field_meanings(config_type), typing.get_type_hints(config_type)
    own: list[tuple[str, ...]] = []
    shared: list[tuple[str, ...]] = []
    for field in fields(config_type):
        assert field.default is not MISSING, f"{field.name} has no default"
        row = (
            f"`{field.name}`",
            kind_text(kinds[field.name]),
            default_text(field.default),
            meanings[field.name],
        )
        changed = any(field.name in cls.__annotations__ for cls in task_bases(config_type))
        (own if changed else shared).append(row)
    heading = ("Name", "Type", "Default", "Meaning")
    listed, opening = table(heading, shared), "Of every environment:"
    if config_type is not environment_class(FIRST).task_type.config_type:
        listed = ", ".join(f"`{row[0].strip('`')}={row[2].strip('`')}`" for row in shared) + "."
        opening = f"Of every environment, with their [meanings]({FIRST.name}.md#arguments):"
    return "\n\n".join(("Of this task:", table(heading, own), opening, listed))


def small_forms(registration: Registration) -> str:
    """Return what ids with other keywords there are of an environment, Markdown."""
    told = ""
    for small in (*SMALL, *SIZES, *CENTRAL):
        if small.name == registration.name:
            given = ", ".join(
                f"`{name}={default_text(value).strip('`')}`"
                for name, value in small.keywords.items()
            )
            told += f"\n\n`{small.id}` is the same environment with {given}."
    return told


def task_bases(config_type: type[EnvConfig]) -> list[type]:
    """Return the classes of a configuration below the one that all environments share."""
    return [cls for cls in config_type.__mro__ if issubclass(cls, EnvConfig) and cls != EnvConfig]


def vector_table() -> str:
    """Return what only `gym.make_vec` takes as a table, from the docstring of the base class."""
    text = inspect.cleandoc(NPAVectorEnv.__doc__ or "").split("Args:\n")[1].split("\n\n")[0]
    parts = re.split(r"^    (\w+): ", text, flags=re.MULTILINE)
    meanings = dict(zip(parts[1::2], parts[2::2], strict=True))
    rows = [
        (f"`{name}`", default_text(parameter.default), meanings[name].strip())
        for name, parameter in inspect.signature(NPAVectorEnv).parameters.items()
        if parameter.kind is not parameter.VAR_KEYWORD
    ]
    opening = "Only `gym.make_vec` takes these; it gives `max_episode_steps` by itself:"
    return f"{opening}\n\n{table(('Name', 'Default', 'Meaning'), rows)}"


def numbered_columns(text: str, letters: dict[str, int], width: int) -> str:
    """Give tables of columns such as `C : 2C` a second column with the numbers.

    Args:
        text: A section with such a table.
        letters: What the letters stand for.
        width: How many columns there are; the table has to name each once, in order.
    """
    reached = 0

    def number(formula: str) -> int:
        product = re.sub(r"(?<=\d)(?=[A-Z])", "*", formula)
        return int(eval(product, {"__builtins__": {}}, letters))

    def with_numbers(match: re.Match[str]) -> str:
        nonlocal reached
        first, end = number(match[1]), number(match[2])
        assert first == reached, f"columns {match[0]} do not follow on {reached}"
        reached = end
        return f"{match[0]} {first} to {end - 1} |"

    text = text.replace("| Columns |", "| Columns | By default |").replace("|---|", "|---|---|", 1)
    text = COLUMNS.sub(with_numbers, text)
    assert reached == width, f"the table names {reached} columns of {width}"
    return text


def page(registration: Registration) -> str:
    """Return the page of an environment, Markdown."""
    env_class = environment_class(registration)
    task = env_class.task_type
    config = task.config_type()
    physics = config.physics(task.space_dim, static=task.static)
    count = config.particle_count
    described = (task.spaces_type or ParticleSpaces)(physics, config)
    spaces = {
        "Observation space": described.observation_space,
        "Action space": described.action_space,
    }
    letters = {"C": config.state_dim, "D": task.space_dim, "N": count}
    text = resolved_sections(env_class)
    if task.worlds_type is not RuleDrivenWorlds:
        for heading, space in spaces.items():
            text[heading] = numbered_columns(text[heading], letters, space.shape[1])
    text["Arguments"] += "\n\n" + argument_tables(task.config_type)
    text["Arguments"] += small_forms(registration)
    if registration is FIRST:
        text["Vectorized environment"] += "\n\n" + vector_table()
    facts = table(
        ("", "By default"),
        [
            ("Particles N, channels C", f"{count}, {config.state_dim}"),
            *((heading, f"`{space}`") for heading, space in spaces.items()),
            ("Steps of an episode", str(registration.max_episode_steps)),
            *learned_by(registration),
            ("Classes", f"`{registration.entry_point}`, `{registration.vector_entry_point}`"),
        ],
    )
    opening = (f"# {registration.id}", text.pop(""), picture(registration), facts)
    example = EXAMPLE.format(id=registration.id)
    body = [f"## {heading}\n\n{content}" for heading, content in text.items()]
    return "\n\n".join((species_pages.MADE, *opening, example, *body)) + "\n"


def learned_by(registration: Registration) -> list[tuple[str, str]]:
    """Return the row of an environment's first table that says what learns it, or takes it."""
    task, name = environment_class(registration).task_type, registration.name
    if registration in CODED:
        return [("Learned by", '[PPO](#description), with `actions="choice"`')]
    if task.worlds_type is RuleDrivenWorlds:
        return [("Learned by", f"[PPO](../gardening.md): {garden_returns(name)} ({MEASURED})")]
    if "control" in task.config_type.fixed:
        return [("Taken by", "`ParticleVecEnv`; nothing measured")]
    central = [f"`{row.id}`" for row in CENTRAL if row.name == name]
    if not central:
        learned = "[some methods](../npa_bench.md#results)"
        return [("Learned by", f'{learned}; `ParticleVecEnv` and `control="central"` take it')]
    ending = " ([tutorial](../tutorial.md))" if registration is FIRST else " takes it"
    learned = f'`control="central"`, {central[0]} ({MEASURED}); `ParticleVecEnv`{ending}'
    return [("Learned by", learned)]


def garden_returns(name: str) -> str:
    """Return what PPO and the script earn in a small garden, by the record of defaults."""
    id = f"npa/{name}Small-v0"
    record = gardeners_page.RESULTS / "defaults_cpu.json"
    runs = [run for run in json.loads(record.read_text("utf-8"))["runs"] if run["id"] == id]
    learned, script = (
        mean(mean(run["return"]) for run in runs if (run["learner"], run.get("seconds")) == kind)
        for kind in (("PPO", 900), ("scripted", None))
    )
    return f"return {learned:.1f} of `{id}` in 900 s; script: {script:.1f}"


def size_table() -> str:
    """Return all ids with their sizes as a table, Markdown."""
    rows = []
    for row in sorted(ALL, key=lambda one: (one.module, len(one.id))):
        env = environment_class(row)(**row.keywords)
        shape = str(list(env.action_space.shape or ())).replace(", ", "×")
        sizes = str(env.config.particle_count), str(row.max_episode_steps), shape
        rows.append((f"`{row.id}`", *sizes))
    return table(("Id", "Particles", "Steps", "Action"), rows)


def picture(registration: Registration) -> str:
    """Return the film and the picture with their caption, Markdown."""
    names = film_path(registration).name, picture_path(registration).name
    return film_and_strip(FILMS[registration.name].caption, *names)


def index() -> str:
    """Return the list of the pages, Markdown."""
    rows: list[tuple[str, ...]] = []
    for registration in (*ENVIRONMENTS, *GARDENS, *CODED):
        text = sections(environment_class(registration))[""]
        rows.append((f"[`{registration.id}`]({registration.name}.md)", text))
    opening = (
        "One page each. `import npa_envs` "
        'registers the ids; `gym.make("npa_envs:npa/Texture-v0")` does so by itself. Words and '
        "letters are "
        "explained in [the glossary](../glossary.md). To train a first policy: "
        "[the tutorial](../tutorial.md). [To make one of your own](../own_environment.md)."
    )
    rows += [gardeners_page.index_row(), *species_pages.index_rows()]
    listing = table(("Environment", "Task"), rows)
    others = (
        "PettingZoo's ids, listed on their modules' pages, need the module: `import "
        'npa_envs.envs.multispecies_v0`, then `pettingzoo.make("parallel", "npa/MixingSmall-v0")`.'
    )
    parts = (species_pages.MADE, "# Environments", opening, listing, size_table(), others)
    return "\n\n".join(parts) + "\n"


def pages() -> dict[str, str]:
    """Return all pages by their file names."""
    listed = (*ENVIRONMENTS, *GARDENS, *CODED)
    made = {f"{registration.name}.md": page(registration) for registration in listed}
    made[f"{gardeners_page.NAME}.md"] = gardeners_page.page()
    return made | species_pages.pages() | {"README.md": index()}


def main(arguments: list[str] | None = None, folder: Path = PAGES) -> int:
    """Write or check the pages of a folder; return the exit status."""
    there = [path.name for path in folder.glob("*.md")]
    return write_or_check(folder, pages(), there, __doc__, arguments)


if __name__ == "__main__":
    sys.exit(main())
