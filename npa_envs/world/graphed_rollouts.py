"""Recorded rollouts: on CUDA, repeated calls are replayed as CUDA graphs instead of launched.

A rollout launches some ten short kernels a step, and the launches take many times longer than the
kernels. Calls with the same shapes, options and form of the rule are of one kind. The third call of
a kind is recorded: its forward pass, and with gradients its backward pass, as two CUDA graphs on
fixed tensors. Each call copies worlds and weights into these, replays, and returns copies of the
results. So a recording serves any rule of that form, and later calls do not overwrite results.

Tensors for the backward pass stay in the recording's memory. Until that pass has run, the recording
is in use, and another rollout of the kind gets another recording.
"""

from __future__ import annotations

import collections
import contextlib
import copy
import itertools
import logging
import operator
import weakref
from collections.abc import Callable, Hashable, Sequence
from typing import TYPE_CHECKING, Any, Literal, NamedTuple

import torch
from torch import Tensor

from npa_envs.checks import FiniteCheck, check_finite_positions
from npa_envs.errors import NPAError
from npa_envs.ops.custom_op import once_differentiable
from npa_envs.rule.rule import HYPER_PARAMETERS, NPARule
from npa_envs.world.cuda_graph import (
    GraphSequence,
    can_capture,
    capture,
    current_stream,
    may_be_disturbed,
    plain_tensors,
    prepare_capture,
    recording_lock,
)
from npa_envs.world.network_fingerprint import rule_settings, rule_tensors
from npa_envs.world.particles import Particles, combined
from npa_envs.world.randomness import (
    Randomness,
    WorldRandom,
    give_back_draws,
    reserve_draws,
    torch_generator,
)

if TYPE_CHECKING:
    from npa_envs.world.execute import RolloutSpec

CudaGraph = bool | Literal["auto"]
"""Which rollouts are recorded on CUDA: those of plain rules ("auto"), all or none."""

CUDA_GRAPH_CHOICES: tuple[CudaGraph, ...] = ("auto", True, False)

LAUNCHED_FIRST = 2
"""Calls of a kind that are launched before the next one is recorded."""

MEMORY_FRACTION = 0.5
"""Largest fraction of a device's memory for recordings; the least recently used are deleted."""

BLOCK_STEPS = 64
"""Steps of a graph without gradients: longer rollouts replay it several times."""

MAX_STEPS = 1024
"""Most steps of a graph with gradients: longer rollouts are launched."""

MAX_GRAPHS = 128
"""Most graphs of a recording, each for one number of steps."""

MAX_KINDS = 256
"""Most kinds of calls that are counted."""

WARM_UP_STEPS = 4
"""Steps that load all kernels of a kind: enough for static worlds and every `memory` mode."""

logger = logging.getLogger(__name__)


# A call: it is launched, recorded or replayed.
def run_recorded(
    spec: RolloutSpec,
    rules: Sequence[NPARule],
    particles: Particles,
    generator: Randomness | None,
    *,
    cuda_graph: CudaGraph,
) -> Particles | None:
    """Run a checked rollout by replaying a recording; None if it has to be launched."""
    x = particles.x
    # In this order: a compiler cannot trace queries of streams.
    if cuda_graph is False or not x.is_cuda or torch.compiler.is_compiling() or spec.steps == 0:
        return None
    if not can_capture() or torch.cuda.is_current_stream_capturing():
        return None
    explicit = cuda_graph is True
    plain = [rule.has_network() for rule in rules]
    if not all(plain) and (not explicit or torch.is_autocast_enabled(x.device.type)):
        return None
    forms, rule_weights = zip(*map(_settings_and_weights, rules, plain), strict=True)
    weights = list(itertools.chain.from_iterable(rule_weights))
    grad_flags = _grad_flags(particles, weights)
    per_world_streams = isinstance(generator, WorldRandom)
    # Torch's older getter raises an error if the precision was set in the new way.
    precision = torch.backends.cuda.matmul.fp32_precision
    shape = (x.shape, particles.s.shape[2], x.dtype, x.device)
    key = spec._replace(steps=0), forms, shape, grad_flags, per_world_streams, precision
    with _lock:
        kind = _kinds.count(key, MAX_KINDS)
    if kind.refused or kind.calls <= (1 if explicit else LAUNCHED_FIRST):
        return None
    if grad_flags and (spec.steps > MAX_STEPS or _saves_tensors_elsewhere()):
        return None
    blocks = _blocks(spec, with_gradients=bool(grad_flags))
    call = _Call(spec, rules, particles, weights, grad_flags, generator, explicit, blocks)
    use = _take_recording(kind, call)
    if use is None:
        return None
    if not all(plain) and not use.recording.compared.issuperset(call.blocks):
        return _run_and_compare(call, kind, use)
    return use.recording.replay(call, use)


