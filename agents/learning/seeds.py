"""Seeds of worlds: every run learns in worlds of its own, and none in those of evaluations."""

from __future__ import annotations

from npa_envs.errors import NPAError

WORLDS_PER_SEED = 10_000
"""Distance of the worlds' seeds of one run from those of the next."""

FIRST_EVALUATION_SEED = 1_000_000
"""Seeds from here on are for evaluations."""

EVALUATION_SEEDS = range(FIRST_EVALUATION_SEED, FIRST_EVALUATION_SEED + 16)
"""Seeds of evaluations, far from those that learners begin their worlds with."""


def world_seeds(seed: int, count: int) -> range:
    """Return the seeds of the worlds that a run learns in, which no other run has.

    Args:
        seed: Of the run, at least 0.
        count: How many worlds.

    Raises:
        NPAError: There are too many, or the seed is so large that they are those of evaluations.
    """
    runs = FIRST_EVALUATION_SEED // WORLDS_PER_SEED
    if seed >= runs:
        raise NPAError(
            f"seed must be below {runs}, got {seed}: later ones would have worlds of evaluations"
        )
    if count > WORLDS_PER_SEED:
        raise NPAError(
            f"worlds must be at most {WORLDS_PER_SEED}, got {count}: more would share their "
            "seeds with the next run"
        )
    first = seed * WORLDS_PER_SEED
    return range(first, first + count)
