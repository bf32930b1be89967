"""Agent-steps a second against the number of worlds: these environments and other libraries' own.

    pip install --target peers vmas mpe2 magent2 gym
    PYTHONPATH=peers python benchmarks/agents_beside.py --output FILE --plot PNG

An agent-step is one action of one agent; where every particle acts it is a particle-step. All have
the same number of agents (MAgent2's Battle the nearest that its maps allow) and of worlds, random
actions made beforehand, observations of every agent in every step, and episodes of `--steps` steps:
a reading is one episode and the reset after it. A round takes one reading of each. On a CPU times
are those of the process, which the machine's other work hardly changes. VMAS and the environments
in batches step all worlds together; the others' worlds are stepped in turn, and are measured on a
CPU alone. A library that is not installed is left out, and so are more worlds than an episode of
`--longest` seconds allows.

`--output` writes the entry `agents` of a JSON file, and leaves the file's other entries as they
are. `--draw FILE FILE` draws such files' entries without measuring.
"""

from __future__ import annotations

import statistics
import time
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import gymnasium
import torch
from scripts import script_facts, script_parser
from torch import Tensor

from npa_envs.atomic_files import read_json, write_bytes
from npa_envs.envs import multispecies_v0, particles_v0
from npa_envs.measure.benchmark_records import write_record
from npa_envs.measure.plots import legend_of, new_figure, number_plainly, png
from npa_envs.measure.speed.timing import synchronize

WORLDS = {"cpu": (1, 8, 64), "cuda": (1, 64, 1024)}
AGENTS = (8, 64)
BATTLE_MAPS = range(12, 46)
"""Sides of Battle's maps, of which the one with the nearest number of agents is taken."""
WARM_STEPS = 3
"""Steps before the first reading: those of the environments prepare their launches."""


class Case(NamedTuple):
    """The size of a measurement: B worlds of some agents, and the steps of an episode."""

    world_count: int
    agent_count: int
    episode_steps: int
    device: str


class Runner(NamedTuple):
    """Worlds that are ready to be timed: a function that resets them, and one that steps them."""

    reset: Callable[[], Any]
    step: Callable[[], int]
    """Step all worlds once and return the number of actions that agents took."""


def drawn(shape: Sequence[int], device: str) -> Tensor:
    """Return random actions, uniform between -1 and 1."""
    generator = torch.Generator(device).manual_seed(0)
    return 2.0 * torch.rand(*shape, generator=generator, device=device) - 1.0


def output_of(device: str) -> str:
    """Return the kind of arrays: on a GPU they stay there."""
    return "numpy" if device == "cpu" else "torch"


def species_runner(case: Case) -> Runner:
    """Return worlds of `multispecies_v0`, stepped together; each particle acts."""
    env = multispecies_v0.batched(
        "mixing",
        world_count=case.world_count,
        particle_count=case.agent_count,
        max_cycles=case.episode_steps,
        device=case.device,
        output=output_of(case.device),
    )
    env.reset(seed=0)
    spaces = env.single_action_spaces
    shapes = {name: (case.world_count, *spaces[name].shape) for name in env.agents}
    actions: dict[str, Any] = {name: drawn(shape, case.device) for name, shape in shapes.items()}
    if case.device == "cpu":
        actions = {name: action.numpy() for name, action in actions.items()}
    return Runner(lambda: None, lambda: _stepped(env, actions, case))


def picture_runner(case: Case) -> Runner:
    """Return worlds of Morphogenesis2D, stepped together; each particle acts."""
    env = gymnasium.make_vec(
        "npa_envs:npa/Morphogenesis2D-v0",
        num_envs=case.world_count,
        vectorization_mode="vector_entry_point",
        particle_count=case.agent_count,
        max_episode_steps=case.episode_steps,
        device=case.device,
        output=output_of(case.device),
    )
    env.reset(seed=0)
    actions: Any = drawn((case.world_count, *env.unwrapped.single_action_space.shape), case.device)
    if case.device == "cpu":
        actions = actions.numpy()
    return Runner(lambda: None, lambda: _stepped(env, actions, case))


def _stepped(env: Any, actions: Any, case: Case) -> int:
    # The step that ends an episode returns the next one's first observation.
    env.step(actions)
    return case.world_count * case.agent_count


def vmas_runner(scenario: str, case: Case) -> Runner:
    """Return worlds of a scenario of VMAS, stepped together."""
    from vmas import make_env

    env = make_env(
        scenario=scenario,
        num_envs=case.world_count,
        device=case.device,
        continuous_actions=True,
        max_steps=case.episode_steps,
        seed=0,
        n_agents=case.agent_count,
    )
    widths = [env.get_agent_action_size(agent) for agent in env.agents]
    actions = [drawn((case.world_count, width), case.device) for width in widths]
    return Runner(env.reset, lambda: _stepped(env, actions, case))


