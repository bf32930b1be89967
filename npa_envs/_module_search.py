"""Search for the package's modules in a checkout as it lies on the disk.

`envs/`, `wrappers/` and `agents/` lie beside `npa_envs/` in the repository and inside it once
installed. Python started in the repository's root imports the bare folder `npa_envs/` before any
installed one, and would miss the other three.
"""

from __future__ import annotations

from pathlib import Path

MAPPED_PACKAGES = ("envs", "wrappers", "agents")
"""Sub-packages of `npa_envs` that lie beside it in the repository."""


def extend_path(package_path: list[str], package_file: str) -> None:
    """Add the repository's root to the search path of `npa_envs` where it is imported from there.

    Does nothing for an installed package, so that a folder called `envs` which some other project
    left in site-packages is never taken for ours.
    """
    package = Path(package_file).resolve().parent
    root = package.parent
    installed = any((package / name).is_dir() for name in MAPPED_PACKAGES)
    if installed or not (root / "pyproject.toml").is_file() or str(root) in package_path:
        return
    if all((root / name / "__init__.py").is_file() for name in MAPPED_PACKAGES):
        package_path.append(str(root))
