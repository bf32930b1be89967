"""Settings of the runs of recipes.py: sizes of worlds, arms, seeds."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from npa_envs.tasks.morphogenesis2d import SPECIES_RUN, Morphogenesis2DTrainConfig
from npa_envs.training import preset

SEEDS = tuple(range(1000, 1008))
"""Seeds of the worlds that rules are measured on."""

QUARTERS = (0.2, 0.4, 0.6, 0.8)
"""Milestones of the paper's schedule, as fractions of its length."""

Fields = Mapping[str, Any]

SIZES: Mapping[str, Fields] = {
    "full": {"particle_count": 4096, "target_point_count": 4096, "iterations": 10_000},
    "small": {
        "particle_count": 1024,
        "target_point_count": 1024,
        "resolution": 128,
        "eps": 0.14,
        "seed_radius": 0.28,
        "iterations": 3000,
    },
    "fast": {},
    "tiny": {
        "particle_count": 128,
        "target_point_count": 128,
        "resolution": 32,
        "hidden_dim": 16,
        "eps": 0.3,
        "iterations": 6,
        "steps": (4, 6),
        "max_age_range": (4, 64),
        "pool_size": 16,
    },
}
"""Worlds: as in the preset `paper`; a quarter of its particles, which see as many others and
begin in a disk as large, as they see; as in `fast`; and a test of the script."""

STRAYS: Fields = {
    "escape_share": 2e-4,
    "escape_weight": 10.0,
    "bound_weight": 10.0,
    "drift_weight": 1.0,
    "clump_radius": 0.2,
    "cut_gap": 0.1,
}
"""What keeps worlds together for 100 000 steps, and heals clumps and cuts."""

NO_STRAYS: Fields = dict.fromkeys(STRAYS, 0.0) | {"bound_weight": 100.0}

SECOND: Fields = {
    **STRAYS,
    "max_age_range": (64, 16_384),
    "pool_size": 64,
    "schedule": "cosine",
    "learning_rate": 1e-3,
    "steps": (48, 80),
    "damage_share": 0.5,
    "escape_share": 5e-5,
}
"""The second candidate: worlds of all ages, of which half are left to themselves.

Its damaged worlds were those of every other place of the pool, the longest-lived ones too."""

THIRD: Fields = SECOND | {
    "max_age_range": (256, 32_768),
    "damage_share": 0.25,
    "escape_share": 2e-4,
}
"""The third candidate: fewer seeds, older worlds, and only worlds of short lives are damaged."""

SEVENTH: Fields = {
    **STRAYS,
    "seed_interval": 1,
    "fresh_share": 0.5,
    "pool_size": 64,
    "steps": (32, 64),
    "schedule": "cosine",
    "learning_rate": 2e-3,
    "initial_rule": "heart-first",
}
"""What serves `fast`, in large: half of the worlds are seeds, none is old. Not at full size."""

EIGHTH: Fields = {
    **STRAYS,
    "max_age_range": (64, 16_384),
    "pool_size": 64,
    "steps": (48, 80),
    "schedule": "cosine",
    "learning_rate": 2e-3,
    "damage_share": 0.25,
    "damage_radius": 0.2,
    "stillness_weight": 2.0,
    "initial_rule": "heart-first",
}
"""The eighth candidate: grown worlds are to rest."""

MUON: Fields = {"optimiser": "muon", "learning_rate": 5e-3}
"""Orthogonal steps, and a rate; `best` has 3e-3."""

FROM_32: Fields = {
    "damage_and_keep_share": 0.5,
    "max_age_range": (32, 16_384),
    "damage_share": 0.125,
}
TO_4096: Fields = {"damage_and_keep_share": 0.6, "max_age_range": (16, 4096), "damage_share": 0.125}
FROM_16: Fields = {
    "damage_and_keep_share": 0.6,
    "max_age_range": (16, 16_384),
    "damage_share": 0.125,
}
"""Second lives, with shorter ones that bring back the seeds."""

FAST_BEFORE: Fields = {
    **NO_STRAYS,
    **SPECIES_RUN,
    "stillness_min_age": 512,
    "learning_rate": 2e-3,
    "schedule": "milestones",
    "milestones": (1500, 2100),
    "seed_interval": 2,
    "hidden_dim": 64,
    "initial_rule": "",
}
"""The preset `fast` as it was when its arms were compared, laid over what it is."""

