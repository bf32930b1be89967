"""Proximal policy optimisation (PPO) whose worlds, rollouts and updates are tensors on the device.

Source: Schulman et al., arXiv 1707.06347. A round is `steps` steps of all worlds, then `epochs`
passes over them in minibatches of particles. Read `PPOLearner.play` and `improve` first, then the
formulas at the end of the file. Actor, critic and minibatches are in `actor_critic.py`.

The CPU reads one byte a world in each step (whether its episode ended) and one number a pass. On
CUDA most work is recorded once as CUDA graphs, as launching its short kernels one by one takes
longer than running them.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Literal, NamedTuple

import torch
from torch import Tensor, nn

from npa_envs.agents.learning.actor_critic import (
    CRITIC_RATE,
    CRITIC_WIDTH,
    CommonOptions,
    GaussianRules,
    Minibatches,
    find_gradients,
    gradients_of,
    learner_random,
    noise_left,
    seeded_critic,
)
from npa_envs.agents.learning.problem import ROW_REWARDS, WORLDS_PER_SEED, Problem, world_seeds
from npa_envs.agents.learning.progress import Budget, Progress
from npa_envs.agents.learning.rule_set import RuleSet
from npa_envs.checks import check_flag, check_positive, check_word
from npa_envs.envs.core.world_state import free_bytes, needed_bytes
from npa_envs.errors import NPAError
from npa_envs.training.process_group import ALONE, ProcessGroup, registered, restart
from npa_envs.world.cuda_graph import GraphedCallable
from npa_envs.wrappers.base import own_rewards

MANY_PARTICLES = 2**17
"""Particles of all worlds on a GPU by default: fewer take hardly less time."""

MIN_ROUNDS = 128
"""Least rounds in a budget of particle-steps, which limits the default number of worlds."""

MEMORY_FRACTION = 0.25
"""Largest fraction of the free GPU memory to use."""


@dataclass(frozen=True, kw_only=True)
class PPOOptions(CommonOptions):
    """Options of `train`."""

    worlds: int | None = None
    """Worlds B of all processes; None: the problem's `num_envs`, or more on CUDA: 131 072 particles
    on each GPU, if they fit into memory and the particle-steps are enough for 128 rounds."""
    clip: float | None = None
    """Likelihood ratios are clipped to 1 ± this (dimensionless). None: 0.2, or 0.02 with
    `ratio="world"`, where log-ratios are means over many particles."""
    ratio: Literal["particle", "world"] = "particle"
    """One likelihood ratio for each particle, or one for each world: of the mean log-probability
    of its particles."""
    credit: Literal["world", "particle", "marginal"] = "world"
    """Reward of a particle: that of its world; its own part of it; or the difference that its
    action makes to the world's."""
    masked: bool = False
    """Ignore actions in steps that did not update their particles; not with several species."""

    def __post_init__(self) -> None:
        """Check every field; raises NPAError."""
        super().__post_init__()
        check_flag(self, "masked")
        if self.clip is not None:
            check_positive(self, float, "clip")
        if self.worlds is not None:
            check_positive(self, int, "worlds")
        check_word(self, "ratio", ("particle", "world"))
        check_word(self, "credit", ("world", *ROW_REWARDS))
        if self.ratio == "world" and self.credit != "world":
            raise NPAError(
                f"credit={self.credit!r} needs ratio='particle': with ratio='world' there is one "
                "advantage a world"
            )

    @property
    def largest_change(self) -> float:
        """Distance from 1 at which ratios are clipped."""
        if self.clip is not None:
            return self.clip
        return 0.2 if self.ratio == "particle" else 0.02


DEFAULTS = PPOOptions()


def train(progress: Progress, options: PPOOptions = DEFAULTS) -> RuleSet:
    """Return the rules that proximal policy optimisation finds within a budget."""
    problem, device, ranks = progress.problem, progress.device, progress.ranks
    count = ranks.broadcast(world_count(problem, options, device, progress.budget, ranks))
    options = replace(options, worlds=count)
    learner = PPOLearner(progress, options)

    def round_of_ppo() -> int:
        budget_left = 1.0 - progress.share
        learner.play()
        learner.improve(budget_left)
        return learner.round_size

    return progress.run(learner.actor.rules, round_of_ppo, learner)


