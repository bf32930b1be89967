"""Many worlds as one Gymnasium vector environment, batched on the device."""

from __future__ import annotations

import operator
from collections.abc import Mapping, Sequence
from functools import cached_property
from typing import Any

import numpy as np
import torch
from gymnasium import Space
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space
from numpy.typing import NDArray
from torch import Tensor

from npa_envs.checks import is_whole, number_tensor
from npa_envs.envs.core.base import WorldsEnv
from npa_envs.envs.core.referee import FLAGS, StepReport, reason
from npa_envs.errors import NPAError, shown, suggest
from npa_envs.world.actions import TIME_LIMIT
from npa_envs.world.cuda_graph import to_device_async
from npa_envs.world.randomness import WorldRandom

AUTORESET_MODES = {
    "same-step": AutoresetMode.SAME_STEP,
    "next-step": AutoresetMode.NEXT_STEP,
    "disabled": AutoresetMode.DISABLED,
}
"""What happens to worlds whose episodes are over."""

REASONS = np.array([reason(ending) for ending in range(2 * TIME_LIMIT)], dtype=object)
"""Why an episode ended, in words, for each combination of endings."""


class NPAVectorEnv(WorldsEnv, VectorEnv[Any, Any, Any]):
    """B worlds of a task, stepped together; subclasses name the task.

    World k, reset with `seed`, is the single environment reset with `seed + k`, bit for bit.

    Args:
        num_envs: Worlds B.
        max_episode_steps: Steps after which an episode is truncated; None or -1: never.
        autoreset_mode: "same-step": the step that ends an episode returns the next one's first
            observation, the last one is in `infos["final_obs"]`; "next-step": the next step does,
            whatever its action; "disabled": `reset(options={"reset_mask": ...})` does.
        copy: Hand out new arrays; False: the same ones in each step, overwritten by the next.
        keywords: Fields of the task's configuration.

    Raises:
        NPAError: A keyword is unknown or wrong, or the worlds do not fit into memory.
    """

    metadata: dict[str, Any] = {  # noqa: RUF012 (each instance gets a dictionary of its own)
        "render_modes": ["rgb_array", "human"],
        "render_fps": 25,
        "autoreset_mode": AutoresetMode.SAME_STEP,
    }

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
        # Gymnasium's word for "never" is -1.
        if max_episode_steps is not None and max_episode_steps != -1:
            episode_steps = checked_count("max_episode_steps", max_episode_steps)
        else:
            episode_steps = None
        self.autoreset_mode = checked_mode(autoreset_mode)
        self.metadata = {**type(self).metadata, "autoreset_mode": self.autoreset_mode}
        self.num_envs = num_envs
        self._make_worlds(keywords, num_envs, episode_steps)
        self.single_observation_space = self.form.observation_space
        self.single_action_space = self.form.action_space
        self.copies = copy
        """Whether what is handed out stays as it is after the next step."""
        self._buffer: Tensor | None = None
        self._shared: NDArray[np.float64] | None = None
        self._ended = np.zeros(num_envs, dtype=bool)

    @cached_property
    def observation_space(self) -> Space[Any]:  # type: ignore[override]
        """Observations of all worlds, shape [B, N, P]; made when asked for, as it is large."""
        return batch_space(self.single_observation_space, self.num_envs)

    @cached_property
    def action_space(self) -> Space[Any]:  # type: ignore[override]
        """Actions of all worlds, shape [B, N, A]; made when asked for, as it is large."""
        return batch_space(self.single_action_space, self.num_envs)

    def reset(
        self,
        *,
        seed: int | Sequence[int] | None = None,
        options: dict[str, Any] | None = None,
    ) -> tuple[Any, dict[str, Any]]:
        """Start episodes.

        Args:
            seed: Begin the sequences of episodes of seed, seed + 1, ..., or of the seeds in a list;
                without it the sequences go on.
            options: `{"reset_mask": mask}` resets only the worlds where the mask, bool, shape [B],
                is True; the others are left as they are, bit for bit.

        Returns:
            Observations of all worlds, shape [B, N, P], and the losses with their parts.

        Raises:
            NPAError: The mask or the seeds have a wrong shape.
        """
        seed = plain_seed(seed)
        super().reset(seed=seed if isinstance(seed, int) else None)
        chosen = worlds_to_reset(options, self.num_envs)
        if not self._started and len(chosen) < self.num_envs:
            raise NPAError("reset_mask needs worlds to leave alone: reset all of them first")
        keys = None
        if seed is not None or not self._started:
            keys = rng_keys(seed, self.num_envs, self.np_random)[chosen]
        worlds = torch.from_numpy(chosen).to(self.task.device)
        observation = self._begin(worlds, keys, self._buffer)
        if not self.copies:
            self._buffer = observation
        self._ended[chosen] = False
        which = np.zeros(self.num_envs, dtype=bool)
        which[chosen] = True
        losses = self.losses_of(self._numbers(self.worlds.report.copy()))
        infos = masked(losses, self._mask(which)) | self._extras("reset", self._mask(which))
        return self.form.seen(observation), infos

    def step(self, actions: Any) -> tuple[Any, Any, Any, Any, dict[str, Any]]:
        """Apply an action to each world and perceive.

        Args:
            actions: Shape [B, N, A], in [-1, 1].

        Returns:
            Observations [B, N, P], rewards [B], terminations [B], truncations [B], and infos.

        Raises:
            NPAError: The actions have another shape; the worlds are then as they were.
            DivergedError: An action is not finite, and the worlds are as they were; or a world
                diverged, and `on_divergence` is "raise".
        """
        if not self._started:
            raise NPAError("step needs worlds: call reset first")
        action = self.form.action(actions, self.num_envs)
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
        endings = self.worlds.guarded(endings, observation)
        if restarting:
            self.worlds.restart(np.flatnonzero(over), observation)
        ended = endings != 0
        final = self.autoreset_mode is AutoresetMode.SAME_STEP and bool(ended.any())
        # What a restart overwrites is copied first, whatever the caller wants of the rest.
        numbers, flags, infos = self._report(stepped, copy=self.copies or final)
        if final:
            which = self._mask(ended)
            final_infos = {n: which if n.startswith("_") else v for n, v in infos.items()}
            final_infos |= {"reason": REASONS[endings], "_reason": which}
            final_observation = observation
            if self.copies and ended.all():
                observation = torch.empty_like(observation)
            else:
                final_observation = observation.clone()
            self.worlds.restart(np.flatnonzero(ended), observation)
            _, _, infos = self._report(~ended, copy=self.copies)
            infos |= {
                "final_obs": self.form.last_seen(final_observation, ended),
                "_final_obs": which,
            }
            infos |= {"final_info": final_infos, "_final_info": self._mask(ended)}
        else:
            self._ended = ended
            if ended.any():
                infos |= {"reason": REASONS[endings], "_reason": self._mask(ended)}
        self._show()
        return self.form.seen(observation), numbers[0], flags[0], flags[1], infos

    def render(self) -> tuple[NDArray[np.uint8], ...] | None:
        """Return a picture of each world, shape [R, R, 3], in the mode "rgb_array"."""
        if not self._started:
            raise NPAError("render needs worlds: call reset first")
        pictures = self._pictures()
        return None if pictures is None else tuple(pictures)

    def close_extras(self, **kwargs: Any) -> None:
        """Close the window, if there is one."""
        self._close_window()

    def particles(self) -> tuple[Tensor, Tensor]:
        """Return copies of positions [length units], [B, N, D], and states, [B, N, C]."""
        return self.worlds.x.clone(), self.worlds.s.clone()

    def place_particles(self, x: Any, s: Any, worlds: Any = None) -> Any:
        """Replace particles, at no reward, and return the new observations of all worlds.

        Args:
            x: Positions [length units], shape [M, N, D].
            s: States, dimensionless, shape [M, N, C].
            worlds: Which worlds, indices, each once, shape [M]; None: all of them.

        Raises:
            NPAError: A shape is another one, a number is not finite or beyond its limit, or worlds
                are no such indices.
        """
        if not self._started:
            raise NPAError("particles need worlds: call reset first")
        if worlds is None:
            chosen = torch.arange(self.num_envs)
        else:
            chosen = world_numbers(worlds, self.num_envs)
        return self.form.seen(self._place(x, s, chosen.to(self.task.device), self._buffer))

    def _report(
        self, stepped: NDArray[np.bool_] | None, *, copy: bool
    ) -> tuple[list[Any], list[Any], dict[str, Any]]:
        """Return numbers, flags and infos as they are, as they are handed out."""
        worlds = self.worlds
        report = worlds.report.copy() if copy else worlds.report
        # One view for each quantity, made at once.
        numbers, flags = self._numbers(report), list(self._out(report.endings))
        everyone = self._out(report.everyone if copy else report.everyone.clone())
        which = everyone if stepped is None else self._mask(stepped)
        infos = masked(self.losses_of(numbers), everyone)
        infos |= self._extras("reset", everyone, copy=copy)
        own = self._improvements(numbers) | dict(zip(FLAGS, flags[2:], strict=True))
        if worlds.particle_reward is not None:
            shares = worlds.particle_reward
            own["particle_reward"] = self._out(shares.clone() if copy else shares)
        infos |= masked(own, which) | self._extras("step", which, copy=copy)
        return numbers, flags, infos

    def _extras(self, when: str, which: Any, *, copy: bool = True) -> dict[str, Any]:
        extras = self.worlds.extras(when).items()
        return masked({n: self._out(v.clone() if copy else v) for n, v in extras}, which)

    def _numbers(self, report: StepReport) -> list[Any]:
        """Return a report's numbers as handed out: arrays are float64, as Gymnasium's own are."""
        numbers = self._out(report.numbers)
        if isinstance(numbers, Tensor):
            return list(numbers)
        if report is not self.worlds.report:
            return list(numbers.astype(np.float64))
        if self._shared is None:
            self._shared = np.empty(numbers.shape)
        self._shared[:] = numbers
        return list(self._shared)

    def _mask(self, mask: NDArray[np.bool_]) -> Any:
        """Return a mask of worlds as a new array to hand out."""
        return self._sent(mask.copy())


