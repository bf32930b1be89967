"""`npa-envs search`: a search for rules that differ from each other and stay alive."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Literal

from npa_envs.agents.search.candidate_evaluation import SearchWorld
from npa_envs.cli import common
from npa_envs.errors import NPAError


@dataclass(frozen=True, kw_only=True)
class SearchOptions(common.RunOptions, SearchWorld):
    """Search for rules that differ from each other and stay alive.

    An archive has cells by speed, crowding of particles and mixing of colours, and keeps the best
    candidate of each (its elite): the one whose colours change most while states and positions stay
    within [-1, 1]. The folder gets every elite as a rule file that `view` and `rollout` open, a
    page that shows them, and a record. The same command continues a stopped search, also with a
    larger budget.

    Examples:
      npa-envs search
      npa-envs search --method cma-me --budget 5e7 --out runs/alive
    """

    method: Literal["map-elites", "cma-me", "cma-es", "random"] = "map-elites"
    """How candidates are proposed: as mutants of elites, by CMA-ES rewarded for new elites (cma-me)
    or for quality (cma-es), or at random."""
    budget: float = 2e7
    """Particle-steps of the whole search: candidates times worlds, particles and steps."""
    batch_size: int = 20
    """Candidates that are proposed together."""
    seed: int = 0
    """Seed of the proposals; all candidates run in the same worlds."""
    threads: int = 1
    """CPU threads of torch and of the kernels."""
    max_seconds: float = math.inf
    """Stop after this time [s]; the same command continues."""
    out: Path = Path("runs/search")
    """Folder to write to; created where missing."""


def main(arguments: Sequence[str]) -> int:
    """Search; write the elites' rules, and a page and a picture that show them."""
    options = common.parse_options(SearchOptions, "search", arguments)
    common.check_numbers(options, threads=1)
    from npa_envs.agents.search.elite_files import PAGE, atlas_html, atlas_png, write_elites
    from npa_envs.agents.search.quality_diversity import RESULTS, Search
    from npa_envs.atomic_files import write_text
    from npa_envs.measure.benchmark_records import time_limit
    from npa_envs.measure.plots import write_plots

    enough = time_limit(options.max_seconds)
    world = SearchWorld(**{f.name: getattr(options, f.name) for f in fields(SearchWorld)})
    least = options.batch_size * world.particle_steps
    if not least <= options.budget < math.inf:
        raise NPAError(
            f"budget must be finite and at least that of one batch, {least} particle-steps, got "
            f"{options.budget:g}: raise it"
        )
    device = options.checked_device()
    folder = common.writable_folder(options.out)
    search = Search(
        world, method=options.method, seed=options.seed, batch_size=options.batch_size,
        device=device, path=folder / RESULTS,
    )  # fmt: skip
    if search.evaluations:
        print(f"{search.evaluations} candidates were tried before")
    budget = int(options.budget)
    with common.measuring(options, budget, "particle-step") as advance:
        advance(search.particle_steps)
        search.run(budget, enough=enough, progress=advance)
        if not search.growth:
            print("nothing was tried: raise --max-seconds")
            return 0
        pictures = write_elites(search, folder)
    growth = search.growth[-1]
    print(
        f"{growth.evaluations} candidates, {len(pictures)} elites: coverage {growth.coverage:.3f}, "
        f"QD score {growth.qd_score:.3f}, best quality {growth.best:.3f}"
    )
    write_text(folder / PAGE, atlas_html(search, pictures))
    print(f"wrote {folder / PAGE} and the elites' rules")
    drawn = write_plots(
        lambda: {"": atlas_png(search.axes, pictures)}, folder / "atlas.png", "picture of the atlas"
    )
    print("\n".join(drawn))
    return 0
