"""Results all over the library, for `make golden-check`: run by each of two trees on one machine.

A scene returns whatever of numbers, arrays, tensors, lists and dictionaries; `flat` names each. The
names of arrays must stay the same when the library's own names change.
`python wide.py OUT.npz` writes all.
"""

import contextlib
import functools
import gc
import io
import json
import os
import re
import sys
import tempfile
import time
from functools import partial
from pathlib import Path

import gymnasium
import numpy as np
import scenes as golden
import torch
from support import crowds, small_envs

import npa_envs
from npa_envs import WorldRandom, load_rule, rollout
from npa_envs.agents import learning
from npa_envs.cli import main as npa_envs_command
from npa_envs.envs import gardeners_v0, multispecies_v0, particles_v0
from npa_envs.tasks.damage import damage_worlds
from npa_envs.training.task_of_rule import task_of_rule
from npa_envs.world import brushes
from npa_envs.world.particles import Particles

TRAINED = ("morphogenesis2d", "co_morphogenesis2d", "morphogenesis3d", "texture")
"""Tasks of `npa-envs train` besides `point_classification`, whose data are drawn elsewhere."""


def flat(value, name, into):
    """Store all arrays of a result under names."""
    if isinstance(value, dict):
        for key, part in value.items():
            flat(part, f"{name}/{key}", into)
    elif isinstance(value, torch.Tensor):
        into[name] = value.detach().cpu().numpy()
    elif isinstance(value, list | tuple) and not all(isinstance(v, int | float) for v in value):
        for k, part in enumerate(value):
            flat(part, f"{name}/{k}", into)
    elif value is not None:
        array = np.asarray(value)
        if array.dtype == object and all(isinstance(part, np.ndarray) for part in array.flat):
            array = np.stack(array)
        into[name] = array.astype(str) if array.dtype == object else array


def command(*words, codes=(0,)):
    """Run a command of `npa-envs` in the current folder."""
    with contextlib.redirect_stdout(io.StringIO()) as out:
        code = npa_envs_command([*words, "--no-progress"])
    if code not in codes:
        raise RuntimeError(f"{words} returned {code}: {out.getvalue()[-500:]}")


def gradients(value, rule, **others):
    """Return derivatives by all weights and some tensors."""
    named = dict(rule.named_parameters()) | others
    found = torch.autograd.grad(value, list(named.values()), allow_unused=True)
    return dict(zip(named, found, strict=True))


def of_rule(name):
    """Sixteen steps of a shipped rule from its task's seed, its loss, and gradients over three."""
    rule = load_rule(name)
    task = task_of_rule(name, rule, torch.device("cpu"), particle_count=160).task
    run = functools.partial(rollout, rule, eps=task.eps, box=task.box)
    x, s, _, goal = task.seed(2, generator=WorldRandom([3, 4]), device=torch.device("cpu"))
    task = task.with_goal(goal)
    with torch.no_grad():
        x, s = run(x, s, 16, generator=WorldRandom([5, 6]))
    results = {"x": x, "s": s, "colour": rule.colour(s), "picture": task.picture(x, s)}
    x.requires_grad_()
    s.requires_grad_()
    after = run(x, s, 3, generator=WorldRandom([7, 8]), return_path_length=True)
    loss, terms = task.loss(Particles(*after))
    results |= {"loss": loss, "terms": terms, "metric": task.metric(*after[:2])}
    return results | {"gradients": gradients(loss.sum(), rule, x=x, s=s)}


KINDS = {
    "plain": ({}, {"return_path_length": True}),
    "periodic": ({}, {"box": (1.2, 0.9), "keep_every": 2}),
    "static": ({"static": True}, {"update_prob": 0.7}),
    "equivariant": ({"equivariant": True}, {}),
    "chiral": ({"equivariant": True, "chiral": True}, {"box": (1.2, 0.9)}),
    "divides": ({"divides": True}, {"memory": "recompute"}),
    "dead-zone": ({"dead_zone": 0.02}, {"position_noise": 0.01}),
    "smooth": ({"moment_inverse": "smooth"}, {"memory": "minimal", "dt": 0.5}),
    "read-out": ({"readout_dim": 3, "readout_hidden_dim": 8}, {"update_prob": 1.0}),
}
"""Rules and rollouts of all kinds: options of a rule, and of its rollout."""


