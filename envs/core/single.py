"""One world as a Gymnasium environment."""

from __future__ import annotations

import warnings
from typing import Any

import gymnasium
import numpy as np
import torch
from torch import Tensor

from npa_envs.checks import number_tensor
from npa_envs.envs.core.base import WorldsEnv
from npa_envs.envs.core.config import as_python
from npa_envs.envs.core.step_report import reason
from npa_envs.envs.core.vector import check_options, rng_keys
from npa_envs.world.environment_steps import DIVERGED, SUCCESS, TIME_LIMIT


class NPAEnv(WorldsEnv, gymnasium.Env[Any, Any]):
    """One world of a task as a Gymnasium environment; subclasses set `task_type`.

    Keywords are the fields of the task's configuration. The page of each subclass ends with the
    sections below, each after the subclass's own section of the same name.

    ## Reward

    | `reward` | Reward of step t |
    |---|---|
    | `"dense"` | L before the step minus L after it |
    | `"sparse"` | 0, and minus L in the last step; needs `episode_steps`, see below |
    | `"particle"` | as dense; `info["particle_reward"]` is the decrease of each particle's loss |
    | `"marginal"` | as dense; `info["particle_reward"]` is each action's contribution |

    Dense rewards of an episode sum to L at its start minus L at its end. The mean of all particles'
    rewards is the dense reward, up to rounding, as long as the episode lasts. In a step that
    diverges, L counts as at least its value at the start, so that diverging is never rewarded; the
    terms in `info` are not changed by this.

    With `"marginal"` a particle's reward is −N times its change in the step, times the gradient of
    L in the middle of the step: to second order, N times what its action contributed to the
    decrease of L, averaged over being the first and the last to act. The remainder of the dense
    reward is spread equally. So a particle is rewarded only for its own action; with `"particle"`
    also for what the actions of others do to its pixels.

    ## Starting state

    `reset(seed=k)` begins the sequence of episodes that belongs to k, and `reset()` continues with
    the next one. With `seed_pool=9` there are only nine different starts.

    ## Episode end

    | Cause | Returned as | `info["reason"]` |
    |---|---|---|
    | the loss is at most `success_loss` | terminated | `"success"` |
    | a particle has left the world, or its state has diverged | terminated | `"diverged"` |
    | `episode_steps` or, of a vector, `max_episode_steps` are done | truncated | `"time limit"` |

    A particle has left the world if a coordinate is beyond ±`position_limit`. Its state has
    diverged if a channel is beyond ±`observation_limit`. `max_episode_steps` of `gym.make` gives no
    reason, and `reward="sparse"` needs its number as `episode_steps` as well. After `close` only a
    `reset` is no error: it begins anew.

    ## Info

    | Key | In | Value |
    |---|---|---|
    | `loss` | reset, step | the current loss L |
    | `success`, `diverged` | step | whether the world succeeded or diverged in it, bool |
    | `reason` | last step | why the episode ended, see above; None for other worlds |
    | `particle_reward` | step, with two `reward`s | each particle's reward, shape [N] |
    | `updated` | step, with `tell_updated=True` | which particles it updated, bool, shape [N] |

    ## Central control

    With `control="central"` one controller of few numbers acts, for learners whose policy is one
    Gaussian over the whole action.

    It observes `Box(-64, 64, (4 G²,), float32)` with G = `picture_size`: red, green, blue and
    density of G × G pixels, row by row from the bottom up. They span ±`place_reach` along x and y.
    Each particle is shared bilinearly between the four pixels around it, at the edge if it is
    outside; colours are sums over particles. Particles that cover the square evenly have density 1.

    It acts by `Box(-1, 1, (P² A,), float32)` with P = `place_count`: a particle's row of A numbers
    at each place of a grid over the same square, row by row. A particle gets the row interpolated
    bilinearly between the four places around it. With P = 1 all particles get one row.

    ## Rendering

    `render_mode="rgb_array"` makes uint8 pictures of shape [R, R, 3], R = `render_size`, that show
    [-1, 1] × [-1, 1] with y up. `render_mode="human"` shows them in a window; it needs
    `pip install 'npa-envs[human]'`, and without a screen it warns once. `render_style` chooses
    between the particles' colours, density, and hidden channels.

    ## Arguments

    All are keywords of `gym.make` and `gym.make_vec`. An unknown name, or a value out of range,
    raises an `NPAError` that says which values are valid.

    ## Vectorized environment

    `gym.make_vec(id, num_envs=B)` makes B worlds that one call steps together, on the CPU or, with
    `device="cuda"`, on a GPU. Observations have shape [B, N, P], actions [B, N, A], rewards and
    flags [B]. World k after `reset(seed=s)` is the single environment after `reset(seed=s + k)`,
    bit for bit, for every B.

    - With `output="torch"` results are tensors on the device, and actions may be too. Only the
      flags of episode ends are copied to the host.
    - Infos are those of Gymnasium's `SyncVectorEnv`: arrays of shape [B] with masks. As tensors
      they are of all worlds, and the masks say which count.
    - With `autoreset_mode="same-step"`, the default, a world whose episode is over starts the next
      one at once: the last observation is in `infos["final_obs"]`, an object array with None for
      other worlds, or a tensor of all worlds; the last infos are in `infos["final_info"]`.
    - `reset(options={"reset_mask": mask})` resets some worlds and does not change the others.

    `env.unwrapped.particles()` returns positions and states, and `place_particles(x, s)` replaces
    them, without a reward; single environments have both methods as well.

    ## References

    H. Kim, E. Pajouheshgar, S. Süsstrunk, W. Jakob, J. Park: Neural Particle Automata: Learning
    Self-Organizing Particle Dynamics. [arXiv 2601.16096](https://arxiv.org/abs/2601.16096), 2026.

    ## Version history

    - v0: first version.
    """

    def __init__(self, **keywords: Any) -> None:
        self._make_worlds(keywords, 1, None)
        self.observation_space = self.spaces.observation_space
        self.action_space = self.spaces.action_space
        self._world_index = torch.zeros(1, dtype=torch.int64, device=self.task.device)
        self._key_generator: np.random.Generator | None = None
        self._continues = False

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Any, dict[str, Any]]:
        """Start an episode; return the observation, shape [N, P], and the loss with its terms.

        A seed begins its sequence of episodes; None starts the next episode of the current
        sequence. There are no options.
        """
        seed = as_python(seed)
        check_options(options, ())
        super().reset(seed=seed)
        is_sparse = self.task.rewards_last_step_only
        if self._continues and (is_sparse or self._is_cut()):
            what = "its sparse reward, which comes in step" if is_sparse else "step"
            warnings.warn(
                f"an episode ended before {what} episode_steps={self.config.episode_steps}: give "
                "that number to gymnasium.make as max_episode_steps as well",
                stacklevel=2,
            )
        self._continues = False
        # A new generator, by `seed` or because the caller set `np_random`, begins a new sequence.
        keys = None
        if seed is not None or self.np_random is not self._key_generator:
            self._key_generator = self.np_random
            keys = rng_keys(None, 1, self.np_random)
        observation = self._change_worlds(self.worlds.start, self._world_index, keys)
        info = self.losses_of(self.worlds.episodes.report.numbers[:, 0].tolist())
        info |= self._of_world(self.worlds.extra_info())
        return self.spaces.observation_output(observation[0]), info

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        """Apply an action, [N, A]; return observation, reward, terminated, truncated and info.

        Raises:
            NPAError: The action has another shape; the world is not changed.
            DivergedError: The action is not finite, and the world is not changed; or the world
                diverged, and `on_divergence` is "raise".
        """
        self.check_begun("step needs a world")
        worlds = self.worlds
        checked = self.spaces.action(action, None)
        with worlds.device_context():
            endings, observation = worlds.step(checked)
            diverged = bool(endings[0] & DIVERGED)
            ending = int(worlds.handle_diverged(endings, observation)[0])
        terminated, truncated = ending & (SUCCESS | DIVERGED) != 0, ending & TIME_LIMIT != 0
        numbers = worlds.episodes.host_numbers.numpy()[:, 0].tolist()
        info = self.losses_of(numbers) | self._improvements(numbers)
        info |= {"success": bool(ending & SUCCESS), "diverged": diverged}
        if terminated or truncated:
            info["reason"] = reason(ending)
        info |= self._of_world(worlds.extra_info() | worlds.step_info())
        self._continues = not (terminated or truncated)
        self._show()
        returned = self.spaces.observation_output(worlds.host_observation(observation)[0])
        return returned, numbers[0], terminated, truncated, info

    def particles(self) -> tuple[Tensor, Tensor]:
        """Return copies of positions [length units], [N, D], and states, [N, C], on the device."""
        return self.worlds.x[0].clone(), self.worlds.s[0].clone()

    def place_particles(self, x: Any, s: Any) -> Any:
        """Replace the particles, without a reward, and return the new observation, shape [N, P].

        Positions, [N, D], and states, [N, C], must be finite and within their limits.
        """
        self.check_begun("particles need a world")
        x, s = number_tensor("x", x)[None], number_tensor("s", s)[None]
        placed = self.worlds.checked_particles(x, s, 1, self.config.particle_count)
        observation = self._change_worlds(self.worlds.place, self._world_index, placed)
        return self.spaces.observation_output(observation[0])

    def _is_cut(self) -> bool:
        """Return whether the episode has come to the limit of its id before `episode_steps`."""
        if self.spec is None or self.config.episode_steps is None:
            return False
        entry = gymnasium.registry.get(self.spec.id)
        elapsed = int(self.worlds.episodes.elapsed[0])
        return entry is not None and entry.max_episode_steps == elapsed

    def _of_world(self, values: dict[str, Tensor]) -> dict[str, Any]:
        return {
            name: self._out(value[0].clone()) if value.ndim > 1 else value[0].item()
            for name, value in values.items()
        }
