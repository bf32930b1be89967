"""Proximal policy optimisation that stays on the device, from the first world to the last gradient.

Source: Schulman et al., arXiv 1707.06347, in the manner of CleanRL: one file, read from the top.
A round is `steps` steps of all worlds, then `epochs` passes over them in minibatches of particles.
The host reads one byte a world in each step (has its episode ended?), and one number a pass. On
CUDA draws, advantages and updates are recorded once as CUDA graphs: a round is thousands of short
kernels, which a host takes longer to launch than a GPU to run.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Literal, NamedTuple

import torch
from torch import Tensor, nn

from npa_envs.agents.learning.ppo_common import (
    CommonOptions,
    GaussianRules,
    Minibatches,
    check_word,
    find_gradients,
    gradients_of,
    learner_random,
    noise_left,
    seeded_critic,
    zero_output_rules,
)
from npa_envs.agents.learning.problem import ROW_REWARDS, WORLDS_PER_SEED, Problem, world_seeds
from npa_envs.agents.learning.progress import Budget, Progress
from npa_envs.agents.learning.rules import RuleSet
from npa_envs.checks import check_flag, check_non_negative, check_positive
from npa_envs.envs.core.state import free_bytes, needed_bytes
from npa_envs.errors import NPAError
from npa_envs.training.ranks import ALONE, Ranks, registered, restart
from npa_envs.world.cuda_graph import GraphedCallable
from npa_envs.wrappers.base import own_rewards

MANY_PARTICLES = 2**17
"""Particles of all worlds on a GPU: a round of fewer takes hardly less time."""

FEWEST_ROUNDS = 128
"""Rounds that a budget of particle-steps is to be enough for."""

ROOM = 0.25
"""Share of the free memory that is taken; other runs may share the device."""


@dataclass(frozen=True, kw_only=True)
class PPOOptions(CommonOptions):
    """Options of `train`."""

    worlds: int | None = None
    """Worlds B to act in; None: the problem's `num_envs`, and on CUDA, where that is more, as many
    as have 131 072 particles together on each GPU, if memory has room for them and particle-steps
    are enough for 128 rounds. Several processes share them out."""
    critic_learning_rate: float = 1e-3
    """The critic's step at the start, as `learning_rate` is the rules'."""
    clip: float | None = None
    """Ratios of likelihoods count up to 1 plus or minus this (dimensionless). None: 0.2, or 0.02
    for a world's, whose logarithms are means over many particles."""
    ratio: Literal["particle", "world"] = "particle"
    """Each particle has a ratio of its own, or a world has one, of mean log-probabilities."""
    credit: Literal["world", "particle", "marginal"] = "world"
    """Each particle is paid what its world is; its own share; or what its world would have lost
    without its action."""
    masked: bool = False
    """Leave out of a round the actions of particles in steps that did not update them; not with
    several species."""
    critic_width: int = 64
    """Units in a hidden layer of the critic."""

    def __post_init__(self) -> None:
        """Check every field; raises NPAError."""
        super().__post_init__()
        check_positive(self, int, "critic_width")
        check_non_negative(self, "critic_learning_rate")
        check_flag(self, "masked")
        if self.clip is not None:
            check_positive(self, float, "clip")
        if self.worlds is not None:
            check_positive(self, int, "worlds")
        check_word("ratio", self.ratio, ("particle", "world"))
        check_word("credit", self.credit, ("world", *ROW_REWARDS))
        if self.ratio == "world" and self.credit != "world":
            raise NPAError(
                f"credit={self.credit!r} needs ratio='particle': one ratio a world has one "
                "advantage"
            )

    @property
    def largest_change(self) -> float:
        """How far ratios count from 1."""
        if self.clip is not None:
            return self.clip
        return 0.2 if self.ratio == "particle" else 0.02


DEFAULTS = PPOOptions()


