"""The end of `npa-envs train` (no command of its own): measures, films and model card of a rule."""

from __future__ import annotations

import itertools
import json
import math
import shlex
from collections.abc import Callable, Mapping, Sequence
from dataclasses import fields
from datetime import date
from pathlib import Path
from typing import TYPE_CHECKING, Any, cast

import torch

from npa_envs.atomic_files import write_text
from npa_envs.cli import common
from npa_envs.errors import MissingDependencyError
from npa_envs.measure.benchmark_records import (
    UNMEASURED,
    current_commit,
    machine,
    markdown_table,
    table_markdown,
    tables_json,
    versions,
)
from npa_envs.measure.quality import (
    CHECKPOINTS,
    CLOUD_CHECKPOINTS,
    FIRST_SEED,
    STATE_STEPS,
    hidden_states,
    picture_rows,
    picture_step_count,
    score_line,
    step_count,
    tables_of,
)
from npa_envs.measure.wounds import WoundRow
from npa_envs.render.colours import to_uint8
from npa_envs.render.picture_files import write_filmstrip, write_gif
from npa_envs.render.world_film import SCREEN, film_states, film_world, write_3d_world
from npa_envs.rule.files import load_rule
from npa_envs.tasks.damage import DamageEvent
from npa_envs.training import RunFolder, TrainConfig, check_device, config_to_dict, task_entry
from npa_envs.training.task_of_rule import task_for_film, task_of_rule, tasks_of_codes

if TYPE_CHECKING:
    from npa_envs.rule.rule import NPARule
    from npa_envs.tasks.base import Task
    from npa_envs.tasks.point_classification import PointClassification

FILM_STEPS = 512
"""Steps of the film."""

TITLES: Mapping[str, str] = {
    "healing": "After damage:",
    "pictures": "Each picture by its own code, and by that of the next one, shuffled:",
    "judge": "Distances that no loss uses; 1: between a quarter of the target and the whole:",
    "changes": "Some steps after a change of the clouds:",
}
"""Lines above tables of a model card."""

WORDS: Mapping[str, str] = {
    "step": "updates since the seed",
    "loss": "distance from the target, 0 if equal; training lowers it",
    "loss_worst": "that of the worst world",
    "psnr": "likeness of pictures [dB]: 20 is rough, 30 looks alike",
    "psnr_worst": "that of the worst world",
    "overflow": "how far states leave [-1, 1]; it stays small in a stable world",
    "extent": "longest side of the world [length units]; it grows where particles escape",
    "damage": "what is done to grown worlds: states set to zero in a disk, or a slit",
    "wounds": "places that are damaged, one in each copy of a world",
    "changed": "wounds that leave a mark: the loss near them rises by more than a quarter, and by "
    "more than a tenth of the whole picture's loss",
    "healed": "changed wounds whose mark is gone at the end",
    "scars": "parts of the body where wounds did not heal",
    "before": "loss before the damage; of wounds, near them",
    "after": "that right after the damage",
    "end": "that at the end",
    "steps_to_heal": "steps until the mean loss is back",
    "worlds_healed": "worlds whose own loss is back",
    "ratio": "mean of the three distances: of shapes, of contrasts and of colours",
    "ratio_worst": "that of the worst world",
    "majority": "share of clouds whose majority of particles is right",
    "particle": "share of particles that are right",
    "agreement": "share of particles that agree with their cloud's majority",
    "majority_before": "share of clouds that are still taken for what they were",
    "shuffled": "loss of worlds that have the next picture's code",
}
"""Columns of a card's tables -> one line that explains them."""

GROWN = 200
"""Step of the film's world that is shown beside the target; then it is damaged."""

LIKENESS = 20.0
"""PSNR [dB] below which a card says that worlds are unlike the target."""


