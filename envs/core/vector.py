"""Many worlds as one Gymnasium vector environment, and checks of its arguments."""

from __future__ import annotations

import operator
from collections.abc import Mapping, Sequence
from functools import cached_property
from typing import Any

import gymnasium
import numpy as np
import torch
from gymnasium import Space
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space
from numpy.typing import NDArray
from torch import Tensor

from npa_envs.checks import check_count, number_tensor
from npa_envs.envs.core.base import WorldsEnv
from npa_envs.envs.core.config import as_python
from npa_envs.envs.core.step_report import TRUE_ROW, StepReport, reason
from npa_envs.errors import NPAError, shown, suggest
from npa_envs.world.cuda_graph import to_device_async
from npa_envs.world.environment_steps import TIME_LIMIT
from npa_envs.world.randomness import WorldRandom

AUTORESET_MODES = {mode.name.lower().replace("_", "-"): mode for mode in AutoresetMode}
"""Gymnasium's modes by the names that `autoreset_mode` takes."""

REASONS = np.array([reason(ending) for ending in range(2 * TIME_LIMIT)], dtype=object)
"""`info["reason"]` for each combination of the flags of an ending."""


class BatchedSpaces(VectorEnv[Any, Any, Any]):
    """Base class of vector environments, which make the large spaces of all worlds when used."""

    @cached_property
    def observation_space(self) -> Space[Any]:  # type: ignore[override]
        """Space of the observations of all B worlds, [B, ...]."""
        return batch_space(self.single_observation_space, self.num_envs)

    @cached_property
    def action_space(self) -> Space[Any]:  # type: ignore[override]
        """Space of the actions of all B worlds, [B, ...]."""
        return batch_space(self.single_action_space, self.num_envs)