def train(progress: Progress, options: PPOOptions = DEFAULTS) -> RuleSet:
    """Return the rules that proximal policy optimisation finds within a budget."""
    problem, device, ranks = progress.problem, progress.device, progress.ranks
    count = ranks.broadcast(world_count(problem, options, device, progress.budget, ranks))
    options = replace(options, worlds=count)
    learner = PPOLearner(problem, options, progress.seed, device, progress.initial, ranks)

    def round_of_ppo() -> int:
        share_left = 1.0 - progress.share
        learner.play()
        learner.improve(share_left)
        return learner.round_size

    return progress.run(learner.actor.rules, round_of_ppo, learner)


class PPOLearner:
    """Rules, critic, worlds and their rounds; the seed is that of all draws.

    Several processes each have a share of the worlds, draw for each of these by itself, and take
    the means of gradients, moments and weights.
    """

    def __init__(
        self,
        problem: Problem,
        options: PPOOptions,
        seed: int,
        device: torch.device,
        start: RuleSet | None,
        ranks: Ranks = ALONE,
    ) -> None:
        self.options, self.pace, self.ranks = options, options.pace(start), ranks
        total = problem.num_envs if options.worlds is None else options.worlds
        ranks.check_even("worlds", total)
        places = ranks.indices(total)
        self.envs = problem.make_envs(
            len(places),
            device=device,
            row_rewards=None if options.credit == "world" else options.credit,
            tell_updated=options.masked,
            copy=False,
        )
        self.random = learner_random(seed, total, places, device, ranks)
        rules = zero_output_rules(problem, seed, start)
        self.actor = GaussianRules(rules, self.pace.initial_std).to(device)
        perception_dim = problem.interface.perception_dim
        self.critic = seeded_critic(problem, perception_dim, options, seed).to(device)
        self.modules = {"actor": self.actor, "critic": self.critic}
        # Recorded steps read their length where it can be changed.
        self.optimisers = {
            name: torch.optim.Adam(
                net.parameters(),
                lr=torch.zeros((), device=device),
                eps=1e-5,
                fused=True,
                capturable=device.type == "cuda",
            )
            for name, net in self.modules.items()
        }
        self.optimizer, self.critic_optimizer = self.optimisers.values()
        self._seed, self._places, self._total = seed, places.tolist(), total
        observation = self._worlds_of_part(0)
        self.memory = Memory(
            options.steps,
            observation,
            problem.interface.action_dim,
            own_advantages=options.ratio == "particle",
        )
        self.critic.observe(observation, ranks)
        self.rounds = 0
        # Recorded work reads and writes these in place.
        self._now = observation.clone()
        self._action, self._log_prob = (
            part[0].clone() for part in (self.memory.actions, self.memory.log_probs)
        )
        self._near, self._rate, self._all_act = torch.ones(3, device=device)
        # Groups for the rules, and worlds for the critic.
        rows = (1,) if options.ratio == "world" else problem.counts
        self._minibatches = Minibatches(
            options.steps, len(places), (*rows, 1), options.minibatches, self.random
        )
        self._act = GraphedCallable(self._draw_actions, device, registered(self.random))
        self._value = GraphedCallable(self._find_values, device)
        # A process alone records whole passes. Several record what lies between their reductions.
        shared = ranks.together
        self._judge = GraphedCallable(self._find_advantages, device, recorded=not shared)
        self._learn_values = GraphedCallable(self._improve_critic, device, recorded=not shared)
        self._learn = GraphedCallable(self._improve_both, device, recorded=not shared)
        pool = torch.cuda.graph_pool_handle() if shared and device.type == "cuda" else None
        self._weigh_own, self._step, *self._find = (
            GraphedCallable(function, device, recorded=shared, pool=pool)
            for function in (
                self._weigh_parts,
                self._step_both,
                *[self._find_gradients] * self._minibatches.count,
            )
        )
        self._part = 0
        self._weights = self._near.new_zeros(self._minibatches.count, 2)
        self._moved = self._near.new_zeros(2)

    def go_on(self, iteration: int, part: int) -> None:
        """Go on after so many rounds, for the part-th time, from 1 on, with other worlds."""
        self.rounds = iteration
        self.memory.seen[-1].copy_(self._worlds_of_part(part))

    def _worlds_of_part(self, part: int) -> Tensor:
        seeds = world_seeds(self._seed, self._total, part)
        observation: Tensor
        observation, _ = self.envs.reset(seed=[seeds[place] for place in self._places])
        return observation

    @property
    def round_size(self) -> int:
        """Particle steps of a round of all processes, T B N."""
        return self.ranks.count * self.memory.rewards.numel()

    @torch.no_grad()
    def play(self) -> Round:
        """Act for T steps in all worlds, and find advantages; the next round overwrites them."""
        memory = self.memory
        memory.seen[0].copy_(memory.seen[-1])
        last_seen = {}
        for step in range(self.options.steps):
            self._now.copy_(memory.seen[step])
            self._act()
            memory.actions[step].copy_(self._action)
            memory.log_probs[step].copy_(self._log_prob)
            observation, reward, terminated, truncated, infos = self.envs.step(self._action)
            memory.seen[step + 1].copy_(observation)
            if "final_obs" in infos:
                last_seen[step] = infos["final_obs"]
            shared = self.options.credit == "world"
            memory.rewards[step].copy_(reward[:, None] if shared else own_rewards(infos))
            memory.acted[step].copy_(infos.get("acted", self._all_act))
            if self.options.masked and "updated" in infos:
                # True of worlds that began anew as well: it is of the step before.
                memory.acted[step].mul_(infos["updated"])
            # A species may end before its world does.
            gone = infos.get("particle_terminated", terminated[:, None])
            memory.terminated[step].copy_(terminated[:, None] | gone)
            memory.ended[step].copy_((terminated | truncated)[:, None] | gone)
        self._value()
        for step, observation in last_seen.items():
            memory.following[step].copy_(self.critic(observation))
        self._judge()
        return memory.round

    @torch.no_grad()
    def _draw_actions(self) -> None:
        restart(self.random)
        action, log_prob = self.actor.sample(self._now, self.random)
        self._action.copy_(action)
        self._log_prob.copy_(log_prob)

    @torch.no_grad()
    def _find_values(self) -> None:
        """Find the critic's values of all observations, part by part to save memory."""
        memory, seen = self.memory, self.memory.seen.flatten(0, 1)
        size = -(-len(seen) // self.options.minibatches)
        values = torch.cat([self.critic(part) for part in torch.split(seen, size)])
        memory.values.copy_(values.view_as(memory.values))
        memory.following.copy_(memory.values[1:])

    @torch.no_grad()
    def _find_advantages(self) -> None:
        memory, values = self.memory, self.memory.values[:-1]
        advantages = generalised_advantages(
            memory.rewards,
            values,
            memory.following,
            memory.terminated,
            memory.ended,
            gamma=self.options.gamma,
            gae_lambda=self.options.gae_lambda,
        )
        memory.targets.copy_(advantages + values)
        if self.options.ratio == "world":
            advantages = over_particles(advantages, memory.acted)
        memory.advantages.copy_(standardised(advantages, memory.acted, self.ranks))

    def improve(self, share_left: float) -> None:
        """Let rules and critic learn from the last round.

        Learning rates, and the noise of the next round, fall with the share of the budget that is
        left.
        """
        options = self.options
        rules_learn = self.rounds >= self.pace.critic_rounds
        self.rounds += 1
        self.critic.observe(self.memory.seen[:-1], self.ranks)
        self.critic.rescale(self.memory.targets, self.ranks)
        rate = self.critic_optimizer.param_groups[0]["lr"]
        rate.fill_(options.critic_learning_rate * share_left)
        self._rate.fill_(self.pace.learning_rate * share_left)
        self._near.fill_(1.0)
        for _ in range(options.epochs):
            self._minibatches.shuffle()
            if not rules_learn:
                self._learn_values()
                continue
            self._learn()
            # The host waits for nothing else.
            if not bool(self._near):
                break
        self.actor.leave_noise(
            noise_left(share_left, self.pace.last_noise, options.noise_decay_share)
        )

    def _improve_critic(self) -> None:
        """Let the critic learn once from all of a round, in the order that was drawn."""
        self._weigh()
        for part in range(self._minibatches.count):
            self._part = part
            self._find_critic_gradients()
            self.ranks.reduce(gradients_of(self.critic_optimizer))
            self._descend(self.critic_optimizer)

    def _improve_both(self) -> None:
        """Let critic and rules learn once from all of a round, in the orders that were drawn."""
        self._weigh()
        for part, find in enumerate(self._find):
            self._part = part
            find()
            found = gradients_of(self.critic_optimizer) + gradients_of(self.optimizer)
            self.ranks.reduce([*found, self._moved])
            self._step()

    def _find_gradients(self) -> None:
        self._find_critic_gradients()
        rows = [Round(*own) for own in self._rows(self._part, self.memory.round)]
        find_gradients(self.optimizer, -self._gain(rows))

    def _find_critic_gradients(self) -> None:
        worlds = Round(*self._worlds(self._part, self.memory.round))
        error = (self.critic(worlds.observations) - worlds.targets) / self.critic.scale
        squares = (worlds.acted * error.square()).sum()
        loss = 0.5 * squares / self._weight(worlds.acted, 0).clamp(min=1.0)
        find_gradients(self.critic_optimizer, loss)

    def _step_both(self) -> None:
        self._descend(self.critic_optimizer)
        # Rules that have gone too far stay; the host need not know.
        moved, count = self._moved
        self._near *= moved / count.clamp(min=1.0) <= self.pace.target_kl
        self.optimizer.param_groups[0]["lr"].copy_(self._near * self._rate)
        self._descend(self.optimizer)

    def _descend(self, optimizer: torch.optim.Optimizer) -> None:
        parameters = optimizer.param_groups[0]["params"]
        nn.utils.clip_grad_norm_(parameters, self.options.max_gradient_norm)
        optimizer.step()

    def _weigh(self) -> None:
        """Find the weights of the parts of a pass, where several processes share them."""
        if self.ranks.together:
            self._weigh_own()
            self.ranks.reduce([self._weights])

    def _weigh_parts(self) -> None:
        """Add up the weights of worlds and of rules' rows in each part of a pass."""
        acted = [self.memory.round.acted]
        for part in range(self._minibatches.count):
            (worlds,) = self._worlds(part, acted)
            rows = torch.cat([own for (own,) in self._rows(part, acted)])
            weights = worlds.sum(), self._gain_weights(rows).sum()
            self._weights[part].copy_(torch.stack(weights))

    def _weight(self, weights: Tensor, column: int) -> Tensor:
        """Return the sum of a part's weights; of several processes, its mean over them."""
        return self._weights[self._part, column] if self.ranks.together else weights.sum()

    def _worlds(self, part: int, values: Sequence[Tensor]) -> list[Tensor]:
        """Return the worlds of a part that the critic learns from, of values [M, N, ...] each."""
        order = self._minibatches.parts[-1][part]
        return [value[order] for value in values]

    def _rows(self, part: int, values: Sequence[Tensor]) -> list[list[Tensor]]:
        """Return the rows that rules learn from: worlds as well, or particles of each species."""
        orders = [parts[part] for parts in self._minibatches.parts[:-1]]
        if self.options.ratio == "world":
            return [[value[order] for value in values] for order in orders]
        rows, count = [], self.memory.acted.shape[2]
        for span, order in zip(self.actor.rules.spans, orders, strict=True):
            own = span.stop - span.start
            whole = own == count
            index = order if whole else order // own * count + span.start + order % own
            rows.append([value.flatten(0, 1)[index] for value in values])
        return rows

    def _gain_weights(self, acted: Tensor) -> Tensor:
        return acted.amax(dim=1, keepdim=True) if self.options.ratio == "world" else acted

    def _gain(self, part: list[Round]) -> Tensor:
        """Return the clipped gain of the rules, and note how far actions have moved [nats]."""
        options, actor = self.options, self.actor
        if options.ratio == "world":
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
        moved = (acted * (torch.expm1(log_ratio) - log_ratio)).sum().detach()
        self._moved.copy_(torch.stack((moved, acted.sum())))
        if options.ratio == "world":
            log_ratio = over_particles(log_ratio, acted)
        weights = self._gain_weights(acted)
        total = self._weight(weights, 1)
        gain = clipped_gain(log_ratio, advantages, weights, total, clip=options.largest_change)
        if options.entropy_weight:
            gain = gain + options.entropy_weight * actor.entropy()
        return gain


class Round(NamedTuple):
    """T steps of B worlds of N particles, flat: M = T B worlds, one after the other."""

    observations: Tensor
    """Perceptions, shape [M, N, P]."""
    actions: Tensor
    """Actions, not clipped, shape [M, N, A]."""
    log_probs: Tensor
    """Their log-probabilities when they were drawn, shape [M, N]."""
    advantages: Tensor
    """Advantages over the critic's values and over other worlds in the same step, standardised,
    shape [M, N], or [M, 1] where a world has one."""
    targets: Tensor
    """Targets of the critic, shape [M, N]."""
    acted: Tensor
    """1 where a particle's species was alive, else 0, shape [M, N]."""


class Memory:
    """Tensors of a round, which the next round overwrites: recorded work reads them in place.

    A particle has an advantage of its own where `own_advantages`; else a world has one. Shapes are
    [T, B, N], where nothing else is said; the fields of `Round` are as there.
    """

    def __init__(
        self, steps: int, observation: Tensor, action_dim: int, *, own_advantages: bool
    ) -> None:
        worlds, particles = observation.shape[:2]

        def zeros(*shape: int, dtype: torch.dtype = observation.dtype) -> Tensor:
            return observation.new_zeros(*shape, dtype=dtype)

        single = (steps, worlds, particles)
        self.seen = zeros(steps + 1, *observation.shape)
        """Observations before each step, and after the last one, shape [T + 1, B, N, P]."""
        self.seen[-1].copy_(observation)
        self.actions = zeros(*single, action_dim)
        self.log_probs, self.acted, self.targets = (zeros(*single) for _ in range(3))
        self.rewards = zeros(*single)
        self.terminated, self.ended = (zeros(*single, dtype=torch.bool) for _ in range(2))
        """Whether a particle's episode ended by itself in a step; and whether it ended at all."""
        self.values = zeros(steps + 1, worlds, particles)
        """The critic's values of `seen`, shape [T + 1, B, N]."""
        self.following = zeros(*single)
        """Its values of the states after each step, before any restart."""
        self.advantages = zeros(steps, worlds, particles if own_advantages else 1)

    @property
    def round(self) -> Round:
        """The round, as views."""
        kept = (self.actions, self.log_probs, self.advantages, self.targets, self.acted)
        return Round(*(part.flatten(0, 1) for part in (self.seen[:-1], *kept)))


def generalised_advantages(
    rewards: Tensor,
    values: Tensor,
    following: Tensor,
    terminated: Tensor,
    ended: Tensor,
    *,
    gamma: float,
    gae_lambda: float,
) -> Tensor:
    """Return advantages: discounted sums of rewards and of changes of value, within episodes.

    An episode that terminated has no value afterwards; one that was cut off has the critic's. All
    have shape [T, ...]: `values` are of the states before each step, `following` of those after it,
    before any restart; `ended` is where an episode terminated or was cut off. Source: Schulman et
    al., arXiv 1506.02438, equation 16.
    """
    surprises = rewards + gamma * following.masked_fill(terminated, 0.0) - values
    discounts = (gamma * gae_lambda) * (~ended).to(rewards.dtype)
    advantages = torch.empty_like(surprises)
    later = torch.zeros_like(surprises[0])
    for step in reversed(range(len(surprises))):
        later = surprises[step] + discounts[step] * later
        advantages[step] = later
    return advantages


def over_particles(values: Tensor, weights: Tensor) -> Tensor:
    """Return means of values [..., N] by weights of at least 0, 0 where all are 0; [..., 1]."""
    total = (values * weights).sum(dim=-1, keepdim=True)
    return total / weights.sum(dim=-1, keepdim=True).clamp(min=1e-8)


def standardised(values: Tensor, weights: Tensor, ranks: Ranks = ALONE) -> Tensor:
    """Return numbers less each step's weighted mean, in units of the standard deviation of all.

    A step's mean over all worlds depends on how far an episode has come, which a critic learns only
    with time. A single world is compared with its own other steps. Values have shape [T, B, N], or
    [T, B, 1] for one number a world, weights [T, B, N]; means and deviation are over the worlds of
    all processes.
    """
    shares = weights if values.shape == weights.shape else weights.amax(-1, True)
    alike = (1, 2) if values.shape[1] * ranks.count > 1 else (0, 1, 2)
    means, totals = (part.sum(alike, keepdim=True) for part in (values * shares, shares))
    ranks.reduce([means, totals])
    centred = shares * (values - means / totals.clamp(min=1e-8))
    square, total = centred.square().sum(), shares.sum()
    ranks.reduce([square, total])
    return centred / (square / total.clamp(min=1e-8) + 1e-16).sqrt()


def clipped_gain(
    log_ratio: Tensor, advantages: Tensor, weights: Tensor, total: Tensor, *, clip: float
) -> Tensor:
    """Return the weighted mean of min(r A, clip(r) A), for r the ratio of likelihoods to before.

    All have shape [M, N], or [M, 1] for one ratio a world; ratios count up to 1 ± `clip`. `total`
    is the sum of all weights, or its mean over the processes whose gradients are averaged.
    Source: Schulman et al., arXiv 1707.06347, equation 7.
    """
    ratio = log_ratio.exp()
    clipped = ratio.clamp(1.0 - clip, 1.0 + clip)
    gain = torch.minimum(ratio * advantages, clipped * advantages)
    return (weights * gain).sum() / total.clamp(min=1.0)


def world_count(
    problem: Problem,
    options: PPOOptions,
    device: torch.device,
    budget: Budget,
    ranks: Ranks = ALONE,
) -> int:
    """Return the worlds B of all processes: those of the options, or by default the problem's.

    On a GPU the default is about `MANY_PARTICLES` particles for each process, if memory and budget
    allow, and never fewer worlds than the problem's.
    """
    if options.worlds is not None:
        return options.worlds
    if device.type != "cuda":
        return problem.num_envs
    counts = [MANY_PARTICLES // problem.particle_count, WORLDS_PER_SEED // ranks.count]
    free = free_bytes(device)
    if free is not None:
        counts.append(int(ROOM * free) // world_bytes(problem, options, device))
    if budget.particle_steps is not None:
        round_size = ranks.count * options.steps * problem.particle_count
        counts.append(budget.particle_steps // (FEWEST_ROUNDS * round_size))
    return max(problem.num_envs, ranks.count * min(counts))


def world_bytes(problem: Problem, options: PPOOptions, device: torch.device) -> int:
    """Return about the memory of a world, its rounds and its part in learning [bytes]."""
    interface, count = problem.interface, problem.particle_count
    columns = interface.perception_dim + interface.action_dim
    # Each step keeps observations, actions and rewards; those of a minibatch also gradients.
    kept = (options.steps + 1) * (columns + interface.action_dim + 16)
    hidden = 4 * problem.hidden_dim + 8 * options.critic_width
    learned = -(-options.steps // options.minibatches) * (2 * columns + hidden)
    return needed_bytes(1, count, problem.physics, device) + 4 * count * (kept + learned)
