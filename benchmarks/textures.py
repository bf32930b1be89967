"""Losses of textures compared: rules trained with each, and judged by what none of them compares.

`run` trains rules, several side by side on one GPU, each on a stream of its own, and judges them as
`npa-envs evaluate --judge` does, with seeds that training never saw. Every finished rule is a line
of JSON, with its file and a strip of pictures. `particles` asks what a loss is worth without any
rule: positions and colours of grey particles follow its slope. `report` prints a table, and
`figures` draws the strips of several runs as one picture.

    python benchmarks/textures.py particles --out OUT
    python benchmarks/textures.py run --device cuda --out OUT --losses patch_swd patch_ot
    python benchmarks/textures.py report --out OUT --steps 64 512 2048
"""

from __future__ import annotations

import argparse
import json
import time
from collections.abc import Sequence
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from PIL import Image
from side_by_side import iterate_together, on, stream_of

from npa_envs.measure.benchmark_records import as_objects
from npa_envs.measure.quality import evaluate
from npa_envs.measure.texture_metric import TextureMetric, TextureRow
from npa_envs.render import to_uint8, write_filmstrip
from npa_envs.rule.files import load_rule
from npa_envs.rule.rule import NPARule
from npa_envs.tasks.texture import Texture
from npa_envs.training import Trainer, preset
from npa_envs.training.task_of_rule import task_of_rule
from npa_envs.world.capture_cache import release_captures

SEEDS = tuple(range(1_000_000, 1_000_008))
"""Seeds of the worlds for the judge."""


def measured(
    rule: NPARule, task: Texture, steps: Sequence[int], device: str, seeds: Sequence[int]
) -> tuple[dict[str, list[dict[str, Any]]], np.ndarray[Any, Any]]:
    """Return the rows of `npa-envs evaluate --judge`, and a picture of target and world."""
    judge = TextureMetric(task)
    judged: list[TextureRow] = []
    frames = [task.target_picture[None].cpu()]

    def watch(x: torch.Tensor, s: torch.Tensor, step: int) -> None:
        judged.append(judge.row(x, s, step))
        frames.append(task.picture(x[:1], s[:1]).cpu())

    rows = evaluate(rule, task, checkpoints=steps, seeds=seeds, device=device, watch=watch)
    if device.startswith("cuda"):
        release_captures()
    strip = np.concatenate(list(to_uint8(torch.cat(frames))), axis=1)
    return {"growth": as_objects(rows), "judge": as_objects(judged)}, strip


def told(tables: dict[str, list[dict[str, Any]]]) -> str:
    """Return the texture metric's ratios as a line of text."""
    return "  ".join(
        f"{r['step']}: {r['ratio']:.2f} ({r['shapes']:.1f} {r['contrasts']:.1f} {r['colours']:.1f})"
        for r in tables["judge"]
    )


