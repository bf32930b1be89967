"""Particles of several species as rows of Stable-Baselines3: a policy for all, or for each."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
import torch
from gymnasium.spaces import Box
from numpy.typing import NDArray
from torch import Tensor

from npa_envs.envs.multi.vector import MultiSpeciesVectorEnv
from npa_envs.errors import NPAError, suggest
from npa_envs.wrappers.adapters import check_same_step, row_space
from npa_envs.wrappers.moments import as_tensor
from npa_envs.wrappers.rows import RowVecEnv, on_host

SpeciesPolicy = Callable[[Any], Any]
"""Takes a species' observations, shape [B, N_k, P], and returns its actions, [B, N_k, A]."""


class RowPolicy:
    """A Stable-Baselines3 model that was trained on rows, as the policy of a species or a world.

    Args:
        model: The model; the policy follows when it is trained on.
        deterministic: Whether it acts by its mean instead of a draw.
        tag: What the model was told of the species behind each row, shape [K]; None: nothing.
    """

    def __init__(
        self, model: Any, *, deterministic: bool = False, tag: NDArray[np.float32] | None = None
    ) -> None:
        self.model = model
        self.deterministic = deterministic
        self.tag = tag

    def __call__(self, observations: Any) -> NDArray[np.float32]:
        """Return actions, shape [B, N, A].

        Args:
            observations: Shape [B, N, P].
        """
        (seen,) = on_host(observations)
        rows = seen.reshape(-1, seen.shape[-1])
        if self.tag is not None:
            rows = np.hstack((rows, np.broadcast_to(self.tag, (len(rows), len(self.tag)))))
        actions, _ = self.model.predict(rows, deterministic=self.deterministic)
        return np.asarray(actions, np.float32).reshape(*seen.shape[:-1], -1)