def masked(values: dict[str, Any], which: Any) -> dict[str, Any]:
    """Return values of worlds, and which worlds have them, as Gymnasium's infos hold them."""
    infos = {}
    for name, value in values.items():
        infos[name], infos[f"_{name}"] = value, which
    return infos


def batched(env_type: type[WorldsEnv]) -> type[NPAVectorEnv]:
    """Return the class of many worlds of the task of an environment of one."""
    name = env_type.__name__
    own = {
        "__doc__": f"Worlds of `{name}`, batched on one device; its docstring describes both.",
        "__module__": env_type.__module__,
        "task_type": env_type.task_type,
    }
    return type(name.replace("Env", "VectorEnv"), (NPAVectorEnv,), own)


# Arguments of environments that are no fields of a configuration, checked.


def checked_count(name: str, value: Any) -> int:
    """Return what the caller calls so, a whole number of at least 1."""
    if isinstance(value, np.integer):
        value = int(value)
    if not is_whole(value) or value < 1:
        raise NPAError(
            f"{name} must be a whole number of at least 1, got {shown(value)}: for example {name}=8"
        )
    return int(value)


def checked_mode(given: str | AutoresetMode) -> AutoresetMode:
    """Return Gymnasium's mode for a word or for itself."""
    if isinstance(given, AutoresetMode):
        return given
    by_name = AUTORESET_MODES | {mode.value: mode for mode in AutoresetMode}
    if not isinstance(given, str) or given not in by_name:
        raise NPAError(
            f"autoreset_mode must be a known word, got {shown(given)}: "
            f"{suggest(given, AUTORESET_MODES)}"
        )
    return by_name[given]