def _grad_flags(particles: Particles, weights: list[Tensor]) -> tuple[bool, ...]:
    """Return which worlds and weights require a gradient; () if none does or can."""
    if not torch.is_grad_enabled():
        return ()
    world_flags = [tensor.requires_grad for tensor in particles.tensors()]
    weight_flags = [tensor.requires_grad for tensor in weights]
    # Paths, which begin at 0, need no gradient.
    return (*world_flags, False, *weight_flags) if any(world_flags + weight_flags) else ()


def _saves_tensors_elsewhere() -> bool:
    """Return whether the caller has hooks for saved tensors, as checkpoints do."""
    hooks = getattr(torch._C._autograd, "_top_saved_tensors_default_hooks", None)
    return hooks is not None and hooks(True) is not None


def _blocks(spec: RolloutSpec, *, with_gradients: bool) -> list[int]:
    """Return the steps of each graph to replay, one after the other; with gradients it is one."""
    if with_gradients:
        return [spec.steps]
    interval = spec.keep_every or 1
    block = max(BLOCK_STEPS // interval, 1) * interval
    remainder = spec.steps % block
    return [block] * (spec.steps // block) + [remainder] * (remainder > 0)


def _run_and_compare(call: _Call, kind: CallKind, use: _RecordingUse) -> Particles:
    """Launch a rollout and compare it with its replay, which custom Python code may break.

    If results differ, calls with these shapes and options are launched from then on.
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
    launched = call.spec.run(call.rules, worlds, generator)
    with torch.no_grad():
        replayed = use.recording.replay(call._replace(weights=copies, generator=source), use)
        pairs = zip((*launched.tensors(), *weights), (*replayed.tensors(), *copies), strict=True)
        same = all(bool(((a == b) | (a.isnan() & b.isnan())).all()) for a, b in pairs)
    if same:
        use.recording.compared.update(call.blocks)
    else:
        _refuse(kind, "a replay gives other numbers than forward, run by Python", logging.WARNING)
    return launched


rule_form: Callable[[NPARule], Hashable] = operator.attrgetter(
    *HYPER_PARAMETERS.keys() - {"readout_dim", "readout_hidden_dim", "code_names", "encoder"}
)
"""Returns all settings of a plain rule that its steps depend on, except weights."""


def _settings_and_weights(rule: NPARule, plain: bool) -> tuple[Hashable, list[Tensor]]:
    """Return a rule's settings, which a recording depends on, and its weights."""
    if plain:
        weights = rule.network_weights()
        return (rule_form(rule), *map(_tensor_form, weights)), weights
    device = rule.hidden.weight.device
    settings = tuple(rule_settings(rule, device).items())
    deterministic = torch.are_deterministic_algorithms_enabled()
    return (weakref.ref(rule), settings, deterministic), rule_tensors(rule, device)


def _tensor_form(tensor: Tensor) -> Hashable:
    return tensor.shape, tensor.dtype, tensor.device


def _clone(rule: NPARule, x: Tensor) -> NPARule:
    """Return a rule of the same shapes and settings, with new memory for weights of x's dtype."""
    if not rule.has_network():
        return copy.deepcopy(rule)
    form = rule.hyper_parameters() | {"readout_dim": 0, "readout_hidden_dim": 0}
    # On the meta device no initial weights are drawn.
    with torch.device("meta"):
        clone = NPARule(**form)
    clone = clone.to(x.dtype).to_empty(device=x.device)
    forms = [list(map(_tensor_form, each.network_weights())) for each in (rule, clone)]
    if forms[0] != forms[1]:
        raise NPAError(
            f"a rule's weights must have the shapes of its sizes, {forms[1]}, got {forms[0]}: make "
            "the rule again with NPARule(...)"
        )
    return clone


class _Call(NamedTuple):
    """A checked call of a rollout, which may be recorded."""

    spec: RolloutSpec
    rules: Sequence[NPARule]
    particles: Particles
    weights: list[Tensor]
    """Tensors of all rules."""
    grad_flags: tuple[bool, ...]
    """Which worlds and weights require a gradient; (): none does, or gradients are disabled."""
    generator: Randomness | None
    explicit: bool
    """Whether the caller asked for a recording by `cuda_graph=True`."""
    blocks: list[int]
    """Steps of each graph to replay, one after the other."""


# Kinds of calls: which recording serves a call, and which are deleted to make room.
class CallKind:
    """Calls with the same shapes and options: their number, and their recordings or tapes."""

    def __init__(self) -> None:
        self.calls = 0
        self.free: collections.deque[Any] = collections.deque()
        """Recordings, or taped steps, that are not in use."""
        self.recordings: list[_Recording] = []
        self.failures = 0
        """Number of failed recordings."""
        self.refused = False
        """Whether calls of this kind cannot be recorded."""


class CallKinds(collections.OrderedDict[Hashable, CallKind]):
    """All kinds of calls by shapes and options, the least recently used first."""

    def count(self, key: Hashable, most: int) -> CallKind:
        """Count a call and return its kind; beyond `most` kinds delete the least recently used."""
        kind = self.get(key)
        if kind is None:
            kind = self[key] = CallKind()
            if len(self) > most:
                self.forget(next(iter(self)))
        else:
            self.move_to_end(key)
        kind.calls += 1
        return kind

    def forget(self, key: Hashable) -> None:
        """Delete a key and its recordings; those in use live until their backward pass has run."""
        for recording in self.pop(key).recordings:
            if recording.stream is not None:
                recording.stream.synchronize()


class _RecordingUse:
    """One use of a recording, which is free again once autograd and the caller drop this object."""

    def __init__(self, recording: _Recording, kind: CallKind) -> None:
        self.recording = recording
        self._kind = kind
        self.broken = False
        """Whether the recording must not be used again."""

    def __del__(self) -> None:
        if not (self.broken or self._kind.refused):
            # Appending to a deque needs no lock: any thread may drop the last reference.
            self._kind.free.append(self.recording)


_kinds = CallKinds()

_lock = recording_lock
"""Lock of `_kinds`: that of captures, as with two locks two threads could wait for each other."""


def recorded_memory(device: torch.device) -> int:
    """Return the bytes of a device's memory that recorded rollouts use."""
    with _lock:
        recordings = [recording for kind in _kinds.values() for recording in kind.recordings]
        return sum(recording.bytes for recording in recordings if recording.device == device)


def release_recordings() -> None:
    """Delete all recorded rollouts and free their memory; later calls are recorded again."""
    with _lock:
        for key in list(_kinds):
            _kinds.forget(key)
    torch.cuda.empty_cache()


def _take_recording(kind: CallKind, call: _Call) -> _RecordingUse | None:
    """Reserve a recording with the graphs for a call; None: the call has to be launched."""
    with _lock:
        use = None
        with contextlib.suppress(IndexError):
            # The one used last: it more likely has these numbers of steps.
            use = _RecordingUse(kind.free.pop(), kind)
        try:
            if use is None:
                with plain_tensors():
                    recording = _Recording(call)
                kind.recordings.append(recording)
                use = _RecordingUse(recording, kind)
            recording = use.recording
            for steps in set(call.blocks) - recording.graphs.keys():
                if not _make_room(recording.device):
                    logger.debug("a rollout is launched: recordings use all memory that they may")
                    return None
                # Later calls may be in other modes.
                with plain_tensors(), torch.autocast("cuda", enabled=False):
                    recording.record(steps, call)
        except Exception as error:
            kind.failures += 1
            if use is not None and may_be_disturbed(kind.failures):
                use.broken = True
                kind.recordings.remove(use.recording)
                return None
            drew = "CUDA generator" in str(error)
            reason = "forward draws from torch's own generator, as dropout does" if drew else error
            # If the rollout cannot be launched either, that raises the right error.
            _refuse(kind, reason, logging.WARNING if call.explicit else logging.DEBUG)
            return None
        return use


def _make_room(device: torch.device) -> bool:
    """Delete recordings until a device has room for another; return whether it has."""
    limit = MEMORY_FRACTION * torch.cuda.get_device_properties(device).total_memory
    for key in list(_kinds)[:-1]:
        if recorded_memory(device) < limit:
            break
        if any(other.device == device for other in _kinds[key].recordings):
            _kinds.forget(key)
    return recorded_memory(device) < limit


def _refuse(kind: CallKind, reason: object, level: int) -> None:
    """Launch all further calls of a kind, without recordings; log the reason."""
    logger.log(level, "rollouts of this kind are launched, not recorded: %s", reason)
    with _lock:
        kind.refused = True
        kind.recordings.clear()
        kind.free.clear()


# Recordings: a rollout is captured as CUDA graphs, on copies of worlds and weights, and replayed.
class _Graphs(NamedTuple):
    forward: GraphSequence
    worlds: list[Tensor]
    """Outputs of the forward pass."""
    backward: GraphSequence | None
    gradients: list[Tensor]
    """Outputs of the backward pass: gradients of the inputs that require one."""
    written: list[int]
    """Indices of inputs that the network may change, such as running means."""


class _Recording:
    """Fixed input tensors, and graphs that run rollouts on them for several numbers of steps.

    All graphs share memory, so only one rollout can use a recording at a time.
    """

    def __init__(self, call: _Call) -> None:
        x = call.particles.x
        self.device = x.device
        worlds = call.particles.with_zero_paths()
        self._no_paths = worlds.per_particle()[-1]
        """Path lengths at the start, zeros."""
        self.bytes = 0
        """Memory of the graphs [bytes]."""
        self.ready = torch.cuda.Event()  # type: ignore[no-untyped-call]
        """Event after which the first worlds are complete."""
        self._spec = call.spec
        self._rules = [_clone(rule, x) for rule in call.rules]
        self._custom_rules = [rule for rule in self._rules if not rule.has_network()]
        weights = (_settings_and_weights(rule, rule.has_network())[1] for rule in self._rules)
        self._worlds = worlds.map(
            lambda value: torch.empty(value.shape, dtype=value.dtype, device=value.device)
        )
        self._inputs = [*self._worlds.tensors(), *itertools.chain.from_iterable(weights)]
        self._grad_flags = call.grad_flags or (False,) * len(self._inputs)
        self.differentiable = any(self._grad_flags)
        """Whether backward passes are recorded."""
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
        """Cotangents of the returned worlds, by the number of worlds returned."""
        self.graphs: collections.OrderedDict[int, _Graphs] = collections.OrderedDict()
        """Graphs by number of steps, the least recently used first."""
        self.compared: set[int] = set()
        """Numbers of steps whose replay was found equal to a launched rollout."""
        self._draws_per_step = 0
        """Increase of a generator's offset in one step."""
        self._pool = torch.cuda.graph_pool_handle()
        self.stream: torch.cuda.Stream | None = None
        """Stream of the last use."""
        self.token = torch.empty(0, device=self.device)
        """What autograd saves in the place of tensors for the backward pass."""

    def _inputs_of(self, call: _Call) -> list[Tensor]:
        """Return a call's tensors, in the order of the fixed tensors that they are copied to."""
        return [*call.particles.with_zero_paths(self._no_paths).tensors(), *call.weights]

    def record(self, steps: int, call: _Call) -> None:
        """Capture `steps` steps as CUDA graphs; before the first, run some of `call` eagerly."""
        if not self.graphs:
            self._warm_up(min(steps, WARM_UP_STEPS), call)
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

        draws = None if self._streams is not None else self._generator
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

    def _warm_up(self, steps: int, call: _Call) -> None:
        """Run `steps` steps of a call eagerly, and count the random numbers that they draw."""
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
        """Check that a capture has changed no settings, and its backward pass no inputs."""
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
        """Return the buffers for the gradients by the worlds that so many steps return."""
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
        hooks = torch.autograd.graph.saved_tensors_hooks(save, lambda tensor: tensor)
        with torch.set_grad_enabled(self.differentiable), hooks:
            return spec.run(self._rules, self._worlds, generator)

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

    def replay(self, call: _Call, use: _RecordingUse) -> Particles:
        """Replay the graphs of a call, and copy buffers that they change back to the rule."""
        generator = call.generator
        inputs = self._inputs_of(call)
        self.ready.record(current_stream(self.device))
        results: list[Particles] = []
        for steps in call.blocks:
            if self.differentiable:
                # The use takes the place of saved tensors. It ends when autograd drops these:
                # after a backward pass, unless the graph is retained, or with the last result.
                hooks = torch.autograd.graph.saved_tensors_hooks(
                    lambda _: use, lambda saved: saved.recording.token
                )
                with hooks:
                    worlds = Particles(*_Replayed.apply(self, steps, generator, *inputs))  # type: ignore[no-untyped-call]
            else:
                worlds = Particles(*self.forward(steps, inputs, generator))
            if not results:
                # Only now, when the device has work: this check takes much CPU time.
                self._check_positions(call.particles.x, generator, steps)
            if self._streams is not None:
                assert isinstance(generator, WorldRandom)
                generator.sync_with(self._streams, steps)
            written = self.graphs[steps].written
            if written:
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

    def _check_positions(self, x: Tensor, generator: Randomness | None, steps: int) -> None:
        """Check that positions are finite; otherwise the generator returns to its former state."""
        try:
            FiniteCheck(x, self.ready).wait()
        except NPAError:
            if self._streams is None:
                count = steps * self._draws_per_step
                source = torch_generator(generator, self.device)
                give_back_draws(source, self._generator.get_offset() - count, count)
            raise

    def forward(
        self, steps: int, tensors: Sequence[Tensor], generator: Randomness | None
    ) -> list[Tensor]:
        """Replay a rollout, and return copies of the resulting worlds; not differentiable."""
        with torch.cuda.device(self.device):
            self._wait_for_last_use()
            torch._foreach_copy_(self._inputs, list(tensors))
            self._load_draws(generator, steps)
            graphs = self.graphs[steps]
            self.graphs.move_to_end(steps)
            graphs.forward.replay()
            return _copies(graphs.worlds)

    def backward(
        self, steps: int, cotangents: Sequence[Tensor | None], grad_flags: Sequence[bool]
    ) -> list[Tensor | None]:
        """Replay the backward pass of the last rollout, and return copies of the gradients."""
        with torch.cuda.device(self.device):
            self._wait_for_last_use()
            for buffer, cotangent in zip(self._cotangents_of(steps), cotangents, strict=True):
                buffer.zero_() if cotangent is None else buffer.copy_(cotangent)
            graphs = self.graphs[steps]
            assert graphs.backward is not None, "it was recorded for gradients"
            graphs.backward.replay()
            recorded = iter(_copies(graphs.gradients))
            gradients = [next(recorded) if flag else None for flag in self._grad_flags]
            pairs = zip(gradients, grad_flags, strict=True)
            return [gradient if flag else None for gradient, flag in pairs]

    def _load_draws(self, generator: Randomness | None, steps: int) -> None:
        if self._streams is not None:
            assert isinstance(generator, WorldRandom)
            self._streams.put(slice(None), generator)
        else:
            source = torch_generator(generator, self.device)
            self._generator.manual_seed(source.initial_seed())
            self._generator.set_offset(reserve_draws(source, steps * self._draws_per_step))

    def _wait_for_last_use(self) -> None:
        """Make the current stream wait for the stream of the last use."""
        stream = current_stream(self.device)
        if self.stream is not stream:
            if self.stream is not None:
                stream.wait_stream(self.stream)
            self.stream = stream


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
    """Return copies of tensors, made by one kernel."""
    copies = [torch.empty_like(tensor) for tensor in tensors]
    torch._foreach_copy_(copies, tensors)
    return copies


class _Replayed(torch.autograd.Function):
    """Autograd function of one replay of a recording."""

    @staticmethod
    def forward(
        ctx: Any, recording: _Recording, steps: int, generator: Randomness | None, *tensors: Tensor
    ) -> tuple[Tensor, ...]:
        ctx.recording, ctx.steps = recording, steps
        ctx.set_materialize_grads(False)
        ctx.save_for_backward(recording.token)
        return tuple(recording.forward(steps, tensors, generator))

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *cotangents: Tensor | None) -> tuple[Tensor | None, ...]:
        # Raises autograd's own error if the saved tensors are freed.
        _ = ctx.saved_tensors
        gradients = ctx.recording.backward(ctx.steps, cotangents, ctx.needs_input_grad[3:])
        return (None, None, None, *gradients)
