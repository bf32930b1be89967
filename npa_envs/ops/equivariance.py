"""Equivariant rules: products of mixed vectors as inputs, and gated displacements.

Perceived vectors v are a particle's gradients; mixed vectors u = mixing^T v are linear combinations
of them. A rotation of the world rotates all vectors. It leaves the products u_a · u_b unchanged, in
2D also u_a × u_b, whose sign changes in a mirror. The rule's network reads these products. For each
mixed vector its output has a gate g_a, and the displacement is Σ_a relu(g_a) steering_a u_a, where
`steering` are trained factors. Each formula exists twice: in plain torch, for any tensors
(`invariants`, `steered`), and as kernels with hand-written adjoints, for rollouts (`read_rows`,
`steer_rows`).
"""

from __future__ import annotations

from typing import Any, NamedTuple

import torch
from torch import Tensor

from npa_envs.kernels.cuda.equivariance import (
    MIXING_SUM_WARPS,
    PULL_WARPS,
    READ_WARPS,
    STEER_WARPS,
    STEERED_ROWS,
    mixing_sum,
    row_kernels,
    rows_of_warp,
    steering_kernels,
)
from npa_envs.kernels.lanes_and_memory import WARP
from npa_envs.kernels.portable.equivariance import equivariance_kernels
from npa_envs.ops.backend import KernelRequest, choose, multiprocessor_count
from npa_envs.ops.custom_op import custom_op, once_differentiable
from npa_envs.ops.launch import SCALARS, launch

MIXED_VECTORS = 8
"""Default number of mixed vectors of an equivariant rule."""

MIN_STEERING = 1e-19
"""Value that replaces a steering of 0, dimensionless: small, but it gets a gradient."""


class VectorSizes(NamedTuple):
    """Numbers of perceived scalars, perceived vectors and mixed vectors of an equivariant rule."""

    space_dim: int
    """Space dimension D."""
    scalars: int
    """Entries of the perception vector before the first vector."""
    perceived: int
    """Perceived vectors, D numbers each."""
    mixed: int
    """Mixed vectors: linear combinations of the perceived ones."""
    chiral: bool
    """Whether the rule distinguishes left from right."""

    @classmethod
    def from_list(cls, numbers: list[int]) -> VectorSizes:
        """Return the sizes from the list of integers that torch operators take."""
        space_dim, scalars, perceived, mixed, chiral = numbers
        return cls(space_dim, scalars, perceived, mixed, bool(chiral))

    @property
    def perception_dim(self) -> int:
        """Length of the perception vector."""
        return self.scalars + self.perceived * self.space_dim

    @property
    def product_count(self) -> int:
        """Number of products u_a · u_b with a <= b and, where chiral, u_a × u_b with a < b."""
        pairs = self.mixed * (self.mixed + 1) // 2
        return pairs + self.chiral * (pairs - self.mixed)

    @property
    def input_dim(self) -> int:
        """Length of the network's input: perceived scalars, then products of mixed vectors."""
        return self.scalars + self.product_count

    @property
    def gate_count(self) -> int:
        """Number of gates: one for each mixed vector and, where chiral, for each turned by 90°."""
        return self.mixed * (1 + self.chiral)


def invariants(perception: Tensor, mixing: Tensor, sizes: VectorSizes) -> tuple[Tensor, Tensor]:
    """Return an equivariant rule's mixed vectors, [..., mixed, D], and inputs, [..., input_dim].

    Mixed vectors u = mixing^T v are linear combinations of the perceived vectors v; `mixing` has
    shape [perceived, mixed]. The network's inputs do not change with rotations: they are the
    perceived scalars and the products of mixed vectors.
    """
    shape = (*perception.shape[:-1], sizes.perceived, sizes.space_dim)
    vectors = perception[..., sizes.scalars :].reshape(shape)
    mixed = mixing.T @ vectors
    a, b = torch.triu_indices(sizes.mixed, sizes.mixed, device=mixed.device)
    products = [(mixed[..., a, :] * mixed[..., b, :]).sum(dim=-1)]
    if sizes.chiral:
        a, b = torch.triu_indices(sizes.mixed, sizes.mixed, 1, device=mixed.device)
        products.append((_turned(mixed)[..., a, :] * mixed[..., b, :]).sum(dim=-1))
    return mixed, torch.cat((perception[..., : sizes.scalars], *products), dim=-1)


def steered(output: Tensor, mixed: Tensor, steering: Tensor, sizes: VectorSizes) -> Tensor:
    """Return an equivariant rule's updates [δ (D) ; Δs (C)] from its network's `output` [g ; Δs].

    The vectors u_a are `mixed`, and if the rule is chiral also `mixed` turned by 90 degrees. Each
    has a gate g_a and a trained factor, `steering` [gate_count]. The displacement is
    δ = Σ_a relu(g_a) steering_a u_a. Δs changes the state; `output` is [..., gate_count + C].
    """
    gates = torch.relu(output[..., : sizes.gate_count]) * steering
    along = torch.cat((mixed, _turned(mixed)), dim=-2) if sizes.chiral else mixed
    direction = (along * gates[..., None]).sum(dim=-2)
    return torch.cat((direction, output[..., sizes.gate_count :]), dim=-1)


