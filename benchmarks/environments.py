"""Speed of the batched environments with observations, rewards and resets; run with --help.

Actions are random and drawn in advance. Episodes have 64 steps, so that times include resets: of
all worlds in one step, or (staggered) of some in every step. Worlds start from the seed, a dense
disk (Morphogenesis2D), or as grown and damaged pictures (Regeneration2D). On CUDA observations stay
on the device and the CPU reads one byte a world; on a CPU they are NumPy arrays.

If all worlds are reset together, `calm_step` is a step without resets, and `queued` the same steps
with the work queued on the device without Python, so that the difference is Python's cost. `device`
is the sum of the kernels' times, `idle` the fraction of a step without any kernel.

With --plain only: plain loops of `env.step` without resets, of single environments and of batches.

With --small only: environment steps a second of the small ids of several B, whole episodes with
their resets, and no peers. On a CPU these are seconds of CPU time, of the fastest of some episodes,
which other programs disturb least. benchmarks/gardens.py has more about gardens.

Peers, on a CPU: Gymnasium steps B of our single environments one after the other ("sync") or in B
processes ("async"). Environments of other libraries are measured by benchmarks/agents_beside.py.
"""

from __future__ import annotations

import gc
import statistics
import time
from collections.abc import Callable, Iterator
from typing import Any, NamedTuple

import gymnasium
import torch
from scripts import script_facts, script_parser
from torch import Tensor
from torch.autograd import DeviceType
from torch.profiler import ProfilerActivity, profile

from npa_envs.agents.learning import Problem
from npa_envs.measure.benchmark_records import markdown_table, write_record
from npa_envs.measure.speed.timing import synchronize
from npa_envs.registration import CENTRAL, SIZES, SMALL, SPECIES_SIZES


class Case(NamedTuple):
    """The size of a measurement: B worlds of N particles, and their perception radius eps."""

    world_count: int
    particle_count: int
    eps: float = 0.1


CUDA = (
    Case(1, 1024),
    Case(64, 1024),
    Case(1024, 1024),
    Case(1, 4096),
    Case(64, 4096),
    Case(16, 16384),
)
CPU = (Case(1, 256), Case(1, 1024), Case(1, 4096), Case(8, 1024), Case(64, 256))
QUICK = (Case(1, 64), Case(3, 64))
BROKEN_DOWN = (Case(1024, 1024), Case(64, 4096))
"""Cases whose kernels are listed."""

STARTS: dict[str, tuple[str, dict[str, Any]]] = {
    "seed": ("npa_envs:npa/Morphogenesis2D-v0", {}),
    "grown": ("npa_envs:npa/Regeneration2D-v0", {"success_loss": 0.0}),
}
"""Where episodes start; none ends in success, so that all are equally long."""

EPISODE_STEPS = 64
CALM = 0.25
"""Actions are uniform in plus and minus this: full ones let states run away within an episode."""
ACTION_SETS = 4
CALM_STEPS, COMPARISONS = 16, 9
"""Steps without resets that are timed with and without Python, and how often."""
ENOUGH = 2.0
"""Seconds of a case's episodes that are enough."""
MAX_EPISODES = 9
LISTED_KERNELS = 12


