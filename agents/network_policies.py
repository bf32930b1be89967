"""Policies of whole worlds that are networks, their files, and the choice of a policy by name."""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Iterable, Mapping
from copy import deepcopy
from pathlib import Path
from typing import Any

import numpy as np
import torch
from gymnasium.spaces import Box, flatdim
from torch import Tensor, nn

from npa_envs.agents.garden_policies import ScriptedGardener, ScriptedShepherd
from npa_envs.agents.policies import RandomPolicy, RulePolicy, ZeroPolicy, unwrapped
from npa_envs.atomic_files import checked_path
from npa_envs.envs.garden.base import GardenTask
from npa_envs.envs.shepherd2d import ShepherdTask
from npa_envs.errors import NPAError, shown, suggest
from npa_envs.rule.files import (
    check_checksum,
    load_rule,
    preset_rules,
    read_tensors,
    shipped_rules,
    write_tensors,
)

FORMAT_NAME = "npa-envs policy"


class NetworkPolicy:
    """A network from a world's observation to its action, with tanh between linear layers.

    It maps observations [O] or [B, O], or dicts of them, to actions [A] or [B, A] in [-1, 1]:
    arrays to arrays, and tensors to tensors on the same device. It has no noise and no gradients.

    Args:
        network: The layers, which are not copied.
        parts: Names of the entries of dict observations, in the order of inputs; () for arrays.
    """

    def __init__(self, network: nn.Sequential, parts: Iterable[str] = ()) -> None:
        self.network, self.parts = network.requires_grad_(False), tuple(parts)

    @classmethod
    def of_sb3(cls, model: Any) -> NetworkPolicy:
        """Return a copy of the actor of Stable-Baselines3's PPO with its default network."""
        layers = [*model.policy.mlp_extractor.policy_net, model.policy.action_net]
        if any(type(layer) is not (nn.Linear, nn.Tanh)[k % 2] for k, layer in enumerate(layers)):
            raise NPAError(f"model must have linear layers and tanh between them, got {layers}")
        network = deepcopy(nn.Sequential(*layers)).cpu()
        return cls(network, getattr(model.observation_space, "spaces", ()))

    @torch.no_grad()
    def __call__(self, observation: Any) -> Any:
        """Return the actions for observations of one world or of many."""
        given = [observation[name] for name in self.parts] if self.parts else [observation]
        device = next(self.network.parameters()).device
        inputs = torch.cat([torch.as_tensor(part, device=device) for part in given], dim=-1)
        action = self.network(inputs.float()).clamp(-1.0, 1.0)
        return action.to(given[0].device) if isinstance(given[0], Tensor) else action.cpu().numpy()

    def save(self, path: str | Path, metadata: Mapping[str, str]) -> None:
        """Write the policy to a `.safetensors` file; `metadata`: further text for its header."""
        header = {**metadata, "parts": json.dumps(self.parts)}
        write_tensors(checked_path(path), FORMAT_NAME, header, self.network.state_dict())

    @classmethod
    def load(cls, path: str | Path, device: str | torch.device = "cpu") -> NetworkPolicy:
        """Return the policy of a file that `save` wrote; raises NPAError if it is damaged."""
        try:
            header, named = read_tensors(checked_path(path), FORMAT_NAME)
            check_checksum(header, named)
        except NPAError as error:
            raise NPAError(f"cannot load a policy from {shown(str(path))}: {error}") from error
        layers: list[nn.Module] = []
        while (weight := named.get(f"{len(layers)}.weight")) is not None:
            layers += [nn.Linear(weight.shape[1], len(weight), device="meta"), nn.Tanh()]
        network = nn.Sequential(*layers[:-1])
        network.load_state_dict(named, assign=True)
        return cls(network.to(device), json.loads(header["parts"]))


def shipped_policies() -> dict[str, Path]:
    """Return the policies that come with the package: id of an environment -> file, sorted."""
    folder = Path(__file__).resolve().parent / "shipped"
    return {f"npa/{path.stem}": path for path in sorted(folder.glob("*.safetensors"))}


def load_policy(source: str, env: Any) -> Callable[[Any], Any]:
    """Return a policy for an environment: a function from observations to actions.

    Args:
        source: "zero" or "random". Where actions are updates of particles, also a rule, as for
            `load_rule`. Where an action is a whole world's, also "shipped", the policy that comes
            with the package for the environment's id, or a file of `NetworkPolicy.save`; in
            gardens with brushes that push, also "scripted".
        env: A single or a vector environment of `npa_envs`, wrapped or not.

    Raises:
        NPAError: There is no such policy, its file is damaged, or it does not fit `env`.
    """
    worlds, task = unwrapped(env).worlds, unwrapped(env).worlds.task
    shipped, id = shipped_policies(), getattr(getattr(env, "spec", None), "id", None)
    is_central = getattr(task.config, "control", None) == "central"
    by_particle = task.controls not in ("brushes", "codes") and not is_central
    special = {"scripted": isinstance(task, GardenTask), "shipped": id in shipped}
    known = ["zero", "random", *(name for name, is_there in special.items() if is_there)]
    is_word = isinstance(source, str) and source == Path(source).stem and not Path(source).exists()
    other = is_word and source not in known
    rules = shipped_rules() | preset_rules() if other and by_particle else ()
    if other and source not in rules:
        hint = "take another" if source in special else suggest(source, [*known, *rules])
        raise NPAError(
            "source must be zero, random, scripted or shipped, of which the environment "
            f"{shown(id)} has {', '.join(known)}, or {'a rule' if by_particle else 'a file'}, got "
            f"{shown(source)}: {hint}"
        )
    if source == "shipped":
        source = str(shipped[str(id)])
    if by_particle:
        if source in ("zero", "random"):
            return (ZeroPolicy if source == "zero" else RandomPolicy)(env)
        return RulePolicy(load_rule(source, device=worlds.device).float(), env)
    acted = getattr(env, "single_action_space", None) or env.action_space
    if source in ("zero", "random"):
        return _actions_of(acted, random=source == "random")
    if source == "scripted":
        return (ScriptedShepherd if isinstance(task, ShepherdTask) else ScriptedGardener)(env)
    policy = NetworkPolicy.load(source, worlds.device)
    seen = getattr(env, "single_observation_space", None) or env.observation_space
    ends: Any = policy.network[0].in_features, policy.network[-1].out_features
    wanted = flatdim(seen), flatdim(acted) if isinstance(acted, Box) else 0
    if ends != wanted or policy.parts != tuple(getattr(seen, "spaces", ())):
        parts = f" of {', '.join(policy.parts)}" if policy.parts else ""
        raise NPAError(
            f"the policy must fit the environment, {seen} to {acted}, got one from {ends[0]} "
            f"numbers{parts} to {ends[1]}: make the environment with its own settings"
        )
    return policy


def _actions_of(space: Any, *, random: bool) -> Callable[[Any], Any]:
    """Return a policy of random actions of a space, or of zeros, for each observed world."""
    space = deepcopy(space)
    space.seed(0)

    def act(observation: Any) -> Any:
        array = observation["observation"] if isinstance(observation, Mapping) else observation
        worlds = tuple(array.shape[:-1])
        drawn = np.stack([space.sample() for _ in range(math.prod(worlds))]) * random
        actions = drawn.reshape(worlds + space.shape)
        return torch.as_tensor(actions, device=array.device) if torch.is_tensor(array) else actions

    return act
