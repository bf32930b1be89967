"""Stable-Baselines3's SAC and PPO in gardens, as they come: a row for each world."""

from __future__ import annotations

import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from gymnasium.spaces import Dict
from numpy.typing import NDArray

from npa_envs.agents.learning.baselines import check_no_start
from npa_envs.agents.learning.problem import world_seeds
from npa_envs.agents.learning.progress import Progress
from npa_envs.checks import check_fraction, check_positive
from npa_envs.errors import MissingDependencyError, NPAError, shown
from npa_envs.wrappers.sb3 import WorldVecEnv, on_host

try:
    from stable_baselines3 import PPO, SAC
    from stable_baselines3.common.callbacks import BaseCallback
except ImportError as error:
    raise MissingDependencyError(
        "SAC and PPO in gardens need Stable-Baselines3: pip install 'npa-envs[sb3]'"
    ) from error

ALGORITHMS: dict[str, type[SAC] | type[PPO]] = {"sac": SAC, "ppo": PPO}
"""By the names of the files that `GardenPolicy.save` writes, without ".zip"."""


@dataclass(frozen=True, kw_only=True)
class GardenOptions:
    """What both algorithms are settings; all that is not said is as Stable-Baselines3 has it."""

    gamma: float = 0.9
    """Discount of a reward one step later (dimensionless)."""

    learning_rate: float = 3e-4
    """Adam's."""

    def __post_init__(self) -> None:
        """Check every field; raises NPAError."""
        check_fraction(self, "gamma")
        check_positive(self, float, "learning_rate")


@dataclass(frozen=True, kw_only=True)
class SACOptions(GardenOptions):
    """Options of `train_sac`."""

    learning_starts: int = 1000
    """Steps of worlds before the first gradient step."""

    world_steps: int = 8
    """Steps of worlds for each gradient step, as nearly as the number of worlds allows."""

    def __post_init__(self) -> None:
        """Check every field; raises NPAError."""
        super().__post_init__()
        check_positive(self, int, "learning_starts", "world_steps")


@dataclass(frozen=True, kw_only=True)
class GardenPPOOptions(GardenOptions):
    """Options of `train_ppo`."""

    steps: int = 32
    """Steps of each world in a round."""

    batch_size: int = 64
    """Steps of worlds in a minibatch, at least 2."""

    def __post_init__(self) -> None:
        """Check every field; raises NPAError."""
        super().__post_init__()
        check_positive(self, int, "steps")
        check_positive(self, int, "batch_size", at_least=2)


SAC_DEFAULTS, PPO_DEFAULTS = SACOptions(), GardenPPOOptions()


def train_sac(progress: Progress, options: SACOptions = SAC_DEFAULTS) -> GardenPolicy:
    """Return what SAC (Haarnoja et al., arXiv 1801.01290) finds within a budget."""
    settings = {
        "learning_starts": options.learning_starts,
        "gradient_steps": max(1, progress.problem.num_envs // options.world_steps),
    }
    return _learned(SAC, settings, progress, options)


def train_ppo(progress: Progress, options: GardenPPOOptions = PPO_DEFAULTS) -> GardenPolicy:
    """Return what PPO (Schulman et al., arXiv 1707.06347) finds within a budget."""
    if options.steps * progress.problem.num_envs < 2:
        raise NPAError("steps must be at least 2 in a single world, got 1: give steps=32")
    settings = {"n_steps": options.steps, "batch_size": options.batch_size}
    return _learned(PPO, settings, progress, options)


def _learned(
    algorithm: Any, settings: dict[str, int], progress: Progress, options: GardenOptions
) -> GardenPolicy:
    check_no_start(progress)
    problem, seed, device = progress.problem, progress.seed, progress.device
    env = WorldVecEnv(problem.make_envs(device=device))
    has_goals = isinstance(env.observation_space, Dict)
    model = algorithm(
        "MultiInputPolicy" if has_goals else "MlpPolicy",
        env,
        gamma=options.gamma,
        learning_rate=options.learning_rate,
        seed=seed,
        device=device,
        **settings,
    )
    # Stable-Baselines3 would begin with worlds seed, seed + 1, and so on.
    env.seed(world_seeds(seed, problem.num_envs)[0])
    policy = GardenPolicy(model)
    model.learn(sys.maxsize, AccountCallback(progress, policy))
    env.close()
    return policy


class AccountCallback(BaseCallback):
    """Keeps a learner's account while Stable-Baselines3 learns, and stops it in time."""

    def __init__(self, progress: Progress, policy: GardenPolicy) -> None:
        super().__init__()
        self._progress, self._policy = progress, policy
        problem = progress.problem
        rule_steps: int = getattr(problem.config, "rule_steps", 1)
        self._step = problem.num_envs * problem.particle_count * rule_steps

    def _on_training_start(self) -> None:
        self._progress.start(self._policy)

    def _on_step(self) -> bool:
        """Take down a step of all worlds, and return whether to go on."""
        self._progress.advance(self._step)
        self._progress.look(self._policy)
        return not self._progress.over

    def _on_training_end(self) -> None:
        self._progress.look(self._policy, force=True)


class GardenPolicy:
    """A model of Stable-Baselines3, without noise, as the policy of a garden.

    Args:
        model: It; the policy follows while it learns.
    """

    def __init__(self, model: Any) -> None:
        self.model = model
        space = model.observation_space
        self._shapes = _shapes(space.spaces if isinstance(space, Dict) else space)

    def __call__(self, observation: Any) -> NDArray[np.float32]:
        """Return actions of worlds, shape [B, K, W], for what is seen of them, [B, ...]."""
        wanted = self._shapes
        found = {name: shape[1:] for name, shape in _shapes(observation).items()}
        if wanted != found:
            raise NPAError(
                "observation must be of a garden like that which the policy has learned in, of "
                f"shapes {wanted} by world, got {found}: take one that has learned in this garden"
            )
        seen: Any = observation
        if isinstance(observation, dict):
            seen = dict(zip(observation, on_host(*observation.values()), strict=True))
        else:
            (seen,) = on_host(observation)
        action, _ = self.model.predict(seen, deterministic=True)
        return np.asarray(action)

    def save(self, folder: str | Path) -> list[Path]:
        """Write the model as Stable-Baselines3 does, `sac.zip` or `ppo.zip`; return the path."""
        path = Path(folder) / f"{type(self.model).__name__.lower()}.zip"
        self.model.save(path)
        return [path]

    @classmethod
    def load(cls, path: str | Path) -> GardenPolicy:
        """Return what `save` wrote; Stable-Baselines3 unpickles it, so trust who made the file."""
        name = Path(path).stem
        if name not in ALGORITHMS:
            raise NPAError(
                f"path must be of a file sac.zip or ppo.zip, got {shown(str(path))}: name the file "
                "as the learner that wrote it, because its name says how to read it"
            )
        if not Path(path).is_file():
            raise NPAError(
                f"path must be of a file that exists, got {shown(str(path))}: name one that "
                "`save` or `npa-envs learn` wrote"
            )
        try:
            return cls(ALGORITHMS[name].load(path, device="cpu"))
        except Exception as error:
            # What unpickling raises depends on what is in the file.
            raise NPAError(
                f"path must be of a file that {name}'s `save` wrote, got {shown(str(path))} "
                f"({shown(error)}): save the policy again, or name another file"
            ) from error


def _shapes(parts: Any) -> dict[str, tuple[int, ...]]:
    """Return the shapes of the parts of an observation or a space, or of what has none."""
    named = parts if isinstance(parts, dict) else {"observation": parts}
    return {name: tuple(part.shape) for name, part in named.items()}