def of_kind(name):
    """Some steps of an untrained rule, with and without gradients, in both precisions."""
    of_rule, options = KINDS[name]
    results = {}
    for dtype in (torch.float32, torch.float64):
        random = np.random.default_rng(1)
        x = torch.from_numpy(random.uniform(-0.45, 0.45, (3, 90, 2))).to(dtype)
        s = torch.from_numpy(random.normal(0.4, 0.3, (3, 90, 8))).to(dtype)
        torch.manual_seed(2)
        rule = npa_envs.NPARule(2, 8, 24, eps0=0.2, **of_rule).to(dtype)
        with torch.no_grad():
            for parameter in rule.parameters():
                noise = torch.from_numpy(random.normal(0.0, 0.05, parameter.shape))
                parameter.add_(noise.to(dtype))
            long = rollout(rule, x, s, 40, eps=0.22, generator=WorldRandom([1, 2, 3]), **options)
        x.requires_grad_()
        s.requires_grad_()
        draws = {"generator": torch.Generator().manual_seed(9), "detach_positions": False}
        short = rollout(rule, x, s, 4, eps=0.22, **draws, **options)
        value = short[0].square().sum() + short[1].pow(3).sum()
        word = str(dtype).removeprefix("torch.")
        results[word] = {"long": long, "short": short, "d": gradients(value, rule, x=x, s=s)}
    return results


def at_rest():
    """A rollout whose steps are left out once the worlds are at rest."""
    torch.manual_seed(3)
    rule = npa_envs.NPARule(2, 8, 16, eps0=0.2, dead_zone=50.0)
    x, s = torch.rand(2, 40, 2), torch.rand(2, 40, 8)
    source = WorldRandom([1, 2])
    with torch.no_grad():
        return {"world": rollout(rule, x, s, 300, generator=source), "after": source.uniform(5)}


def fields_of(name):
    """Return keywords of a small environment."""
    if "Shapeshifter" in name:
        return {"particle_count": 61}
    pool = {"seed_pool": 2} if "Gardener" in name or "Shepherd" in name else {}
    return small_envs.small(re.sub(r"(Small|Large)-", "-", name), **pool)


def drawn(random, space):
    """Return an action in the inner part of a space."""
    share = random.uniform(0.3, 0.7, space.shape)
    low, high = np.maximum(space.low, -1.0), np.minimum(space.high, 1.0)
    return (low + share * (high - low)).astype(space.dtype)


def of_environment(name, world_count):
    """Six steps of an environment, single or a batch of two that start anew after four."""
    fields = fields_of(name)
    if world_count is None:
        env = gymnasium.make(name, render_mode="rgb_array", **fields)
    else:
        fields |= {"vectorization_mode": "vector_entry_point", "max_episode_steps": 4}
        env = gymnasium.make_vec(name, world_count, **fields)
    random = np.random.default_rng(4)
    steps = [env.reset(seed=11)]
    steps += [env.step(drawn(random, env.action_space)) for _ in range(6)]
    results = {"steps": steps}
    if world_count is None:
        results |= {"picture": env.render(), "world": env.unwrapped.particles()}
    env.close()
    return results


def of_agents(env):
    """Six steps of a parallel environment, or of a batch of worlds."""
    random = np.random.default_rng(5)
    steps = [env.reset(seed=12)]
    spaces = getattr(env, "action_spaces", None)
    for _ in range(6):
        if not env.agents:
            break
        chosen = spaces if spaces else {a: env.action_space(a) for a in env.agents}
        steps.append(env.step({a: drawn(random, chosen[a]) for a in env.agents}))
    results = {"steps": steps}
    if hasattr(env, "state"):
        with contextlib.suppress(NotImplementedError):
            results["state"] = env.state()
    env.close()
    return results


