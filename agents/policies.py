"""Policies of particles: a rule's, random, scripted; and whether a rule fits an environment."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from itertools import accumulate, pairwise
from typing import Any, TypeVar, overload

import numpy as np
import torch
from gymnasium.vector import SyncVectorEnv, VectorEnv
from numpy.typing import NDArray
from torch import Tensor

from npa_envs.checks import checked_count, checked_finite, checked_positive, number_tensor
from npa_envs.envs.core.config import Interface
from npa_envs.errors import NPAError, shown
from npa_envs.rule.rule import COLOUR_OFFSET, NPARule, check_rule
from npa_envs.world.randomness import StreamId, WorldRandom

Array = TypeVar("Array", NDArray[Any], Tensor)


def unwrapped(env: Any) -> Any:
    """Return the environment of `npa_envs` inside wrappers; of a `SyncVectorEnv` its first one."""
    # Batches of agents have no wrappers.
    inner = getattr(env, "unwrapped", env)
    if isinstance(inner, SyncVectorEnv):
        inner = inner.envs[0].unwrapped
    if not hasattr(inner, "worlds"):
        hint = "gymnasium.make('npa/Morphogenesis2D-v0')"
        if isinstance(env, VectorEnv):
            hint = (
                "gymnasium.make_vec('npa/Morphogenesis2D-v0', num_envs=8, "
                "vectorization_mode='vector_entry_point')"
            )
        raise NPAError(
            f"env must be an environment of npa_envs, got {type(env).__name__}: make it with {hint}"
        )
    return inner


def interface_of(env: Any) -> Interface:
    """Return what the columns of an environment's observations and actions mean.

    `env` is a single or a vector environment of `npa_envs`, wrapped or not.
    """
    worlds = unwrapped(env).worlds
    interface: Interface = worlds.task.config.interface(worlds.physics)
    return interface


def acting_interface(env: Any) -> Interface:
    """Return `interface_of(env)`; raises NPAError if its actions are not rows of particles."""
    interface = interface_of(env)
    space = getattr(env, "single_action_space", None) or getattr(env, "action_space", None)
    # In PettingZoo's environments, whose agents are species, `action_space` is a method.
    shape = getattr(space, "shape", None)
    if space is not None and not callable(space) and (shape is None or len(shape) != 2):
        raise NPAError(
            f"this policy acts by rows of particles, but the environment takes {space}: use "
            "load_policy('random', env) or load_policy('zero', env) of npa_envs.agents"
        )
    return interface


def spans_of(counts: Iterable[int]) -> list[slice]:
    """Return slices of consecutive groups of particles; `counts` has the size of each group."""
    ends = [0, *accumulate(counts)]
    return [slice(*pair) for pair in pairwise(ends)]


class Policy:
    """A function from observations to actions; subclasses define `act`.

    It maps observations of one world, [N, P], or of several, [B, N, P], to actions [N, A] or
    [B, N, A], float32, within the action space: arrays to arrays, and tensors to tensors on the
    same device. It also maps a dict of agents' observations, as of PettingZoo's parallel
    environments, to a dict of their actions. It has no gradients. `interface`: `interface_of(env)`.
    """

    def __init__(self, interface: Interface) -> None:
        self.interface = interface

    def act(self, observation: Tensor) -> Tensor:
        """Return actions [B, N, A] for observations [B, N, P], float32, on any device."""
        raise NotImplementedError

    @overload
    def __call__(self, observation: Array) -> Array: ...

    @overload
    def __call__(self, observation: Mapping[str, Array]) -> dict[str, Array]: ...

    @torch.no_grad()
    def __call__(self, observation: Any) -> Any:
        """Return the actions for observations, or for a dict of them."""
        if isinstance(observation, Mapping):
            return self._act_by_agent(observation)
        if isinstance(observation, Tensor):
            return self._act_on(observation).to(observation.device)
        # `from_numpy` needs writable memory.
        writable = np.require(observation, np.float32, ("C", "W"))
        return self._act_on(torch.from_numpy(writable)).cpu().numpy()

    def _act_by_agent(self, observations: Mapping[str, Any]) -> dict[str, Any]:
        """Return actions by agent, for observations [P], [N_k, P] or [B, N_k, P] of agent k."""
        if not observations:
            return {}
        # One particle's observation, [P], is a row as well.
        given = zip(observations, map(torch.as_tensor, observations.values()), strict=True)
        rows = {agent: rows if rows.ndim > 1 else rows[None] for agent, rows in given}
        spans = self._spans({agent: values.shape[-2] for agent, values in rows.items()})
        joined = _joined(rows, spans)
        actions = self._act_on(joined).to(joined.device)
        return {
            agent: _in_form_of(observed, actions[..., spans[agent], :])
            for agent, observed in observations.items()
        }

    def _spans(self, counts: Mapping[str, int]) -> dict[str, slice]:
        """Return the slice of each agent's particles, for the number of its particles."""
        return dict(zip(counts, spans_of(counts.values()), strict=True))

    def _act_on(self, observation: Tensor) -> Tensor:
        shape, columns = tuple(observation.shape), self.interface.perception_dim
        whole = columns + self.interface.target_dim
        if len(shape) not in (2, 3) or shape[-1] != whole:
            raise NPAError(
                f"observation must have shape [N, P] or [B, N, P] with P = {whole}, got {shape}: "
                "use the policy with the environment that it was made for"
            )
        action = self.act(observation[..., :columns].float().reshape(-1, shape[-2], columns))
        return action.view(*shape[:-1], self.interface.action_dim)