class Prepared:
    """An environment of a case and random actions, compiled and captured, ready to be timed."""

    def __init__(
        self, case: Case, start: str, staggered: bool, device: torch.device, quick: bool
    ) -> None:
        gc.collect()
        synchronize(device)
        if device.type == "cuda":
            torch.cuda.empty_cache()
            torch.cuda.reset_peak_memory_stats(device)
        name, keywords = STARTS[start]
        if start == "grown":
            keywords = keywords | {"seed_pool": min(case.world_count, 4)}
            keywords["grow_steps"] = 4 if quick else 256
        self.env: Any = gymnasium.make_vec(
            name,
            num_envs=case.world_count,
            vectorization_mode="vector_entry_point",
            particle_count=case.particle_count,
            eps=case.eps,
            max_episode_steps=EPISODE_STEPS,
            device=str(device),
            output="torch" if device.type == "cuda" else "numpy",
            **keywords,
        )
        self.env.reset(seed=0)
        self.device, worlds = device, self.env.unwrapped.worlds
        if staggered:
            ages = torch.arange(case.world_count, device=device) * EPISODE_STEPS
            worlds.episodes.elapsed.copy_(ages // case.world_count)
        generator = torch.Generator(device).manual_seed(0)
        shape = (ACTION_SETS, case.world_count, case.particle_count, worlds.physics.action_dim)
        drawn = torch.rand(shape, generator=generator, device=device)
        sets = list(CALM * (2.0 * drawn - 1.0))
        cuda = device.type == "cuda"
        self.actions: list[Any] = sets if cuda else [actions.numpy() for actions in sets]
        # The first episode compiles and captures; the second does all that only follows a reset.
        self.run(2 * EPISODE_STEPS)

    def run(self, steps: int, step: Callable[[Any], Any] | None = None) -> float:
        """Return the wall time of some steps [s], of the environment or of another function."""
        step = step or self.env.step
        synchronize(self.device)
        start = time.perf_counter()
        for k in range(steps):
            step(self.actions[k % len(self.actions)])
        synchronize(self.device)
        return time.perf_counter() - start

    def episodes(self, quick: bool) -> list[float]:
        """Return the times of several episodes [s], enough of them for a median."""
        times = [self.run(EPISODE_STEPS)]
        while not quick and len(times) < MAX_EPISODES and (len(times) < 3 or sum(times) < ENOUGH):
            times.append(self.run(EPISODE_STEPS))
        return times

    def neighbours(self) -> float:
        """Return the mean number of particles within eps of one, in the first world."""
        x, eps = self.env.unwrapped.particles()[0][0], self.env.unwrapped.config.eps
        return float((torch.cdist(x[:256], x) < eps).sum(dim=1).float().mean())

    def python_times(self) -> tuple[float, float]:
        """Return the times of a step [s] as it is, and where the host only queues the work.

        Both are medians over the same steps, from the same worlds, without resets; the second
        neither reads endings nor makes infos. The difference is the cost of Python.
        """
        worlds = self.env.unwrapped.worlds
        changing = (worlds.x, worlds.s, worlds.random.steps, worlds.episodes.elapsed)
        before = [tensor.clone() for tensor in changing]
        out = worlds.perceive()
        calm: list[float] = []
        queued: list[float] = []
        for _ in range(COMPARISONS):
            for step, times in ((None, calm), (lambda a: worlds.queue(a, out), queued)):
                for tensor, value in zip(changing, before, strict=True):
                    tensor.copy_(value)
                times.append(self.run(CALM_STEPS, step) / CALM_STEPS)
        return statistics.median(calm), statistics.median(queued)


def measure(
    case: Case, start: str, staggered: bool, device: torch.device, quick: bool
) -> dict[str, Any]:
    """Return the row of one case."""
    prepared = Prepared(case, start, staggered, device, quick)
    scale, cuda = 1e6 / EPISODE_STEPS, device.type == "cuda"
    times = prepared.episodes(quick)
    wall = statistics.median(times) * scale
    row = {
        **case._asdict(),
        "start": start,
        "resets": "staggered" if staggered else "together",
        "step_us": wall,
        "step_us_range": [min(times) * scale, max(times) * scale],
        "particle_steps_per_s": case.world_count * case.particle_count / wall * 1e6,
    }
    if cuda:
        row["peak_allocated_mib"] = torch.cuda.max_memory_allocated(device) / 2**20
        row["peak_reserved_mib"] = torch.cuda.max_memory_reserved(device) / 2**20
    # Half-way through an episode worlds are as they typically are.
    prepared.run(EPISODE_STEPS // 2)
    row["neighbours"] = prepared.neighbours()
    if cuda and not staggered:
        calm, queued = prepared.python_times()
        row["calm_step_us"], row["queued_us"] = calm * 1e6, queued * 1e6
    prepared.env.close()
    return row


def add_kernels(row: dict[str, Any], device: torch.device, quick: bool) -> None:
    """Add a row's device time, idle share and kernels; print the longest of these.

    On a CPU, torch's operations stand in for kernels. Done after all timings, which a profiler that
    was once at work may slow down.
    """
    case = Case(*(row[name] for name in Case._fields))
    prepared = Prepared(case, row["start"], row["resets"] == "staggered", device, quick)
    cuda = device.type == "cuda"
    kind = DeviceType.CUDA if cuda else DeviceType.CPU
    with profile(activities=[ProfilerActivity.CUDA if cuda else ProfilerActivity.CPU]) as profiler:
        prepared.run(EPISODE_STEPS)
    prepared.env.close()
    kernels = [
        {
            "name": entry.key,
            "us": (entry.self_device_time_total if cuda else entry.self_cpu_time_total)
            / EPISODE_STEPS,
            "launches": entry.count / EPISODE_STEPS,
        }
        for entry in profiler.key_averages()
        if entry.device_type == kind
    ]
    kernels.sort(key=lambda kernel: -kernel["us"])
    row["device_us"] = total = sum(kernel["us"] for kernel in kernels)
    row["idle"] = max(0.0, 1.0 - total / row["step_us"])
    row["launches"] = sum(kernel["launches"] for kernel in kernels)
    print(
        f"{tuple(case)} from {row['start']}, resets {row['resets']}: device {total:.1f} µs, "
        f"{row['launches']:.0f} launches, idle {row['idle']:.0%} of {row['step_us']:.1f} µs",
        flush=True,
    )
    if case in BROKEN_DOWN or quick:
        row["kernels"] = kernels[:LISTED_KERNELS]
        for kernel in row["kernels"]:
            spent, count = kernel["us"], kernel["launches"]
            print(f"  {spent:9.2f} µs {spent / total:6.1%} {count:6.1f} x  {kernel['name'][:80]}")


# Plain loops

PLAIN_STEPS, PLAIN_WARM, PLAIN_READINGS = 48, 2, 5


def measure_plain(
    start: str, count: int | None, particle_count: int, output: str, device: str, quick: bool
) -> dict[str, Any]:
    """Return the time of a step of a plain loop; count None: of a single environment."""
    name, keywords = STARTS[start]
    if start == "grown":
        keywords = keywords | {"seed_pool": min(count or 4, 4), "grow_steps": 4 if quick else 256}
    given: dict[str, Any] = {"particle_count": particle_count, "eps": 0.1, "device": device}
    given |= {"max_episode_steps": EPISODE_STEPS, "output": output, **keywords}
    env: Any
    if count is None:
        env = gymnasium.make(name, disable_env_checker=True, **given)
    else:
        env = gymnasium.make_vec(name, count, vectorization_mode="vector_entry_point", **given)
    generator = torch.Generator().manual_seed(0)
    sets = [
        CALM * (2.0 * torch.rand(env.action_space.shape, generator=generator) - 1.0)
        for _ in range(ACTION_SETS)
    ]
    actions = [drawn.to(device) if output == "torch" else drawn.numpy() for drawn in sets]
    times = []
    for reading in range(PLAIN_WARM + PLAIN_READINGS):
        env.reset(seed=reading)
        synchronize(torch.device(device))
        begun = time.perf_counter()
        for k in range(PLAIN_STEPS):
            env.step(actions[k % ACTION_SETS])
        synchronize(torch.device(device))
        times.append((time.perf_counter() - begun) / PLAIN_STEPS)
    env.close()
    taken = times[PLAIN_WARM:]
    return {
        "form": "single" if count is None else "vector",
        "world_count": count or 1,
        "particle_count": particle_count,
        "start": start,
        "output": output,
        "step_us": statistics.median(taken) * 1e6,
        "step_us_range": [min(taken) * 1e6, max(taken) * 1e6],
    }


def plain_rows(device: str, quick: bool) -> Iterator[dict[str, Any]]:
    """Yield single environments by both kinds of arrays, then batches of tensors."""
    count = 64 if quick else 1024
    for start in ("grown", "seed"):
        for output in ("torch", "numpy"):
            yield measure_plain(start, None, count, output, device, quick)
    batches = (Case(2, 64),) if quick else PLAIN_BATCHES
    for case in batches:
        yield measure_plain("grown", case[0], case[1], "torch", device, quick)


PLAIN_BATCHES = (Case(64, 4096), Case(1024, 1024), Case(1, 1024), Case(64, 1024))

# Small worlds

SMALL_STEPS = {
    row.id: row.max_episode_steps
    for row in (*SMALL, *SIZES, *CENTRAL, *SPECIES_SIZES)
    if "Small" in row.id
}
"""Steps of an episode by id."""

SMALL_WORLDS = (1, 8, 64)
SMALL_SECONDS = 1.0


def measure_small(
    env_id: str, world_count: int, device: torch.device, quick: bool
) -> dict[str, Any]:
    """Return the row of a small id with a number of worlds."""
    steps = SMALL_STEPS[env_id]
    envs: Any = Problem(env_id=env_id, episode_steps=steps).make_envs(world_count, device=device)
    generator = torch.Generator(device).manual_seed(0)
    shape = (ACTION_SETS, world_count, *envs.single_action_space.shape)
    drawn = torch.rand(shape, generator=generator, device=device)
    actions: list[Tensor] = list(CALM * (2.0 * drawn - 1.0))
    envs.reset(seed=0)

    def run() -> None:
        for k in range(steps):
            envs.step(actions[k % len(actions)])

    envs.step(actions[0])
    envs.reset(seed=0)
    times: list[float] = []
    cuda = device.type == "cuda"
    clock = time.perf_counter if cuda else time.process_time
    while not times or (not quick and (sum(times) < SMALL_SECONDS or len(times) < 3)):
        synchronize(device)
        start = clock()
        run()
        synchronize(device)
        times.append(clock() - start)
    taken = (statistics.median(times) if cuda else min(times)) / steps
    envs.close()
    return {
        "id": env_id,
        "world_count": world_count,
        "step_us": taken * 1e6,
        "steps_per_s": world_count / taken,
    }


def small_table(rows: list[dict[str, Any]]) -> str:
    """Return environment steps a second, a line for each id, Markdown."""
    counts = sorted({row["world_count"] for row in rows})
    found = {(row["id"], row["world_count"]): f"{row['steps_per_s']:.0f}" for row in rows}
    ids = dict.fromkeys(row["id"] for row in rows)
    lines = [(f"`{name}`", *(found[name, count] for count in counts)) for name in ids]
    return markdown_table(("Id", *(f"B {count}" for count in counts)), lines)


# Peers

GYMNASIUM_WORLDS, GYMNASIUM_PARTICLES = 8, 1024


def median_time(run: Callable[[], None], device: torch.device, seconds: float) -> float:
    """Return the median time of a call [s], from at least three and about `seconds`."""
    times: list[float] = []
    run()
    while len(times) < 3 or sum(times) < seconds:
        synchronize(device)
        start = time.perf_counter()
        run()
        synchronize(device)
        times.append(time.perf_counter() - start)
    return statistics.median(times)


def measure_gymnasium(mode: str, quick: bool) -> dict[str, Any]:
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
    sets = [CALM * env.action_space.sample() for _ in range(4)]
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


def show(row: dict[str, Any]) -> None:
    """Print a row with rounded numbers."""
    hidden = ("kernels", "step_us_range")
    short = {k: f"{v:.4g}" if isinstance(v, float) else v for k, v in row.items()}
    print("  ".join(f"{k} {v}" for k, v in short.items() if k not in hidden), flush=True)


def main() -> None:
    """Measure, print and write JSON."""
    parser = script_parser(__doc__)
    parser.add_argument("--quick", action="store_true", help="tiny worlds: does it run?")
    parser.add_argument("--case", type=int, nargs=2, metavar=("B", "N"), help="only this one")
    parser.add_argument("--plain", action="store_true", help="only plain loops without resets")
    parser.add_argument("--small", action="store_true", help="only small ids")
    parser.add_argument("--skip-peers", action="store_true", help="only these environments")
    parser.add_argument("--skip-own", action="store_true", help="only the peers")
    arguments = parser.parse_args()
    torch.set_num_threads(arguments.threads)
    device, quick = torch.device(arguments.device), arguments.quick
    if arguments.small:
        counts = SMALL_WORLDS[:1] if quick else SMALL_WORLDS
        small = []
        for name in SMALL_STEPS:
            small += [measure_small(name, count, device, quick) for count in counts]
            print(small_table(small[-len(counts) :]).splitlines()[-1], flush=True)
        if arguments.output:
            write_record(arguments.output, {**script_facts(arguments), "rows": small})
        return
    if arguments.plain:
        plain = []
        for row in plain_rows(arguments.device, quick):
            plain.append(row)
            show(row)
            if arguments.output:
                write_record(arguments.output, {**script_facts(arguments), "rows": plain})
        return
    cuda = device.type == "cuda"
    cases = QUICK if quick else CUDA if cuda else CPU
    if arguments.case:
        cases = (Case(*arguments.case),)
    rows: list[dict[str, Any]] = []
    for case in () if arguments.skip_own else cases:
        for start in STARTS:
            for staggered in (False, True) if case.world_count > 1 else (False,):
                rows.append(measure(case, start, staggered, device, quick))
                show(rows[-1])
    for row in rows if cuda or quick else ():
        add_kernels(row, device, quick)
    peers: list[dict[str, Any]] = []
    for mode in () if cuda or arguments.skip_peers else ("sync", "async"):
        peers.append(measure_gymnasium(mode, quick))
        show(peers[-1])
    if arguments.output:
        report = {"episode_steps": EPISODE_STEPS, "rows": rows, "peers": peers}
        write_record(arguments.output, {**script_facts(arguments), **report})


if __name__ == "__main__":
    main()
