"""Precisions of a rollout: of arithmetic, of the rule's products, of states between steps.

    python benchmarks/precisions.py gecko dots digits --device cuda

prints the metric of rules at their horizon in each precision, over that of float32.
"""

from __future__ import annotations

import contextlib
from collections.abc import Iterator
from dataclasses import dataclass

import torch
from scripts import script_parser
from torch import Tensor
from torch.nn import functional

from npa_envs.checks import check_device
from npa_envs.ops.equivariance import invariants, steered
from npa_envs.rule.files import load_rule
from npa_envs.rule.folded_network import without_small
from npa_envs.rule.rule import NPARule
from npa_envs.training.task_of_rule import task_of_rule
from npa_envs.world.rollout import rollout

HORIZONS = {"morphogenesis3d": 128, "point_classification": 32}
"""Steps after which rules of a task are measured; default 512."""


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
        """Whether this precision concerns perception, not only the products of the rule."""
        return not (self.short_products or self.tensor_float)

    def obstacle(self, device: torch.device) -> str | None:
        """Return why it cannot be measured on a device; None if it can."""
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
        """Return a context in which torch's switch for TF32 is set as this precision needs."""
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


@torch.no_grad()
def metric(name: str, precision: Precision, device: torch.device) -> float:
    """Return the metric of one world of a rule at its horizon; NaN where it is not finite."""
    rule = load_rule(name, device=device).float().requires_grad_(False)
    trained = task_of_rule(name, rule, device)
    generator = torch.Generator(device).manual_seed(0)
    x, s, _, goal = trained.task.seed(1, generator=generator, device=device)
    task = trained.task.with_goal(goal)
    x, s, own = x.float(), precision.kept(s.float()), precision.rule(rule)
    x, s = x.to(precision.dtype), s.to(precision.dtype)
    steps = HORIZONS.get(trained.task_name or "", 512)
    at_once = 1 if precision.short_states else steps
    options = {"eps": task.eps, "box": task.box, "update_prob": task.update_prob}
    generator.manual_seed(1)
    with precision.active():
        for _ in range(steps // at_once):
            x, s = rollout(own, x, s, at_once, generator=generator, **options)
            s = precision.kept(s)
    finite = bool(x.isfinite().all()) and bool(s.isfinite().all())
    return float(task.metric(x.float(), s.float()).mean()) if finite else float("nan")


def main() -> None:
    """Print a line for each rule and precision."""
    parser = script_parser(__doc__)
    parser.add_argument("rules", nargs="+")
    arguments = parser.parse_args()
    torch.set_num_threads(arguments.threads)
    device = check_device(arguments.device)
    for name in arguments.rules:
        base = metric(name, PRECISIONS["float32"], device)
        for precision in PRECISIONS.values():
            if precision.obstacle(device) is None:
                ratio = metric(name, precision, device) / base
                print(f"{name}  {precision.name}  {ratio:.3f} times that of float32", flush=True)


if __name__ == "__main__":
    main()