class NPAVectorEnv(WorldsEnv, BatchedSpaces):
    """B worlds of a task, stepped together; subclasses set `task_type`.

    World k, reset with `seed`, is the single environment reset with `seed + k`, bit for bit.

    Args:
        num_envs: Worlds B.
        max_episode_steps: Steps after which an episode is truncated; None or -1: never.
        autoreset_mode: When a world whose episode is over starts the next one. "same-step": in the
            step that ends the episode, whose last observation is in `infos["final_obs"]`;
            "next-step": in the step after, which ignores its action; "disabled": when
            `reset(options={"reset_mask": ...})` is called.
        copy: Return new arrays; False: the same ones in each step, overwritten by the next.
        keywords: Fields of the task's configuration.
    """

    metadata = WorldsEnv.metadata | {"autoreset_mode": AutoresetMode.SAME_STEP}
    _is_batch = True

    def __init__(
        self,
        num_envs: int = 1,
        *,
        max_episode_steps: int | None = None,
        autoreset_mode: str | AutoresetMode = "same-step",
        copy: bool = True,
        **keywords: Any,
    ) -> None:
        num_envs = checked_count("num_envs", num_envs)
        # Gymnasium takes -1 for no limit.
        is_limited = max_episode_steps is not None and max_episode_steps != -1
        steps = checked_count("max_episode_steps", max_episode_steps) if is_limited else None
        self.autoreset_mode = checked_mode(autoreset_mode)
        self.metadata = {**type(self).metadata, "autoreset_mode": self.autoreset_mode}
        self.num_envs = num_envs
        self._make_worlds(keywords, num_envs, steps)
        if steps is not None and self.config.episode_steps not in (None, steps):
            gymnasium.logger.warn(
                f"episode_steps={self.config.episode_steps} and max_episode_steps={steps} differ: "
                "the smaller one ends episodes"
            )
        self.single_observation_space = self.spaces.observation_space
        self.single_action_space = self.spaces.action_space
        self.copies = copy
        """Whether returned arrays are new, and not overwritten by the next step."""
        self._buffer: Tensor | None = None
        self._ended = np.zeros(num_envs, dtype=bool)

    def reset(
        self, *, seed: int | Sequence[int] | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Any, dict[str, Any]]:
        """Start episodes; return all observations, [B, N, P], and the losses with their terms.

        Args:
            seed: World k begins the sequence of episodes of seed + k, or of the k-th seed of a
                list; None: each world starts the next episode of its sequence.
            options: `{"reset_mask": mask}` resets only the worlds where the mask, bool, shape [B],
                is True; the others do not change.
        """
        seed = as_python(seed)
        super().reset(seed=seed if isinstance(seed, int) else None)
        chosen = worlds_to_reset(options, self.num_envs, started=self._started)
        keys = None
        if seed is not None or not self._started:
            keys = rng_keys(seed, self.num_envs, self.np_random)[chosen]
        worlds = torch.from_numpy(chosen).to(self.task.device)
        observation = self._change_worlds(self.worlds.start, worlds, keys, self._buffer)
        if not self.copies:
            self._buffer = observation
        self._ended[chosen] = False
        which = np.zeros(self.num_envs, dtype=bool)
        which[chosen] = True
        values = self.losses_of(self._report_rows(self.worlds.episodes.report.copy()))
        values |= self._returned_values(self.worlds.extra_info())
        return self.spaces.observation_output(observation), with_masks(values, self._mask(which))

    def step(self, actions: Any) -> tuple[Any, Any, Any, Any, dict[str, Any]]:
        """Apply actions, shape [B, N, A]; return a batch [B, ...] of what `NPAEnv.step` returns."""
        self.check_begun("step needs worlds")
        action = self.spaces.action(actions, self.num_envs)
        with self.worlds.device_context():
            return self._step(action)

    def _step(self, action: Tensor) -> tuple[Any, Any, Any, Any, dict[str, Any]]:
        over = self._ended
        if over.any() and self.autoreset_mode is AutoresetMode.DISABLED:
            raise NPAError(
                f"the episodes of worlds {np.flatnonzero(over).tolist()} are over: reset them with "
                "reset(options={'reset_mask': terminations | truncations})"
            )
        restarting = self.autoreset_mode is AutoresetMode.NEXT_STEP and bool(over.any())
        if restarting:
            action = action.clone()
            action[to_device_async(over, action.device)] = 0.0
        endings, observation = self.worlds.step(action, self._buffer)
        stepped = None
        if restarting:
            stepped, endings = ~over, np.where(over, 0, endings)
        endings = self.worlds.handle_diverged(endings, observation)
        if restarting:
            self.worlds.restart(np.flatnonzero(over), observation)
        ended = endings != 0
        any_ended = bool(ended.any())
        restarts = any_ended and self.autoreset_mode is AutoresetMode.SAME_STEP
        # A restart overwrites the report, so it is copied first.
        *results, infos = self._report(stepped, copy=self.copies or restarts)
        if any_ended:
            infos |= {"reason": REASONS[endings], "_reason": self._mask(ended)}
        if restarts:
            observation, infos = self._restart_ended(ended, observation, infos)
        else:
            self._ended = ended
        if self.config.output == "numpy" and (any_ended or restarting):
            infos = own_entries(infos)
        self._show()
        return self.spaces.observation_output(observation), *results, infos

    def _restart_ended(
        self, ended: NDArray[np.bool_], last: Tensor, infos: dict[str, Any]
    ) -> tuple[Tensor, dict[str, Any]]:
        """Restart the worlds that `ended`; return observations, and infos with the `last` ones."""
        which = self._mask(ended)
        final_infos = {n: which if n.startswith("_") else v for n, v in infos.items()}
        observation = last
        if self.copies and ended.all():
            observation = torch.empty_like(last)
        else:
            last = last.clone()
        self.worlds.restart(np.flatnonzero(ended), observation)
        *_, infos = self._report(~ended, copy=self.copies)
        final_observation = self.spaces.final_observation_output(last, ended)
        infos |= {"final_obs": final_observation, "_final_obs": which}
        return observation, infos | {"final_info": final_infos, "_final_info": self._mask(ended)}

    close = VectorEnv.close

    def close_extras(self, **kwargs: Any) -> None:
        """End all worlds, and close the window, if there is one."""
        WorldsEnv.close(self)

    def particles(self) -> tuple[Tensor, Tensor]:
        """Return copies of positions [length units], [B, N, D], and states, [B, N, C]."""
        return self.worlds.x.clone(), self.worlds.s.clone()

    def place_particles(self, x: Any, s: Any, worlds: Any = None) -> Any:
        """Replace particles, without a reward, and return the new observations of all worlds.

        Positions have shape [B', N, D], states [B', N, C]; `worlds` are the worlds' indices, each
        once, or None for all of them. Errors are those of `NPAEnv.place_particles`.
        """
        self.check_begun("particles need worlds")
        all_worlds = torch.arange(self.num_envs)
        chosen = all_worlds if worlds is None else checked_worlds(worlds, self.num_envs)
        placed = self.worlds.checked_particles(x, s, len(chosen), self.config.particle_count)
        index = chosen.to(self.task.device)
        observation = self._change_worlds(self.worlds.place, index, placed, self._buffer)
        return self.spaces.observation_output(observation)

    def _report(
        self, stepped: NDArray[np.bool_] | None, *, copy: bool
    ) -> tuple[Any, Any, Any, dict[str, Any]]:
        """Return rewards, terminations, truncations, infos; `stepped`, [B]: worlds that acted."""
        worlds = self.worlds
        report = worlds.episodes.report.copy() if copy else worlds.episodes.report
        rows = self._report_rows(report)
        terminated, truncated, success, diverged, all_worlds, *_ = unbound(self._out(report.flags))
        if not copy:
            all_worlds = self._out(report.flags[TRUE_ROW].clone())
        which = all_worlds if stepped is None else self._mask(stepped)
        of_all = self.losses_of(rows) | self._returned_values(worlds.extra_info(), copy=copy)
        of_step = self._improvements(rows) | {"success": success, "diverged": diverged}
        of_step |= self._returned_values(worlds.step_info(), copy=copy)
        infos = with_masks(of_all, all_worlds) | with_masks(of_step, which)
        return rows[0], terminated, truncated, infos

    def _returned_values(self, values: dict[str, Tensor], *, copy: bool = True) -> dict[str, Any]:
        """Return values by name, [B, ...] each, as `config.output`; numbers as float64 arrays."""
        found = {n: self._out(v.clone() if copy else v) for n, v in values.items()}
        if self.config.output == "torch":
            return found
        of_numbers = [n for n, v in found.items() if v.ndim == 1 and v.dtype == np.float32]
        return found | {n: found[n].astype(np.float64) for n in of_numbers}

    def _report_rows(self, report: StepReport) -> Sequence[Any]:
        """Return the rows of `report.numbers`, [B] each, as tensors or float64 arrays."""
        rows = self._out(report.numbers)
        return unbound(rows if isinstance(rows, Tensor) else rows.astype(np.float64))

    def _mask(self, mask: NDArray[np.bool_]) -> Any:
        """Return a copy of a mask of worlds, [B], as `config.output`: array or tensor."""
        return self._out(mask.copy())


