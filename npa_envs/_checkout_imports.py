"""The import path of `npa_envs` in a checkout of the repository.

`envs/`, `wrappers/` and `agents/` are next to `npa_envs/` in the repository, and inside of it once
installed. Python started in the repository's root imports the folder `npa_envs/` before an
installed package, and would not find the other three.
"""

from __future__ import annotations

from pathlib import Path

MAPPED_PACKAGES = ("envs", "wrappers", "agents")
"""Sub-packages of `npa_envs` that are next to it in the repository."""


def extend_path(package_path: list[str], package_file: str) -> None:
    """Append the repository's root to `package_path`, if `package_file` is in a checkout of it.

    These are `npa_envs.__path__` and `npa_envs.__file__`. The path of an installed package does not
    change, so that a folder `envs` of another project in site-packages is never imported.
    """
    package = Path(package_file).resolve().parent
    root = package.parent
    installed = any((package / name).is_dir() for name in MAPPED_PACKAGES)
    if installed or not (root / "pyproject.toml").is_file() or str(root) in package_path:
        return
    if all((root / name / "__init__.py").is_file() for name in MAPPED_PACKAGES):
        package_path.append(str(root))