FAST_SECOND: Fields = {
    "max_age_range": (24, 2048),
    "pool_size": 16,
    "schedule": "cosine",
    "damage_share": 0.5,
}
"""The second candidate in small."""

FAST_STRAYS: Fields = STRAYS | {"escape_share": 1e-3}
"""As `STRAYS`, of fewer particles."""

FAST_FIFTH: Fields = {
    **FAST_STRAYS,
    "learning_rate": 4e-3,
    "schedule": "cosine",
    "initial_rule": "gecko-512",
}
"""The preset `fast` after the third round, which begins with a rule that has learned a gecko."""

FAST_SIXTH: Fields = FAST_FIFTH | {"seed_interval": 1}
"""Half of the worlds are seeds: the preset `fast`."""

FAST_EIGHTH: Fields = {
    **FAST_FIFTH,
    "learning_rate": 2e-3,
    "max_age_range": (24, 256),
    "damage_share": 0.5,
    "stillness_min_age": 64,
    "stillness_weight": 0.5,
}
"""The eighth candidate in small: of two worlds one is young and damaged, one grown and at rest."""

ARMS: Mapping[str, Fields] = {
    "paper": {},
    "paper, seeds every 3rd": {"seed_interval": 3},
    "second": SECOND,
    "second, no strays": SECOND | NO_STRAYS,
    "second, share 0.25": SECOND | {"damage_share": 0.25},
    "second, share 1": SECOND | {"damage_share": 1.0},
    "second, rate 2e-3": SECOND | {"learning_rate": 2e-3},
    "second, steps 96 to 128": SECOND | {"steps": (96, 128), "iterations": 1700},
    "second, max_age_range to 65536": SECOND | {"max_age_range": (64, 65_536)},
    "second, hidden 256": SECOND | {"hidden_dim": 256},
    "second, 4 worlds": SECOND | {"world_count": 4, "iterations": 6000},
    "third": THIRD,
    "third, no strays": THIRD | NO_STRAYS,
    "third, max_age_range from 64": THIRD | {"max_age_range": (64, 32_768)},
    "seventh": SEVENTH,
    "eighth": EIGHTH,
    "eighth, rest 1": EIGHTH | {"stillness_weight": 1.0},
    "eighth, no rest": EIGHTH | {"stillness_weight": 0.0},
    "eighth, rest 0.5": EIGHTH | {"stillness_weight": 0.5},
    "eighth, rate 1e-3": EIGHTH | {"learning_rate": 1e-3},
    "eighth, rate 4e-3": EIGHTH | {"learning_rate": 4e-3},
    "eighth, share 0.5": EIGHTH | {"damage_share": 0.5},
    "eighth, steps 32 to 64": EIGHTH | {"steps": (32, 64), "max_age_range": (32, 16_384)},
    "eighth, damage 0.1": EIGHTH | {"damage_radius": 0.1},
    "eighth, muon": EIGHTH | MUON,
    "eighth, muon, rate 2.5e-3": EIGHTH | MUON | {"learning_rate": 2.5e-3},
    "eighth, muon, rate 1e-2": EIGHTH | MUON | {"learning_rate": 1e-2},
    "eighth, muon, to 4096": EIGHTH | MUON | TO_4096,
    "eighth, muon, from 16": EIGHTH | MUON | FROM_16,
    "eighth, muon, from 16, decay 0.1": EIGHTH | MUON | FROM_16 | {"weight_decay": 0.1},
    "eighth, second lives": EIGHTH | {"damage_and_keep_share": 0.5},
    "eighth, second lives, from 32": EIGHTH | FROM_32,
    "eighth, second lives, to 4096": EIGHTH | TO_4096,
    "eighth, second lives, from 16": EIGHTH | FROM_16,
    "eighth, second lives, from 32, more cuts": EIGHTH | FROM_32 | {"cut_share": 0.5},
    "eighth, second lives, from 16, more cuts": EIGHTH | FROM_16 | {"cut_share": 0.5},
    "eighth, from 32": EIGHTH | {"max_age_range": (32, 16_384), "damage_share": 0.125},
    "seventh, untrained, rate 3e-3": SEVENTH
    | {"initial_rule": "", "learning_rate": 3e-3, "steps": (48, 50), "iterations": 1500},
}
"""Arms of `full` and `small`: what each changes of the preset `paper`."""

