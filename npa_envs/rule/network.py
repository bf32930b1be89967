"""A rule's network as it is run: its weights as two plain products that map rows to updates."""

from __future__ import annotations

from typing import Any, NamedTuple, Protocol

import torch
from torch import Tensor

from npa_envs.ops.custom_op import without_autocast
from npa_envs.ops.equivariance import VectorForm, read_rows, steer_rows
from npa_envs.ops.network import ArrangedWeights, arrange_weights, run_network

FOLD = 4
"""Rows of products are padded to a multiple of this many columns: 16 bytes of float32."""

OUTPUT_BLOCKS = 4
"""The sum over hidden units is taken in this many blocks."""


def _blocked_product(hidden: Tensor, weight: Tensor) -> Tensor:
    """Return hidden @ weight.T, summed in blocks."""
    blocks = OUTPUT_BLOCKS if hidden.shape[1] % OUTPUT_BLOCKS == 0 else 1
    left = hidden.view(hidden.shape[0], blocks, -1).transpose(0, 1)
    right = weight.view(weight.shape[0], blocks, -1).permute(1, 2, 0)
    return torch.bmm(left, right).sum(dim=0)


class _TwoLayers(torch.autograd.Function):
    """relu(rows W1.T) W2.T, the latter product summed in blocks: rules amplify rounding.

    One function in place of four takes the host less time, which small worlds are bound by.
    """

    @staticmethod
    def forward(ctx: Any, rows: Tensor, hidden_weight: Tensor, output_weight: Tensor) -> Tensor:
        hidden = torch.relu(rows @ hidden_weight.T)
        ctx.save_for_backward(rows, hidden, hidden_weight, output_weight)
        return _blocked_product(hidden, output_weight)

    @staticmethod
    @without_autocast
    def backward(ctx: Any, update_bar: Tensor) -> tuple[Tensor | None, ...]:
        rows, hidden, hidden_weight, output_weight = ctx.saved_tensors
        hidden_bar = torch.ops.aten.threshold_backward(update_bar @ output_weight, hidden, 0.0)
        rows_bar = hidden_bar @ hidden_weight if ctx.needs_input_grad[0] else None
        if not any(ctx.needs_input_grad[1:]):
            return rows_bar, None, None
        return rows_bar, hidden_bar.T @ rows, update_bar.T @ hidden


def without_small(update: Tensor, dead_zone: float) -> Tensor:
    """Return updates with 0 in place of all numbers y with |y| <= `dead_zone`."""
    return torch.nn.functional.hardshrink(update, dead_zone) if dead_zone > 0.0 else update


class Network(Protocol):
    """What maps rows of perception to updates."""

    @property
    def row_width(self) -> int:
        """Columns of a row."""

    @property
    def update_width(self) -> int:
        """Columns of an update, A'."""

    def __call__(self, rows: Tensor) -> Tensor:
        """Map rows [z | 1 | 0], shape [K, row_width], to raw updates [y | 0], shape [K, A']."""


class FoldedRule(NamedTuple):
    """A rule's weights as two plain products: the bias is one more column of the first.

    A row of perception is followed by a one and by zeros up to a multiple of `FOLD` columns, which
    saves the passes over all rows that a bias and its gradient cost, and aligns the products.
    """

    hidden_weight: Tensor
    """[W1 | b1 | 0], shape [H, row_width]."""
    output_weight: Tensor
    """W2 and rows of zeros up to a multiple of `FOLD`, shape [A', H]."""
    arranged: ArrangedWeights | None = None
    """Both as the fused kernels read them, where there are such for their device and sizes."""
    joined: Tensor | None = None
    """Both one after the other where there are: gradients of many steps are added up at once."""
    dead_zone: float = 0.0
    """Outputs of this size or smaller are 0."""

    @property
    def row_width(self) -> int:
        """Columns of a row of perception: P + 1, rounded up to a multiple of `FOLD`."""
        return self.hidden_weight.shape[1]

    @property
    def update_width(self) -> int:
        """Columns of an update, A'."""
        return self.output_weight.shape[0]

    def __call__(self, rows: Tensor) -> Tensor:
        """Map rows [z | 1 | 0], shape [K, row_width], to raw updates [y | 0], shape [K, A']."""
        return without_small(self._product(rows), self.dead_zone)

    def _product(self, rows: Tensor) -> Tensor:
        if self.arranged is not None and self.joined is not None:
            return run_network(rows, self.joined, self.output_weight.shape, self.arranged)
        if not torch.is_grad_enabled():
            hidden = torch.relu(rows @ self.hidden_weight.T)
            return _blocked_product(hidden, self.output_weight)
        update: Tensor = _TwoLayers.apply(rows, self.hidden_weight, self.output_weight)  # type: ignore[no-untyped-call]
        return update


class FoldedInvariants(NamedTuple):
    """An equivariant rule's weights: two plain products between mixtures and gates."""

    products: FoldedRule
    """The products, whose rows are scalars and products of mixed vectors, and whose gates are as
    large as they steer."""
    mixing: Tensor
    """Weights of the mixtures."""
    signs: Tensor
    """Whether a gate moves along its vector or against it."""
    form: VectorForm
    """What of a row is a vector."""
    row_width: int
    """Columns of a row of perception: P + 1, rounded up to a multiple of `FOLD`."""
    update_width: int
    """Columns of an update, A'."""

    def __call__(self, rows: Tensor) -> Tensor:
        """Map rows [z | 1 | 0], shape [K, row_width], to raw updates [y | 0], shape [K, A']."""
        mixed, inputs = read_rows(rows, self.mixing, self.form, self.products.row_width)
        output = self.products(inputs)
        if len(self.signs) == 0:
            return output
        return steer_rows(output, mixed, self.signs, self.update_width)


def fold_weights(
    hidden_weight: Tensor, output_weight: Tensor, dead_zone: float = 0.0
) -> FoldedRule:
    """Return folded weights as they are run on their device, differentiable in both."""
    arranged = arrange_weights(hidden_weight, output_weight)
    if arranged is None:
        return FoldedRule(hidden_weight, output_weight, dead_zone=dead_zone)
    joined = torch.cat((hidden_weight.flatten(), output_weight.flatten()))
    return FoldedRule(hidden_weight, output_weight, arranged, joined, dead_zone)
