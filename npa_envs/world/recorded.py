"""Recorded rollouts: on CUDA, calls that repeat are replayed as graphs instead of launched.

A rollout launches some ten short kernels a step, which takes the host many times longer than it
takes the device. The third call of a kind (same shapes, options and form of the rule) is recorded:
its forward pass, and where gradients are wanted its backward pass, as two CUDA graphs between
tensors that stay where they are. Each call copies worlds and weights there, replays, and returns
copies of what came out. So a recording serves any rule of that form, and later calls overwrite
nothing that was returned.

What a backward pass reads stays in the recording's memory. Until that pass has run, the recording
is leased; another rollout meanwhile gets a recording of its own.
"""

from __future__ import annotations

import collections
import contextlib
import copy
import functools
import itertools
import logging
import weakref
from collections.abc import Callable, Hashable, Sequence
from typing import TYPE_CHECKING, Any, Literal, NamedTuple

import torch
from torch import Tensor

from npa_envs.checks import FiniteCheck, check_finite_positions
from npa_envs.errors import NPAError, shown
from npa_envs.ops.custom_op import once_differentiable
from npa_envs.rule.rule import NPARule
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
from npa_envs.world.module_state import rule_settings, rule_tensors
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
"""Whether rollouts record themselves on CUDA: "auto" records plain rules."""

LAUNCHED_FIRST = 2
"""Calls of a kind that are launched before one is recorded."""

MEMORY_SHARE = 0.5
"""Share of a device's memory that recordings take at most; the least recently used go first."""

BLOCK_STEPS = 64
"""Steps of a graph without gradients: longer rollouts replay it several times."""

MOST_STEPS = 1024
"""Steps of a graph with gradients, at most: longer rollouts are launched."""

MOST_GRAPHS = 128
"""Numbers of steps for which one recording holds graphs, at most."""

MOST_KINDS = 256
"""Kinds that are remembered, at most."""

WARM_UP_STEPS = 4
"""Steps that load all kernels of a kind: enough for static worlds and each form of `memory`."""

logger = logging.getLogger(__name__)


def check_cuda_graph(cuda_graph: CudaGraph) -> None:
    """Check whether rollouts shall be recorded."""
    if not isinstance(cuda_graph, bool | str) or cuda_graph not in (True, False, "auto"):
        raise NPAError(f"cuda_graph must be 'auto', True or False, got {shown(cuda_graph)}")