class SpeciesVecEnv(RowVecEnv):
    """Particles of several species as the rows of a Stable-Baselines3 `VecEnv`.

    Without `others` all particles of all species are rows and share one policy; each is told its
    species by a one-hot tag behind what it perceives. With `others` the particles of those species
    are played by the policies given, and the remaining species' particles are the rows, without
    tags: for policies of their own, train them in turn, each beside the others as they are.

    A world's rows follow each other, species after species. Each row is paid what its species is.
    Where a species ends, its rows end; until the world's next episode they see zeros,
    are paid nothing, and their actions are not read. With the world they end once more.

    Args:
        env: What `multispecies_v0.batched` returns, with same-step autoreset.
        others: Policies of species that are not to be rows, by name.

    Raises:
        NPAError: `env` is another environment, or does not restart worlds by itself, or there is no
            species of a name, or none left to be rows, or a policy is no function.
        MissingDependencyError: Stable-Baselines3 is not installed (on import).
    """

    def __init__(
        self,
        env: MultiSpeciesVectorEnv,
        *,
        others: Mapping[str, SpeciesPolicy] | None = None,
    ) -> None:
        if not isinstance(env, MultiSpeciesVectorEnv):
            raise NPAError(
                f"env must be a batch of worlds of several species, got {type(env).__name__}: "
                "make one with npa_envs.envs.multispecies_v0.batched"
            )
        check_same_step(env.autoreset_mode)
        self.others = dict(others or {})
        """Policies of species that are not rows."""
        for name, policy in self.others.items():
            if not callable(policy):
                raise NPAError(
                    f"others must hold functions of observations, got {type(policy).__name__} for "
                    f"{name!r}: RowPolicy(model) makes one of a model"
                )
            if name not in env.possible_agents:
                raise NPAError(
                    f"others must name species, got {name!r}: "
                    f"{suggest(str(name), env.possible_agents)}"
                )
        self.rows_of = [name for name in env.possible_agents if name not in self.others]
        """Species whose particles are rows, in order."""
        if not self.rows_of:
            raise NPAError("others must leave at least one species to be rows, got all of them")
        spaces = env.single_observation_spaces
        self._counts = np.array([spaces[name].shape[0] for name in self.rows_of])
        observed = row_space(spaces[self.rows_of[0]])
        self._tags = None
        if not self.others:
            kinds = np.eye(len(self._counts), dtype=np.float32).repeat(self._counts, axis=0)
            self._tags = torch.from_numpy(kinds).to(env.worlds.device)
            tag = np.ones(len(self._counts), np.float32)
            observed = Box(np.append(observed.low, 0.0 * tag), np.append(observed.high, tag))
        self._seen: dict[str, Any] = {}
        acted = row_space(env.single_action_spaces[self.rows_of[0]])
        super().__init__(env, env.world_count, int(self._counts.sum()), observed, acted)

    def reset(self) -> NDArray[np.float32]:
        """Start episodes in all worlds and return the rows' observations, shape [B R, P]."""
        self._seen, _ = self.begin()
        return on_host(self._joined(self._seen))[0].reshape(self.num_envs, -1)

    def step_wait(
        self,
    ) -> tuple[NDArray[np.float32], NDArray[np.float32], NDArray[np.bool_], list[dict[str, Any]]]:
        """Step all worlds, the other species by their policies.

        Returns:
            Of each row: observation [B R, P], reward [B R], whether its episode is over [B R], and
            infos.

        Raises:
            NPAError: There are no worlds yet.
            DivergedError: An action is not finite; the worlds are then as they were.
        """
        if not self._seen:
            raise NPAError("step needs worlds: call reset first")
        own = np.split(self.taken_actions(), np.cumsum(self._counts)[:-1], axis=1)
        actions: dict[str, Any] = dict(zip(self.rows_of, own, strict=True))
        actions |= {name: policy(self._seen[name]) for name, policy in self.others.items()}
        seen, rewards, terminations, truncations, infos = self.vector_env.step(actions)
        self._seen = seen
        live = {name: as_tensor(infos[name]["live"]) for name in self.rows_of}
        shown, paid, ended, cut = on_host(
            torch.where(self._repeated(live)[..., None], self._joined(seen), 0.0),
            self._repeated(rewards),
            self._repeated(terminations),
            self._repeated(truncations),
        )
        over = ended | cut
        first = infos[self.rows_of[0]]
        if "final_obs" in first:
            (restarted,) = on_host(first["_final_obs"])
            over |= restarted[:, None]
        rows: list[dict[str, Any]] = [self.nothing] * self.num_envs
        if over.any():
            last = {name: infos[name].get("final_obs", seen[name]) for name in self.rows_of}
            final = on_host(self._joined(last))[0].reshape(self.num_envs, -1)
            late = (cut & ~ended).reshape(-1)
            for row in np.flatnonzero(over):
                rows[row] = {
                    "TimeLimit.truncated": bool(late[row]),
                    "terminal_observation": final[row],
                }
        return shown.reshape(self.num_envs, -1), paid.reshape(-1), over.reshape(-1), rows

    def policy(self, model: Any, species: str, *, deterministic: bool = False) -> RowPolicy:
        """Return a model that was trained on these rows as the policy of one species.

        Args:
            model: The model.
            species: Its name, one of `rows_of`.
            deterministic: Whether it acts by its mean instead of a draw.

        Raises:
            NPAError: The species' particles are not among the rows.
        """
        if species not in self.rows_of:
            raise NPAError(
                f"species must be one whose particles are rows, got {species!r}: "
                f"{suggest(str(species), self.rows_of)}"
            )
        tag = None
        if self._tags is not None:
            tag = np.eye(len(self.rows_of), dtype=np.float32)[self.rows_of.index(species)]
        return RowPolicy(model, deterministic=deterministic, tag=tag)

    def _joined(self, by_species: Mapping[str, Any]) -> Tensor:
        """Return what rows observe, with tags where all species are rows, shape [B, R, P]."""
        rows = torch.cat([as_tensor(by_species[name]) for name in self.rows_of], dim=1)
        if self._tags is None:
            return rows
        return torch.cat((rows, self._tags.to(rows.device).expand(len(rows), -1, -1)), dim=2)

    def _repeated(self, by_species: Mapping[str, Any]) -> Tensor:
        """Return what species have in each world, [B], for each of their rows, shape [B, R]."""
        values = [as_tensor(by_species[name]) for name in self.rows_of]
        return torch.cat(
            [value[:, None].expand(-1, n) for value, n in zip(values, self._counts, strict=True)],
            dim=1,
        )