def of_species(task, kind):
    """Several species: a world, a batch, or each particle an agent."""
    fields = crowds.small(task, particle_count=48, max_cycles=5)
    if kind == "parallel":
        return of_agents(multispecies_v0.parallel_env(**fields))
    if kind == "batch":
        return of_agents(multispecies_v0.batched(world_count=2, **fields))
    return of_agents(particles_v0.parallel_env(**fields | {"particle_count": 10}))


def two_gardeners():
    """The keeper and the raider of one garden."""
    fields = small_envs.small("npa/Gardener2D-v0", seed_pool=2, max_cycles=5)
    return of_agents(gardeners_v0.parallel_env(**fields))


def lines_of(path):
    """Return a log's numbers without times."""
    records = [json.loads(line) for line in path.read_text(encoding="utf-8").splitlines()]
    return [{k: v for k, v in record.items() if "second" not in k} for record in records]


def of_training(task, *words):
    """Ten iterations of a task's tiny preset: the log, and the rules it ends with."""
    last = ("--iterations", "10", "--no-report", "--out", "run")
    command("train", task, "--preset", "tiny", *words, *last)
    rules = [load_rule(path) for path in sorted(Path("run").glob("rule*.safetensors"))]
    return {"log": lines_of(Path("run/log.jsonl")), "rules": [r.state_dict() for r in rules]}


def resumed():
    """A run that is stopped somewhere and goes on: where it was stopped does not matter."""
    words = ("train", "morphogenesis2d", "--preset", "tiny", "--no-report", "--out", "run")
    command(*words, "--iterations", "30", "--max-seconds", "1", codes=(0, 1, 75, 130))
    command(*words, "--iterations", "30", "--resume")
    return lines_of(Path("run/log.jsonl"))


def of_learning(method, name, fields, **options):
    """A few updates of a learner: its curve and its rules."""
    problem = learning.Problem(env_id=name, keywords=fields, episode_steps=4, num_envs=2)
    options |= {"evaluation_seeds": range(100, 102), "curve_points": 2}
    done = learning.train(method, problem, learning.Budget(particle_steps=4096), 1, **options)
    curve = [{k: v for k, v in vars(e).items() if "second" not in k} for e in done.log]
    rules = None if done.rules is None else [rule.state_dict() for rule in done.rules.rules]
    return {"curve": curve, "rules": rules}


def of_evaluation(rule, *words):
    """What `npa-envs evaluate` measures."""
    command("evaluate", rule, *words, "--seed-count", "2", "--json", "table.json")
    return json.loads(Path("table.json").read_text(encoding="utf-8"))


def of_film(rule, *words):
    """Bytes of what `npa-envs rollout` writes."""
    fixed = ("--steps", "24", "--particle-count", "200", "--every", "12", "--resolution", "48")
    command("rollout", rule, *fixed, "--out", "film", *words)
    files = sorted(p for p in Path("film").iterdir() if p.suffix != ".mp4")
    return {path.name: np.frombuffer(path.read_bytes(), np.uint8) for path in files}


def page():
    """The collection of rules that the authors' web demo reads."""
    with contextlib.redirect_stdout(io.StringIO()):
        npa_envs_command(["export-web", "gecko-v0", "dots", "--out", "models.json"])
    return json.loads(Path("models.json").read_text(encoding="utf-8"))


def brushed():
    """All brushes and damages, soft ones with gradients."""
    results, random = {}, np.random.default_rng(6)
    x = torch.from_numpy(random.uniform(-0.5, 0.5, (2, 80, 2))).float().requires_grad_()
    s = torch.from_numpy(random.normal(size=(2, 80, 4))).float().requires_grad_()
    centre, move = torch.tensor([[0.1, 0.0], [-0.45, 0.4]]), torch.tensor([[0.1, 0.2], [0.0, 0.3]])
    for word, box in (("open", None), ("box", (1.0, 1.0))):
        at = {"centre": centre, "box": box}
        found = {
            "push": brushes.push(x, move=move, radius=0.3, strength=0.7, **at),
            "inject": brushes.inject(x, s, radius=0.3, state=torch.ones(2, 4), strength=0.5, **at),
            "around": brushes.state_around(x, s, radius=0.3, **at),
            "wipe": brushes.wipe_state(x, s, radius=0.3, **at),
            "cut": brushes.cut(x, s, normal=move, gap=0.1, along=move, **at),
            "clump": brushes.clump(x, s, radius=0.3, factor=0.6, **at),
        }
        d = torch.autograd.grad(found["push"].square().sum() + found["inject"].pow(3).sum(), (x, s))
        results[word] = found | {"d": d}
    x, s = x.detach(), s.detach()
    for k, kind in enumerate(("wipe", "cut", "clump", "noise")):
        worlds = damage_worlds(Particles(x, s), kind=kind, generator=WorldRandom([1, 2]))
        results[f"damage{k}"] = worlds[:2]
    return results