def _turned(vectors: Tensor) -> Tensor:
    """Return 2D vectors [..., 2] rotated counterclockwise by 90 degrees."""
    x, y = vectors.unbind(dim=-1)
    return torch.stack((-y, x), dim=-1)


def _kernels(like: Tensor, space_dim: int) -> Any:
    return equivariance_kernels(space_dim, SCALARS[like.dtype])


def _cuda_runs(like: Tensor, sizes: VectorSizes) -> bool:
    """Return whether CUDA kernels support these `sizes` on the device and dtype of `like`."""
    return choose("vectors", KernelRequest(like.device, like.dtype, vectors=sizes)).name == "cuda"


BLOCKS_PER_PROCESSOR = 5
"""Blocks per multiprocessor in the adjoint of `read_rows`, where there are many rows."""


def _launch_blocks(kernel: Any, blocks: int, warps: int, *tensors: Tensor) -> None:
    block = warps * WARP
    launch(kernel, blocks * block, tensors[0].device, *tensors, block_dim=block)


@custom_op("npa::read_rows")
def _read_rows(
    rows: Tensor, mixing: Tensor, width: int, size_list: list[int]
) -> tuple[Tensor, Tensor]:
    sizes = VectorSizes.from_list(size_list)
    mixed = rows.new_empty(rows.shape[0], sizes.mixed, sizes.space_dim)
    inputs = rows.new_empty(rows.shape[0], width)
    if _cuda_runs(rows, sizes):
        blocks = -(-rows.shape[0] // (rows_of_warp(sizes.mixed) * READ_WARPS))
        kernel = row_kernels(*sizes).read_rows
        _launch_blocks(kernel, blocks, READ_WARPS, rows, mixing, mixed, inputs)
        return mixed, inputs
    kernels, threads = _kernels(rows, sizes.space_dim), rows.shape[0] * sizes.mixed
    launch(kernels.mix_vectors, threads, rows.device, sizes.scalars, rows, mixing, mixed)
    numbers = sizes.scalars, sizes.perception_dim, int(sizes.chiral)
    launch(kernels.write_inputs, threads, rows.device, *numbers, rows, mixed, inputs)
    return mixed, inputs


@custom_op("npa::read_rows_backward")
def _read_rows_backward(
    rows: Tensor,
    mixing: Tensor,
    mixed: Tensor,
    mixed_bar: Tensor,
    inputs_bar: Tensor,
    size_list: list[int],
    with_mixing: bool,
) -> tuple[Tensor, Tensor]:
    sizes, row_count, device = VectorSizes.from_list(size_list), mixed.shape[0], rows.device
    space_dim, scalars, perceived, count, chiral = sizes
    rows_bar = torch.empty_like(rows)
    if _cuda_runs(rows, sizes):
        blocks = -(-row_count // (rows_of_warp(count) * PULL_WARPS))
        blocks = min(blocks, BLOCKS_PER_PROCESSOR * multiprocessor_count(device))
        partial_sums, mixing_bar = rows.new_empty(blocks, mixing.numel()), torch.empty_like(mixing)
        kernel = row_kernels(*sizes).pull_back_rows
        tensors = rows, mixing, mixed, mixed_bar, inputs_bar, rows_bar, partial_sums
        _launch_blocks(kernel, blocks, PULL_WARPS, *tensors)
        if with_mixing:
            columns = -(-mixing.numel() // WARP)
            _launch_blocks(mixing_sum(), columns, MIXING_SUM_WARPS, partial_sums, mixing_bar)
        return rows_bar, mixing_bar
    kernels, total = _kernels(mixed, space_dim), torch.empty_like(mixed)
    bars = mixed, inputs_bar, mixed_bar, total
    launch(kernels.pull_back_products, row_count * count, device, scalars, int(chiral), *bars)
    pulled = mixing, inputs_bar, total, rows_bar
    launch(kernels.pull_back_rows, row_count * perceived, device, scalars, *pulled)
    if not with_mixing:
        return rows_bar, torch.empty_like(mixing)
    # One matrix product gives all pairs of axes; only the pairs of an axis with itself are summed.
    vectors = rows[:, scalars : sizes.perception_dim]
    pairs = (vectors.T @ total.flatten(1)).view(perceived, space_dim, count, space_dim)
    return rows_bar, pairs.diagonal(dim1=1, dim2=3).sum(dim=-1)


def _launch_steering(name: str, threads: int, *tensors: Tensor) -> None:
    """Launch "steer" or "pull_back_steering", on CUDA or by `threads` threads of portable kernels.

    The tensors are network outputs, mixed vectors, signs, and the kernel's further ones.
    """
    output, mixed, signs, *_ = tensors
    count, space_dim = map(int, mixed.shape[1:])
    chiral = len(signs) > count
    # Steering needs no shared memory, so CUDA runs it wherever the smallest rows fit.
    if _cuda_runs(mixed, VectorSizes(space_dim, 0, 1, count, chiral)):
        blocks = -(-output.shape[0] // (STEERED_ROWS * STEER_WARPS))
        kernel = getattr(steering_kernels(space_dim, count, chiral), name)
        _launch_blocks(kernel, blocks, STEER_WARPS, *tensors)
    else:
        kernel = getattr(_kernels(output, space_dim), name)
        launch(kernel, threads, output.device, len(signs), *tensors)


@custom_op("npa::steer_rows")
def _steer_rows(output: Tensor, mixed: Tensor, signs: Tensor, width: int) -> Tensor:
    update = output.new_empty(output.shape[0], width)
    _launch_steering("steer", update.numel(), output, mixed, signs, update)
    return update


@custom_op("npa::steer_rows_backward")
def _steer_rows_backward(
    output: Tensor, mixed: Tensor, signs: Tensor, update_bar: Tensor
) -> tuple[Tensor, Tensor]:
    bars = torch.empty_like(output), torch.empty_like(mixed)
    tensors = output, mixed, signs, update_bar, *bars
    _launch_steering("pull_back_steering", output.numel(), *tensors)
    return bars


class _ReadRows(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx: Any, rows: Tensor, mixing: Tensor, width: int, sizes: VectorSizes
    ) -> tuple[Tensor, Tensor]:
        ctx.size_list = [*map(int, sizes)]
        outputs: tuple[Tensor, Tensor] = _read_rows(rows, mixing, width, ctx.size_list)
        ctx.save_for_backward(rows, mixing, outputs[0])
        return outputs

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, mixed_bar: Tensor, inputs_bar: Tensor) -> tuple[Tensor | None, ...]:
        rows, mixing, mixed = ctx.saved_tensors
        bars = mixed_bar.contiguous(), inputs_bar.contiguous()
        options = ctx.size_list, ctx.needs_input_grad[1]
        rows_bar, mixing_bar = _read_rows_backward(rows, mixing, mixed, *bars, *options)
        return rows_bar, mixing_bar if ctx.needs_input_grad[1] else None, None, None


class _SteerRows(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, output: Tensor, mixed: Tensor, signs: Tensor, width: int) -> Tensor:
        ctx.save_for_backward(output, mixed, signs)
        update: Tensor = _steer_rows(output, mixed, signs, width)
        return update

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, update_bar: Tensor) -> tuple[Tensor | None, ...]:
        output, mixed, signs = ctx.saved_tensors
        output_bar, mixed_bar = _steer_rows_backward(output, mixed, signs, update_bar.contiguous())
        return output_bar, mixed_bar, None, None


def read_rows(
    rows: Tensor, mixing: Tensor, sizes: VectorSizes, width: int
) -> tuple[Tensor, Tensor]:
    """Return mixed vectors [K, mixed, D] and network inputs [K, width]: `invariants` by kernels.

    A row is a perception vector, a one and zeros; inputs are [scalars | products | 1 | zeros].
    """
    tensors = rows.contiguous(), mixing.contiguous()
    if not (torch.is_grad_enabled() and any(tensor.requires_grad for tensor in tensors)):
        return _read_rows(*tensors, width, [*map(int, sizes)])
    outputs: tuple[Tensor, Tensor] = _ReadRows.apply(*tensors, width, sizes)  # type: ignore[no-untyped-call]
    return outputs


def signed_gates(weight: Tensor, steering: Tensor) -> tuple[Tensor, Tensor]:
    """Return output weights for `steer_rows`, [gate_count + C, H], and the signs of `steering`.

    Weights of gates g are multiplied by |steering|: relu(g) steering is sign(steering) times
    relu(|steering| g). So the gradient of `steering` follows from that of the weights, without a
    sum over particles. A steering of 0 is replaced by `MIN_STEERING`, to get a gradient.
    """
    steering = torch.where(steering == 0.0, steering + MIN_STEERING, steering)
    factors = torch.nn.functional.pad(steering.abs(), (0, len(weight) - len(steering)), value=1.0)
    return weight * factors[:, None], steering.detach().sign()


def steer_rows(output: Tensor, mixed: Tensor, signs: Tensor, width: int) -> Tensor:
    """Return updates of K particles, [K, width]: [displacement δ | state changes Δs | zeros].

    As `steered`, by kernels: δ sums `mixed` vectors, [K, mixed, D], times relu(g) and `signs`. The
    `output` [gates g | Δs | zeros] is by the weights of `signed_gates`, which also returns `signs`.
    """
    output = output.contiguous()
    if not (torch.is_grad_enabled() and (output.requires_grad or mixed.requires_grad)):
        return _steer_rows(output, mixed, signs, width)
    update: Tensor = _SteerRows.apply(output, mixed, signs, width)  # type: ignore[no-untyped-call]
    return update
