"""`npa-envs compare`: reinforcement learning, evolution and the gradient on the same tasks."""

from __future__ import annotations

import itertools
import json
import math
import re
import sys
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import tyro

from npa_envs.cli import common
from npa_envs.errors import NPAError, check_known

if TYPE_CHECKING:
    from npa_envs.agents.comparison.plan import BudgetKind, ComparisonPlan
    from npa_envs.agents.comparison.single_run import RunRecord


@dataclass(frozen=True, kw_only=True)
class CompareOptions(common.MeasureOptions):
    """Compare methods on tasks over seeds, for equal wall time, equal particle-steps, or both.

    Each run learns in its own process. A failed run is recorded with its error, and the others
    continue. A stopped comparison continues and repeats failed runs. The exit code is 1 if a run
    failed.

    Examples:
      npa-envs compare --quick --out quick
      npa-envs compare --learning-seconds 60 --methods gradient ppo --tasks morphogenesis2d
      npa-envs compare --suite npa-bench-small-v0 --out bench --jobs 2
    """

    out: Path = Path("comparison")
    """Folder for AXIS/TASK/METHOD/seed-K/, comparison.md, .json, .csv, curves (extra `bench`)."""
    suite: Literal["npa-bench-v0", "npa-bench-small-v0"] | None = None
    """Run a frozen benchmark, which fixes tasks, budgets and episodes; the small one runs on a
    laptop. OUT/rows/METHOD.json gets the results of each method; those of other tasks and seeds
    stay there."""
    tasks: tuple[str, ...] = ()
    """morphogenesis2d, regeneration2d, point_classification, mixing, or ids of the suite without
    npa/; default: all, or the first when quick."""
    methods: tuple[str, ...] = ()
    """Methods of npa_envs.agents.learning; default: those of the suite, or all but `clone`, which
    imitates the run of `gradient` from the same seed. NAME=METHOD gives one a new name, for other
    options (bold=ppo), or runs your function (mine=module:function)."""
    seed_count: int | None = None
    """Number of seeds 0, 1, ... for each method and task; default: 3, in a suite 5, quick 1."""
    learning_seconds: float | None = None
    """Compare for equal wall time: seconds of learning of each run, without evaluations."""
    particle_steps: float | None = None
    """Compare for equal particle-steps: how many each run may learn from, for example 1e8."""
    episodes: int | None = None
    """Held-out episodes that evaluate a run; default: 32, or 4 when quick."""
    options: Annotated[tuple[str, ...], tyro.conf.arg(metavar="METHOD.NAME=VALUE")] = ()
    """Options of methods, values as JSON or plain text: evolution.population=64."""
    quick: bool = False
    """Tiny worlds and, by default, few steps, methods, tasks and one seed: a test that it runs, a
    minute at most on two CPU cores."""
    devices: tuple[str, ...] = ()
    """Devices to distribute the runs over, for example cuda:0 cuda:1; default: --device."""
    jobs: int | None = None
    """Runs at the same time; default: one for each device. With --learning-seconds each device must
    have the same number, as runs on one device share its time."""
    part: Annotated[str | None, tyro.conf.arg(metavar="K/N")] = None
    """Run only the K-th of N parts: several machines, or tasks of a scheduler's array, run one part
    each, all with the same --out on a shared disk."""