def in_turn(make: Callable[[], Any], case: Case) -> Runner:
    """Return worlds of PettingZoo's parallel interface, which are stepped one after the other."""
    envs = [make() for _ in range(case.world_count)]
    actions: list[dict[str, Any]] = []
    for seed, env in enumerate(envs):
        env.reset(seed=seed)
        for agent in env.agents:
            env.action_space(agent).seed(seed)
        actions.append({agent: env.action_space(agent).sample() for agent in env.agents})

    def reset() -> None:
        for env in envs:
            env.reset()

    def step() -> int:
        count = 0
        for env, drawn in zip(envs, actions, strict=True):
            acting = {agent: drawn[agent] for agent in env.agents}
            env.step(acting)
            count += len(acting)
        return count

    return Runner(reset, step)


def particles_runner(case: Case) -> Runner:
    """Return worlds of `particles_v0`, stepped in turn."""
    options = {"particle_count": case.agent_count, "max_cycles": case.episode_steps}
    return in_turn(lambda: particles_v0.parallel_env("mixing", **options), case)


def mpe2_runner(case: Case) -> Runner:
    """Return worlds of mpe2's simple_spread, stepped in turn."""
    from mpe2 import simple_spread_v3

    options = {"N": case.agent_count, "max_cycles": case.episode_steps, "continuous_actions": True}
    return in_turn(lambda: simple_spread_v3.parallel_env(**options), case)


def magent2_runner(case: Case) -> Runner:
    """Return worlds of MAgent2's Battle, stepped in turn, of about as many agents."""
    from magent2.environments import battle_v4

    def make(side: int) -> Any:
        return battle_v4.parallel_env(map_size=side, max_cycles=case.episode_steps)

    def distance(side: int) -> int:
        env = make(side)
        env.reset(seed=0)
        return abs(len(env.agents) - case.agent_count)

    side = min(BATTLE_MAPS, key=distance)
    return in_turn(lambda: make(side), case)


class Contender(NamedTuple):
    """An environment that is measured."""

    name: str
    make: Callable[[Case], Runner]
    library: str = "npa_envs"
    batched: bool = True
    """Whether all worlds are stepped together, on any device."""


CONTENDERS = (
    Contender("particles_v0", particles_runner, batched=False),
    Contender("multispecies_v0.batched", species_runner),
    Contender("Morphogenesis2D, vector", picture_runner),
    Contender("VMAS flocking", lambda case: vmas_runner("flocking", case), "vmas"),
    Contender("VMAS simple_spread", lambda case: vmas_runner("simple_spread", case), "vmas"),
    Contender("mpe2 simple_spread", mpe2_runner, "mpe2", batched=False),
    Contender("MAgent2 Battle", magent2_runner, "magent2", batched=False),
)


def missing_libraries() -> dict[str, str]:
    """Return why libraries cannot be imported, by their names."""
    missing: dict[str, str] = {}
    for library in {contender.library for contender in CONTENDERS}:
        try:
            __import__(library)
        except ImportError as problem:
            missing[library] = str(problem)
    return missing


class Reading(NamedTuple):
    """One episode: its time [s], and the actions that agents took."""

    seconds: float
    actions: int


def read(runner: Runner, case: Case, steps: int) -> Reading:
    """Step worlds that have been reset, and reset them again."""
    device = torch.device(case.device)
    clock = time.process_time if device.type == "cpu" else time.perf_counter
    synchronize(device)
    begun = clock()
    actions = sum(runner.step() for _ in range(steps))
    runner.reset()
    synchronize(device)
    return Reading(clock() - begun, actions)


class Entry(NamedTuple):
    """A contender with worlds of one size, and its readings."""

    contender: Contender
    case: Case
    runner: Runner
    readings: list[Reading]

    def row(self) -> dict[str, Any]:
        """Return the row of the record: medians over the readings."""
        rates = [found.actions / found.seconds for found in self.readings]
        step = statistics.median(found.seconds for found in self.readings)
        step /= self.case.episode_steps
        worlds = self.case.world_count
        first = self.readings[0].actions / self.case.episode_steps / worlds
        return {
            "name": self.contender.name,
            "agents": self.case.agent_count,
            "agents_acting": first,
            "world_count": worlds,
            "batched": self.contender.batched,
            "step_us": step * 1e6,
            "world_steps_per_s": worlds / step,
            "agent_steps_per_s": statistics.median(rates),
            "agent_steps_range": [min(rates), max(rates)],
        }