def unbound(values: Any) -> Sequence[Any]:
    """Return the rows of an array or tensor; for tensors `unbind` is faster than `list`."""
    return values.unbind() if isinstance(values, Tensor) else list(values)


def with_masks(values: dict[str, Any], which: Any) -> dict[str, Any]:
    """Return infos: each value by its `name`, and the mask of worlds with it, [B], by `_name`."""
    infos = {}
    for name, value in values.items():
        infos[name], infos[f"_{name}"] = value, which
    return infos


def own_entries(infos: dict[str, Any]) -> dict[str, Any]:
    """Return infos of arrays as `SyncVectorEnv` has them: by the masks, [B], that they come with.

    Where a mask is False the value is 0. An entry that no world has is left out.
    """
    own = {}
    for name, value in infos.items():
        which = infos.get(f"_{name}")
        if which is None or not which.any():
            continue
        if isinstance(value, dict):
            value = own_entries(value)
        elif value.dtype != object and not which.all():
            value = value.copy()
            value[~which] = 0
        own[name], own[f"_{name}"] = value, which
    return own


def vector_class(env_type: type[WorldsEnv], *mixins: type[Any]) -> type[NPAVectorEnv]:
    """Return the class of vector environments of the task of `env_type`, with `mixins` as bases."""
    name = env_type.__name__
    attributes = {
        "__doc__": f"Worlds of `{name}`, batched on one device; its docstring describes both.",
        "__module__": env_type.__module__,
        "task_type": env_type.task_type,
    }
    return type(name.replace("Env", "VectorEnv"), (*mixins, NPAVectorEnv), attributes)


