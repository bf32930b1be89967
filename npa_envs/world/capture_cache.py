"""On CUDA, repeated rollouts are replayed as CUDA graphs instead of launched.

A rollout launches some ten short kernels a step, and the launches take many times longer than the
kernels. Calls with the same shapes, options and settings of the rule form a group. The third call
of a group is captured: its forward pass, and with gradients its backward pass, as two CUDA graphs
on fixed tensors. Each call copies worlds and weights into these, replays, and returns copies of the
results. So a capture serves any rule with these settings, and later calls do not overwrite results.

Tensors for the backward pass stay in the capture's memory. Until that pass has run, the capture is
in use, and another rollout of the group gets another capture.

A rule with a network of its own is captured as `torch.cuda.make_graphed_callables` would: it must
be a function of perception, parameters and buffers. Its first replay is compared with a launched
rollout of the same draws, bit for bit, and only if they are equal do replays serve later calls.
"""

from __future__ import annotations

import collections
import itertools
import logging
from collections.abc import Hashable, Sequence
from operator import not_
from typing import TYPE_CHECKING, Any, Literal

import torch
from torch import Tensor

from npa_envs.checks import check_finite_positions
from npa_envs.rule.rule import NPARule
from npa_envs.world.captured_rollout import CapturedRollout, RolloutCall
from npa_envs.world.cuda_graph import can_capture, capture_lock, may_be_disturbed, plain_tensors
from npa_envs.world.particles import Particles
from npa_envs.world.randomness import Randomness, WorldRandom, torch_generator
from npa_envs.world.rule_settings import is_observed, settings_and_weights

if TYPE_CHECKING:
    from npa_envs.world.rollout_execution import RolloutSpec

CudaGraph = bool | Literal["auto", "whole"]
"""Which rollouts are captured on CUDA: those without hooks ("auto"), all or none. "whole" is
"auto", but one kernel runs all steps of small worlds."""

CUDA_GRAPH_CHOICES: tuple[CudaGraph, ...] = ("auto", "whole", True, False)

LAUNCHED_FIRST = 2
"""Number of calls of a group that are launched before the next one is captured."""

MEMORY_FRACTION = 0.5
"""Largest fraction of a device's memory for captures; the least recently used are deleted."""

BLOCK_STEPS = 64
"""Number of steps of a graph without gradients: longer rollouts replay it several times."""

MAX_STEPS = 1024
"""Maximum number of steps of a graph with gradients: longer rollouts are launched."""

MAX_CAPTURED_GROUPS = 256
"""Maximum number of groups of calls that are counted."""

logger = logging.getLogger(__name__)


def run_captured(
    spec: RolloutSpec,
    rules: Sequence[NPARule],
    particles: Particles,
    generator: Randomness | None,
    *,
    cuda_graph: CudaGraph,
) -> Particles | None:
    """Run a checked rollout by replaying CUDA graphs; None if it has to be launched."""
    x = particles.x
    # In this order: a compiler cannot trace queries of streams.
    if cuda_graph is False or torch.compiler.is_compiling() or spec.steps == 0:
        return None
    if not _may_capture(x):
        return None
    explicit = cuda_graph is True
    plain = [rule.has_network() for rule in rules]
    if not all(plain):
        own = itertools.compress(rules, map(not_, plain))
        observed = not explicit and any(map(is_observed, own))
        if observed or torch.is_autocast_enabled(x.device.type):
            return None
    found = [*map(settings_and_weights, rules, plain)]
    forms, weights = tuple(form for form, _ in found), [w for _, each in found for w in each]
    grad_flags = _grad_flags(particles, weights)
    per_world_streams = isinstance(generator, WorldRandom)
    # Torch's older getter raises an error if the precision was set in the new way.
    precision = torch.backends.cuda.matmul.fp32_precision
    shape = (x.shape, particles.s.shape[2], x.dtype, x.device)
    key = spec[1:], forms, shape, grad_flags, per_world_streams, precision
    with capture_lock:
        group = _groups.count(key, MAX_CAPTURED_GROUPS)
    if group.launched_only or group.calls <= (1 if explicit else LAUNCHED_FIRST):
        return None
    if grad_flags and (spec.steps > MAX_STEPS or _saves_tensors_elsewhere()):
        return None
    blocks = _blocks(spec, with_gradients=bool(grad_flags))
    call = RolloutCall(spec, rules, particles, weights, grad_flags, generator, explicit, blocks)
    use = _reserve_capture(group, call)
    if use is None:
        return None
    if not all(plain) and not use.rollout.compared.issuperset(call.blocks):
        return _run_and_compare(call, group, use)
    return use.rollout.replay(call, use)


