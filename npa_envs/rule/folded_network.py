"""A rule's network as steps run it, "folded": biases and padding are parts of the weight matrices.

A row is the input of the network for one particle: its perception vector z, then 1, then zeros.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import torch
from torch import Tensor

from npa_envs.ops.custom_op import without_autocast
from npa_envs.ops.equivariance import VectorSizes, read_rows, steer_rows
from npa_envs.ops.network import ArrangedWeights, arrange_weights, run_network

FOLD = 4
"""The lengths of rows and of updates are rounded up to a multiple of this, 16 bytes of float32."""

OUTPUT_BLOCKS = 4
"""Number of partial sums that the sum over hidden units is computed from, to limit rounding."""


def _blocked_product(hidden: Tensor, weight: Tensor) -> Tensor:
    """Return hidden @ weight.T, as a sum of the products of `OUTPUT_BLOCKS` blocks of units."""
    blocks = OUTPUT_BLOCKS if hidden.shape[1] % OUTPUT_BLOCKS == 0 else 1
    left = hidden.view(hidden.shape[0], blocks, -1).transpose(0, 1)
    right = weight.view(weight.shape[0], blocks, -1).permute(1, 2, 0)
    return torch.bmm(left, right).sum(dim=0)


def run_layers(rows: Tensor, hidden_weight: Tensor, output_weight: Tensor) -> tuple[Tensor, Tensor]:
    """Return hidden units relu(rows W1.T), and their product with W2.T; not differentiable."""
    hidden = torch.relu_(rows @ hidden_weight.T)
    return hidden, _blocked_product(hidden, output_weight)


def layers_backward(
    update_bar: Tensor,
    rows: Tensor,
    hidden: Tensor,
    hidden_weight: Tensor,
    output_weight: Tensor,
    *,
    needs: Sequence[bool],
) -> tuple[Tensor | None, ...]:
    """Return the gradients of rows, W1 and W2, from that of the outputs of `run_layers`."""
    hidden_bar = torch.ops.aten.threshold_backward(update_bar @ output_weight, hidden, 0.0)
    rows_bar = hidden_bar @ hidden_weight if needs[0] else None
    if not any(needs[1:]):
        return rows_bar, None, None
    return rows_bar, hidden_bar.T @ rows, update_bar.T @ hidden


class _TwoLayers(torch.autograd.Function):
    """relu(rows W1.T) W2.T, with the second product summed in blocks to limit rounding.

    One function in place of four costs less CPU time, which limits small worlds.
    """

    @staticmethod
    def forward(ctx: Any, rows: Tensor, hidden_weight: Tensor, output_weight: Tensor) -> Tensor:
        hidden, update = run_layers(rows, hidden_weight, output_weight)
        ctx.save_for_backward(rows, hidden, hidden_weight, output_weight)
        return update

    @staticmethod
    @without_autocast
    def backward(ctx: Any, update_bar: Tensor) -> tuple[Tensor | None, ...]:
        rows, hidden, *weights = ctx.saved_tensors
        return layers_backward(update_bar, rows, hidden, *weights, needs=ctx.needs_input_grad)


def without_small(update: Tensor, dead_zone: float) -> Tensor:
    """Return updates in which entries y with |y| <= `dead_zone` are set to 0."""
    return torch.nn.functional.hardshrink(update, dead_zone) if dead_zone > 0.0 else update


class FoldedRule(NamedTuple):
    """A rule's network as two matrix products: the bias is a column of the first matrix.

    It is multiplied by the 1 that follows the perception vector in a row. That saves the passes
    over all rows that a bias and its gradient cost.
    """

    hidden_weight: Tensor
    """W1, then b1, then zeros, shape [H, row_width]."""
    output_weight: Tensor
    """W2, then rows of zeros, shape [A', H]."""
    arranged: ArrangedWeights | None = None
    """Both as the kernel of the whole network reads them; None: it does not run these sizes."""
    joined: Tensor | None = None
    """Both flattened into one tensor for that kernel, so that their gradients are one as well."""
    dead_zone: float = 0.0
    """Outputs y with |y| <= `dead_zone` are set to 0 (dimensionless)."""

    @property
    def row_width(self) -> int:
        """Length of a row: P + 1, rounded up to a multiple of `FOLD`."""
        return self.hidden_weight.shape[1]

    @property
    def update_width(self) -> int:
        """Length A' of an output: A of an update, rounded up to a multiple of `FOLD`."""
        return self.output_weight.shape[0]

    def __call__(self, rows: Tensor) -> Tensor:
        """Return the updates of K rows [K, row_width], each followed by zeros, shape [K, A']."""
        update: Tensor
        if self.arranged is not None and self.joined is not None:
            update = run_network(rows, self.joined, self.output_weight.shape, self.arranged)
        elif torch.is_grad_enabled():
            update = _TwoLayers.apply(rows, self.hidden_weight, self.output_weight)  # type: ignore[no-untyped-call]
        else:
            update = run_layers(rows, self.hidden_weight, self.output_weight)[1]
        return without_small(update, self.dead_zone)


class FoldedInvariants(NamedTuple):
    """An equivariant rule's network: a displacement is a weighted sum of mixed vectors.

    Mixed vectors are linear combinations of the perceived ones. Their weights in the sum are gates:
    outputs of two matrix products.
    """

    products: FoldedRule
    """The matrix products, from scalars and products of mixed vectors to gates and Δs; its second
    matrix contains the sizes of `NPARule.steering`, the gates' factors."""
    mixing: Tensor
    """Coefficients of the linear combinations, shape [perceived, mixed]."""
    signs: Tensor
    """Signs of the gates' factors, 1 or -1: a gate moves along or against its vector."""
    form: VectorSizes
    """Numbers of scalars and vectors."""
    row_width: int
    """Length of a row: P + 1, rounded up to a multiple of `FOLD`."""
    update_width: int
    """Length A' of an output: A of an update, rounded up to a multiple of `FOLD`."""

    def __call__(self, rows: Tensor) -> Tensor:
        """Return the updates of K rows [K, row_width], each followed by zeros, shape [K, A']."""
        mixed, inputs = read_rows(rows, self.mixing, self.form, self.products.row_width)
        output = self.products(inputs)
        if len(self.signs) == 0:
            return output
        return steer_rows(output, mixed, self.signs, self.update_width)


Network = FoldedRule | FoldedInvariants
"""Maps rows [K, row_width] to updates [K, A']."""


def fold_weights(
    hidden_weight: Tensor, output_weight: Tensor, dead_zone: float = 0.0
) -> FoldedRule:
    """Return the `FoldedRule` of its first two fields, differentiable in these."""
    arranged = arrange_weights(hidden_weight, output_weight)
    if arranged is None:
        return FoldedRule(hidden_weight, output_weight, dead_zone=dead_zone)
    joined = torch.cat((hidden_weight.flatten(), output_weight.flatten()))
    return FoldedRule(hidden_weight, output_weight, arranged, joined, dead_zone)
