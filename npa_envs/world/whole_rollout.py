"""Rollouts of small worlds that one kernel runs on CUDA, with all random numbers drawn before."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from npa_envs.errors import NPAError
from npa_envs.ops.backend import KernelRequest, choose
from npa_envs.ops.position_check import PositionCheck
from npa_envs.ops.whole_rollout import run_whole_rollout
from npa_envs.rule.rule import NPARule
from npa_envs.world.particles import Particles
from npa_envs.world.randomness import Randomness, WorldRandom, give_back_draws, torch_generator
from npa_envs.world.steps import draw_ahead

if TYPE_CHECKING:
    from npa_envs.world.rollout_execution import RolloutSpec

MAX_DRAWN = 2**26
"""Maximum number of random numbers that are drawn before a launch; they take memory."""


def rollout_request(spec: RolloutSpec, rules: Sequence[NPARule], x: Tensor) -> KernelRequest | None:
    """Return a rollout as the request for an implementation; None: its steps are launched."""
    if not x.is_cuda or len(rules) != 1 or spec.species or spec.keep_every is not None:
        return None
    (rule,) = rules
    # A world at rest needs updates that do not depend on which other particles are active.
    plain = not (rule.static or rule.divides or rule.dead_zone) and rule.is_plain()
    if not plain or spec.steps == 0 or torch.compiler.is_compiling():
        return None
    return KernelRequest(
        x.device,
        x.dtype,
        x.shape[1],
        space_dim=x.shape[2],
        hidden_dim=rule.hidden_dim,
        rollout=True,
        boundary=spec.physics.boundary,
        state_dim=rule.state_dim,
    )


def run_whole(
    spec: RolloutSpec,
    rules: Sequence[NPARule],
    particles: Particles,
    generator: Randomness | None,
) -> Particles | None:
    """Run a checked rollout in one launch; None: its steps have to be launched."""
    request = rollout_request(spec, rules, particles.x)
    if request is None or choose("rollout", request).name != "whole":
        return None
    tensors = (*particles.tensors(), *rules[0].network_weights())
    if torch.is_grad_enabled() and any(tensor.requires_grad for tensor in tensors):
        return None
    x, s, *_ = particles
    capturing = torch.cuda.is_current_stream_capturing()
    check = None if capturing else PositionCheck(x)
    weights = [*rules[0].network_weights()[:2], rules[0].update_weight]
    together = max(MAX_DRAWN // (x.shape[0] * x.shape[1] * x.shape[2]), 1)
    with torch.no_grad():
        for first in range(0, spec.steps, together):
            steps = min(together, spec.steps - first)
            source, begin = generator, 0
            if isinstance(generator, WorldRandom):
                source = generator.take_steps(steps)
            elif not capturing:
                begin = torch_generator(generator, x.device).get_offset()
            draws = draw_ahead(particles.x, spec.physics, steps, source)
            x, s = run_whole_rollout(x, s, spec.physics, weights, steps, *draws)
            if first == 0 and check is not None:
                # Only now, when the device has work.
                try:
                    check.wait()
                except NPAError:
                    if not isinstance(generator, WorldRandom):
                        offset = torch_generator(generator, x.device)
                        give_back_draws(offset, begin, offset.get_offset() - begin)
                    raise
            if isinstance(generator, WorldRandom) and isinstance(source, WorldRandom):
                generator.sync_with(source, steps)
    return particles.with_fields(x=x, s=s)