def main(arguments: Sequence[str]) -> int:
    """Do the missing runs, print and write the table; return 1 if a run failed."""
    options = common.parse_options(CompareOptions, "compare", arguments)
    from npa_envs.agents.comparison.npa_bench import SUITES, check_rows, write_rows
    from npa_envs.agents.comparison.report import write_pictures, write_table
    from npa_envs.agents.comparison.single_run import held_records, run_jobs
    from npa_envs.measure.benchmark_records import command_text
    from npa_envs.measure.process_queue import Slots

    command = command_text("compare", arguments, "--out")
    # Methods of the user are imported from the current folder, as in the runs' processes.
    sys.path.insert(0, str(Path.cwd()))
    plan = make_plan(options)
    folder = common.writable_folder(options.out)
    rows_folder = folder / "rows"
    # Read before any run, so that a record of other settings is rejected at once.
    records = held_records(plan, folder)
    if options.suite is not None:
        check_rows(SUITES[options.suite], plan, rows_folder)
    jobs = plan.jobs()
    part_jobs = plan.part(options.part)
    missing = [job for job in part_jobs if job not in records]

    def done_records() -> list[RunRecord]:
        return [records[job] for job in jobs if job in records]

    def add_record(record: RunRecord) -> None:
        records[record.job] = record
        write_table(plan, done_records(), folder, command)
        advance(1)

    slots = Slots((options.devices or (options.device,)), _jobs(options), options.threads)
    with common.progress_bar(len(missing), show=options.progress, unit="run") as advance:
        run_jobs(
            plan, missing, folder, slots, command=command, max_seconds=options.max_seconds,
            written=add_record,
        )  # fmt: skip
    done = done_records()
    lines = [write_table(plan, done, folder, command), *write_pictures(done, folder)]
    if options.suite is not None:
        common.writable_folder(rows_folder)
        rows = write_rows(SUITES[options.suite], plan, done, rows_folder, command)
        lines += [f"wrote {path}" for path in rows]
    failed = [record for record in done if record.status == "failed"]
    lines += [f"{record.job} failed: {record.error}" for record in failed]
    if remaining := sum(job not in records for job in part_jobs):
        lines.append(f"{remaining} runs are left: call again with the same options")
    print("\n".join(lines))
    return 1 if failed else 0


def make_plan(options: CompareOptions) -> ComparisonPlan:
    """Return the tasks, methods, seeds and budgets to compare; a suite fixes the budgets."""
    from npa_envs.agents.comparison import npa_bench
    from npa_envs.agents.comparison.plan import LEFT_OUT, PROBLEMS, ComparisonPlan, make_problem
    from npa_envs.agents.learning import METHODS

    options, quick = _checked(options), options.quick
    suite = None if options.suite is None else npa_bench.SUITES[options.suite]
    tasks = common.chosen_names("task", options.tasks, suite.tasks if suite else PROBLEMS)
    if suite and quick and not options.tasks:
        tasks = tasks[:1]
    methods, own = _chosen_methods(options.methods, suite.methods if suite else METHODS)
    if not (suite or options.methods):
        methods = [name for name in methods if name != "clone"]  # It needs a teacher.
    changed_options = _method_options(options.options, methods, own)
    budgets: dict[BudgetKind, dict[str, float]]
    if suite:
        for name in changed_options.keys() - own.keys():
            raise NPAError(
                f"options of {name!r} are frozen in {options.suite}: give it another name, "
                f"--methods my_{name}={name} --options my_{name}.NAME=VALUE"
            )
        problems = {name: suite.problem_of(name) for name in tasks}
        part = npa_bench.QUICK_FRACTION if quick else 1.0
        steps = {name: part * suite.budgets[suite.tasks[name]] for name in tasks}
        budgets = {npa_bench.BUDGET_KIND: steps}
        left_out = [
            (task, method)
            for task, method in itertools.product(tasks, methods)
            if suite.leaves_out(task, own.get(method, method))
        ]
        seeds, episodes = 1 if quick else npa_bench.MIN_SEEDS, npa_bench.EPISODES
    else:
        problems = {name: make_problem(name, quick=quick) for name in tasks}
        budgets = {axis: dict.fromkeys(tasks, limit) for axis, limit in _budgets(options).items()}
        left_out = [] if options.methods else list(LEFT_OUT)
        seeds, episodes = 3, 32
    return ComparisonPlan(
        tasks={name: json.loads(problem.to_json()) for name, problem in problems.items()},
        methods=methods, seeds=tuple(range(options.seed_count or seeds)), budgets=budgets,
        options=changed_options, own=own, left_out=left_out,
        episodes=options.episodes or (4 if quick else episodes), settings=_settings(options),
    )  # fmt: skip


def _checked(options: CompareOptions) -> CompareOptions:
    """Return the options with the defaults of `--quick`; raise NPAError for wrong ones."""
    from npa_envs.agents.learning.problem import RUN_SEED_COUNT

    common.check_numbers(options, seed_count=1, episodes=1, jobs=1, threads=1)
    if options.seed_count is not None and options.seed_count > RUN_SEED_COUNT:
        raise NPAError(
            f"seed_count must be at most {RUN_SEED_COUNT}, got {options.seed_count}: later "
            "runs would learn in the worlds of evaluations"
        )
    for name in ("learning_seconds", "particle_steps", "episodes"):
        if options.suite is not None and getattr(options, name) is not None:
            raise NPAError(
                f"--{name.replace('_', '-')} must not be given with --suite, whose protocol is "
                "frozen: leave it out, or compare without a suite"
            )
    if options.suite is not None or not options.quick:
        return options
    return replace(
        options, tasks=options.tasks or ("morphogenesis2d",), seed_count=options.seed_count or 1,
        methods=options.methods or ("gradient", "evolution", "zero"),
    )  # fmt: skip


