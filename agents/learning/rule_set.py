"""Sets of rules, one for each species of a problem; rules with clamped state steps."""

from __future__ import annotations

import copy
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, cast

import torch
from torch import Tensor, nn

from npa_envs.agents.policies import Policy, bounded_update, check_rule_fits, spans_of
from npa_envs.atomic_files import made_folder
from npa_envs.checks import checked_count
from npa_envs.envs.core.config import Interface
from npa_envs.errors import NPAError, shown
from npa_envs.rule.files import load_rule, save_rule
from npa_envs.rule.folded_network import FoldedRule
from npa_envs.rule.rule import NPARule

if TYPE_CHECKING:
    from npa_envs.agents.learning.problem import Problem

Source = str | Path | NPARule
"""A rule, a shipped rule's name, or a rule's file."""


class RuleSet(nn.Module):
    """One rule for each species, as a function from observations to actions.

    Make one with `new`, `of` or `load`.

    Args:
        rules: One for each species; not copied.
        counts: Number of particles of each species.
        interface: Columns of observations and actions, `problem.interface`.
    """

    def __init__(
        self, rules: Sequence[NPARule], counts: Sequence[int], interface: Interface
    ) -> None:
        super().__init__()
        if len(rules) != len(counts):
            raise NPAError(
                f"rules must be one for each of {len(counts)} species, got {len(rules)}: "
                "give them in the species' order"
            )
        self.rules = nn.ModuleList(rules)
        self.spans = spans_of(counts)
        """Slice of the particles of each species, among all N."""
        self.counts = tuple(counts)
        """Number of particles of each species."""
        self.interface = interface

    @classmethod
    def new(cls, problem: Problem, seed: int) -> RuleSet:
        """Return untrained rules for a problem, on the CPU; torch's random state stays."""
        seed, interface, config = checked_count("seed", seed), problem.interface, problem.config
        with torch.random.fork_rng(devices=()):
            torch.manual_seed(seed)
            sizes = interface.space_dim, interface.state_dim, problem.hidden_dim
            rules = [
                NPARule(
                    *sizes,
                    eps0=config.eps0,
                    alpha=config.alpha,
                    static=not interface.moving,
                    moment_inverse=config.moment_inverse,
                    species_count=interface.species_count,
                )
                for _ in problem.counts
            ]
        return cls(rules, problem.counts, interface)

    @classmethod
    def of(cls, problem: Problem, source: Source | Iterable[Source]) -> RuleSet:
        """Return copies of existing rules, on the CPU, checked to fit a problem.

        `source`: a rule, its file or name, for all or each species; or a folder that `save` wrote.
        """
        if isinstance(source, str | Path) and (Path(source) / _file_name(0)).is_file():
            return cls.load(source, problem)
        single = isinstance(source, Source)
        sources: list[Source] = [source] * len(problem.counts) if single else list(source)  # type: ignore[arg-type, list-item]
        rules = [
            copy.deepcopy(one).cpu() if isinstance(one, NPARule) else load_rule(one)
            for one in sources
        ]
        for rule in rules:
            check_rule_fits(rule, problem.interface, problem.config)
        return cls([rule.float() for rule in rules], problem.counts, problem.interface)

    @classmethod
    def load(cls, folder: str | Path, problem: Problem) -> RuleSet:
        """Return the rules that `save` wrote, on the CPU, for a problem."""
        return cls.of(problem, [Path(folder) / _file_name(k) for k in range(len(problem.counts))])

    def save(self, folder: str | Path) -> list[Path]:
        """Write each rule, as `rule-0.safetensors` and so on, into a folder; return the paths."""
        paths = [Path(folder) / _file_name(k) for k in range(len(self.rules))]
        try:
            with made_folder(Path(folder)):
                for rule, path in zip(self, paths, strict=True):
                    save_rule(rule, path)
        except OSError as error:
            raise NPAError(
                f"folder must be one that can be made, got {shown(str(folder))} "
                f"({error.strerror}): choose another place"
            ) from error
        return paths

    def __iter__(self) -> Iterator[NPARule]:
        """Return an iterator over the rules, by species."""
        return iter(cast(list[NPARule], list(self.rules)))

    def mean(self, observation: Tensor) -> Tensor:
        """Return actions [B, N, A] for observations: a_x = δ / (1 + |δ|), a_s = Δs / state_scale.

        Unlike in `policy`, a_s is not clipped to the action space: gradients do not vanish.
        """
        return self.actions(observation, self.mean_by_rule)

    def mean_by_rule(self, rule: NPARule, rows: Tensor) -> Tensor:
        """Return actions [K, A], as `mean` does, by one rule at K rows of observations [K, P]."""
        delta, state_step = bounded_update(rule, rows)
        return torch.cat((delta, state_step / self.interface.state_scale), dim=-1)

    def actions(
        self, observation: Tensor, action_by_rule: Callable[[NPARule, Tensor], Tensor]
    ) -> Tensor:
        """Return actions [B, N, A]; `action_by_rule` maps a rule and rows [K, P] to its [K, A]."""
        actions = []
        for rule, span in zip(self, self.spans, strict=True):
            rows = observation[:, span]
            action = action_by_rule(rule, rows.flatten(0, 1))
            actions.append(action.view(*rows.shape[:2], -1))
        return actions[0] if len(actions) == 1 else torch.cat(actions, dim=1)

    def policy(self) -> RuleSetPolicy:
        """Return the rules, not copied, as a policy."""
        return RuleSetPolicy(self)