def scenes():
    """Return all scenes by name."""
    names = sorted(name for name in gymnasium.registry if name.startswith("npa/"))
    rules = npa_envs.shipped_rules()
    small = ("npa/Morphogenesis2DSmall-v0", {"target": "ring"})
    crowd = ("npa/MixingSmall-v0", {})
    learners = ("ppo", "shac", "gradient", "evolution")
    few = ("--checkpoints", "4", "12", "--particle-count", "128")
    healing = ("heart", "--checkpoints", "16", "--particle-count", "128", "--healing")
    kinds = ("parallel", "batch", "particles")
    groups = {
        "rule": {name: partial(of_rule, name) for name in rules},
        "kind": {name: partial(of_kind, name) for name in KINDS},
        "env": {name: partial(of_environment, name, None) for name in names},
        "batch": {name: partial(of_environment, name, 2) for name in names},
        "species": {f"{t}/{k}": partial(of_species, t, k) for t in crowds.TASKS for k in kinds},
        "train": {
            **{task: partial(of_training, task) for task in TRAINED},
            "points": partial(of_training, "point_classification", "--data", "digits"),
            "resumed": resumed,
        },
        "learn": {
            **{method: partial(of_learning, method, *small) for method in learners},
            **{
                f"{method}-species": partial(of_learning, method, *crowd) for method in learners[:2]
            },
        },
        "evaluate": {name: partial(of_evaluation, name, *few) for name in rules if name != "mnist"},
        "healing": {"heart": partial(of_evaluation, *healing)},
        "film": {
            "gecko": partial(of_film, "gecko", "--damage", "8:cut", "10:wipe", "12:clump"),
            "dots": partial(of_film, "dots", "--style", "points", "--background", "black"),
            "duck": partial(of_film, "duck"),
        },
    }
    alone = {"at-rest": at_rest, "gardeners": two_gardeners, "page": page, "brushes": brushed}
    return alone | {
        f"{group}/{n}": scene for group, members in groups.items() for n, scene in members.items()
    }


def main(out, only=""):
    """Compute what begins with a word, beginning with the golden scenes, and write it."""
    torch.set_num_threads(1)
    gymnasium.logger.min_level = gymnasium.logger.ERROR
    root = Path(golden.__file__).resolve().parents[2]
    for module in (npa_envs, multispecies_v0):
        assert Path(module.__file__).resolve().is_relative_to(root), module.__file__
    found = {}
    every = scenes() | {f"golden/{name}": scene for name, scene in golden.SCENES.items()}
    for name, scene in every.items():
        if not name.startswith(only):
            continue
        began, here = time.perf_counter(), os.getcwd()
        # So that nothing that was drawn before matters.
        torch.manual_seed(0)
        np.random.seed(0)
        with tempfile.TemporaryDirectory() as folder:
            os.chdir(folder)
            try:
                flat(scene(), name, found)
            except Exception as error:
                found[f"{name}/EXCEPTION"] = np.asarray(f"{type(error).__name__}: {error}"[:400])
            finally:
                os.chdir(here)
        gc.collect()
        if only:
            print(f"{name}: {time.perf_counter() - began:.1f} s")
    np.savez(out, **{name.replace("/", "|"): array for name, array in found.items()})


if __name__ == "__main__":
    main(Path(sys.argv[1]), *sys.argv[2:])