def write_report(
    path: Path, task_name: str, config: TrainConfig[Any], training: str, *, progress: bool
) -> tuple[Path, str]:
    """Measure and film the rule in the file `path`; return the model card's path and its scores.

    The scores are a line of text, then one for each of `shortfalls`, then those of `next_steps`.
    `training` says how the rule was trained: iterations, time and command.

    The run's folder `report` gets the model card STEM.md, STEM.json as of `npa-envs evaluate
    --json`, STEM.gif, STEM.mp4, STEM-filmstrip.png, for a 3D rule also a turntable and point files,
    for a classifier STEM-states.gif and STEM-states.png. On a CPU fewer worlds are measured, for
    fewer steps, and only pictures and objects are damaged.
    """
    folder, device = RunFolder(config.out).report, check_device(config.device)
    common.writable_folder(folder)
    rule = load_rule(path, device=device).float()
    task = task_of_rule(str(path), rule, device).task
    thorough = device.type == "cuda"
    clouds = task.classifies
    checkpoints = (CLOUD_CHECKPOINTS if clouds else CHECKPOINTS)[: None if thorough else 5]
    seeds = range(FIRST_SEED, FIRST_SEED + (8 if thorough else 2))
    changed = task.grows_picture or (thorough and (clouds or task.aligned))
    tasks = tasks_of_codes(str(path), rule, device)
    total = FILM_STEPS + step_count(task, checkpoints=checkpoints, changed=changed)
    if len(tasks) > 1:
        total += picture_step_count(len(tasks), seed_count=len(seeds))
    with common.progress_bar(total, show=progress) as advance:
        tables = tables_of(
            rule, task, checkpoints=checkpoints, seeds=seeds, device=device, progress=advance,
            changed=changed, texture_metric=task.has_texture_metric,
        )  # fmt: skip
        if len(tasks) > 1:
            tables["pictures"] = picture_rows(
                rule, tasks, seeds=seeds, device=device, progress=advance
            )
        missing_films = _write_films(rule, task, path, folder, advance)
    command = f"npa-envs evaluate {shlex.quote(str(path))} --device {device.type}"
    if not clouds:
        command += f" --seed-count {len(seeds)} --checkpoints {' '.join(map(str, checkpoints))}"
        command += " --healing" * ("healing" in tables) + " --judge" * task.has_texture_metric
    facts = {"command": command, "commit": current_commit(), "date": date.today().isoformat()}
    facts |= {"machine": machine(device), "metric": task.metric_name}
    text = tables_json(tables, **facts)
    write_text(folder / f"{path.stem}.json", text)
    model_card = folder / f"{path.stem}.md"
    names = {
        "The target, and a world.": "target",
        "A world from the seed on.": "filmstrip",
        "Hidden states of particles, projected to the plane, by class.": "states",
    }
    pictures = "\n\n".join(
        f"![{text}]({path.stem}-{name}.png)"
        for text, name in names.items()
        if (folder / f"{path.stem}-{name}.png").exists()
    )
    usual, more = next_steps(path, task_name, config, tables)
    clauses = shortfalls(tables) + usual
    card = _model_card(rule, task, task_name, training, facts, tables, pictures, clauses, more)
    write_text(model_card, card)
    clauses += [f"train on: {more}"] * bool(more)
    said = "".join(f"\n              {clause}" for clause in clauses)
    return model_card, score_line(json.loads(text)) + missing_films + said


def _write_films(
    rule: NPARule, task: Task, path: Path, folder: Path, advance: Callable[[int], Any]
) -> str:
    """Film a world of the rule in `path`; return text that says which films are missing, or ""."""
    device = rule.hidden.weight.device
    generator = torch.Generator(device).manual_seed(FIRST_SEED)
    seed_world = task.seed(1, generator=generator, device=device)
    film_task = task_for_film(task, str(path), rule, device, least=SCREEN)
    damages = (DamageEvent(GROWN, "cut"), DamageEvent(350, "wipe")) if task.aligned else ()
    grown, film = film_world(
        rule, film_task, seed_world, FILM_STEPS, generator=generator, damages=damages,
        progress=advance,
    )  # fmt: skip
    if task.classifies:
        states, label = hidden_states(rule, cast("PointClassification", task), seed=FIRST_SEED)
        frames, strip = film_states(states, label, STATE_STEPS)
        write_gif(folder / f"{path.stem}-states.gif", frames, fps=12)
        write_filmstrip(folder / f"{path.stem}-states.png", strip, columns=5)
    else:
        last = max(index for index, step in film.steps.items() if step <= GROWN)
        frames = [to_uint8(film_task.target_picture, film.background), film.frames[last]]
        captions = ["target", film.captions[last]]
        write_filmstrip(folder / f"{path.stem}-target.png", frames, captions)
    try:
        if task.has_views:
            write_3d_world(task, grown, folder, drawn_by=task)
        film.write(folder, path.stem)
    except MissingDependencyError as error:
        return f"; not all films: {error}"
    return ""


def shortfalls(tables: Mapping[str, Sequence[Any]]) -> list[str]:
    """Return what does not hold of a rule with these tables, one clause for each failure."""
    clauses = []
    rows = tables.get("growth", ())
    finite = [row for row in rows if math.isfinite(row.loss)]
    best = min(finite, key=lambda row: row.loss, default=None)
    if best is not None and rows[-1].extent > 2.0 * best.extent:
        clauses.append(
            f"particles escape: the world is {best.extent:.1f} wide at step {best.step} and "
            f"{rows[-1].extent:.1f} at step {rows[-1].step}"
        )
    # Written so that a last loss of NaN also counts as unstable.
    if rows and (best is None or not rows[-1].loss <= 4.0 * best.loss):
        clauses.append(f"unstable: at step {rows[-1].step} the loss is many times the least")
    elif rows and rows[-1].psnr is not None and not rows[-1].psnr >= LIKENESS:
        clauses.append(f"unlike the target: {rows[-1].psnr:.1f} dB at step {rows[-1].step}")
    for row in tables.get("healing", ()):
        if isinstance(row, WoundRow):
            healed, count = row.healed, row.changed
            kind, _, size = row.damage.partition(", ")
            which = "it" if count == 1 else f"{count - healed} of these"
            what = f"{count} of {row.wounds} {kind}s, {size}, left a mark, and {which} did not heal"
            what += f" ({row.scars})"
        else:
            healed, count = row.worlds_healed, row.world_count
            what = f"after a {row.damage}, {count - healed} of {count} worlds do not heal"
        if healed < count:
            rise = f"the mean loss becomes {row.end / row.before:.1f} times that before"
            clauses.append(f"{what}; {rise}")
    return clauses