def run(arguments: argparse.Namespace) -> None:
    """Train and judge all runs in parallel."""
    out: Path = arguments.out
    out.mkdir(parents=True, exist_ok=True)
    changes = json.loads(arguments.fields)
    changes = {k: tuple(v) if isinstance(v, list) else v for k, v in changes.items()}
    started = time.perf_counter()
    names, trainers, streams = [], [], []
    for loss in arguments.losses:
        for target in arguments.targets:
            name = f"{target}-{loss}{arguments.label}"
            fields: dict[str, Any] = {"tensorboard": False, "picture_interval": 0}
            fields |= {"checkpoint_interval": 10**9, "log_interval": 100, "target": target}
            fields |= {"loss": loss, "device": arguments.device, "out": arguments.runs / name}
            config = preset(arguments.preset, "texture", **(fields | changes))
            streams.append(stream_of(arguments.device))
            with on(streams[-1]):
                task = Texture(config.task, device=arguments.device)
                config = replace(config, task=task.config)
                trainers.append(Trainer(task, config, task_name="texture", overwrite=True))
            names.append(name)
    print(f"made in {time.perf_counter() - started:.0f} s", flush=True)
    seconds = iterate_together(trainers, streams, arguments.longest)
    print(f"{[t.iteration for t in trainers]} in {seconds:.0f} s", flush=True)
    for name, trainer in zip(names, trainers, strict=True):
        trainer.save()
        (out / f"rule-{name}.safetensors").write_bytes(trainer.folder.rule.read_bytes())
    if arguments.device.startswith("cuda"):
        release_captures()
    seeds = SEEDS[: 8 if arguments.device.startswith("cuda") else 1]
    for name, trainer in zip(names, trainers, strict=True):
        begun = time.perf_counter()
        rule = trainer.saved_rule
        told_task = trainer.config.task
        if arguments.particles:
            told_task = told_task.with_particle_count(arguments.particles)
        task = Texture(told_task, device=arguments.device)
        tables, strip = measured(rule, task, arguments.steps, arguments.device, seeds)
        Image.fromarray(strip).save(out / f"strip-{name}.png")
        line = {"name": name, "iterations": trainer.iteration, "seconds": seconds, **tables}
        line |= {
            "together": len(trainers),
            "particles": told_task.particle_count,
            "fields": changes,
        }
        with (out / "runs.jsonl").open("a", encoding="utf-8") as file:
            file.write(json.dumps(line) + "\n")
        print(f"{name:24s} {told(tables)}  {time.perf_counter() - begun:.1f} s", flush=True)
    for name in arguments.rules:
        rule = load_rule(name, device=arguments.device).float()
        trained: Any = task_of_rule(name, rule, torch.device(arguments.device)).task
        tables, strip = measured(rule, trained, arguments.steps, arguments.device, seeds)
        Image.fromarray(strip).save(out / f"strip-{name}-shipped.png")
        with (out / "runs.jsonl").open("a", encoding="utf-8") as file:
            file.write(json.dumps({"name": f"{name}-shipped", **tables}) + "\n")
        print(f"{name:24s} {told(tables)}", flush=True)


def particles(arguments: argparse.Namespace) -> None:
    """Optimise positions and colours without a rule by each loss, and judge the results."""
    out: Path = arguments.out
    out.mkdir(parents=True, exist_ok=True)
    device = torch.device(arguments.device)
    changes = json.loads(arguments.fields)
    for target in arguments.targets:
        frames = []
        for loss in arguments.losses:
            config = preset("paper", "texture", target=target, loss=loss, **changes).task
            task = Texture(config, device=device)
            generator = torch.Generator(device).manual_seed(0)
            x, s, *_ = task.seed(1, generator=generator, device=device)
            colour = s[..., -3:].clone().requires_grad_()
            x.requires_grad_()
            half = 0.5 * config.box_size
            optimiser = torch.optim.Adam([{"params": [x]}, {"params": [colour]}], betas=(0.9, 0.9))
            begun = time.perf_counter()
            for number in range(arguments.iterations):
                left = max(0.05, 1.0 - number / arguments.iterations)
                optimiser.param_groups[0]["lr"] = 0.012 * left
                optimiser.param_groups[1]["lr"] = 0.03 * left
                shift = torch.rand(1, 1, 2, generator=generator, device=device) * 2.0 * half
                pictured = task.picture((x + shift + half) % (2.0 * half) - half, colour)
                value = task.weighted(*task.compare_pictures(pictured)).sum()
                total = value + 10.0 * (colour.abs() - 0.5).relu().mean()
                optimiser.zero_grad()
                total.backward()
                optimiser.step()
            found = TextureMetric(task).row(
                (x.detach() + half) % (2.0 * half) - half, colour.detach(), 0
            )
            seconds = time.perf_counter() - begun
            line = {"target": target, "loss": loss, "value": value.item(), "seconds": seconds}
            line |= {"iterations": arguments.iterations, "fields": changes}
            line |= {"judge": asdict(found), "device": str(device)}
            with (out / "particles.jsonl").open("a", encoding="utf-8") as file:
                file.write(json.dumps(line) + "\n")
            print(
                f"{target:9s} {loss:13s} {found.ratio:6.2f} ({found.shapes:.1f} "
                f"{found.contrasts:.1f} {found.colours:.1f})  {seconds:.0f} s",
                flush=True,
            )
            with torch.no_grad():
                frames.append(task.picture(x, colour).cpu())
        frames.insert(0, task.target_picture[None].cpu())
        strip = np.concatenate(list(to_uint8(torch.cat(frames))), axis=1)
        Image.fromarray(strip).save(out / f"particles-{target}.png")


