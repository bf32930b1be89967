"""One rollout captured as CUDA graphs, on copies of worlds and weights, and its replays."""

from __future__ import annotations

import collections
import contextlib
import copy
import itertools
from collections.abc import Hashable, Sequence
from typing import TYPE_CHECKING, Any, NamedTuple

import torch
from torch import Tensor

from npa_envs.errors import NPAError
from npa_envs.ops.custom_op import once_differentiable
from npa_envs.ops.position_check import PositionCheck, is_slow
from npa_envs.rule.rule import NPARule
from npa_envs.world.cuda_graph import GraphSequence, capture, current_stream, prepare_capture
from npa_envs.world.particles import Particles, combined
from npa_envs.world.randomness import (
    Randomness,
    WorldRandom,
    give_back_draws,
    reserve_draws,
    torch_generator,
)
from npa_envs.world.rule_settings import (
    rule_settings,
    rule_tensors,
    settings_and_weights,
    tensor_form,
)

if TYPE_CHECKING:
    from npa_envs.world.rollout_execution import RolloutSpec

MAX_GRAPHS = 128
"""Maximum number of graphs of a captured rollout, each for one number of steps."""

CAPTURE_WARM_UP_STEPS = 4
"""Number of steps that load all kernels: enough for static worlds and every `memory` mode."""


def _clone(rule: NPARule, x: Tensor) -> NPARule:
    """Return a rule of the same settings; a plain one has new, empty weights of x's dtype."""
    if not rule.has_network():
        return copy.deepcopy(rule)
    form = rule.hyper_parameters() | {"readout_dim": 0, "readout_hidden_dim": 0}
    # On the meta device no initial weights are drawn.
    with torch.device("meta"):
        clone = NPARule(**form)
    clone = clone.to(x.dtype).to_empty(device=x.device)
    forms = [list(map(tensor_form, each.network_weights())) for each in (rule, clone)]
    if forms[0] != forms[1]:
        raise NPAError(
            f"a rule's weights must have the shapes of its sizes, {forms[1]}, got {forms[0]}: make "
            "the rule again with NPARule(...)"
        )
    return clone


class RolloutCall(NamedTuple):
    """A checked call of a rollout, which may be captured."""

    spec: RolloutSpec
    rules: Sequence[NPARule]
    particles: Particles
    weights: list[Tensor]
    """Tensors of all rules."""
    grad_flags: tuple[bool, ...]
    """Which tensors of worlds and weights require a gradient; () if none does."""
    generator: Randomness | None
    explicit: bool
    """Whether the caller asked for a capture by `cuda_graph=True`."""
    blocks: list[int]
    """Numbers of steps of the graphs to replay, one after the other."""


class _Graphs(NamedTuple):
    forward: GraphSequence
    worlds: list[Tensor]
    """Outputs of the forward pass."""
    backward: GraphSequence | None
    gradients: list[Tensor]
    """Outputs of the backward pass: gradients of the inputs that require one."""
    written: list[int]
    """Indices of inputs that the network may change, such as running means."""


