"""PettingZoo, or the command that installs it."""

from __future__ import annotations

from typing import Any

from npa_envs.errors import MissingDependencyError

try:
    import pettingzoo
    from pettingzoo.utils import parallel_to_aec
    from pettingzoo.utils.wrappers import ClipOutOfBoundsWrapper, OrderEnforcingWrapper
except ImportError as error:
    raise MissingDependencyError(
        f"environments of several species need PettingZoo, which is not installed ({error}): "
        "pip install 'npa-envs[envs]'"
    ) from error

__all__ = ["ParallelEnv", "aec_env", "clipped", "register"]

ParallelEnv = pettingzoo.ParallelEnv
"""PettingZoo's base class of environments in which all agents act at once."""


def aec_env(parallel: Any) -> Any:
    """Return an environment as one in which agents act in turn, with PettingZoo's checks of order.

    Args:
        parallel: An environment in which all act at once.
    """
    return parallel_to_aec(parallel)


def clipped(raw: Any) -> Any:
    """Return an environment of turns that clips actions into their spaces, and says so.

    Args:
        raw: What `aec_env` returned.
    """
    return OrderEnforcingWrapper(ClipOutOfBoundsWrapper(raw))


def register(name: str, module: str, keywords: dict[str, Any]) -> None:
    """Put both kinds of an environment into PettingZoo's registries; what is there stays as it is.

    Args:
        name: What `pettingzoo.make` takes.
        module: Where `parallel_env` and `env` are.
        keywords: What they are given.
    """
    # PettingZoo before 1.27 has no registries.
    if not hasattr(pettingzoo, "register"):
        return
    kinds = (
        ("parallel", pettingzoo.parallel_registry, "parallel_env"),
        ("aec", pettingzoo.aec_registry, "env"),
    )
    for kind, registry, function in kinds:
        if name not in registry:
            pettingzoo.register(kind, name, f"{module}:{function}", kwargs=keywords)
