"""Neural Particle Automata: differentiable SPH particle worlds.

Importing it registers the Gymnasium environments `npa/...`. Names are imported at their first use,
so that the import loads neither torch nor Warp and the command line starts fast.
"""

from importlib import import_module as _import_module
from pathlib import Path as _Path
from typing import TYPE_CHECKING, Any

from npa_envs.errors import suggest as _suggest
from npa_envs.registration import register_environments as _register_environments

if TYPE_CHECKING:
    from npa_envs.errors import DivergedError as DivergedError
    from npa_envs.errors import MissingDependencyError as MissingDependencyError
    from npa_envs.errors import NPAError as NPAError
    from npa_envs.ops import PerceptionFields as PerceptionFields
    from npa_envs.ops import SpeciesFields as SpeciesFields
    from npa_envs.ops import perceive as perceive
    from npa_envs.ops import perceive_species as perceive_species
    from npa_envs.ops import perception_fields as perception_fields
    from npa_envs.ops import species_fields as species_fields
    from npa_envs.ops import world_mean as world_mean
    from npa_envs.rule.files import load_rule as load_rule
    from npa_envs.rule.files import save_rule as save_rule
    from npa_envs.rule.files import shipped_rules as shipped_rules
    from npa_envs.rule.rule import NPARule as NPARule
    from npa_envs.tasks.seeds import uniform_ball as uniform_ball
    from npa_envs.world.divergence import describe_divergence as describe_divergence
    from npa_envs.world.divergence import divergence as divergence
    from npa_envs.world.randomness import WorldRandom as WorldRandom
    from npa_envs.world.rollout import at_rest as at_rest
    from npa_envs.world.rollout import rollout as rollout
    from npa_envs.world.rollout import step as step
    from npa_envs.world.species import rollout_species as rollout_species

_MAPPED_PACKAGES = ("envs", "wrappers", "agents")
"""Sub-packages that are next to `npa_envs/` in the repository, and inside of it once installed."""


def _extend_path(package_path: list[str], package_file: str) -> None:
    """Append the repository's root to `package_path`, if `package_file` is in a checkout of it.

    Python started in the repository's root imports the folder `npa_envs/` before an installed
    package, and would miss the others. The path of an installed package does not change, so that a
    folder `envs` of another project in site-packages is never imported.
    """
    package = _Path(package_file).resolve().parent
    root = package.parent
    installed = any((package / name).is_dir() for name in _MAPPED_PACKAGES)
    if installed or not (root / "pyproject.toml").is_file() or str(root) in package_path:
        return
    if all((root / name / "__init__.py").is_file() for name in _MAPPED_PACKAGES):
        package_path.append(str(root))


_extend_path(__path__, __file__)
_register_environments()

__version__ = "0.1.0"

_PUBLIC_NAMES = {
    "errors": "DivergedError MissingDependencyError NPAError",
    "ops": "PerceptionFields SpeciesFields perceive perceive_species perception_fields "
    "species_fields world_mean",
    "rule.files": "load_rule save_rule shipped_rules",
    "rule.rule": "NPARule",
    "tasks.seeds": "uniform_ball",
    "world.divergence": "describe_divergence divergence",
    "world.randomness": "WorldRandom",
    "world.rollout": "at_rest rollout step",
    "world.species": "rollout_species",
}
"""The public names of each module."""

_MODULES = {name: module for module, names in _PUBLIC_NAMES.items() for name in names.split()}

__all__ = sorted(_MODULES)


def __getattr__(name: str) -> Any:
    if name not in _MODULES:
        known = {*_MODULES, "agents", "envs", "render", "training", "wrappers"}
        hint = f"import npa_envs.{name}" if name in known else _suggest(name, known)
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}: {hint}")
    # Kept, so that only the first use searches.
    value = globals()[name] = getattr(_import_module(f"npa_envs.{_MODULES[name]}"), name)
    return value


def __dir__() -> list[str]:
    return sorted({*__all__, "__version__"})