def plain_seed(seed: Any) -> Any:
    """Return a seed as Gymnasium takes it: NumPy's whole number as Python's, all else as it is."""
    return int(seed) if isinstance(seed, np.integer) else seed


def check_options(options: Any, known: tuple[str, ...]) -> None:
    """Check the options of `reset` by their names."""
    if not isinstance(options, Mapping | None):
        raise NPAError(
            f"options must be a dict or None, got {type(options).__name__}: "
            "for example options={'reset_mask': mask}"
        )
    for name in options or ():
        if name not in known:
            cure = suggest(name, known) if known else "a single environment has none"
            raise NPAError(f"unknown reset option {shown(str(name)[:80])}: {cure}")


def worlds_to_reset(options: dict[str, Any] | None, world_count: int) -> NDArray[np.int64]:
    """Return which of B worlds the options of `reset` ask for: those of the mask, or all."""
    check_options(options, ("reset_mask",))
    mask = (options or {}).get("reset_mask")
    if mask is None:
        return np.arange(world_count)
    given = mask.cpu().numpy() if isinstance(mask, Tensor) else np.asarray(mask)
    if given.dtype != bool or given.shape != (world_count,):
        raise NPAError(
            f"reset_mask must be bool of shape [B] = ({world_count},), got {given.dtype} "
            f"{given.shape}: True for each world to reset"
        )
    if not given.any():
        raise NPAError("reset_mask must choose at least one world, got none: skip the reset")
    return np.flatnonzero(given)


def world_numbers(worlds: Any, world_count: int) -> Tensor:
    """Return indices of worlds, each once, checked; on the CPU, int64, shape [M]."""
    given = number_tensor("worlds", worlds).cpu()
    # A mask would else be taken for the indices 0 and 1.
    whole = not given.is_floating_point() and given.dtype != torch.bool
    if given.ndim == 1 and whole:
        chosen = given.long()
        there = bool(((chosen >= 0) & (chosen < world_count)).all())
        if there and len(set(chosen.tolist())) == len(chosen):
            return chosen
    raise NPAError(
        f"worlds must be indices below {world_count}, each once, got {shown(given.tolist())}: "
        "for example worlds=[0, 2]"
    )


def rng_keys(
    seed: int | Sequence[int] | None, world_count: int, np_random: np.random.Generator
) -> Tensor:
    """Return the key of each world's randomness, int64, shape [B].

    The seed is that of the first world, each of the others has one more; or there is one for each;
    without any, keys are drawn from the generator.
    """
    if seed is None:
        drawn = np_random.integers(2**64, size=world_count, dtype=np.uint64)
        return torch.from_numpy(drawn.view(np.int64))
    if isinstance(seed, int | np.integer):
        seed = [int(seed) + k for k in range(world_count)]
    cure = f"one whole number, or one for each of {world_count} worlds: give seed=0"
    try:
        seeds = [operator.index(number) for number in seed]
    except TypeError as error:
        raise NPAError(f"seed must be {cure}, got {shown(seed)}") from error
    if len(seeds) != world_count:
        raise NPAError(f"seed must be {cure}, got {len(seeds)}")
    return WorldRandom(seeds).keys
