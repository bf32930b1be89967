"""Rules whose state steps are held within the action space, as environments hold them."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from npa_envs.rule.rule import FoldedRule, NPARule


class _Hold(torch.autograd.Function):
    """Numbers held within ± a limit; gradients that lead back inside go on as they are."""

    @staticmethod
    def forward(ctx: Any, values: Tensor, limit: float) -> Tensor:
        ctx.save_for_backward(values)
        ctx.limit = limit
        return values.clamp(-limit, limit)

    @staticmethod
    def backward(ctx: Any, bar: Tensor) -> tuple[Tensor, None]:
        (values,) = ctx.saved_tensors
        # A loss falls against its gradient: beyond the limit only a fall towards it is let through.
        leads_out = torch.where(values > 0.0, bar < 0.0, bar > 0.0)
        return bar.masked_fill((values.abs() > ctx.limit) & leads_out, 0.0), None


def hold(values: Tensor, limit: float) -> Tensor:
    """Return values clipped to ± a limit, so that those beyond it can be learned to come back.

    Args:
        values: Any shape.
        limit: Above 0.
    """
    held: Tensor = _Hold.apply(values, limit)  # type: ignore[no-untyped-call]
    return held


class HeldWeights(FoldedRule):
    """The weights of a rule, run with its state steps held within a limit."""

    displacement_dim: int
    limit: float

    def __call__(self, rows: Tensor) -> Tensor:
        """Map rows [z | 1 | 0], shape [K, row_width], to updates [δ | held Δs | 0], [K, A']."""
        update = super().__call__(rows)
        first = self.displacement_dim
        return torch.cat((update[:, :first], hold(update[:, first:], self.limit)), dim=1)


class HeldRule(NPARule):
    """A rule that shares another one's weights, with state steps within ± `limit`.

    In a rollout it does what the other does in an environment with that `state_scale`.

    Args:
        rule: The other rule.
        limit: Largest state step, dimensionless.
    """

    def __init__(self, rule: NPARule, limit: float) -> None:
        # The very parameters: what changes one rule changes both.
        vars(self).update(vars(rule))
        self.limit = limit
        self.rule_is_plain = rule.is_plain()

    def forward(self, perception: Tensor) -> Tensor:
        """Map perception vectors to updates with held state steps; as `NPARule`.

        Args:
            perception: Perception vectors z, dimensionless, shape [..., P].
        """
        update = super().forward(perception)
        first = self.update_dim - self.state_dim
        return torch.cat((update[..., :first], hold(update[..., first:], self.limit)), dim=-1)

    def is_plain(self) -> bool:
        """Return whether `folded` may stand in for the rule: where it may for the other one."""
        return self.rule_is_plain

    def folded(self) -> FoldedRule:
        """Return the weights as two plain products with held state steps."""
        held = HeldWeights(*super().folded())
        held.displacement_dim = self.update_dim - self.state_dim
        held.limit = self.limit
        return held