def nearest_preset(task_name: str, config: TrainConfig[Any]) -> str:
    """Return the preset from which a configuration differs in the fewest fields."""

    def fields_of(config: TrainConfig[Any]) -> dict[str, Any]:
        values = config_to_dict(config)
        return {**values.pop("task"), **values}

    presets, values = task_entry(task_name).presets, fields_of(config)
    shared = {
        name: sum(values[key] == value for key, value in fields_of(one).items())
        for name, one in presets.items()
    }
    return max(shared, key=shared.__getitem__)


def next_steps(
    path: Path, task_name: str, config: TrainConfig[Any], tables: Mapping[str, Sequence[Any]]
) -> tuple[list[str], str]:
    """Return what is usual of a run's rule with these tables, and a command that trains on, or "".

    Runs are trained on that are shorter than their preset, or whose worlds fail unhurt.
    """
    presets, usual, words = task_entry(task_name).presets, list[str](), list[str]()
    name = nearest_preset(task_name, config)
    total = presets[name].total_iterations
    if config.total_iterations < total:
        usual = [f"{config.total_iterations} iterations of the {total} of the preset `{name}`"]
        words = ["--iterations", str(-(-total // config.repeats))]
    elif (
        name == "fast"
        and presets.get("best", config).wound_chance > config.wound_chance
        and shortfalls({"healing": tables.get("healing", ())})
    ):
        usual = ["usual for `fast`; `best`, which `--device cuda` takes, heals most wounds"]
    run = str(path.parent)
    failing = words or shortfalls({"growth": tables.get("growth", ())})
    if path.name != "rule.safetensors" or not failing:
        return usual, ""
    stem = run.rstrip("0123456789")
    outs = (f"{stem}{k}" for k in itertools.count(int(run.removeprefix(stem) or 1) + 1))
    words = ["--config", f"{run}/config.json", "--initial-rule", run, *words]
    words += ["--out", next(out for out in outs if not Path(out).exists())]
    return usual, shlex.join(["npa-envs", "train", task_name, *words])


def _model_card(
    rule: NPARule,
    task: Task,
    task_name: str,
    training: str,
    facts: Mapping[str, str],
    tables: Mapping[str, Sequence[Any]],
    pictures: str,
    clauses: Sequence[str],
    more: str,
) -> str:
    config = task.config
    goal = getattr(config, "data", config.goal_text)
    others = "" if rule.codes is None else f", one of {len(rule.codes)} pictures"
    box = task.box
    space = "open space" if box is None else f"periodic box of {' x '.join(map(str, box))}"
    moves = "static" if rule.static else f"α {rule.alpha:g}"
    world = f"N {config.particle_count}, C {rule.state_dim}, ε {task.eps:g}, {moves}"
    wide, narrow = rule.hidden.weight.shape[1], rule.output.weight.shape[0]
    sizes = f"{wide} → {rule.hidden_dim} → {narrow}"
    sizes += f", read-out to {rule.readout_dim}" if rule.readout_dim else ""
    sizes += f", {rule.weight_count} weights"
    sizes += f", dead zone {rule.dead_zone:g}" if rule.dead_zone else ""
    used = versions()
    rows = [
        ("task", f"{rule.space_dim}D, {space}, {world}, p {task.update_prob:g}"),
        ("network", sizes),
        ("format", "safetensors with all hyper-parameters in its metadata"),
        ("machine", f"{facts['machine']}, torch {used['torch']}, warp-lang {used['warp-lang']}"),
        ("date", facts["date"]),
    ]
    failures = [f"- {clause[0].upper()}{clause[1:]}." for clause in clauses]
    parts = [
        f"# {Path(goal).stem}",
        f"A rule of the task `{task_name}` for `{goal}`{others}.",
        pictures,
        markdown_table(("", ""), rows),
        "N: particles, C: channels of a state, ε: radius of perception [length units], α: longest "
        "move of a step in ε, p: probability of an update.",
        "## What does not hold",
        "\n".join(failures) or "Nothing that was measured fails.",
        f"To train on:\n\n```sh\n{more}\n```" if more else "",
        "## Training",
        f"Commit {facts['commit']}: {training}",
        "## Measured",
        f"`{facts['command']}`, seeds that training never saw. Loss: {task.metric_name}.",
    ]
    for name, table in tables.items():
        parts += [TITLES[name]] if name in TITLES else []
        parts.append(table_markdown(table, missing=UNMEASURED if name == "growth" else "never"))
        if name == "healing":
            parts.append("\n".join(f"- {row.summary}" for row in table))
    names = dict.fromkeys(
        field.name
        for table in tables.values()
        for field in fields(table[0])
        if any(getattr(row, field.name) is not None for row in table)
    )
    words = [f"- {name.replace('_', ' ')}: {WORDS[name]}" for name in names if name in WORDS]
    parts.append("\n".join(words))
    return "\n\n".join(filter(None, parts)) + "\n"
