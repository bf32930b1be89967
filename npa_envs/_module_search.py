"""Search for the package's modules: in a checkout as it lies on the disk, and by old names.

`envs/`, `wrappers/` and `agents/` lie beside `npa_envs/` in the repository and inside it once
installed. Python started in the repository's root imports the bare folder `npa_envs/` before any
installed one, and would miss the other three.

Old names of documented modules that lie elsewhere now still work, with a warning. A name goes one
release after the one that began to warn.
"""

from __future__ import annotations

import importlib
import sys
import warnings
from collections.abc import Sequence
from importlib.abc import Loader, MetaPathFinder
from importlib.machinery import ModuleSpec
from pathlib import Path
from types import ModuleType

MAPPED_PACKAGES = ("envs", "wrappers", "agents")
"""Sub-packages of `npa_envs` that lie beside it in the repository."""


def extend_path(package_path: list[str], package_file: str) -> None:
    """Add the repository's root to the search path of `npa_envs` where it is imported from there.

    Does nothing for an installed package, so that a folder called `envs` which some other project
    left in site-packages is never taken for ours.

    Args:
        package_path: `npa_envs.__path__`, extended in place.
        package_file: `npa_envs.__file__`.
    """
    package = Path(package_file).resolve().parent
    root = package.parent
    installed = any((package / name).is_dir() for name in MAPPED_PACKAGES)
    if installed or not (root / "pyproject.toml").is_file() or str(root) in package_path:
        return
    if all((root / name / "__init__.py").is_file() for name in MAPPED_PACKAGES):
        package_path.append(str(root))


MOVED = {
    "npa_envs.agents.learning.sb3_world": "npa_envs.agents.learning.sb3",
    "npa_envs.classification": "npa_envs.measure.quality",
    "npa_envs.envs.species": "npa_envs.envs.multi",
    "npa_envs.sph": "npa_envs.ops",
    "npa_envs.tasks.clouds": "npa_envs.tasks.targets.clouds",
    "npa_envs.tasks.morphogenesis3d_config": "npa_envs.tasks.morphogenesis3d",
    "npa_envs.tasks.point_classification_config": "npa_envs.tasks.point_classification",
    "npa_envs.tasks.renderers": "npa_envs.tasks.appearance",
    "npa_envs.tasks.task": "npa_envs.tasks.base",
    "npa_envs.tasks.texture_config": "npa_envs.tasks.texture",
    "npa_envs.tasks.texture_losses": "npa_envs.tasks.losses.texture",
    "npa_envs.tasks.textures": "npa_envs.tasks.targets.textures",
}
"""Old module name -> new one."""


class _MovedLoader(Loader):
    def exec_module(self, module: ModuleType) -> None:
        """Put the module of the new name in place of the empty one that was made."""
        new_name = MOVED[module.__name__]
        warnings.warn(
            f"{module.__name__} is now {new_name}: import that",
            DeprecationWarning,
            stacklevel=2,
        )
        sys.modules[module.__name__] = importlib.import_module(new_name)


class MovedFinder(MetaPathFinder):
    """Finds the modules of the table under their old names, and refuses modules within them.

    It comes before all other finders: they would find a module within a moved package by the
    package's path, and run it a second time, which registers torch operators anew.
    """

    def find_spec(
        self, fullname: str, path: Sequence[str] | None, target: ModuleType | None = None
    ) -> ModuleSpec | None:
        """Return how to load an old name, or None for all others.

        Raises:
            ModuleNotFoundError: The name lies within an old one.
        """
        package = fullname.rpartition(".")[0]
        if package in MOVED:
            raise ModuleNotFoundError(
                f"no module {fullname}: {package} is now {MOVED[package]}", name=fullname
            )
        return ModuleSpec(fullname, _MovedLoader()) if fullname in MOVED else None


def keep_old_names() -> None:
    """Let the old names be imported; once, however often it is called."""
    if not any(type(finder).__name__ == "MovedFinder" for finder in sys.meta_path):
        sys.meta_path.insert(0, MovedFinder())
