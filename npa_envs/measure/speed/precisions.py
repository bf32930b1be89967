"""Precisions of a rollout: of arithmetic, of the rule's products, of states between steps."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator
from dataclasses import dataclass

import torch
from torch import Tensor
from torch.nn import functional

from npa_envs.ops.equivariance import invariants, steered
from npa_envs.rule.network import without_small
from npa_envs.rule.rule import NPARule


class TorchRule(NPARule):
    """A rule whose products are torch's, which has a switch for TF32."""

    def forward(self, perception: Tensor) -> Tensor:
        """Map perception vectors, shape [..., P], to raw updates, shape [..., A]."""
        return super().forward(perception)


class MixedRule(NPARule):
    """A rule whose two products are taken in bfloat16, summed and returned in float32."""

    def forward(self, perception: Tensor) -> Tensor:
        """Map perception vectors, shape [..., P], to raw updates, shape [..., A]."""
        if not self.equivariant:
            return without_small(self._outputs(perception, self.update_weight), self.dead_zone)
        mixed, inputs = invariants(perception, self.mixing, self.vector_form)
        output = self._outputs(inputs, self.output.weight)
        return output if self.static else steered(output, mixed, self.steering, self.vector_form)

    def _outputs(self, inputs: Tensor, weight: Tensor) -> Tensor:
        short = torch.bfloat16
        hidden_weight, bias = self.hidden.weight.to(short), self.hidden.bias.to(short)
        hidden = torch.relu(functional.linear(inputs.to(short), hidden_weight, bias))
        return functional.linear(hidden, weight.to(short)).to(inputs.dtype)


@dataclass(frozen=True)
class Precision:
    """How numbers are kept and multiplied."""

    name: str
    summary: str
    dtype: torch.dtype
    """Dtype of positions, states and sums over neighbours."""
    short_states: bool = False
    """States are rounded to bfloat16 after every step."""
    short_products: bool = False
    """The rule's products are taken in bfloat16."""
    tensor_float: bool = False
    """The rule's products are taken in TF32."""

    @property
    def reaches_perception(self) -> bool:
        """Whether perception itself differs from float32's, or is float32's."""
        return not (self.short_products or self.tensor_float)

    def obstacle(self, device: torch.device) -> str | None:
        """Return why it has nothing to measure on a device; None where it has."""
        if self.tensor_float and device.type != "cuda":
            return "TF32 products exist on CUDA devices only"
        return None

    def rule(self, rule: NPARule) -> NPARule:
        """Return a copy of a rule that computes in this precision."""
        kind = MixedRule if self.short_products else TorchRule if self.tensor_float else NPARule
        own = kind(**rule.hyper_parameters()).to(rule.hidden.weight)
        own.load_state_dict(rule.state_dict())
        return own.to(self.dtype)

    def kept(self, states: Tensor) -> Tensor:
        """Return states as they are kept from one step to the next, in their own dtype."""
        return states.to(torch.bfloat16).to(states.dtype) if self.short_states else states

    @contextlib.contextmanager
    def active(self) -> Iterator[None]:
        """Set torch's switch for TF32 while a block runs."""
        before = torch.backends.cuda.matmul.allow_tf32
        torch.backends.cuda.matmul.allow_tf32 = self.tensor_float
        try:
            yield
        finally:
            torch.backends.cuda.matmul.allow_tf32 = before


PRECISIONS = {
    precision.name: precision
    for precision in (
        Precision("float64", "everything in float64", torch.float64),
        Precision("float32", "everything in float32", torch.float32),
        Precision("tf32", "the rule's products in TF32", torch.float32, tensor_float=True),
        Precision(
            "bf16_storage", "states rounded to bfloat16 each step", torch.float32, short_states=True
        ),
        Precision("mixed", "the rule's products in bfloat16", torch.float32, short_products=True),
    )
}
"""Every precision by its name."""
