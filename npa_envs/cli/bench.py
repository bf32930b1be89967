"""`npa-envs bench`: times of steps and gradients; which kernels a step runs."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from npa_envs.cli import common
from npa_envs.errors import NPAError


@dataclass(frozen=True, kw_only=True)
class BenchOptions(common.MeasureOptions):
    """Measure the paper's table, scaling and other times; or list the kernels of a step.

    Examples:
      npa-envs bench --quick
      npa-envs bench --suite scaling --out results --plots
    """

    suite: str | None = None
    """quick (the default), paper, scaling or kernels."""
    quick: bool = False
    """Small worlds only: about a minute on a CPU."""
    repeats: int = 7
    """How often each time is measured; tables show median and range."""
    out: Path | None = None
    """Folder for SUITE_DEVICE.json and plots; default: nothing is written."""
    plots: bool = False
    """Also draw plots into the output folder; needs the extra `bench`."""
    explain: bool = False
    """Measure nothing: print which kernels a step launches, and why. The options below describe the
    step."""
    space_dim: Literal[2, 3] = 2
    """Space dimension D."""
    world_count: int = 1
    """Worlds B."""
    particle_count: int = 4096
    """Particles N of each world."""
    state_dim: int = 16
    """State channels C."""
    update_prob: float = 0.5
    """Probability of each particle's update."""
    periodic: bool = False
    """In a periodic box instead of open space."""
    dtype: Literal["float32", "float64"] = "float32"
    """Precision."""
    gradients: Literal["none", "weights", "positions"] = "weights"
    """Gradients of the step: none, by weights and states, or also by positions."""


def main(arguments: Sequence[str]) -> int:
    """Measure times; print and write their tables."""
    options = common.parse_options(BenchOptions, "bench", arguments)
    from npa_envs.atomic_files import write_text
    from npa_envs.measure import benchmark_records, plots
    from npa_envs.measure.speed import suites, timing

    common.check_numbers(
        options, repeats=1, threads=1, world_count=1, particle_count=1, state_dim=1
    )
    if options.plots and options.out is None:
        raise NPAError("plots need a folder to be written to: give --out DIR as well")
    device = options.checked_device()
    (name,) = common.chosen_names("suite", [options.suite or "quick"], suites.SUITES)
    if options.explain:
        import torch

        from npa_envs.measure.speed.explain import explain

        workload = timing.Workload(
            options.space_dim, options.world_count, options.particle_count, steps=1,
            state_dim=options.state_dim, update_prob=options.update_prob,
        )  # fmt: skip
        dtype, gradients = getattr(torch, options.dtype), options.gradients
        print(explain(workload, device, dtype, periodic=options.periodic, gradients=gradients))
        return 0
    folder = None if options.out is None else common.writable_folder(options.out)
    if options.plots:
        plots.check_matplotlib()
    with common.measuring(options, None, "row") as advance:
        session = timing.TimingSession(
            device=device, repeats=options.repeats, small=options.quick, progress=advance,
            enough=benchmark_records.time_limit(options.max_seconds),
        )  # fmt: skip
        tables = suites.SUITES[name](session)
    command = benchmark_records.command_text("bench", arguments)
    commit = options.commit or benchmark_records.current_commit()
    report = suites.BenchReport(name, command, commit, options.threads, session, tables)
    print(report.text())
    if folder is not None:
        path = folder / f"{name}_{device.type}.json"
        write_text(path, report.json())
        print(f"wrote {path}")
        if options.plots:
            pictures = path.with_name(f"{path.stem}_*.png")
            print(*plots.write_plots(lambda: suites.pictures(tables), pictures, "plots"), sep="\n")
    return 0
