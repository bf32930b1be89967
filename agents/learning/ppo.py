"""Proximal policy optimisation that stays on the device, from the first world to the last gradient.

Source: Schulman et al., arXiv 1707.06347, in the manner of CleanRL: one file, read from the top. A
round is `steps` steps of all worlds, then `epochs` passes over them in minibatches of whole worlds.
The host reads one byte a world in each step (has its episode ended?), and one number an epoch.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from typing import Any, NamedTuple

import torch
from torch import Tensor, nn

from npa_envs.agents.learning.advantages import (
    clipped_gain,
    generalised_advantages,
    over_particles,
    standardised,
)
from npa_envs.agents.learning.critics import Critic
from npa_envs.agents.learning.gaussian import GaussianRules
from npa_envs.agents.learning.options import takes_fields_of
from npa_envs.agents.learning.ppo_settings import Settings, beginning, filled, noise_left
from npa_envs.agents.learning.ppo_worlds import world_count
from npa_envs.agents.learning.problem import Problem
from npa_envs.agents.learning.progress import Progress
from npa_envs.agents.learning.rules import RuleSet
from npa_envs.agents.learning.seeds import world_seeds
from npa_envs.wrappers.adapters import own_rewards


class Round(NamedTuple):
    """What T steps of B worlds of N particles gave, flat: M = T B worlds, one after the other."""

    observations: Tensor
    """What particles perceived, shape [M, N, P]."""
    actions: Tensor
    """What they did, not clipped, shape [M, N, A]."""
    log_probs: Tensor
    """Its log-probability then, shape [M, N]."""
    advantages: Tensor
    """How much better it was than foreseen, and than other worlds fared in the same step,
    standardised, shape [M, N]."""
    targets: Tensor
    """What the critic should have said, shape [M, N]."""
    acted: Tensor
    """1 where a particle's species was alive, else 0, shape [M, N]."""