def run_recorded(
    call: RolloutSpec,
    rules: Sequence[NPARule],
    x: Tensor,
    s: Tensor,
    generator: Randomness | None,
    *,
    cuda_graph: CudaGraph,
) -> Particles | None:
    """Run a checked rollout by replaying it; None where it is to be launched.

    Raises:
        NPAError: A position is not finite.
    """
    # Asked in this order: a compiler cannot trace what a stream does.
    if cuda_graph is False or not x.is_cuda or torch.compiler.is_compiling() or call.steps == 0:
        return None
    if not can_capture() or torch.cuda.is_current_stream_capturing():
        return None
    asked = cuda_graph is True
    plain = [rule.has_network() for rule in rules]
    if not all(plain) and (not asked or torch.is_autocast_enabled(x.device.type)):
        return None
    forms, weights = zip(*map(_form, rules, plain), strict=True)
    tensors = [x, s, *itertools.chain.from_iterable(weights)]
    wanted: tuple[bool, ...] = ()
    if torch.is_grad_enabled():
        wanted = tuple(tensor.requires_grad for tensor in tensors)
        wanted = (*wanted[:2], False, *wanted[2:]) if any(wanted) else ()
    by_world = isinstance(generator, WorldRandom)
    # Torch's own getter of old refuses a choice that was made in the new way.
    precision = torch.backends.cuda.matmul.fp32_precision
    shape = (x.shape, s.shape[2], x.dtype, x.device)
    key = call._replace(steps=0), forms, shape, wanted, by_world, precision
    with _lock:
        kind = _kinds.count(key, MOST_KINDS)
    if kind.refused or kind.calls <= (1 if asked else LAUNCHED_FIRST):
        return None
    # Somebody may handle what is saved for backward passes, as checkpoints do.
    hooks = getattr(torch._C._autograd, "_top_saved_tensors_default_hooks", None)
    hooked = hooks is not None and hooks(True) is not None
    if wanted and (hooked or call.steps > MOST_STEPS):
        return None
    # Without gradients graphs are replayed one after the other.
    kept = call.keep_every or 1
    block = call.steps if wanted else max(BLOCK_STEPS // kept, 1) * kept
    rest = call.steps % block
    blocks = [block] * (call.steps // block) + [rest] * (rest > 0)
    make = functools.partial(_Recording, call, rules, x, s, wanted, by_world)
    lease = _lease(kind, set(blocks), make, tensors, asked)
    if lease is None:
        return None
    if not all(plain) and not lease.recording.compared.issuperset(blocks):
        return _compared(call, rules, kind, lease, blocks, tensors, generator)
    return lease.recording.replay(call, lease, blocks, tensors, generator)


def recorded_memory(device: torch.device) -> int:
    """Return how many bytes of a device the graphs of recorded rollouts take."""
    with _lock:
        recordings = [recording for kind in _kinds.values() for recording in kind.recordings]
        return sum(recording.bytes for recording in recordings if recording.device == device)


def release_recordings() -> None:
    """Forget all recorded rollouts, and free their memory; later calls are recorded anew."""
    with _lock:
        for key in list(_kinds):
            _kinds.forget(key)
    torch.cuda.empty_cache()


def rule_form(rule: NPARule) -> Hashable:
    """Return what a plain rule's steps depend on besides its weights."""
    form: dict[str, Any] = {**rule.hyper_parameters()}
    del form["readout_dim"], form["readout_hidden_dim"]
    return tuple(form.items())


def _form(rule: NPARule, plain: bool) -> tuple[Hashable, list[Tensor]]:
    """Return what a recording depends on of a rule besides its weights, and what these are."""
    if not plain:
        device = rule.hidden.weight.device
        settings = tuple(rule_settings(rule, device).items())
        deterministic = torch.are_deterministic_algorithms_enabled()
        return (weakref.ref(rule), settings, deterministic), rule_tensors(rule, device)
    weights = rule.network_weights()
    return (rule_form(rule), *[_memory_form(weight) for weight in weights]), weights


def _memory_form(tensor: Tensor) -> Hashable:
    return tensor.shape, tensor.dtype, tensor.device


def _twin(rule: NPARule, like: Tensor) -> NPARule:
    """Return a rule of the same form with memory of its own for its weights."""
    if not rule.has_network():
        return copy.deepcopy(rule)
    form = rule.hyper_parameters() | {"readout_dim": 0, "readout_hidden_dim": 0}
    # Without drawing first weights.
    with torch.device("meta"):
        twin = NPARule(**form)
    twin = twin.to(like.dtype).to_empty(device=like.device)
    forms = [list(map(_memory_form, each.network_weights())) for each in (rule, twin)]
    if forms[0] != forms[1]:
        raise NPAError(
            f"a rule's weights must have the shapes of its sizes, {forms[1]}, got {forms[0]}: make "
            "the rule anew with NPARule(...)"
        )
    return twin


class CallKind:
    """Calls of one kind: how many there were, and what serves the next of them."""

    def __init__(self) -> None:
        self.calls = 0
        self.free: collections.deque[Any] = collections.deque()
        """Recordings, or taped steps, that nobody uses."""
        self.recordings: list[_Recording] = []
        self.failures = 0
        """Recordings that failed."""
        self.refused = False
        """One of them could not be recorded."""


class CallKinds(collections.OrderedDict[Hashable, CallKind]):
    """Kinds of calls so far, the least recently used first."""

    def count(self, key: Hashable, most: int) -> CallKind:
        """Count a call, and return its kind; more kinds than `most` are forgotten."""
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
        """Forget a kind; recordings under way live until their backward pass has run."""
        for recording in self.pop(key).recordings:
            if recording.stream is not None:
                recording.stream.synchronize()


class _Lease:
    """The right to a recording: given back when nobody can ask for a backward pass any more."""

    def __init__(self, recording: _Recording, kind: CallKind) -> None:
        self.recording = recording
        self._kind = kind
        self.spoilt = False
        """The recording is not to be used again."""

    def __del__(self) -> None:
        if not (self.spoilt or self._kind.refused):
            # Appending to a deque needs no lock: any thread may drop the last reference.
            self._kind.free.append(self.recording)


class _Graphs(NamedTuple):
    forward: GraphSequence
    worlds: list[Tensor]
    """Where its rollout leaves worlds."""
    backward: GraphSequence | None
    gradients: list[Tensor]
    """Where its backward pass leaves gradients, of those inputs that have one."""
    written: list[int]
    """Inputs that the network itself may change, such as running means."""


class _Recording:
    """Tensors that stay where they are, and graphs for some numbers of steps between them.

    All graphs share the memory of what happens in between: only one rollout is under way.
    """

    def __init__(
        self,
        call: RolloutSpec,
        rules: Sequence[NPARule],
        x: Tensor,
        s: Tensor,
        wanted: tuple[bool, ...],
        by_world: bool,
    ) -> None:
        self.device = x.device
        self.no_path = x.new_zeros(x.shape[:2])
        """Lengths of paths at the beginning."""
        self.bytes = 0
        """Memory of the graphs."""
        self.ready = torch.cuda.Event()  # type: ignore[no-untyped-call]
        """When the worlds to begin with are there."""
        self._call = call
        self._rules = [_twin(rule, x) for rule in rules]
        self._own = [rule for rule in self._rules if not rule.has_network()]
        weights = [weight for rule in self._rules for weight in _form(rule, rule.has_network())[1]]
        worlds = [
            torch.empty(value.shape, dtype=value.dtype, device=value.device)
            for value in (x, s, self.no_path)
        ]
        self._inputs = [*worlds, *weights]
        self._wanted = wanted or (False,) * len(self._inputs)
        self.differentiable = any(self._wanted)
        """Whether there are backward passes."""
        for tensor, flag in zip(self._inputs, self._wanted, strict=True):
            # Buffers of rules may hold integers.
            if tensor.requires_grad != flag:
                tensor.requires_grad_(flag)
        self._generator = torch.Generator(self.device)
        self._streams = None
        if by_world:
            keys = torch.zeros(len(x), dtype=torch.int64, device=self.device)
            self._streams = WorldRandom.from_keys(keys)
        self._bars: dict[int | None, list[Tensor]] = {}
        """Cotangents of the worlds that are kept, by their number."""
        self.graphs: collections.OrderedDict[int, _Graphs] = collections.OrderedDict()
        """By their numbers of steps, the least recently used first."""
        self.compared: set[int] = set()
        """Numbers of steps whose replay has given what a launched rollout gives."""
        self._draws_a_step = 0
        """How far a step moves a generator on."""
        self._pool = torch.cuda.graph_pool_handle()
        self.stream: torch.cuda.Stream | None = None
        self.token = torch.empty(0, device=self.device)

    def record(self, steps: int, tensors: Sequence[Tensor]) -> None:
        """Record rollouts of a number of steps; kernels are warmed up with worlds and weights."""
        if not self.graphs:
            first = self._call._replace(steps=min(steps, WARM_UP_STEPS), keep_every=None)
            with torch.no_grad():
                torch._foreach_copy_(self._inputs, list(tensors))
            # What earlier, launched calls have left in the allocator's cache makes room.
            torch.cuda.synchronize(self.device)
            torch.cuda.empty_cache()
            self._generator.set_offset(0)
            shared = torch_generator(None, self.device)
            place = shared.get_offset()

            def warm_up() -> None:
                after = self._run(first, []).tensors()
                if self.differentiable:
                    self._pull_back(after, [torch.zeros_like(value) for value in after])

            prepare_capture(warm_up, self.device)
            self._draws_a_step = self._generator.get_offset() // first.steps
            if self._own:
                # What their networks have drawn was for nobody.
                shared.set_offset(place)
        elif len(self.graphs) >= MOST_GRAPHS:
            self.compared.discard(self.graphs.popitem(last=False)[0])
        call = self._call._replace(steps=steps)
        before = torch.cuda.memory_reserved(self.device)
        results: list[Tensor] = []
        kept: list[Tensor] = []
        gradients: list[Tensor] = []

        def forward() -> None:
            kept.clear()
            results[:] = self._run(call, kept).tensors()

        def backward() -> None:
            gradients[:] = self._pull_back(results, self._bars_of(steps))

        draws = None if self._streams is not None else self._generator
        begin, versions = self._settings(), self._versions()
        forward_graph = capture(forward, self.device, pool=self._pool, generator=draws, alone=True)
        own = {id(tensor) for rule in self._own for tensor in rule_tensors(rule, self.device)}
        # Not every operator says that it writes to buffers.
        written = [
            k
            for k, (tensor, version) in enumerate(zip(self._inputs, versions, strict=True))
            if tensor._version != version
            or (id(tensor) in own and not isinstance(tensor, torch.nn.Parameter))
        ]
        versions = self._versions()
        backward_graph = None
        if self.differentiable:
            self._bars_of(steps)
            backward_graph = capture(backward, self.device, pool=self._pool, alone=True)
        now = self._settings()
        changed = {key[1] for key in begin.keys() | now.keys() if begin.get(key) != now.get(key)}
        if changed:
            raise NPAError(
                "forward must not change a rule's attributes, but for the numbers of its tensors, "
                f"got other {', '.join(sorted(changed))}"
            )
        if versions != self._versions():
            raise NPAError("a rule's tensors must not change in its backward pass, but one does")
        self.graphs[steps] = _Graphs(
            forward_graph, _places(results), backward_graph, _places(gradients), written
        )
        self.bytes += max(torch.cuda.memory_reserved(self.device) - before, 0)

    def _settings(self) -> dict[tuple[int, str], Hashable]:
        """Return what rules with a network of their own depend on besides their inputs."""
        settings: dict[tuple[int, str], Hashable] = {}
        for number, rule in enumerate(self._own):
            for name, setting in rule_settings(rule, self.device).items():
                # No setting is as good as absent.
                settings[number, name] = (setting,)
            for tensor in rule_tensors(rule, self.device):
                settings[id(tensor), "tensors"] = True
        return settings

    def _versions(self) -> list[int]:
        """Return what changes with each write to an input."""
        return [tensor._version for tensor in self._inputs]

    def _bars_of(self, steps: int) -> list[Tensor]:
        """Return cotangents of the worlds that so many steps keep, the same ones for each count."""
        every = self._call.keep_every
        count = None if every is None else steps // every
        if count not in self._bars:
            first = () if count is None else (count,)
            worlds = self._inputs[:3]
            self._bars[count] = [tensor.new_zeros(*first, *tensor.shape) for tensor in worlds]
        return self._bars[count]

    def _run(self, call: RolloutSpec, kept: list[Tensor]) -> Particles:
        """Launch a rollout; what its backward pass reads is kept."""

        def keep(tensor: Tensor) -> Tensor:
            kept.append(tensor.detach())
            return kept[-1]

        generator = self._generator if self._streams is None else self._streams
        hooks = torch.autograd.graph.saved_tensors_hooks(keep, lambda tensor: tensor)
        with torch.set_grad_enabled(self.differentiable), hooks:
            return call.run(self._rules, Particles(*self._inputs[:3]), generator)

    def _pull_back(self, results: Sequence[Tensor], bars: list[Tensor]) -> list[Tensor]:
        """Launch the backward pass; return the gradients that are wanted."""
        pairs = [
            (result, bar) for result, bar in zip(results, bars, strict=True) if result.requires_grad
        ]
        sources = [tensor for tensor, flag in zip(self._inputs, self._wanted, strict=False) if flag]
        # A backward pass may be replayed twice. Freed as it goes, the graph would leave memory that
        # it reads, such as the arranged weights of steps to recompute, to what comes after.
        gradients = torch.autograd.grad(
            [result for result, _ in pairs],
            sources,
            [bar for _, bar in pairs],
            retain_graph=True,
            allow_unused=True,
            materialize_grads=True,
        )
        return [gradient.contiguous() for gradient in gradients]

    def replay(
        self,
        call: RolloutSpec,
        lease: _Lease,
        blocks: Sequence[int],
        tensors: Sequence[Tensor],
        generator: Randomness | None,
    ) -> Particles:
        """Replay graphs of a rollout one after the other; write what the network writes."""
        x, s, *weights = tensors
        given = [x, s, self.no_path, *weights]
        self.ready.record(current_stream(x.device))
        found: list[Particles] = []
        for steps in blocks:
            if self.differentiable:
                # The lease stands for what is saved, so it ends when autograd drops that: after a
                # backward pass, unless the graph is retained, or with the last result.
                hooks = torch.autograd.graph.saved_tensors_hooks(
                    lambda _: lease, lambda saved: saved.recording.token
                )
                with hooks:
                    after = Particles(*_Replayed.apply(self, steps, generator, *given))  # type: ignore[no-untyped-call]
            else:
                after = Particles(*self.forward(steps, given, generator))
            if not found:
                # Only now, when the device has work: this takes the host as long as the rest.
                try:
                    FiniteCheck(x, self.ready).wait()
                except NPAError:
                    if self._streams is None:
                        # The caller's source goes on where the rollout began.
                        count = steps * self._draws_a_step
                        source = torch_generator(generator, self.device)
                        give_back_draws(source, self._generator.get_offset() - count, count)
                    raise
            if self._streams is not None:
                assert isinstance(generator, WorldRandom)
                generator.sync_with(self._streams, steps)
            written = self.graphs[steps].written
            if written:
                with torch.no_grad():
                    torch._foreach_copy_(
                        [given[k] for k in written], [self._inputs[k] for k in written]
                    )
            found.append(after)
            last = after if call.keep_every is None else after.map(lambda value: value[-1])
            given[:3] = last.tensors()
        if len(found) == 1:
            return found[0]
        return last if call.keep_every is None else combined(torch.cat, found)

    def forward(
        self, steps: int, tensors: Sequence[Tensor], generator: Randomness | None
    ) -> list[Tensor]:
        """Replay a rollout, and return copies of the worlds that come out; not differentiable."""
        with self._placed():
            self._take_turns()
            torch._foreach_copy_(self._inputs, list(tensors))
            self._load_draws(generator, steps)
            graphs = self.graphs[steps]
            self.graphs.move_to_end(steps)
            graphs.forward.replay()
            return _copies(graphs.worlds)

    def backward(
        self, steps: int, bars: Sequence[Tensor | None], wanted: Sequence[bool]
    ) -> list[Tensor | None]:
        """Replay the backward pass of the rollout under way; return copies of the gradients."""
        with self._placed():
            self._take_turns()
            for buffer, bar in zip(self._bars_of(steps), bars, strict=True):
                buffer.zero_() if bar is None else buffer.copy_(bar)
            graphs = self.graphs[steps]
            assert graphs.backward is not None, "it was recorded for gradients"
            graphs.backward.replay()
            gradients = iter(_copies(graphs.gradients))
            made = [next(gradients) if flag else None for flag in self._wanted]
            return [value if flag else None for value, flag in zip(made, wanted, strict=True)]

    def _load_draws(self, generator: Randomness | None, steps: int) -> None:
        if self._streams is not None:
            assert isinstance(generator, WorldRandom)
            self._streams.put(slice(None), generator)
        else:
            source = torch_generator(generator, self.device)
            self._generator.manual_seed(source.initial_seed())
            begin = reserve_draws(source, steps * self._draws_a_step)
            self._generator.set_offset(begin)

    def _placed(self) -> contextlib.AbstractContextManager[object]:
        """Return a context in which this device is the current one."""
        if torch.cuda.current_device() == self.device.index:
            return contextlib.nullcontext()
        return torch.cuda.device(self.device)

    def _take_turns(self) -> None:
        """Let the current stream wait for the one on which this was used last."""
        stream = current_stream(self.device)
        if self.stream is not stream:
            if self.stream is not None:
                stream.wait_stream(self.stream)
            self.stream = stream


class _Place:
    """Where a tensor's numbers lie, without keeping that memory from what is recorded next.

    It stays readable as long as a graph of the same memory lives; numbers are the tensor's after
    a replay of the graph that it was recorded in, until the next replay of one of them.
    """

    def __init__(self, tensor: Tensor) -> None:
        self.__cuda_array_interface__ = tensor.detach().__cuda_array_interface__


def _places(tensors: Sequence[Tensor]) -> list[Tensor]:
    """Return tensors that lie where others lie and do not own that memory."""
    return [torch.as_tensor(_Place(tensor), device=tensor.device) for tensor in tensors]


def _copies(tensors: list[Tensor]) -> list[Tensor]:
    """Return copies, made by one kernel."""
    copies = [torch.empty_like(tensor) for tensor in tensors]
    torch._foreach_copy_(copies, tensors)
    return copies


_kinds = CallKinds()

_lock = recording_lock
"""Held while the above changes: with another lock, two threads could wait for each other."""


def _compared(
    call: RolloutSpec,
    rules: Sequence[NPARule],
    kind: CallKind,
    lease: _Lease,
    blocks: Sequence[int],
    tensors: Sequence[Tensor],
    generator: Randomness | None,
) -> Particles:
    """Launch a rollout, and compare it with its replay: Python code may read what nobody sees.

    Calls of a kind whose replay gives other numbers are launched from then on.
    """
    x, s, *weights = tensors
    check_finite_positions(x)
    with torch.no_grad():
        own = [weight.clone() for weight in weights]
    source: Randomness
    if isinstance(generator, WorldRandom):
        source = generator.take(slice(None))
    else:
        # Other threads may draw from a shared one meanwhile: then nothing is recorded.
        shared = torch_generator(generator, x.device)
        source = torch.Generator(x.device).manual_seed(shared.initial_seed())
        source.set_offset(shared.get_offset())
    worlds = Particles(x.view_as(x), s.view_as(s), x.new_zeros(x.shape[:2]))
    launched = call.run(rules, worlds, generator)
    with torch.no_grad():
        replayed = lease.recording.replay(call, lease, blocks, [x, s, *own], source)
        pairs = zip((*launched.tensors(), *weights), (*replayed.tensors(), *own), strict=True)
        same = all(bool(((a == b) | (a.isnan() & b.isnan())).all()) for a, b in pairs)
    if same:
        lease.recording.compared.update(blocks)
    else:
        _refuse(kind, "a replay gives other numbers than forward, run by Python", asked=True)
    return launched


def _refuse(kind: CallKind, reason: object, *, asked: bool) -> None:
    """Launch all calls of a kind from now on."""
    level = logging.WARNING if asked else logging.DEBUG
    logger.log(level, "rollouts of this kind are launched, not recorded: %s", reason)
    with _lock:
        kind.refused = True
        kind.recordings.clear()
        kind.free.clear()


def _lease(
    kind: CallKind,
    steps: set[int],
    make: Callable[[], _Recording],
    tensors: Sequence[Tensor],
    asked: bool,
) -> _Lease | None:
    """Return a recording that holds these numbers of steps; None where there can be none."""
    x, s, *weights = tensors
    with _lock:
        lease = None
        with contextlib.suppress(IndexError):
            # The one used last: it more likely holds the steps.
            lease = _Lease(kind.free.pop(), kind)
        try:
            if lease is None:
                with plain_tensors():
                    recording = make()
                kind.recordings.append(recording)
                lease = _Lease(recording, kind)
            recording = lease.recording
            device = recording.device
            for missing in [number for number in steps if number not in recording.graphs]:
                limit = MEMORY_SHARE * torch.cuda.get_device_properties(device).total_memory
                # Kinds not in use are forgotten, but for the last one.
                for key in list(_kinds)[:-1]:
                    if recorded_memory(device) < limit:
                        break
                    if any(own.device == device for own in _kinds[key].recordings):
                        _kinds.forget(key)
                if recorded_memory(device) >= limit:
                    logger.debug(
                        "a rollout is launched: recordings have taken their share of memory"
                    )
                    return None
                # Whoever comes next may be in other modes.
                with plain_tensors(), torch.autocast("cuda", enabled=False):
                    recording.record(missing, [x, s, recording.no_path, *weights])
        except Exception as error:
            kind.failures += 1
            if lease is not None and may_be_disturbed(kind.failures):
                lease.spoilt = True
                kind.recordings.remove(lease.recording)
                return None
            drew = "CUDA generator" in str(error)
            reason = "forward draws from torch's own generator, as dropout does" if drew else error
            # A launched rollout says what is wrong if that cannot run either.
            _refuse(kind, reason, asked=asked)
            return None
        return lease


class _Replayed(torch.autograd.Function):
    """A recorded rollout."""

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
    def backward(ctx: Any, *bars: Tensor | None) -> tuple[Tensor | None, ...]:
        # Raises autograd's own error where what was saved is gone.
        _ = ctx.saved_tensors
        gradients = ctx.recording.backward(ctx.steps, bars, ctx.needs_input_grad[3:])
        return (None, None, None, *gradients)