def _joined(rows: Mapping[str, Tensor], spans: Mapping[str, slice]) -> Tensor:
    """Return the rows of all agents in one tensor, [..., N, P]; other particles have zeros."""
    first, count = next(iter(rows.values())), max(span.stop for span in spans.values())
    joined = first.new_zeros(*first.shape[:-2], count, first.shape[-1])
    for agent, span in spans.items():
        target, shape = joined[..., span, :], tuple(rows[agent].shape)
        if shape != target.shape:
            raise NPAError(
                f"observation[{agent!r}] must have shape {tuple(target.shape)}, got {shape}: use "
                "the policy with the environment that it was made for"
            )
        target.copy_(rows[agent])
    return joined


def _in_form_of(observed: Any, action: Tensor) -> Any:
    """Return an agent's actions as an array or a tensor, [A] or [..., N_k, A], as `observed`."""
    action = action if np.ndim(observed) > 1 else action[0]
    return action if isinstance(observed, Tensor) else action.cpu().numpy()


class RulePolicy(Policy):
    """An update rule as a policy: its outputs δ (displacement) and Δs (state step) become actions.

    They are a_x = δ / (1 + |δ|), a fraction of α ε, and a_s = Δs / state_scale. An episode equals
    `npa_envs.rollout` up to rounding, unless the environment clips state steps or observations.

    Args:
        rule: The rule, which is not copied; actions are computed on its device.
        env: The environment, which must fit the rule; None: nothing is checked.
        state_scale: Largest state step of the environment, if `env` is None (dimensionless).

    Raises:
        NPAError: The rule lacks `moment_correction`, has picture codes, divides, or misfits `env`.
    """

    def __init__(self, rule: NPARule, env: Any = None, state_scale: float = 1.0) -> None:
        check_rule(rule)
        if rule.divides:
            raise NPAError(
                "a policy needs a constant number of particles, got a rule with divides=True: run "
                "it with npa_envs.rollout"
            )
        if rule.code_dim:
            raise NPAError(
                f"a policy needs a rule without codes, got code_dim={rule.code_dim}: run it with "
                "npa_envs.rollout, or in npa/Shapeshifter2D-v0"
            )
        _check_correction(rule)
        state_scale = checked_positive("state_scale", state_scale)
        if env is not None:
            changed, original = (
                getattr(e, "single_observation_space", None)
                or getattr(e, "observation_space", None)
                for e in (env, unwrapped(env))
            )
            if changed != original:
                raise NPAError(
                    "a rule needs the environment's own observations, but a wrapper changes them "
                    f"from {original} to {changed}: give RulePolicy the environment without it"
                )
            check_rule_fits(rule, interface_of(env), unwrapped(env).config)
            state_scale = interface_of(env).state_scale
        super().__init__(rule_interface(rule, state_scale))
        self.rule = rule

    def act(self, observation: Tensor) -> Tensor:
        """Return the rule's actions for all particles, shape [B, N, A]."""
        return self.interface.action(*bounded_update(self.rule, observation.flatten(0, 1))).float()