def frames_of(strip: Path) -> list[np.ndarray[Any, Any]]:
    """Return the pictures of a strip: the target, and a world after each number of steps."""
    picture = np.asarray(Image.open(strip).convert("RGB"))
    return list(np.split(picture, picture.shape[1] // picture.shape[0], axis=1))


def figures(arguments: argparse.Namespace) -> None:
    """Draw each target with the worlds of its rule, or of each loss."""
    captions, frames = [], []
    for target in arguments.targets:
        found = [
            arguments.out / f"strip-{target}-{loss}{arguments.label}.png"
            for loss in arguments.losses
        ]
        captions.append(target)
        frames.append(frames_of(found[0])[0])
        if len(found) > 1:
            captions += arguments.losses
            frames += [frames_of(strip)[1 + arguments.steps.index(512)] for strip in found]
            continue
        for step in (64, 512, 4096):
            captions.append(f"step {step}")
            frames.append(frames_of(found[0])[1 + arguments.steps.index(step)])
        captions.append("step 4096, 2 x 2")
        frames.append(np.tile(frames[-1], (2, 2, 1))[::2, ::2])
    columns = len(frames) // len(arguments.targets)
    write_filmstrip(arguments.figure, frames, captions, columns=columns)


def report(arguments: argparse.Namespace) -> None:
    """Print the ratios of all runs as a table."""
    print("| run | iterations | " + " | ".join(str(step) for step in arguments.steps) + " |")
    print("|---|---|" + "---|" * len(arguments.steps))
    for text in (arguments.out / "runs.jsonl").read_text(encoding="utf-8").splitlines():
        line = json.loads(text)
        by_step = {row["step"]: row["ratio"] for row in line["judge"]}
        cells = " | ".join(f"{by_step[s]:.2f}" if s in by_step else "" for s in arguments.steps)
        print(f"| {line['name']} | {line.get('iterations', '')} | {cells} |")


def main() -> None:
    """Run the command line."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("what", choices=("run", "particles", "report", "figures"))
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--runs", type=Path, default=Path("runs"))
    parser.add_argument("--losses", nargs="+", default=["patch_ot"])
    parser.add_argument("--targets", nargs="+", default=["hearts", "bubbles", "stripes"])
    parser.add_argument("--preset", default="paper")
    parser.add_argument("--fields", default="{}", help="fields to change, as JSON")
    parser.add_argument("--figure", type=Path, default=Path("figure.png"))
    parser.add_argument("--iterations", type=int, default=120, help="of particles without a rule")
    parser.add_argument("--particles", type=int, help="that rules are measured with")
    parser.add_argument("--rules", nargs="*", default=[], help="shipped rules to judge as well")
    parser.add_argument("--label", default="")
    parser.add_argument("--steps", type=int, nargs="+", default=[64, 512, 4096])
    parser.add_argument("--longest", type=float, default=1e9, help="seconds of training")
    parser.add_argument("--device", default="cpu")
    arguments = parser.parse_args()
    {"run": run, "particles": particles, "report": report, "figures": figures}[arguments.what](
        arguments
    )


if __name__ == "__main__":
    main()