def entries(arguments: Any, left_out: dict[str, str]) -> Iterator[Entry]:
    """Yield all that is measured; what is not comes into `left_out` with its reason."""
    missing = missing_libraries()
    for library, problem in missing.items():
        left_out[library] = f"not installed ({problem})"
    for contender in CONTENDERS:
        if contender.library in missing:
            continue
        if not contender.batched and arguments.device != "cpu":
            left_out[contender.name] = "worlds in turn, on a CPU alone"
            continue
        for agent_count in arguments.agents:
            expected = 0.0
            for count in arguments.worlds:
                case = Case(count, agent_count, arguments.steps, arguments.device)
                if expected * (1 if contender.batched else count) > arguments.longest:
                    name = f"{contender.name}, {agent_count} agents, {count} worlds"
                    left_out[name] = f"an episode takes longer than {arguments.longest:g} s"
                    continue
                runner = contender.make(case)
                runner.reset()
                read(runner, case, WARM_STEPS)
                seconds = read(runner, case, 1).seconds * arguments.steps
                expected = seconds if contender.batched else seconds / count
                yield Entry(contender, case, runner, [])


def draw(records: Sequence[dict[str, Any]]) -> bytes:
    """Return a PNG of agent-steps a second against worlds: a row for each machine's record."""
    agent_counts = sorted({row["agents"] for record in records for row in record["rows"]})
    figure, panels = new_figure(len(records), len(agent_counts), (9.0, 0.6 + 3.3 * len(records)))
    for across, record in zip(panels, records, strict=True):
        rows = record["rows"]
        for panel, agent_count in zip(across, agent_counts, strict=True):
            for number, contender in enumerate(CONTENDERS):
                found = [
                    (row["world_count"], row["agent_steps_per_s"])
                    for row in rows
                    if row["name"] == contender.name and row["agents"] == agent_count
                ]
                style = "o-" if contender.library == "npa_envs" else "s--"
                panel.loglog(
                    *zip(*found, strict=True) if found else ((), ()),
                    style,
                    color=f"C{number}",
                    label=contender.name,
                )
            panel.set(xlabel="worlds", ylabel="agent-steps a second")
            panel.set_title(f"{agent_count} agents, {record['machine']}")
            counts = sorted({row["world_count"] for row in rows})
            panel.set_xticks(counts, [str(count) for count in counts])
            panel.minorticks_off()
            number_plainly(panel.yaxis)
            panel.grid(alpha=0.3)
    legend_of(figure, panels[0, 0], "right center")
    return png(figure)


def main() -> None:
    """Measure, print, write and draw."""
    parser = script_parser(__doc__)
    parser.add_argument("--agents", type=int, nargs="+", default=AGENTS)
    parser.add_argument("--worlds", type=int, nargs="+", help="default: as the device allows")
    parser.add_argument("--steps", type=int, default=16, help="of an episode")
    parser.add_argument("--repeats", type=int, default=5, help="readings of each")
    parser.add_argument("--longest", type=float, default=20.0, help="seconds of an episode")
    parser.add_argument("--plot", type=Path, help="PNG file to draw")
    parser.add_argument("--draw", type=Path, nargs="+", help="JSON files to draw, not measuring")
    arguments = parser.parse_args()
    if arguments.draw:
        write_bytes(arguments.plot, draw([read_json(path)["agents"] for path in arguments.draw]))
        return
    torch.set_num_threads(arguments.threads)
    kind = torch.device(arguments.device).type
    arguments.worlds = sorted(arguments.worlds or WORLDS[kind])
    left_out: dict[str, str] = {}
    measured = list(entries(arguments, left_out))
    for what, why in left_out.items():
        print(f"left out: {what}: {why}", flush=True)
    record: dict[str, Any] = {
        **script_facts(arguments),
        "episode_steps": arguments.steps,
        "clock": "process" if kind == "cpu" else "wall",
        "left_out": left_out,
    }
    for repeat in range(arguments.repeats):
        for entry in measured:
            entry.readings.append(read(entry.runner, entry.case, entry.case.episode_steps))
        record |= {"repeats": repeat + 1, "rows": [entry.row() for entry in measured]}
        if arguments.output:
            before = read_json(arguments.output) if arguments.output.exists() else {}
            write_record(arguments.output, before | {"agents": record})
    for row in record["rows"]:
        print(
            f"{row['name']:24} {row['agents_acting']:5.1f} agents {row['world_count']:5} worlds "
            f"{row['step_us']:12.1f} µs a step {row['agent_steps_per_s']:12.4g} agent-steps/s"
        )
    if arguments.plot:
        write_bytes(arguments.plot, draw([record]))


if __name__ == "__main__":
    main()