class PPOLearner:
    """Rules, critic and worlds, which alternately `play` a round and `improve` from it.

    With several processes (`ranks`) each has some of the worlds, which have random streams of their
    own, and gradients, moments and weights are averaged. `_graphed_NAME` runs `_NAME`: on CUDA
    as a CUDA graph, so that it reads and writes attributes and `memory` in place.
    """

    def __init__(self, progress: Progress, options: PPOOptions) -> None:
        problem, device, ranks = progress.problem, progress.device, progress.ranks
        self.options, self.pace, self.ranks = options, options.pace(progress.initial), ranks
        total = problem.num_envs if options.worlds is None else options.worlds
        ranks.check_even("worlds", total)
        indices = ranks.indices(total)
        self.envs = problem.make_envs(
            len(indices),
            device=device,
            row_rewards=None if options.credit == "world" else options.credit,
            tell_updated=options.masked,
            copy=False,
        )
        self.random = learner_random(progress, total, indices)
        rules = progress.first_rules(zero_output=True)
        self.actor = GaussianRules(rules, self.pace.initial_std).to(device)
        self.critic = seeded_critic(progress, problem.interface.perception_dim, options.critic)
        self.modules = {"actor": self.actor, "critic": self.critic}
        # CUDA graphs read the learning rate from a tensor.
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
        self._seed, self._indices, self._total = progress.seed, indices.tolist(), total
        observation = self._worlds_of_part(0)
        self.memory = RoundMemory(
            options.steps,
            observation,
            problem.interface.action_dim,
            own_advantages=options.ratio == "particle",
        )
        self.critic.observe(observation, ranks)
        self.rounds = 0
        self._observation = observation.clone()
        self._action, self._log_prob = (
            part[0].clone() for part in (self.memory.actions, self.memory.log_probs)
        )
        # `_within_kl` is 0 once the rules have moved farther than `target_kl` in a round.
        self._within_kl, self._rules_rate, self._all_acted = torch.ones(3, device=device)
        # One group of rows for each species, or of worlds, for the rules; worlds for the critic.
        rows = (1,) if options.ratio == "world" else problem.counts
        self._minibatches = Minibatches(
            options.steps, len(indices), (*rows, 1), options.minibatches, self.random
        )
        count = self._minibatches.count
        self._current_part = 0
        self._weight_sums: Tensor = self._within_kl.new_zeros(count, 2)
        self._kl_sums = self._within_kl.new_zeros(2)
        # Means over processes are taken between graphs.
        graphed = partial(GraphedCallable, device=device)
        self._graphed_draw_actions = graphed(self._draw_actions, generator=registered(self.random))
        self._graphed_find_values = graphed(self._find_values)
        self._graphed_find_advantages = graphed(
            self._find_advantages, recorded=not ranks.distributed
        )
        pool = torch.cuda.graph_pool_handle() if device.type == "cuda" else None
        self._graphed_sum_weights = graphed(self._sum_weights, pool=pool)
        self._graphed_find_gradients = [
            graphed(self._find_gradients, pool=pool) for _ in range(count)
        ]
        self._graphed_step = graphed(self._step, pool=pool)

    def resume(self, iteration: int, part: int) -> None:
        """Resume after `iteration` rounds, for the `part`-th time, in new worlds."""
        self.rounds = iteration
        self.memory.observations[-1].copy_(self._worlds_of_part(part))

    def _worlds_of_part(self, part: int) -> Tensor:
        seeds = world_seeds(self._seed, self._total, part)
        observation: Tensor
        observation, _ = self.envs.reset(seed=[seeds[k] for k in self._indices])
        return observation

    @property
    def round_size(self) -> int:
        """Particle-steps of a round of all processes, T B N."""
        return self.ranks.count * self.memory.rewards.numel()

    @torch.no_grad()
    def play(self) -> Round:
        """Act for T steps in all worlds, and compute advantages; the next round overwrites them."""
        memory = self.memory
        memory.observations[0].copy_(memory.observations[-1])
        last_observations = {}
        for step in range(self.options.steps):
            self._observation.copy_(memory.observations[step])
            self._graphed_draw_actions()
            memory.actions[step].copy_(self._action)
            memory.log_probs[step].copy_(self._log_prob)
            observation, reward, terminated, truncated, infos = self.envs.step(self._action)
            memory.observations[step + 1].copy_(observation)
            if "final_obs" in infos:
                last_observations[step] = infos["final_obs"]
            shared = self.options.credit == "world"
            memory.rewards[step].copy_(reward[:, None] if shared else own_rewards(infos))
            memory.acted[step].copy_(infos.get("acted", self._all_acted))
            if self.options.masked and "updated" in infos:
                # It describes the step before a restart.
                memory.acted[step].mul_(infos["updated"])
            # A species may end before its world does.
            ended = infos.get("particle_terminated", terminated[:, None])
            memory.terminated[step].copy_(terminated[:, None] | ended)
            memory.ended[step].copy_((terminated | truncated)[:, None] | ended)
        self._graphed_find_values()
        for step, observation in last_observations.items():
            memory.next_values[step].copy_(self.critic(observation))
        self._graphed_find_advantages()
        return memory.round

    @torch.no_grad()
    def _draw_actions(self) -> None:
        restart(self.random)
        action, log_prob = self.actor.sample(self._observation, self.random)
        self._action.copy_(action)
        self._log_prob.copy_(log_prob)

    @torch.no_grad()
    def _find_values(self) -> None:
        """Compute the critic's values of all observations, part by part to save memory."""
        memory, observations = self.memory, self.memory.observations.flatten(0, 1)
        size = -(-len(observations) // self.options.minibatches)
        values = torch.cat([self.critic(part) for part in torch.split(observations, size)])
        memory.values.copy_(values.view_as(memory.values))
        memory.next_values.copy_(memory.values[1:])

    @torch.no_grad()
    def _find_advantages(self) -> None:
        memory, values = self.memory, self.memory.values[:-1]
        advantages = generalised_advantages(
            memory.rewards,
            values,
            memory.next_values,
            memory.terminated,
            memory.ended,
            gamma=self.options.gamma,
            gae_lambda=self.options.gae_lambda,
        )
        memory.targets.copy_(advantages + values)
        if self.options.ratio == "world":
            advantages = over_particles(advantages, memory.acted)
        memory.advantages.copy_(standardised(advantages, memory.acted, self.ranks))

    def improve(self, budget_left: float) -> None:
        """Train rules and critic on the last round.

        Learning rates, and the noise of the next round, fall with the fraction of the budget that
        is left.
        """
        options = self.options
        rules_learn = self.rounds >= self.pace.critic_rounds
        self.rounds += 1
        self.critic.observe(self.memory.observations[:-1], self.ranks)
        self.critic.rescale(self.memory.targets, self.ranks)
        rate = self.optimisers["critic"].param_groups[0]["lr"]
        rate.fill_(CRITIC_RATE * budget_left)
        self._rules_rate.fill_(self.pace.learning_rate * budget_left)
        self._within_kl.fill_(1.0)
        for _ in range(options.epochs):
            self._minibatches.shuffle()
            self._improve_once(rules_learn)
            # The only synchronisation with the device.
            if not bool(self._within_kl):
                break
        self.actor.leave_noise(
            noise_left(budget_left, self.pace.last_noise, options.noise_decay_share)
        )

    def _improve_once(self, rules_learn: bool) -> None:
        """Train on one pass over a round, in the orders of `_minibatches`."""
        self._graphed_sum_weights()
        self.ranks.reduce([self._weight_sums])
        critic = self.optimisers["critic"]
        for part, find_gradients_of_part in enumerate(self._graphed_find_gradients):
            self._current_part = part
            if rules_learn:
                find_gradients_of_part()
                gradients = gradients_of(critic) + gradients_of(self.optimisers["actor"])
                self.ranks.reduce([*gradients, self._kl_sums])
                self._graphed_step()
            else:
                self._find_critic_gradients()
                self.ranks.reduce(gradients_of(critic))
                self._descend(critic)

    def _sum_weights(self) -> None:
        """Sum the weights of the critic's and of the rules' rows in each minibatch of a pass."""
        acted = [self.memory.round.acted]
        for part in range(self._minibatches.count):
            (worlds,) = self._critic_rows(part, acted)
            rows = torch.cat([own for (own,) in self._rule_rows(part, acted)])
            sums = worlds.sum(), self._gain_weights(rows).sum()
            self._weight_sums[part].copy_(torch.stack(sums))

    def _find_gradients(self) -> None:
        self._find_critic_gradients()
        rows = [Round(*own) for own in self._rule_rows(self._current_part, self.memory.round)]
        find_gradients(self.optimisers["actor"], -self._gain(rows))

    def _find_critic_gradients(self) -> None:
        worlds = Round(*self._critic_rows(self._current_part, self.memory.round))
        error = (self.critic(worlds.observations) - worlds.targets) / self.critic.scale
        squares = (worlds.acted * error.square()).sum()
        loss = 0.5 * squares / self._weight_sums[self._current_part, 0].clamp(min=1.0)
        find_gradients(self.optimisers["critic"], loss)

    def _step(self) -> None:
        self._descend(self.optimisers["critic"])
        # Rules that moved too far get the learning rate 0, without a synchronisation.
        moved, count = self._kl_sums
        self._within_kl *= moved / count.clamp(min=1.0) <= self.pace.target_kl
        optimiser = self.optimisers["actor"]
        optimiser.param_groups[0]["lr"].copy_(self._within_kl * self._rules_rate)
        self._descend(optimiser)

    def _descend(self, optimiser: torch.optim.Optimizer) -> None:
        parameters = optimiser.param_groups[0]["params"]
        nn.utils.clip_grad_norm_(parameters, self.options.max_gradient_norm)
        optimiser.step()

    def _critic_rows(self, part: int, values: Sequence[Tensor]) -> list[Tensor]:
        """Return the critic's minibatch `part` of tensors [T B, N, ...]: worlds at some steps."""
        order = self._minibatches.parts[-1][part]
        return [value[order] for value in values]

    def _rule_rows(self, part: int, values: Sequence[Tensor]) -> list[list[Tensor]]:
        """Return the rules' rows of a minibatch: worlds, or particles of each species."""
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
        """Return PPO's clipped objective; write sums of the KL estimate [nats] to `_kl_sums`."""
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
        self._kl_sums.copy_(torch.stack((moved, acted.sum())))
        if options.ratio == "world":
            log_ratio = over_particles(log_ratio, acted)
        weights, total = self._gain_weights(acted), self._weight_sums[self._current_part, 1]
        gain = clipped_gain(log_ratio, advantages, weights, total, clip=options.largest_change)
        if options.entropy_weight:
            gain = gain + options.entropy_weight * actor.entropy()
        return gain


class Round(NamedTuple):
    """T steps of B worlds of N particles, flattened to M = T B worlds."""

    observations: Tensor
    """Perceptions, shape [M, N, P]."""
    actions: Tensor
    """Actions before clipping, shape [M, N, A]."""
    log_probs: Tensor
    """Their log-probabilities when they were drawn, shape [M, N]."""
    advantages: Tensor
    """Standardised advantages, shape [M, N], or [M, 1] with `ratio="world"`."""
    targets: Tensor
    """Targets of the critic, shape [M, N]."""
    acted: Tensor
    """1 where an action counts, 0 where its species had ended or it is masked, shape [M, N]."""


class RoundMemory:
    """Tensors of a round, which the next round overwrites, as CUDA graphs read them in place.

    The default shape is [T, B, N]; for other fields see `Round`. There is an advantage for each
    particle with `own_advantages`, else for each world.
    """

    def __init__(
        self, steps: int, observation: Tensor, action_dim: int, *, own_advantages: bool
    ) -> None:
        worlds, particles = observation.shape[:2]

        def zeros(*shape: int, dtype: torch.dtype = observation.dtype) -> Tensor:
            return observation.new_zeros(*shape, dtype=dtype)

        single = (steps, worlds, particles)
        self.observations = zeros(steps + 1, *observation.shape)
        """Observations before each step, and after the last one, shape [T + 1, B, N, P]."""
        self.observations[-1].copy_(observation)
        self.actions = zeros(*single, action_dim)
        self.log_probs, self.acted, self.targets = (zeros(*single) for _ in range(3))
        self.rewards = zeros(*single)
        self.terminated, self.ended = (zeros(*single, dtype=torch.bool) for _ in range(2))
        """Whether a particle's episode terminated in a step; whether it terminated or truncated."""
        self.values = zeros(steps + 1, worlds, particles)
        """The critic's values of `observations`, shape [T + 1, B, N]."""
        self.next_values = zeros(*single)
        """The critic's values of the states after each step, before any restart."""
        self.advantages = zeros(steps, worlds, particles if own_advantages else 1)

    @property
    def round(self) -> Round:
        """The round, as views."""
        others = (self.actions, self.log_probs, self.advantages, self.targets, self.acted)
        return Round(*(part.flatten(0, 1) for part in (self.observations[:-1], *others)))


def generalised_advantages(
    rewards: Tensor,
    values: Tensor,
    next_values: Tensor,
    terminated: Tensor,
    ended: Tensor,
    *,
    gamma: float,
    gae_lambda: float,
) -> Tensor:
    """Return generalised advantage estimates (Schulman et al., arXiv 1506.02438, equation 16).

    All have shape [T, ...]. `values` are of the states before each step, `next_values` of those
    after it, before any restart; they count as 0 where an episode terminated. `ended`: terminated
    or truncated.
    """
    errors = rewards + gamma * next_values.masked_fill(terminated, 0.0) - values
    discounts = (gamma * gae_lambda) * (~ended).to(rewards.dtype)
    advantages = torch.empty_like(errors)
    later = torch.zeros_like(errors[0])
    for step in reversed(range(len(errors))):
        later = errors[step] + discounts[step] * later
        advantages[step] = later
    return advantages


def over_particles(values: Tensor, weights: Tensor) -> Tensor:
    """Return weighted means of values [..., N] over particles, 0 without weights, [..., 1]."""
    total = (values * weights).sum(dim=-1, keepdim=True)
    return total / weights.sum(dim=-1, keepdim=True).clamp(min=1e-8)


def standardised(values: Tensor, weights: Tensor, ranks: ProcessGroup = ALONE) -> Tensor:
    """Subtract each step's weighted mean from values, and divide by the standard deviation of all.

    Means are by step, as the mean over worlds depends on the step of the episode, which a critic
    learns only slowly; a single world has one mean of all steps. Values have shape [T, B, N] or
    [T, B, 1], weights [T, B, N]. Mean and deviation are over the worlds of all processes.
    """
    weights = weights if values.shape == weights.shape else weights.amax(-1, True)
    dims = (1, 2) if values.shape[1] * ranks.count > 1 else (0, 1, 2)
    means, totals = (part.sum(dims, keepdim=True) for part in (values * weights, weights))
    ranks.reduce([means, totals])
    centred = weights * (values - means / totals.clamp(min=1e-8))
    square, total = centred.square().sum(), weights.sum()
    ranks.reduce([square, total])
    return centred / (square / total.clamp(min=1e-8) + 1e-16).sqrt()


def clipped_gain(
    log_ratio: Tensor, advantages: Tensor, weights: Tensor, total: Tensor, *, clip: float
) -> Tensor:
    """Return the weighted mean of min(r A, clip(r) A) for likelihood ratios r and advantages A.

    All have shape [M, N], or [M, 1] for one ratio a world; clip(r) is in 1 ± `clip`. `total` is
    the sum of the weights, with several processes its mean over them. Source: Schulman et al.,
    arXiv 1707.06347, equation 7.
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
    ranks: ProcessGroup = ALONE,
) -> int:
    """Return the worlds B of all processes, as `PPOOptions.worlds` defines them."""
    if options.worlds is not None:
        return options.worlds
    if device.type != "cuda":
        return problem.num_envs
    counts = [MANY_PARTICLES // problem.particle_count, WORLDS_PER_SEED // ranks.count]
    free = free_bytes(device)
    if free is not None:
        counts.append(int(MEMORY_FRACTION * free) // world_bytes(problem, options, device))
    if budget.particle_steps is not None:
        round_size = ranks.count * options.steps * problem.particle_count
        counts.append(budget.particle_steps // (MIN_ROUNDS * round_size))
    return max(problem.num_envs, ranks.count * min(counts))


def world_bytes(problem: Problem, options: PPOOptions, device: torch.device) -> int:
    """Return about the memory of a world, its part of a round and of its gradients [bytes]."""
    interface, count = problem.interface, problem.particle_count
    columns = interface.perception_dim + interface.action_dim
    # A step stores observations, actions and rewards; a minibatch also gradients.
    stored = (options.steps + 1) * (columns + interface.action_dim + 16)
    hidden = 4 * problem.hidden_dim + 8 * CRITIC_WIDTH
    learned = -(-options.steps // options.minibatches) * (2 * columns + hidden)
    return needed_bytes(1, count, problem.physics, device) + 4 * count * (stored + learned)