def _budgets(options: CompareOptions) -> dict[BudgetKind, float]:
    seconds, steps = options.learning_seconds, options.particle_steps
    if options.quick and steps is None and seconds is None:
        steps = 200_000
    limits: dict[BudgetKind, float | None] = {"seconds": seconds, "particle-steps": steps}
    budgets = {axis: limit for axis, limit in limits.items() if limit is not None}
    if not budgets:
        raise NPAError(
            "a comparison needs a budget: give --learning-seconds 60, --particle-steps 1e8 or both"
        )
    for axis, value in budgets.items():
        if not (0.0 < value < math.inf and (axis == "seconds" or value >= 1.0)):
            raise NPAError(f"{axis} must be positive and finite, got {value}: try 60 or 1e8")
    return budgets


def _chosen_methods(
    arguments: Sequence[str], known: Iterable[str]
) -> tuple[list[str], dict[str, str]]:
    """Return the names of the methods to run, and METHOD by NAME of arguments NAME=METHOD."""
    from npa_envs.agents.learning import method_options

    known = list(known)
    named = [word.split("=", 1) for word in arguments if "=" in word]
    own = dict(named)
    for name, count in Counter(name for name, _ in named).items():
        if count > 1:
            same = " and ".join(word for word in arguments if word.startswith(f"{name}="))
            raise NPAError(f"methods must have different names, got {same}: rename one")
    for name, method in own.items():
        if not re.fullmatch("[a-z0-9_]+", name) or name in known:
            raise NPAError(
                "a method's own name must be new and of small letters, digits and _, got "
                f"{name!r}: my_{method.rpartition(':')[2]}={method}"
            )
        method_options(method)
    plain = [word for word in arguments if "=" not in word]
    return [*(common.chosen_names("method", plain, known) if plain or not own else []), *own], own


def _method_options(
    arguments: Sequence[str], methods: Sequence[str], own: Mapping[str, str]
) -> dict[str, dict[str, Any]]:
    from npa_envs.agents.learning import method_options

    options_of: dict[str, dict[str, Any]] = {}
    for word in arguments:
        name, mark, value = word.partition("=")
        method, dot, option = name.partition(".")
        if not (mark and dot and option):
            raise NPAError(
                f"options must be METHOD.NAME=VALUE, got {word!r}: evolution.population=64"
            )
        check_known("unknown method", method, methods, f" in {word!r}")
        known = method_options(own.get(method, method))
        check_known("unknown option", option, known, f" in {word!r}")
        options_of.setdefault(method, {}).update(
            common.named_values("options", [f"{option}={value}"])
        )
    return options_of


def _jobs(options: CompareOptions) -> int:
    """Return how many runs learn at the same time.

    Raises NPAError if this is no multiple of the number of devices where wall time is compared.
    """
    count = len(options.devices or (options.device,))
    jobs = count if options.jobs is None else options.jobs
    if options.learning_seconds is not None and jobs % count:
        raise NPAError(
            f"jobs must be a multiple of the number of devices, {count}, where wall time is equal, "
            f"got {jobs}: give --jobs {-(-jobs // count) * count}, or leave it out"
        )
    return jobs


def _settings(options: CompareOptions) -> dict[str, Any]:
    """Return the record's entries on machine, versions and CPU threads."""
    from npa_envs.checks import check_device
    from npa_envs.measure.benchmark_records import installed_version, machine, measured_facts

    devices = [check_device(name) for name in (options.devices or (options.device,))]
    kinds = {(device.type, machine(device)) for device in devices}
    if len(kinds) > 1:
        raise NPAError(
            f"devices must be of one kind, as times are compared, got {sorted(kinds)}: choose some"
        )
    facts = measured_facts(
        devices[0],
        options.commit,
        runs_at_once=-(-_jobs(options) // len(devices)),
        threads=options.threads,
    )
    facts["versions"] |= {name: installed_version(name) for name in ("stable-baselines3", "cma")}
    return facts