class CapturedRollout:
    """Fixed input tensors, and graphs that run rollouts on them, one for each number of steps.

    All graphs share memory, so only one call can use them at a time.
    """

    def __init__(self, call: RolloutCall) -> None:
        x = call.particles.x
        self.device = x.device
        # Made once: that takes longer than its use.
        self._on_device = torch.cuda.device(self.device)
        worlds = call.particles.with_zero_paths()
        _, _, self._zero_paths, *_ = worlds
        self.bytes = 0
        """Memory of the graphs [bytes]."""
        self._spec = call.spec
        self._rules = [_clone(rule, x) for rule in call.rules]
        self._custom_rules = [rule for rule in self._rules if not rule.has_network()]
        weights = (settings_and_weights(rule, rule.has_network())[1] for rule in self._rules)
        self._worlds = worlds.map(
            lambda value: torch.empty(value.shape, dtype=value.dtype, device=value.device)
        )
        self._inputs = [*self._worlds.tensors(), *itertools.chain.from_iterable(weights)]
        fixed = self._worlds.x.detach()
        self._check = None if is_slow(fixed) else PositionCheck(fixed, captured=True)
        """The check of positions that the graphs make; None: each call makes one."""
        self._grad_flags = call.grad_flags or (False,) * len(self._inputs)
        self.differentiable = any(self._grad_flags)
        """Whether backward passes are captured."""
        for tensor, flag in zip(self._inputs, self._grad_flags, strict=True):
            # Buffers of rules may be integers.
            if tensor.requires_grad != flag:
                tensor.requires_grad_(flag)
        self._generator = torch.Generator(self.device)
        self._streams = None
        if isinstance(call.generator, WorldRandom):
            keys = torch.zeros(len(x), dtype=torch.int64, device=self.device)
            self._streams = WorldRandom.from_keys(keys)
        self._cotangents: dict[int | None, list[Tensor]] = {}
        """Buffers for gradients by the returned worlds, by the number of worlds returned."""
        self.graphs: collections.OrderedDict[int, _Graphs] = collections.OrderedDict()
        """Graphs by number of steps, the least recently used first."""
        self.compared: set[int] = set()
        """Numbers of steps whose replay was found equal to a launched rollout."""
        self._draws_per_step = 0
        """Increase of a generator's offset in one step."""
        self._pool = torch.cuda.graph_pool_handle()
        self.last_stream: torch.cuda.Stream | None = None
        self.token = torch.empty(0, device=self.device)
        """An empty tensor that autograd saves in place of those of the backward pass."""

    def _inputs_of(self, call: RolloutCall) -> list[Tensor]:
        """Return a call's tensors, in the order of the fixed tensors that they are copied to."""
        return [*call.particles.with_zero_paths(self._zero_paths).tensors(), *call.weights]

    def own_draws(self) -> contextlib.AbstractContextManager[object]:
        """Return a block after which torch's generator of the CPU is as before, for captures."""
        return torch.random.fork_rng([]) if self._custom_rules else contextlib.nullcontext()

    def capture(self, steps: int, call: RolloutCall) -> None:
        """Capture `steps` steps as CUDA graphs; before the first capture, launch a few of them."""
        if not self.graphs:
            self._warm_up(min(steps, CAPTURE_WARM_UP_STEPS), call)
        elif len(self.graphs) >= MAX_GRAPHS:
            self.compared.discard(self.graphs.popitem(last=False)[0])
        spec = self._spec._replace(steps=steps)
        bytes_before = torch.cuda.memory_reserved(self.device)
        results: list[Tensor] = []
        saved: list[Tensor] = []
        gradients: list[Tensor] = []

        def forward() -> None:
            saved.clear()
            results[:] = self._run(spec, saved).tensors()

        def backward() -> None:
            gradients[:] = self._pull_back(results, self._cotangents_of(steps))

        draws = self._generator if self._draws_per_step else None
        settings, versions = self._settings(), self._versions()
        forward_graph = capture(forward, self.device, pool=self._pool, generator=draws, alone=True)
        # Not every operator that writes to a buffer changes its version.
        buffers = {
            id(tensor)
            for rule in self._custom_rules
            for tensor in rule_tensors(rule, self.device)
            if not isinstance(tensor, torch.nn.Parameter)
        }
        written = [
            k
            for k, (tensor, version) in enumerate(zip(self._inputs, versions, strict=True))
            if tensor._version != version or id(tensor) in buffers
        ]
        versions = self._versions()
        backward_graph = None
        if self.differentiable:
            self._cotangents_of(steps)
            backward_graph = capture(backward, self.device, pool=self._pool, alone=True)
        self._check_unchanged(settings, versions)
        self.graphs[steps] = _Graphs(
            forward_graph, _views(results), backward_graph, _views(gradients), written
        )
        self.bytes += max(torch.cuda.memory_reserved(self.device) - bytes_before, 0)

    def _warm_up(self, steps: int, call: RolloutCall) -> None:
        """Launch `steps` steps of a call, and count the random numbers that a step draws."""
        spec = self._spec._replace(steps=steps, keep_every=None)
        with torch.no_grad():
            torch._foreach_copy_(self._inputs, self._inputs_of(call))
        # Free the allocator's cache of earlier, launched calls.
        torch.cuda.synchronize(self.device)
        torch.cuda.empty_cache()
        self._generator.set_offset(0)
        shared = torch_generator(None, self.device)
        offset = shared.get_offset()

        def launch() -> None:
            after = self._run(spec, []).tensors()
            if self.differentiable:
                self._pull_back(after, [torch.zeros_like(value) for value in after])

        prepare_capture(launch, self.device)
        self._draws_per_step = self._generator.get_offset() // steps
        if self._custom_rules:
            # Draws of their networks in the warm-up do not count.
            shared.set_offset(offset)

    def _check_unchanged(
        self, settings: dict[tuple[int, str], Hashable], versions: list[int]
    ) -> None:
        """Raise NPAError if a capture has changed settings, or its backward pass inputs."""
        after = self._settings()
        keys = settings.keys() | after.keys()
        changed = {key[1] for key in keys if settings.get(key) != after.get(key)}
        if changed:
            raise NPAError(
                "forward must not change a rule's attributes, but for the numbers of its tensors, "
                f"got other {', '.join(sorted(changed))}"
            )
        if versions != self._versions():
            raise NPAError("a rule's tensors must not change in its backward pass, but one does")

    def _settings(self) -> dict[tuple[int, str], Hashable]:
        """Return the settings of rules with custom networks, which `forward` must not change."""
        settings: dict[tuple[int, str], Hashable] = {}
        for number, rule in enumerate(self._custom_rules):
            for name, setting in rule_settings(rule, self.device).items():
                # In a tuple, so that a setting of None differs from none.
                settings[number, name] = (setting,)
            for tensor in rule_tensors(rule, self.device):
                settings[id(tensor), "tensors"] = True
        return settings

    def _versions(self) -> list[int]:
        return [tensor._version for tensor in self._inputs]

    def _cotangents_of(self, steps: int) -> list[Tensor]:
        """Return buffers for dL/dworlds of the worlds that a rollout of `steps` returns."""
        interval = self._spec.keep_every
        count = None if interval is None else steps // interval
        if count not in self._cotangents:
            first = () if count is None else (count,)
            worlds = self._worlds.tensors()
            self._cotangents[count] = [value.new_zeros(*first, *value.shape) for value in worlds]
        return self._cotangents[count]

    def _run(self, spec: RolloutSpec, saved: list[Tensor]) -> Particles:
        """Launch a rollout of the fixed tensors; append what its backward pass reads to `saved`."""

        def save(tensor: Tensor) -> Tensor:
            saved.append(tensor.detach())
            return saved[-1]

        generator = self._generator if self._streams is None else self._streams
        if self._check is not None:
            self._check.begin()
        hooks = torch.autograd.graph.saved_tensors_hooks(save, lambda tensor: tensor)
        with torch.set_grad_enabled(self.differentiable), hooks:
            step = spec.make_step(self._rules, self._worlds)
            return spec.launch(step, self._rules, self._worlds, generator)

    def _pull_back(self, results: Sequence[Tensor], cotangents: list[Tensor]) -> list[Tensor]:
        """Launch the backward pass, and return the gradients of inputs that require one."""
        pairs = [pair for pair in zip(results, cotangents, strict=True) if pair[0].requires_grad]
        # Retained, because a replay may run twice: otherwise memory that the pass reads, such as
        # weights laid out for recomputed steps, would be reused within it.
        gradients = torch.autograd.grad(
            [result for result, _ in pairs],
            list(itertools.compress(self._inputs, self._grad_flags)),
            [cotangent for _, cotangent in pairs],
            retain_graph=True,
            allow_unused=True,
            materialize_grads=True,
        )
        return [gradient.contiguous() for gradient in gradients]

    def replay(self, call: RolloutCall, use: object) -> Particles:
        """Replay a call's graphs; return copies of the worlds. `use` lives until the last pass."""
        generator = call.generator
        inputs = self._inputs_of(call)
        check = self._check or PositionCheck(call.particles.x)
        results: list[Particles] = []
        for steps in call.blocks:
            if self.differentiable:
                # The use takes the place of saved tensors. It ends when autograd drops these:
                # after a backward pass, unless the graph is retained, or with the last result.
                hooks = torch.autograd.graph.saved_tensors_hooks(
                    lambda _: use, lambda saved: saved.rollout.token
                )
                with hooks:
                    worlds = Particles(*_Replayed.apply(self, steps, generator, *inputs))  # type: ignore[no-untyped-call]
            else:
                worlds = Particles(*self.forward(steps, inputs, generator))
            if not results:
                # Only now, when the device has work.
                try:
                    check.wait()
                except NPAError:
                    if self._streams is None:
                        count = steps * self._draws_per_step
                        source = torch_generator(generator, self.device)
                        give_back_draws(source, self._generator.get_offset() - count, count)
                    raise
            if self._streams is not None:
                assert isinstance(generator, WorldRandom)
                generator.sync_with(self._streams, steps)
            written = self.graphs[steps].written
            if written:
                # Buffers that the network has changed are copied back to the call's rules.
                with torch.no_grad():
                    torch._foreach_copy_(
                        [inputs[k] for k in written], [self._inputs[k] for k in written]
                    )
            results.append(worlds)
            if call.spec.keep_every is not None:
                worlds = worlds.map(lambda value: value[-1])
            inputs = [*worlds.tensors(), *call.weights]
        if call.spec.keep_every is None or len(results) == 1:
            return results[-1]
        return combined(torch.cat, results)

    def forward(
        self, steps: int, tensors: Sequence[Tensor], generator: Randomness | None
    ) -> list[Tensor]:
        """Replay a rollout, and return copies of the resulting worlds; not differentiable."""
        with self._on_device:
            self._wait_for_last_use()
            if self._check is not None:
                self._check.restart()
            torch._foreach_copy_(self._inputs, list(tensors))
            self._load_draws(generator, steps)
            graphs = self.graphs[steps]
            self.graphs.move_to_end(steps)
            graphs.forward.replay()
            return _copies(graphs.worlds)

    def backward(
        self, steps: int, cotangents: Sequence[Tensor | None], grad_flags: Sequence[bool]
    ) -> list[Tensor | None]:
        """Replay the last rollout's backward pass; return copies of gradients, None if unneeded."""
        with self._on_device:
            self._wait_for_last_use()
            for buffer, cotangent in zip(self._cotangents_of(steps), cotangents, strict=True):
                buffer.zero_() if cotangent is None else buffer.copy_(cotangent)
            graphs = self.graphs[steps]
            assert graphs.backward is not None, "it was captured for gradients"
            graphs.backward.replay()
            captured = iter(_copies(graphs.gradients))
            gradients = [next(captured) if flag else None for flag in self._grad_flags]
            pairs = zip(gradients, grad_flags, strict=True)
            return [gradient if flag else None for gradient, flag in pairs]

    def _load_draws(self, generator: Randomness | None, steps: int) -> None:
        if self._streams is not None:
            assert isinstance(generator, WorldRandom)
            self._streams.put(slice(None), generator)
        elif self._draws_per_step:
            source = torch_generator(generator, self.device)
            self._generator.manual_seed(source.initial_seed())
            self._generator.set_offset(reserve_draws(source, steps * self._draws_per_step))

    def _wait_for_last_use(self) -> None:
        stream = current_stream(self.device)
        if self.last_stream is not stream:
            if self.last_stream is not None:
                stream.wait_stream(self.last_stream)
            self.last_stream = stream