class RuleSetPolicy(Policy):
    """A set of rules as a policy; it computes on the rules' device."""

    def __init__(self, rules: RuleSet) -> None:
        super().__init__(rules.interface)
        self.rules = rules

    def act(self, observation: Tensor) -> Tensor:
        """Return the actions of all particles by their species' rules, shape [B, N, A]."""

        def action(rule: NPARule, rows: Tensor) -> Tensor:
            return self.interface.action(*bounded_update(rule, rows))

        return self.rules.actions(observation, action).float()

    def _spans(self, counts: Mapping[str, int]) -> dict[str, slice]:
        # Agents that ended are missing: names identify the others.
        spans, count = self.rules.spans, self.rules.spans[-1].stop
        known = {f"species_{k}": span for k, span in enumerate(spans)}
        known |= {f"particle_{k}": slice(k, k + 1) for k in range(count)}
        for agent in counts:
            if agent not in known:
                raise NPAError(
                    f"observation must be of agents of {len(spans)} species and {count} "
                    f"particles, got one of {agent!r}: use the policy with the environment that it "
                    "was made for"
                )
        return {agent: known[agent] for agent in counts}


class _ClampInward(torch.autograd.Function):
    """Clamp values to ± `limit`. Beyond it only gradients pass whose descent leads back inside."""

    @staticmethod
    def forward(ctx: Any, values: Tensor, limit: float) -> Tensor:
        ctx.save_for_backward(values)
        ctx.limit = limit
        return values.clamp(-limit, limit)

    @staticmethod
    def backward(ctx: Any, bar: Tensor) -> tuple[Tensor, None]:
        (values,) = ctx.saved_tensors
        # Descent moves values against their gradient.
        leads_out = torch.where(values > 0.0, bar < 0.0, bar > 0.0)
        return bar.masked_fill((values.abs() > ctx.limit) & leads_out, 0.0), None


class ClampedWeights(FoldedRule):
    """The network of a `ClampedRule` as steps run it: two matrix products, then the clamp."""

    rule: ClampedRule

    def __call__(self, rows: Tensor) -> Tensor:
        """Map K rows of input to K updates, as `FoldedRule` does, with clamped state steps."""
        return self.rule.clamped(super().__call__(rows))


class ClampedRule(NPARule):
    """A rule that shares another rule's parameters and clamps its state steps to ± `limit`.

    In a rollout it acts as the other rule in an environment whose `state_scale` is `limit`.
    """

    def __init__(self, rule: NPARule, limit: float) -> None:
        self.share(rule)
        self.limit = limit
        self.rule_is_plain = rule.is_plain()

    def forward(self, perception: Tensor) -> Tensor:
        """Map perceptions [..., P] to raw updates [..., A] with clamped state steps."""
        return self.clamped(super().forward(perception))

    def clamped(self, update: Tensor) -> Tensor:
        """Return raw updates [δ | Δs], shape [..., A], with the state steps Δs clamped."""
        first = self.update_dim - self.state_dim
        state_step = _ClampInward.apply(update[..., first:], self.limit)  # type: ignore[no-untyped-call]
        return torch.cat((update[..., :first], state_step), dim=-1)

    def is_plain(self) -> bool:
        """Return whether the rule that is clamped is plain, so that `folded` may replace it."""
        return self.rule_is_plain

    def folded(self) -> FoldedRule:
        """Return the network as `ClampedWeights`."""
        clamped = ClampedWeights(*super().folded())
        clamped.rule = self
        return clamped


def species_of(counts: Sequence[int]) -> Tensor:
    """Return the species number of each particle, int64, shape [N]."""
    return torch.arange(len(counts)).repeat_interleave(torch.tensor(tuple(counts)))


def _file_name(species: int) -> str:
    return f"rule-{species}.safetensors"