class ZeroPolicy(Policy):
    """Do nothing: all actions are zero."""

    def __init__(self, env: Any) -> None:
        super().__init__(acting_interface(env))

    def act(self, observation: Tensor) -> Tensor:
        """Return zeros, shape [B, N, A]."""
        return observation.new_zeros(*observation.shape[:2], self.interface.action_dim)


class PolicyRandom:
    """Random streams of a policy, one for each world: world k has the stream of `seed + k`."""

    def __init__(self, seed: Any) -> None:
        self._seed = checked_count("seed", seed)
        self._streams: WorldRandom | None = None

    def next_step(self, world_count: int, device: torch.device) -> WorldRandom:
        """Return each world's random stream, a step further; another `world_count` restarts all."""
        if self._streams is None or self._streams.world_count != world_count:
            seeds = range(self._seed, self._seed + world_count)
            # A substream, as an environment with the same seed uses these streams itself.
            self._streams = WorldRandom(seeds, device=device).substream(StreamId.POLICY)
        self._streams.advance()
        return self._streams


class RandomPolicy(Policy):
    """Act at random, uniformly over the action space; world k acts by the seed `seed + k`."""

    def __init__(self, env: Any, seed: int = 0) -> None:
        super().__init__(acting_interface(env))
        self._random = PolicyRandom(seed)

    def act(self, observation: Tensor) -> Tensor:
        """Return actions drawn from [-1, 1), shape [B, N, A]."""
        world_count, particle_count, _ = observation.shape
        random = self._random.next_step(world_count, observation.device)
        return 2.0 * random.uniform(particle_count, self.interface.action_dim) - 1.0


class SpreadPolicy(Policy):
    """Move down the density gradient: particles repel each other and spread out.

    The displacement, as a fraction of α ε, is -`gain` times the gradient c^{1+D} ∇ρ / N with
    c = ε / ε0. With a gain below 0 particles attract each other.
    """

    def __init__(self, env: Any, gain: float = 0.03) -> None:
        super().__init__(interface_of(env))
        self._gain = checked_finite("gain", gain)

    def act(self, observation: Tensor) -> Tensor:
        """Return actions, shape [B, N, A]: displacements down the gradient, and `state_step`."""
        displacement = -self._gain * self.interface.density_gradient(observation)
        return self.interface.action(displacement, self.state_step(observation))

    def state_step(self, observation: Tensor) -> Tensor:
        """Return changes of states, shape [B, N, C]: here zeros."""
        return torch.zeros_like(self.interface.states(observation))


def target_colour(env: Any) -> Tensor | None:
    """Return the mean colour of an environment's target, shape [3]; None where it has no target."""
    target = getattr(getattr(unwrapped(env).worlds.task, "task", None), "target", None)
    return None if target is None else target.mean_colour


class PaintPolicy(SpreadPolicy):
    """Spread out, and take one colour.

    Args:
        colour: Red, green and blue in [0, 1]; None: the mean colour of the environment's target.
        gain: As of `SpreadPolicy`.
    """

    def __init__(
        self, env: Any, colour: Sequence[float] | Tensor | None = None, gain: float = 0.03
    ) -> None:
        super().__init__(env, gain)
        colour = target_colour(env) if colour is None else colour
        if colour is None:
            raise NPAError("colour must be given if env has no target: colour=(0, 0.5, 0)")
        self._colour = number_tensor("colour", colour).float()
        if self._colour.shape != (3,):
            raise NPAError(
                f"colour must have three numbers, got {shown(colour)}: for example "
                "colour=(0, 0.5, 0)"
            )

    def state_step(self, observation: Tensor) -> Tensor:
        """Return state steps [B, N, C]: the missing colour in the last three channels, else 0."""
        step = torch.zeros_like(self.interface.states(observation))
        target = self._colour.to(step.device) - COLOUR_OFFSET
        step[..., -3:] = target - self.interface.states(observation)[..., -3:]
        return step


class MendPolicy(SpreadPolicy):
    """Spread out, and repair damage: zero states become the mean state of the neighbours.

    Args:
        blank: States with a norm below this count as zero (dimensionless).
        gain: As of `SpreadPolicy`; small, so that undamaged parts hardly change.
    """

    def __init__(self, env: Any, blank: float = 0.1, gain: float = 0.003) -> None:
        super().__init__(env, gain)
        self._blank = checked_finite("blank", blank)

    def state_step(self, observation: Tensor) -> Tensor:
        """Return state steps [B, N, C]: to the neighbours' mean from zero states, else 0."""
        states = self.interface.states(observation)
        is_zero = states.norm(dim=-1, keepdim=True) < self._blank
        return torch.where(is_zero, self.interface.mean_states(observation) - states, 0.0)