def _may_capture(x: Tensor) -> bool:
    """Return whether rollouts of these positions can be captured now."""
    return x.is_cuda and can_capture() and not torch.cuda.is_current_stream_capturing()


def _grad_flags(particles: Particles, weights: list[Tensor]) -> tuple[bool, ...]:
    """Return which tensors of worlds and weights require a gradient; () if none does or can."""
    if not torch.is_grad_enabled():
        return ()
    x_flag, s_flag, *others = (tensor.requires_grad for tensor in (*particles.tensors(), *weights))
    # Paths, which begin at 0, need no gradient.
    flags = (x_flag, s_flag, False, *others)
    return flags if any(flags) else ()


def _saves_tensors_elsewhere() -> bool:
    """Return whether the caller has set torch's hooks for saved tensors, as checkpoints do."""
    hooks = getattr(torch._C._autograd, "_top_saved_tensors_default_hooks", None)
    return hooks is not None and hooks(True) is not None


def _blocks(spec: RolloutSpec, *, with_gradients: bool) -> list[int]:
    """Return the numbers of steps of the graphs to replay; with gradients there is one graph."""
    if with_gradients:
        return [spec.steps]
    interval = spec.keep_every or 1
    block = max(BLOCK_STEPS // interval, 1) * interval
    remainder = spec.steps % block
    return [block] * (spec.steps // block) + [remainder] * (remainder > 0)


def _run_and_compare(call: RolloutCall, group: CallGroup, use: CaptureUse) -> Particles:
    """Launch a rollout, compare it with its replay, and return the launched worlds.

    A custom network's code may make them, or gradients, differ: then later calls of the group are
    launched.
    """
    particles, weights, generator = call.particles, call.weights, call.generator
    device = particles.x.device
    check_finite_positions(particles.x)
    with torch.no_grad():
        copies = [weight.clone() for weight in weights]
    source: Randomness
    if isinstance(generator, WorldRandom):
        source = generator.take(slice(None))
    else:
        # If other threads draw from a shared one in the meantime, results differ.
        shared = torch_generator(generator, device)
        source = torch.Generator(device).manual_seed(shared.initial_seed())
        source.set_offset(shared.get_offset())
    worlds = particles.map(lambda value: value.view_as(value)).with_zero_paths()
    step = call.spec.make_step(call.rules, worlds)
    launched = call.spec.launch(step, call.rules, worlds, generator)
    with torch.no_grad():
        replayed = use.rollout.replay(call._replace(weights=copies, generator=source), use)
    expected, found = [*launched.tensors(), *weights], [*replayed.tensors(), *copies]
    ends = [value for value in launched.tensors() if value.requires_grad]
    # Recomputed once more, a module might change its buffers again.
    if ends and call.spec.memory == "store":
        starts = itertools.compress((*worlds.tensors(), *weights), call.grad_flags)
        bars = [end.detach() for end in ends]
        expected += torch.autograd.grad(ends, [*starts], bars, True, materialize_grads=True)
        bars = [value.detach() for value in launched.tensors()]
        pulled = use.rollout.backward(call.spec.steps, bars, call.grad_flags)
        found += [gradient for gradient in pulled if gradient is not None]
    reason = None
    with torch.no_grad():
        pairs = zip(expected, found, strict=True)
        if not all(bool(((a == b) | (a.isnan() & b.isnan())).all()) for a, b in pairs):
            reason = "a replay gives other numbers than forward, run by Python"
    if _leaves(ends, (*worlds.tensors(), *weights)).difference(map(id, weights)):
        reason = "forward reads parameters that are not the rule's, and must have gradients"
    if reason is None:
        use.rollout.compared.update(call.blocks)
    else:
        _always_launch(group, reason, logging.WARNING)
    return launched


def _leaves(ends: Sequence[Tensor], starts: Sequence[Tensor]) -> set[int]:
    """Return ids of all leaves that get a gradient from `ends`, except through `starts`."""
    waiting = [end.grad_fn for end in ends]
    seen: set[Any] = {start.grad_fn for start in starts}
    leaves: set[int] = set()
    while waiting:
        node = waiting.pop()
        if node is None or node in seen:
            continue
        seen.add(node)
        leaves |= {id(node.variable)} if hasattr(node, "variable") else set()
        waiting += [following for following, _ in node.next_functions]
    return leaves


class CallGroup:
    """Calls with the same shapes and options: their number, and their captures or recordings."""

    def __init__(self) -> None:
        self.calls, self.failed_captures = 0, 0
        # Captures, or `ReplayedSteps`, that are not in use.
        self.free: collections.deque[Any] = collections.deque()
        self.captures: list[CapturedRollout] = []
        # Whether calls of this group cannot be captured.
        self.launched_only = False


class CallGroups(collections.OrderedDict[Hashable, CallGroup]):
    """All groups of calls by shapes and options, the least recently used first."""

    def count(self, key: Hashable, max_groups: int) -> CallGroup:
        """Count a call and return its group; delete the group that was used longest ago if full."""
        group = self.get(key)
        if group is None:
            group = self[key] = CallGroup()
            if len(self) > max_groups:
                self.forget(next(iter(self)))
        else:
            self.move_to_end(key)
        group.calls += 1
        return group

    def forget(self, key: Hashable) -> None:
        """Delete a key and its captures; those in use live until their backward pass has run."""
        for rollout in self.pop(key).captures:
            if rollout.last_stream is not None:
                rollout.last_stream.synchronize()


class CaptureUse:
    """A captured rollout that one call uses; it is free again when this object is deleted."""

    def __init__(self, rollout: CapturedRollout, group: CallGroup) -> None:
        self.rollout = rollout
        self._group = group
        self.broken = False
        """Whether the captured rollout must not be used again."""

    def __del__(self) -> None:
        if not (self.broken or self._group.launched_only):
            # Appending to a deque needs no lock: any thread may drop the last reference.
            self._group.free.append(self.rollout)


_groups = CallGroups()
"""All groups, locked by `capture_lock`: with two locks, two threads could wait for each other."""


def captured_memory(device: torch.device) -> int:
    """Return the bytes of a device's memory that captured rollouts use."""
    with capture_lock:
        captures = [rollout for group in _groups.values() for rollout in group.captures]
        return sum(rollout.bytes for rollout in captures if rollout.device == device)


def release_captures() -> None:
    """Delete all captured rollouts and free their memory; later calls are captured again."""
    with capture_lock:
        for key in list(_groups):
            _groups.forget(key)
    torch.cuda.empty_cache()


def _reserve_capture(group: CallGroup, call: RolloutCall) -> CaptureUse | None:
    """Return a captured rollout with all graphs of a call; None if it has to be launched."""
    with capture_lock:
        # The one used last: it more likely has these numbers of steps.
        use = CaptureUse(group.free.pop(), group) if group.free else None
        try:
            if use is None:
                with plain_tensors():
                    rollout = CapturedRollout(call)
                group.captures.append(rollout)
                use = CaptureUse(rollout, group)
            rollout = use.rollout
            for steps in set(call.blocks) - rollout.graphs.keys():
                if not _make_room(rollout.device):
                    logger.debug("a rollout is launched: captures use all memory that they may")
                    return None
                # Later calls may be in other modes.
                with plain_tensors(), torch.autocast("cuda", enabled=False), rollout.own_draws():
                    rollout.capture(steps, call)
        except Exception as error:
            group.failed_captures += 1
            if use is not None and may_be_disturbed(group.failed_captures):
                use.broken = True
                group.captures.remove(use.rollout)
                return None
            drew = "CUDA generator" in str(error)
            reason = "forward draws from torch's own generator, as dropout does" if drew else error
            # If the rollout cannot be launched either, that raises the right error.
            _always_launch(group, reason, logging.WARNING if call.explicit else logging.DEBUG)
            return None
        return use


def _make_room(device: torch.device) -> bool:
    """Delete captures until a device has room for another one; return whether it has."""
    limit = MEMORY_FRACTION * torch.cuda.get_device_properties(device).total_memory
    for key in [*_groups][:-1]:
        if captured_memory(device) < limit:
            break
        if any(other.device == device for other in _groups[key].captures):
            _groups.forget(key)
    return captured_memory(device) < limit


def _always_launch(group: CallGroup, reason: object, level: int) -> None:
    """Launch all calls of a group from now on, and delete its captures; log the reason."""
    logger.log(level, "rollouts of this kind are launched, not captured: %s", reason)
    with capture_lock:
        group.launched_only = True
        group.captures.clear()
        group.free.clear()