class Learner:
    """Rules, critic, worlds and what was seen of them.

    Args:
        problem: What is to be learned.
        settings: How.
        seed: Of worlds, noise, shuffles and first weights.
        device: Where everything lives.
        start: Rules to begin with; None: fresh ones.
    """

    def __init__(
        self,
        problem: Problem,
        settings: Settings,
        seed: int,
        device: torch.device,
        start: RuleSet | None,
    ) -> None:
        self.settings = settings = filled(settings, start)
        self.envs = problem.make_envs(
            settings.worlds, device=device, row_rewards=settings.credit == "particle", copy=False
        )
        self.generator = torch.Generator(device).manual_seed(seed)
        rules = beginning(problem, seed, start)
        assert settings.initial_std is not None, "filled in above"
        self.actor = GaussianRules(rules, settings.initial_std).to(device)
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(seed)
            critic = Critic(
                problem.interface.perception_dim,
                problem.counts,
                settings.critic,
                settings.critic_width,
            )
        self.critic = critic.to(device)
        self.optimizer, self.critic_optimizer = (
            torch.optim.Adam(net.parameters(), lr=rate, eps=1e-5, fused=True)
            for net, rate in ((self.actor, torch.zeros((), device=device)), (self.critic, 0.0))
        )
        observation, _ = self.envs.reset(seed=world_seeds(seed, self.envs.num_envs))
        self.seen = observation.new_empty(settings.steps + 1, *observation.shape)
        """What is perceived before each step of a round, and after its last, [T + 1, B, N, P]."""
        self.seen[-1].copy_(observation)
        self.critic.observe(observation)
        self.rounds = 0
        """Rounds done."""

    @property
    def round_size(self) -> int:
        """Particle steps of a round, T B N."""
        return self.seen[1:, ..., 0].numel()

    @torch.no_grad()
    def play(self) -> Round:
        """Act for T steps in all worlds, and judge what was done."""
        seen = self.seen
        seen[0].copy_(seen[-1])
        moves, last_seen = [], {}
        for step in range(self.settings.steps):
            action, log_prob = self.actor.sample(seen[step], self.generator)
            observation, reward, terminated, truncated, infos = self.envs.step(action)
            seen[step + 1].copy_(observation)
            if "final_obs" in infos:
                last_seen[step] = infos["final_obs"]
            paid, acted = self._by_particle(reward, infos)
            ended = terminated | truncated
            # A species may end before its world does.
            gone = infos.get("particle_terminated", terminated[:, None])
            flags = [(flag[:, None] | gone).expand_as(paid) for flag in (terminated, ended)]
            # Environments may hand out the same tensors in each step.
            moves.append([value.clone() for value in (action, log_prob, paid, acted, *flags)])
        actions, log_probs, rewards, acted, terminated, ended = (
            torch.stack(column) for column in zip(*moves, strict=True)
        )
        values = self._values(seen.flatten(0, 1)).view(len(seen), *paid.shape)
        following = values[1:].clone()
        for step, observation in last_seen.items():
            following[step] = self.critic(observation)
        advantages = generalised_advantages(
            rewards,
            values[:-1],
            following,
            terminated,
            ended,
            gamma=self.settings.gamma,
            gae_lambda=self.settings.gae_lambda,
        )
        targets = advantages + values[:-1]
        counted = acted.to(rewards.dtype)
        if self.settings.ratio == "world":
            advantages = over_particles(advantages, counted)
        advantages = standardised(advantages, counted)
        parts = (seen[:-1], actions, log_probs, advantages, targets, counted)
        return Round(*(part.flatten(0, 1) for part in parts))

    def improve(self, batch: Round, share_left: float) -> None:
        """Let rules and critic learn from a round.

        Args:
            batch: The round.
            share_left: Share of the budget that is left; learning rates are this part of what they
                were at the start, and by it the noise of the next round is made less.
        """
        settings = self.settings
        rules_learn = self.rounds >= settings.critic_rounds
        self.rounds += 1
        self.critic.observe(batch.observations)
        self.critic.rescale(batch.targets)
        rate = settings.learning_rate * share_left
        self.critic_optimizer.param_groups[0]["lr"] = settings.critic_learning_rate * share_left
        near = torch.ones((), device=batch.targets.device)
        groups = self._groups(batch)
        for _ in range(settings.epochs):
            critic_parts = self._shuffled([batch])
            for part, worlds in zip(self._shuffled(groups), critic_parts, strict=True):
                self._descend(self.critic_optimizer, self._critic_loss(*worlds))
                if rules_learn:
                    gain, kl = self._surrogate(part)
                    # Rules that have gone too far stay, without a question to the host.
                    near *= kl.detach() <= settings.target_kl
                    self.optimizer.param_groups[0]["lr"].copy_(near * rate)
                    self._descend(self.optimizer, -gain)
            # All that the host waits for.
            if rules_learn and not bool(near):
                break
        assert settings.last_noise is not None, "filled in above"
        self.actor.leave_noise(noise_left(share_left, settings.last_noise))

    def _groups(self, batch: Round) -> list[Round]:
        """Return what is shuffled when rules learn: whole worlds, or each species' particles."""
        if self.settings.ratio == "world":
            return [batch]
        spans = self.actor.rules.spans
        return [Round(*(value[:, span].flatten(0, 1) for value in batch)) for span in spans]

    def _shuffled(self, groups: list[Round]) -> Iterator[list[Round]]:
        """Return minibatches: parts of each group."""
        orders = [
            torch.randperm(len(group.targets), generator=self.generator, device=self.seen.device)
            for group in groups
        ]
        count = min(self.settings.minibatches, self.seen[1:, :, 0, 0].numel())
        parts = [order.tensor_split(count) for order in orders]
        for chosen in zip(*parts, strict=True):
            yield [
                Round(*(value[rows] for value in group))
                for group, rows in zip(groups, chosen, strict=True)
            ]

    def _surrogate(self, part: list[Round]) -> tuple[Tensor, Tensor]:
        """Return the clipped gain of the rules, and how far their actions have moved [nats]."""
        settings, actor = self.settings, self.actor
        if settings.ratio == "world":
            (worlds,) = part
            changes = [actor.log_prob(worlds.observations, worlds.actions) - worlds.log_probs]
        else:
            changes = [
                actor.row_log_prob(species, rows.observations, rows.actions) - rows.log_probs
                for species, rows in enumerate(part)
            ]
        log_ratio, advantages, acted = (
            torch.cat(values)
            for values in (changes, [p.advantages for p in part], [p.acted for p in part])
        )
        kl = (acted * (torch.expm1(log_ratio) - log_ratio)).sum() / acted.sum().clamp(min=1.0)
        if settings.ratio == "world":
            log_ratio = over_particles(log_ratio, acted)
            acted = acted.amax(dim=1, keepdim=True)
        gain = clipped_gain(log_ratio, advantages, acted, clip=settings.largest_change)
        return gain + settings.entropy_weight * actor.entropy(), kl

    def _critic_loss(self, worlds: Round) -> Tensor:
        error: Tensor = (self.critic(worlds.observations) - worlds.targets) / self.critic.scale
        return 0.5 * (worlds.acted * error.square()).sum() / worlds.acted.sum().clamp(min=1.0)

    def _descend(self, optimizer: torch.optim.Optimizer, loss: Tensor) -> None:
        optimizer.zero_grad()
        loss.backward()  # type: ignore[no-untyped-call]
        parameters = optimizer.param_groups[0]["params"]
        nn.utils.clip_grad_norm_(parameters, self.settings.max_gradient_norm)
        optimizer.step()

    def _values(self, observations: Tensor) -> Tensor:
        """Return what the critic says of many worlds, part by part to save memory, [M, N]."""
        size = -(-len(observations) // self.settings.minibatches)
        return torch.cat([self.critic(part) for part in torch.split(observations, size)])

    def _by_particle(self, reward: Tensor, infos: dict[str, Any]) -> tuple[Tensor, Tensor]:
        """Return what each particle is paid for the last step, and whether it acted, [B, N]."""
        everyone = self.seen.shape[1:3]
        acted = infos.get("acted", torch.ones_like(reward, dtype=torch.bool)[:, None])
        paid = own_rewards(infos) if self.settings.credit == "particle" else reward[:, None]
        return paid.expand(everyone), acted.expand(everyone)


@takes_fields_of(Settings)
def train(
    problem: Problem,
    progress: Progress,
    seed: int,
    *,
    device: torch.device | str = "cpu",
    start: RuleSet | None = None,
    settings: Settings,
) -> RuleSet:
    """Return the rules that proximal policy optimisation finds within a budget.

    Args:
        problem: What is to be learned.
        progress: Keeps the budget, and looks at the rules now and then.
        seed: Of all that is drawn.
        device: Where everything lives.
        start: Rules to begin with; None: fresh ones.
        settings: Its fields, as keyword arguments.

    Raises:
        NPAError: There is no such option, or one is wrong.
        DivergedError: The policy has diverged.
    """
    place = torch.device(device)
    settings = replace(settings, worlds=world_count(problem, settings, place, progress.budget))
    learner = Learner(problem, settings, seed, place, start)
    rules = learner.actor.rules
    progress.start(rules)
    while not progress.over:
        share_left = 1.0 - progress.share
        batch = learner.play()
        progress.advance(learner.round_size)
        learner.improve(batch, share_left)
        progress.look(rules)
    progress.look(rules, force=True)
    return rules