def rule_interface(rule: NPARule, state_scale: float) -> Interface:
    """Return the columns of observations and actions that a rule needs, as an `Interface`."""
    moving = not rule.static
    return Interface(rule.space_dim, rule.state_dim, moving, state_scale, rule.species_count)


def bounded_update(rule: NPARule, observation: Tensor) -> tuple[Tensor, Tensor]:
    """Return what a rule does for K rows of observations, [K, P]: displacements and state steps.

    Displacements are δ / (1 + |δ|), as fractions of α ε, [K, D], or [K, 0] of a static rule; state
    steps are Δs, without bounds, [K, C]. They are on the rule's device and differentiable.
    """
    weight = rule.hidden.weight
    rows = columns_read(rule, observation.to(weight.device, weight.dtype))
    network = rule.network()
    if network is not None:
        # The same operations as in a rollout, as a rule amplifies rounding errors.
        padded = rows.new_zeros(len(rows), network.row_width)
        padded[:, : rule.perception_dim] = rows
        padded[:, rule.perception_dim] = 1.0
        update = network(padded)[:, : rule.update_dim]
    else:
        update = rule(rows)
    return split_update(rule, update)


def split_update(rule: NPARule, update: Tensor) -> tuple[Tensor, Tensor]:
    """Split raw updates [K, A] into displacements δ / (1 + |δ|), [K, D], and state steps [K, C]."""
    moved = 0 if rule.static else rule.space_dim
    delta, state_step = update[:, :moved], update[:, moved:]
    return delta / (1.0 + delta.norm(dim=1, keepdim=True)), state_step


def columns_read(rule: NPARule, rows: Tensor) -> Tensor:
    """Return the columns of observations [K, P] that a rule reads, in the rule's order."""
    if rule.state_gradient and rule.density_gradient:
        return rows
    first, end = 2 * rule.state_dim, rule_interface(rule, 1.0).shared_dim
    density = end - rule.space_dim
    groups = [rows[:, :first]]
    if rule.state_gradient:
        groups.append(rows[:, first:density])
    if rule.density_gradient:
        groups.append(rows[:, density:end])
    # All rules that perceive by species read all columns of the species.
    return torch.cat((*groups, rows[:, end:]), dim=1)


def check_rule_fits(rule: NPARule, wanted: Interface, config: Any) -> None:
    """Check that a rule can act in an environment: `wanted` is its interface."""
    _check_correction(rule)
    if rule.static == wanted.moving:
        motion, other = ("static", "moving") if rule.static else ("moving", "static")
        raise NPAError(
            f"rule must be one of {other} particles like the environment's, got one of {motion} "
            f"particles (static={rule.static}): choose another environment or another rule"
        )
    if rule.species_count != wanted.species_count:
        raise NPAError(
            f"rule must distinguish {wanted.species_count} species as the environment does, got "
            f"{rule.species_count}: choose another rule, or another perception"
        )
    required = {
        "space_dim": wanted.space_dim,
        "state_dim": wanted.state_dim,
        "moment_inverse": config.moment_inverse,
        "eps0": config.eps0,
        # Nothing moves in a static rule's worlds.
        "alpha": rule.alpha if rule.static else config.alpha,
    }
    for name, value in required.items():
        actual = getattr(rule, name)
        is_float = isinstance(actual, float)
        if math.isclose(actual, value, rel_tol=1e-6) if is_float else actual == value:
            continue
        wanted_text, text = (f"{n:g}" if is_float else repr(n) for n in (value, actual))
        hint = f"make the environment with the keyword {name}={text}"
        if name == "space_dim":
            hint = "choose another environment or another rule"
        raise NPAError(
            f"rule must have the environment's {name}, {wanted_text}, got {text}: {hint}"
        )


def _check_correction(rule: NPARule) -> None:
    if not rule.moment_correction:
        raise NPAError(
            "rule must have moment_correction=True, as observations have corrected gradients, got "
            "False: train it with the correction"
        )