# Checks of arguments that are no fields of a configuration.


def checked_count(name: str, value: Any) -> int:
    """Return `value`, a whole number of at least 1, after a check; `name`: the argument's."""
    count = as_python(value)
    check_count(name, count, f": for example {name}=8")
    return int(count)


def checked_mode(mode: str | AutoresetMode) -> AutoresetMode:
    """Return the `AutoresetMode` of this name; Gymnasium's own modes are returned as they are."""
    if isinstance(mode, AutoresetMode):
        return mode
    by_name = AUTORESET_MODES | {known.value: known for known in AutoresetMode}
    if not isinstance(mode, str) or mode not in by_name:
        raise NPAError(
            f"autoreset_mode must be a known word, got {shown(mode)}: "
            f"{suggest(mode, AUTORESET_MODES)}"
        )
    return by_name[mode]


def check_options(options: Any, known: tuple[str, ...]) -> None:
    """Check that the options of `reset` are a dict with known names only."""
    if not isinstance(options, Mapping | None):
        raise NPAError(
            f"options must be a dict or None, got {type(options).__name__}: "
            "for example options={'reset_mask': mask}"
        )
    for name in options or ():
        if name not in known:
            hint = suggest(name, known) if known else "a single environment has none"
            raise NPAError(f"unknown reset option {shown(str(name)[:80])}: {hint}")


def worlds_to_reset(
    options: dict[str, Any] | None, world_count: int, *, started: bool = True
) -> NDArray[np.int64]:
    """Return the indices of worlds in `options["reset_mask"]`, int64 [B']; without it, of all."""
    check_options(options, ("reset_mask",))
    mask = (options or {}).get("reset_mask")
    if mask is None:
        return np.arange(world_count)
    mask = mask.cpu().numpy() if isinstance(mask, Tensor) else np.asarray(mask)
    if mask.dtype != bool or mask.shape != (world_count,):
        raise NPAError(
            f"reset_mask must be bool of shape [B] = ({world_count},), got {mask.dtype} "
            f"{mask.shape}: True for each world to reset"
        )
    if not mask.any():
        raise NPAError("reset_mask must choose at least one world, got none: skip the reset")
    if not started and not mask.all():
        raise NPAError("reset_mask needs worlds that have started: reset all of them first")
    return np.flatnonzero(mask)


def checked_worlds(worlds: Any, world_count: int) -> Tensor:
    """Return checked indices of worlds, each once, on the CPU, int64, shape [B']."""
    indices = number_tensor("worlds", worlds).cpu()
    # A mask is refused: it would be read as the indices 0 and 1.
    whole = not indices.is_floating_point() and indices.dtype != torch.bool
    exist = whole and bool(((indices >= 0) & (indices < world_count)).all())
    if indices.ndim != 1 or not exist or len(set(indices.tolist())) < len(indices):
        raise NPAError(
            f"worlds must be indices below {world_count}, each once, got "
            f"{shown(indices.tolist())}: for example worlds=[0, 2]"
        )
    return indices.long()


def rng_keys(
    seed: int | Sequence[int] | None, world_count: int, np_random: np.random.Generator
) -> Tensor:
    """Return the key of each world's stream of random numbers, int64, shape [B].

    World k gets the key of seed + k, or of the k-th seed; None: a random one of `np_random`.
    """
    if seed is None:
        keys = np_random.integers(2**64, size=world_count, dtype=np.uint64)
        return torch.from_numpy(keys.view(np.int64))
    if isinstance(seed, int | np.integer):
        seed = [int(seed) + k for k in range(world_count)]
    rule = f"one whole number, or one for each of {world_count} worlds: give seed=0"
    try:
        seeds = [operator.index(number) for number in seed]
    except TypeError as error:
        raise NPAError(f"seed must be {rule}, got {shown(seed)}") from error
    if len(seeds) != world_count:
        raise NPAError(f"seed must be {rule}, got {len(seeds)}")
    return WorldRandom(seeds).keys
