"""The weights of the rule's network, laid out as the fused kernels of `network` read them."""

from __future__ import annotations

import functools
from typing import NamedTuple

import torch
from torch import Tensor

from npa_envs.kernels.cuda.network import UNIT_GROUP, WARP_UNITS, arrangement_kernels
from npa_envs.kernels.cuda.warps import WARP
from npa_envs.sph.bridge import is_modern, launch

LARGEST_ROW, LARGEST_UPDATE, LARGEST_HIDDEN = 128, 32, 512
"""Widest rows and updates, and most hidden units, that the fused kernels take."""


class ArrangedWeights(NamedTuple):
    """A rule's folded weights as the fused kernels read them."""

    forward: list[Tensor]
    """Fragments of W1 and of W2, float16, and the scales of updates, float32."""
    backward: list[Tensor]
    """The same of both transposed, then fragments of both, bfloat16; empty without gradients."""


def fits_network(hidden_weight: Tensor, output_weight: Tensor) -> bool:
    """Return whether the fused kernels take a rule's folded weights.

    They run on CUDA from compute capability 8.0 on, in float32, for rows of up to 128 columns and
    updates of up to 32, both multiples of 4, and for up to 512 hidden units, a multiple of 32.

    Args:
        hidden_weight: Weights of the hidden units, shape [H, row_width].
        output_weight: Weights of the updates, shape [A', H].
    """
    hidden, width = hidden_weight.shape
    return (
        is_modern(hidden_weight.device)
        and hidden_weight.dtype == torch.float32
        and width % 4 == output_weight.shape[0] % 4 == hidden % WARP_UNITS == 0
        and width <= LARGEST_ROW
        and output_weight.shape[0] <= LARGEST_UPDATE
        and hidden <= LARGEST_HIDDEN
    )


def _arrange_layers(first: Tensor, second: Tensor) -> list[Tensor]:
    """Lay out two layers' weights, [H, width] and [width', H]: fragments and output scales."""
    hidden, width = first.shape
    steps, tiles = -(-width // 16), -(-second.shape[0] // 8)
    half = functools.partial(torch.empty, dtype=torch.float16, device=first.device)
    fragments = half(hidden * steps * 32), half(hidden * tiles * 16)
    unit_unscale, output_unscale = first.new_empty(hidden), first.new_empty(8 * tiles)
    kernels = arrangement_kernels()
    launch(
        kernels.arrange_hidden,
        (hidden // 8, steps, WARP),
        first.device,
        first,
        unit_unscale,
        fragments[0],
    )
    launch(
        kernels.arrange_output,
        (hidden // UNIT_GROUP, tiles, WARP),
        first.device,
        second,
        unit_unscale,
        output_unscale,
        fragments[1],
    )
    return [*fragments, output_unscale]


def _arrange_left(weight: Tensor) -> Tensor:
    """Lay out weights [H, width] as the left operand of a product."""
    hidden, width = weight.shape
    steps = -(-width // 16)
    fragments = torch.empty(hidden * steps * 32, dtype=torch.bfloat16, device=weight.device)
    launch(
        arrangement_kernels().arrange_left,
        (hidden // UNIT_GROUP, steps, WARP),
        weight.device,
        weight,
        fragments,
    )
    return fragments


@torch.library.custom_op("npa::arrange_weights", mutates_args=())
def _arrange_weights(
    hidden_weight: Tensor, output_weight: Tensor, with_backward: bool
) -> list[Tensor]:
    arranged = _arrange_layers(hidden_weight, output_weight)
    if with_backward:
        arranged += _arrange_layers(output_weight.T, hidden_weight.T)
        arranged += [_arrange_left(hidden_weight), _arrange_left(output_weight.T)]
    return arranged


@_arrange_weights.register_fake
def _(hidden_weight: Tensor, output_weight: Tensor, with_backward: bool) -> list[Tensor]:
    def layers(hidden: int, width: int, out_width: int) -> list[Tensor]:
        steps, tiles = -(-width // 16), -(-out_width // 8)
        half = functools.partial(hidden_weight.new_empty, dtype=torch.float16)
        fragments = [half(hidden * steps * 32), half(hidden * tiles * 16)]
        return [*fragments, hidden_weight.new_empty(8 * tiles)]

    (hidden, width), out_width = hidden_weight.shape, output_weight.shape[0]
    arranged = layers(hidden, width, out_width)
    if with_backward:
        arranged += layers(hidden, out_width, width)
        for columns in (width, out_width):
            size = hidden * -(-columns // 16) * 32
            arranged.append(hidden_weight.new_empty(size, dtype=torch.bfloat16))
    return arranged


def arrange(
    hidden_weight: Tensor, output_weight: Tensor, *, with_backward: bool
) -> ArrangedWeights:
    """Lay out weights that fit, for the backward pass too if asked."""
    arranged = _arrange_weights(
        hidden_weight.detach().contiguous(), output_weight.detach().contiguous(), with_backward
    )
    return ArrangedWeights(arranged[:3], arranged[3:])


def arrange_weights(hidden_weight: Tensor, output_weight: Tensor) -> ArrangedWeights | None:
    """Lay out a rule's folded weights for `run_network`; None where it does not take them.

    Where gradients are enabled they are laid out for the backward pass too, even of weights that
    need none: once here, instead of at every step whose rows need one.

    Args:
        hidden_weight: Weights of the hidden units, shape [H, row_width].
        output_weight: Weights of the updates, shape [A', H].
    """
    if not fits_network(hidden_weight, output_weight):
        return None
    return arrange(hidden_weight, output_weight, with_backward=torch.is_grad_enabled())