FAST_ARMS: Mapping[str, Fields] = {
    "fast": {},
    "fast, share 0.5": {"damage_share": 0.5},
    "fast, rate 4e-3": {"learning_rate": 4e-3},
    "second": FAST_SECOND,
    "second, rate 4e-3": FAST_SECOND | {"learning_rate": 4e-3},
    "second, no damage": FAST_SECOND | {"damage_share": 0.0},
    "second, strays": FAST_SECOND | FAST_STRAYS,
    "second, steps 32 to 48": FAST_SECOND | {"steps": (32, 48), "iterations": 1440},
    "second, 4 worlds": FAST_SECOND | {"world_count": 4, "iterations": 1200},
    "second, max_age_range from 96": FAST_SECOND | {"max_age_range": (96, 2048)},
    "second, hidden 128": FAST_SECOND | {"hidden_dim": 128},
    "fast, rate 8e-3": {"learning_rate": 8e-3},
    "fast, rate 4e-3, strays": FAST_STRAYS | {"learning_rate": 4e-3},
    "fast, rate 4e-3, strays, cosine": {
        **FAST_STRAYS,
        "learning_rate": 4e-3,
        "schedule": "cosine",
    },
    "third": {
        **FAST_SECOND,
        **FAST_STRAYS,
        "learning_rate": 4e-3,
        "max_age_range": (96, 4096),
        "steps": (24, 40),
        "iterations": 1800,
    },
    "fifth": FAST_FIFTH,
    "fifth, rate 2e-3": FAST_FIFTH | {"learning_rate": 2e-3},
    "sixth": FAST_SIXTH,
    "sixth, rate 2e-3": FAST_SIXTH | {"learning_rate": 2e-3},
    "sixth, share 0.5": FAST_SIXTH | {"damage_share": 0.5},
    "eighth": FAST_EIGHTH,
    "eighth, muon": FAST_EIGHTH | MUON,
    "eighth, muon, hidden 128, rest 2": FAST_EIGHTH
    | MUON
    | {"hidden_dim": 128, "stillness_weight": 2.0, "initial_rule": ""},
    "eighth, rate 4e-3": FAST_EIGHTH | {"learning_rate": 4e-3},
    "eighth, no rest": FAST_EIGHTH | {"stillness_weight": 0.0},
    "eighth, rest 2": FAST_EIGHTH | {"stillness_weight": 2.0},
    "eighth, to 4096": FAST_EIGHTH | {"max_age_range": (24, 4096), "stillness_min_age": 512},
    "sixth, untrained": FAST_SIXTH | {"initial_rule": ""},
}
"""Arms of `fast`: what each changes of it as it was first; the preset is now "eighth, muon, hidden
128, rest 2"."""


@dataclass(frozen=True)
class Run:
    """One training run."""

    size: str
    """A name of `SIZES`."""
    arm: str
    """A name of `ARMS`, or of `FAST_ARMS`."""
    picture: str
    """Stem of the picture's file."""
    seed: int
    """Seed of the run."""

    @property
    def name(self) -> str:
        """What its files are called."""
        return (
            f"{self.size}-{self.arm.replace(' ', '_').replace(',', '')}-{self.picture}-{self.seed}"
        )


def configuration(
    run: Run, picture: Path, out: Path, device: str, changes: Fields
) -> Morphogenesis2DTrainConfig:
    """Return the settings of a run."""
    fields: dict[str, Any] = {"repeats": 1, "tensorboard": False, "picture_interval": 0}
    if run.size == "fast":
        fields |= FAST_BEFORE | FAST_ARMS[run.arm]
    else:
        arm = ARMS[run.arm]
        # An arm's own number of iterations is meant for small worlds.
        fields |= SIZES[run.size] | arm if run.size == "small" else arm | SIZES[run.size]
    fields |= changes
    if run.size != "fast" and fields.get("schedule") != "cosine":
        fields["milestones"] = tuple(round(share * fields["iterations"]) for share in QUARTERS)
    fields |= {"out": out, "device": device, "seed": run.seed, "target": str(picture)}
    fields["checkpoint_interval"] = 10**9
    return preset("fast" if run.size == "fast" else "paper", **fields)