class _MemoryView:
    """A view of a tensor's memory that does not own it, so that later graphs can reuse it.

    It is readable as long as a graph of the same pool lives. It has the tensor's values from a
    replay of the graph that wrote them to the next replay of any graph of the pool.
    """

    def __init__(self, tensor: Tensor) -> None:
        self.__cuda_array_interface__ = tensor.detach().__cuda_array_interface__


def _views(tensors: Sequence[Tensor]) -> list[Tensor]:
    """Return tensors on the same memory that do not own it."""
    return [torch.as_tensor(_MemoryView(tensor), device=tensor.device) for tensor in tensors]


def _copies(tensors: list[Tensor]) -> list[Tensor]:
    """Return copies of tensors of real numbers, made by one kernel and allocated by torch."""
    return list(torch._foreach_mul(tensors, 1.0))


class _Replayed(torch.autograd.Function):
    """Autograd function of one replay of a captured rollout."""

    @staticmethod
    def forward(
        ctx: Any,
        rollout: CapturedRollout,
        steps: int,
        generator: Randomness | None,
        *tensors: Tensor,
    ) -> tuple[Tensor, ...]:
        ctx.rollout, ctx.steps = rollout, steps
        ctx.set_materialize_grads(False)
        ctx.save_for_backward(rollout.token)
        return tuple(rollout.forward(steps, tensors, generator))

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *cotangents: Tensor | None) -> tuple[Tensor | None, ...]:
        # Raises autograd's own error if the saved tensors are freed.
        _ = ctx.saved_tensors
        gradients = ctx.rollout.backward(ctx.steps, cotangents, ctx.needs_input_grad[3:])
        return (None, None, None, *gradients)
