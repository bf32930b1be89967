"""Proximal policy optimisation (PPO) whose worlds, rollouts and updates are tensors on the device.

Source: Schulman et al., arXiv 1707.06347. A round is a rollout of `steps` steps of all worlds, its
advantages (both in `PPOLearner.play`), and `epochs` passes over it in minibatches
(`PPOLearner.improve`). Formulas follow the learner. `actor_critic.py` has actor and critic.

The CPU reads one byte per world in each step (whether its episode ended) and one number per pass.
On CUDA most work is captured once in CUDA graphs, as launching its short kernels one by one takes
longer than running them. `GraphedFunctions` has these functions, with their fixed tensors.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any, Literal, NamedTuple

import torch
from torch import Tensor, nn

from npa_envs.agents.learning.actor_critic import (
    CRITIC_RATE,
    CRITIC_WIDTH,
    CommonOptions,
    GaussianRules,
    Minibatches,
    gradients_of,
    seeded_critic,
    set_gradients,
    worlds_of_process,
)
from npa_envs.agents.learning.problem import WORLDS_PER_SEED, Problem, world_seeds
from npa_envs.agents.learning.progress import Progress
from npa_envs.agents.learning.rule_set import RuleSet
from npa_envs.checks import check_flag, check_positive, check_word
from npa_envs.envs.core.step_report import PARTICLE_REWARDS
from npa_envs.envs.core.world_state import free_bytes, needed_bytes
from npa_envs.errors import NPAError
from npa_envs.training.process_group import (
    ALONE,
    ProcessGroup,
    begin_episodes,
    generator_to_register,
)
from npa_envs.world.cuda_graph import GraphedCallable, WeakFunction
from npa_envs.wrappers.base import own_rewards

MANY_PARTICLES = 2**17
"""Default number of particles of all worlds on a GPU: fewer take hardly less time."""

MIN_ROUNDS = 128
"""Minimum number of rounds in a budget of particle-steps, which limits the default of worlds."""

MEMORY_FRACTION = 0.25
"""Largest fraction of the free GPU memory that the default number of worlds uses."""


@dataclass(frozen=True, kw_only=True)
class PPOOptions(CommonOptions):
    """Options of PPO on the device."""

    num_envs: int | None = None
    """Worlds B of all processes; None: the problem's `num_envs`, or more on CUDA: 131 072 particles
    on each GPU, if they fit into memory and the particle-steps are enough for 128 rounds."""
    clip: float | None = None
    """Likelihood ratios are clipped to 1 ± this (dimensionless). None: 0.2, or 0.02 with
    `ratio="world"`, where log-ratios are means over many particles."""
    ratio: Literal["particle", "world"] = "particle"
    """One likelihood ratio per particle, or per world: of its particles' mean log-probability."""
    particle_rewards: str | None = None
    """Reward of each particle: "particle", its own part of its world's reward; "marginal", the
    difference that its action makes to the world's. None: its world's reward."""
    masked: bool = False
    """Ignore actions of particles that the update mask left out; not with several species."""

    def __post_init__(self) -> None:
        super().__post_init__()
        check_flag(self, "masked")
        if self.clip is not None:
            check_positive(self, float, "clip")
        if self.num_envs is not None:
            check_positive(self, int, "num_envs")
        check_word(self, "ratio", ("particle", "world"))
        check_word(self, "particle_rewards", (None, *PARTICLE_REWARDS))
        if self.ratio == "world" and self.particle_rewards is not None:
            raise NPAError(
                f"particle_rewards={self.particle_rewards!r} needs ratio='particle': with "
                "ratio='world' there is one advantage per world"
            )

    @property
    def clip_range(self) -> float:
        """`clip`, or the default for `ratio` if it is None (dimensionless)."""
        if self.clip is not None:
            return self.clip
        return 0.02 if self.ratio == "world" else 0.2


def train(progress: Progress, options: PPOOptions = PPOOptions()) -> RuleSet:
    """Return the rules that proximal policy optimisation learns within the budget."""
    count = progress.processes.broadcast(total_num_envs(progress, options))
    learner = PPOLearner(progress, replace(options, num_envs=count))

    def iteration() -> int:
        remaining_budget = 1.0 - progress.spent_fraction
        learner.play()
        learner.improve(remaining_budget)
        return count * options.steps * progress.problem.particle_count

    return progress.run(learner.actor.rules, iteration, learner)


class Round(NamedTuple):
    """What PPO learns from: T steps of B worlds of N particles, in the order of steps.

    A minibatch has the same fields, with some of the T B worlds, or [K, ...] of K single particles.
    """

    observations: Tensor
    """Perceptions, shape [T B, N, P]."""
    actions: Tensor
    """Actions before they are clipped to the action space, shape [T B, N, A]."""
    log_probs: Tensor
    """Log-probabilities of the actions by the rules that drew them [nats], shape [T B, N]."""
    advantages: Tensor
    """Standardised advantages, dimensionless, shape [T B, N], or [T B, 1] with `ratio="world"`."""
    targets: Tensor
    """Targets of the critic, in units of the rewards, shape [T B, N]."""
    acted: Tensor
    """1 where an action counts; 0 where its species had ended or it is masked; shape [T B, N]."""


class RoundBuffers:
    """Tensors of a round, T steps of B worlds of N particles; each round overwrites them in place.

    At first the worlds have the observations `observation`, shape [B, N, P].
    """

    def __init__(self, options: PPOOptions, observation: Tensor, action_dim: int) -> None:
        steps, (worlds, particles) = options.steps, observation.shape[:2]
        single, zeros = (steps, worlds, particles), observation.new_zeros
        self.observations = zeros(steps + 1, *observation.shape)
        """Observations before each step, and after the last one, shape [T + 1, B, N, P]."""
        self.observations[-1].copy_(observation)
        self.actions = zeros(*single, action_dim)
        """Actions before they are clipped to the action space, shape [T, B, N, A]."""
        self.log_probs = zeros(single)
        """Log-probabilities of the actions [nats], shape [T, B, N]."""
        self.rewards = zeros(single)
        """Rewards of the steps, shape [T, B, N]."""
        self.acted = torch.ones_like(self.rewards)
        """1 where an action counts, else 0, shape [T, B, N]."""
        self.terminated = zeros(single, dtype=torch.bool)
        """Whether a particle's episode terminated in a step, shape [T, B, N]."""
        self.ended = zeros(single, dtype=torch.bool)
        """Whether it terminated or was truncated, shape [T, B, N]."""
        self.values = zeros(steps + 1, worlds, particles)
        """The critic's values of `observations`, shape [T + 1, B, N]."""
        self.next_values = zeros(single)
        """Values of the observations after each step, before any restart, shape [T, B, N]."""
        self.advantages = zeros(steps, worlds, 1 if options.ratio == "world" else particles)
        """Standardised advantages, shape [T, B, N], or [T, B, 1] with `ratio="world"`."""
        self.targets = zeros(single)
        """Targets of the critic, shape [T, B, N]."""
        parts = (self.actions, self.log_probs, self.advantages, self.targets, self.acted)
        self.round = Round(*(part.flatten(0, 1) for part in (self.observations[:-1], *parts)))
        """These tensors as a `Round`."""
        self.within_kl = zeros(())
        """1, or 0 once the rules have moved farther than `target_kl` in a round, shape []."""
        self.rules_rate = zeros(())
        """Learning rate of the rules while `within_kl` is 1, shape []."""


class PPOLearner:
    """Rules, critic and worlds, which alternately `play` a round and `improve` from it.

    Each of several processes has some worlds; they average gradients, moments and sums of weights.
    """

    def __init__(self, progress: Progress, options: PPOOptions) -> None:
        problem, device = progress.problem, progress.device
        self.options, self.schedule = options, options.schedule(progress.initial)
        self.processes, self._seed = progress.processes, progress.seed
        self._total = problem.num_envs if options.num_envs is None else options.num_envs
        self._indices, self.random = worlds_of_process(progress, self._total)
        self.envs = problem.make_envs(
            len(self._indices),
            device=device,
            particle_rewards=options.particle_rewards,
            tell_updated=options.masked,
            copy=False,
        )
        rules = progress.first_rules(zero_output=True)
        self.actor = GaussianRules(rules, self.schedule.initial_std).to(device)
        self.critic = seeded_critic(progress, problem.interface.perception_dim, options.critic)
        self.modules = {"actor": self.actor, "critic": self.critic}
        self.optimisers = {
            name: torch.optim.Adam(
                net.parameters(),
                # CUDA graphs read the learning rate from a tensor.
                lr=torch.zeros((), device=device),
                eps=1e-5,
                fused=True,
                capturable=device.type == "cuda",
            )
            for name, net in self.modules.items()
        }
        self.rounds = 0
        # One group of rows for each species, or of worlds, for the rules; worlds for the critic.
        groups = (1,) if options.ratio == "world" else problem.counts
        self.minibatches = Minibatches(
            options.steps, len(self._indices), (*groups, 1), options.minibatches, self.random
        )
        observation = self._reset_worlds(0)
        self.critic.observe(observation, self.processes)
        self.buffers = RoundBuffers(options, observation, problem.interface.action_dim)
        self.graphed = GraphedFunctions(self)

    def resume(self, iteration: int, resumption: int) -> None:
        """Begin new worlds after `iteration` rounds; `resumption`: number of resumes so far."""
        self.rounds = iteration
        self.buffers.observations[-1].copy_(self._reset_worlds(resumption))

    def _reset_worlds(self, resumption: int) -> Tensor:
        seeds = world_seeds(self._seed, self._total, resumption)
        observation: Tensor = self.envs.reset(seed=[seeds[k] for k in self._indices])[0]
        return observation

    @torch.no_grad()
    def play(self) -> Round:
        """Roll out T steps of all worlds, and estimate advantages; return views of the buffers."""
        buffers, graphed = self.buffers, self.graphed
        buffers.observations[0].copy_(buffers.observations[-1])
        last_observations = []
        for step in range(self.options.steps):
            action, log_prob = graphed.draw_actions(buffers.observations[step])
            buffers.actions[step].copy_(action)
            buffers.log_probs[step].copy_(log_prob)
            last_observations.append(self._step_worlds(step, action))
        values, next_values = graphed.compute_values(buffers.observations)
        # `observations` has the first ones of the next episodes in place of these.
        for step, observation in enumerate(last_observations):
            if observation is not None:
                next_values[step].copy_(self.critic(observation))
        rewards, ends = buffers.rewards, (buffers.terminated, buffers.ended)
        graphed.compute_advantages(rewards, values, next_values, *ends, buffers.acted)
        return buffers.round

    def _step_worlds(self, step: int, action: Tensor) -> Tensor | None:
        """Apply actions [B, N, A], and write the results of the step into the buffers.

        Return the last observations of episodes, [B, N, P], where one ended; None if none did.
        """
        buffers = self.buffers
        observation, reward, terminated, truncated, infos = self.envs.step(action)
        # Flags and rewards of worlds, [B, 1], are those of all of their particles.
        terminated, ended = terminated[:, None], (terminated | truncated)[:, None]
        # A species may end before its world does.
        if (own_end := infos.get("particle_terminated")) is not None:
            terminated, ended = terminated | own_end, ended | own_end
        # Both describe the step before a restart.
        if (acted := infos.get("acted", infos.get("updated"))) is not None:
            buffers.acted[step].copy_(acted)
        buffers.observations[step + 1].copy_(observation)
        own = self.options.particle_rewards is not None
        buffers.rewards[step].copy_(own_rewards(infos) if own else reward[:, None])
        buffers.terminated[step].copy_(terminated)
        buffers.ended[step].copy_(ended)
        last: Tensor | None = infos.get("final_obs")
        return last

    @torch.no_grad()
    def draw_actions(self, observation: Tensor) -> tuple[Tensor, Tensor]:
        """Return random actions [B, N, A] and their log-probabilities [B, N]."""
        begin_episodes(self.random)
        return self.actor.sample(observation, self.random)

    @torch.no_grad()
    def compute_values(self, observations: Tensor) -> tuple[Tensor, Tensor]:
        """Return `values` of observations, and `next_values` as if no episode ended."""
        flat = observations.flatten(0, 1)
        # Chunks save memory.
        chunks = torch.split(flat, -(-len(flat) // self.options.minibatches))
        values = torch.cat([self.critic(chunk) for chunk in chunks]).view(observations.shape[:-1])
        return values, values[1:]

    @torch.no_grad()
    def compute_advantages(
        self,
        rewards: Tensor,
        values: Tensor,
        next_values: Tensor,
        terminated: Tensor,
        ended: Tensor,
        acted: Tensor,
    ) -> tuple[Tensor, Tensor]:
        """Return standardised advantages, and targets of the critic, as in `RoundBuffers`."""
        gamma, gae_lambda, values = self.options.gamma, self.options.gae_lambda, values[:-1]
        advantages = generalised_advantages(
            rewards, values, next_values, terminated, ended, gamma=gamma, gae_lambda=gae_lambda
        )
        targets = advantages + values
        if self.options.ratio == "world":
            advantages = particle_means(advantages, acted)
        return standardised(advantages, acted, self.processes), targets

    def improve(self, remaining_budget: float) -> None:
        """Train rules and critic by `epochs` passes over the last round.

        Learning rates and the next round's noise fall with the remaining fraction of the budget.
        """
        schedule, buffers, graphed = self.schedule, self.buffers, self.graphed
        batch, within_kl, rules_rate = buffers.round, buffers.within_kl, buffers.rules_rate
        critic, actor = (self.optimisers[name] for name in ("critic", "actor"))
        rules_learn = self.rounds >= schedule.critic_rounds
        self.rounds += 1
        self.critic.observe(buffers.observations[:-1], self.processes)
        self.critic.rescale(buffers.targets, self.processes)
        critic.param_groups[0]["lr"].fill_(CRITIC_RATE * remaining_budget)
        rules_rate.fill_(schedule.learning_rate * remaining_budget)
        within_kl.fill_(1.0)
        for _ in range(self.options.epochs):
            self.minibatches.shuffle()
            (weight_sums,) = graphed.sum_weights(batch.acted)
            self.processes.reduce([weight_sums])
            for minibatch in range(self.minibatches.count):
                if rules_learn:
                    (kl_sums,) = graphed.compute_gradients[minibatch](weight_sums, *batch)
                    self.processes.reduce([*gradients_of(critic), *gradients_of(actor), kl_sums])
                    graphed.descend_both(kl_sums, rules_rate, within_kl)
                else:
                    self._compute_critic_gradients(minibatch, weight_sums, batch)
                    self.processes.reduce(gradients_of(critic))
                    self._descend(critic)
            # The only synchronisation with the device.
            if not bool(within_kl):
                break
        self.actor.set_noise(self.options.noise_factor(remaining_budget, schedule.last_noise))

    def sum_weights(self, acted: Tensor) -> tuple[Tensor]:
        """Return each minibatch's sums of `acted`: the critic's, the rules'; [minibatches, 2]."""
        sums = []
        for minibatch, critic_index in enumerate(self.minibatches.indices[-1]):
            rows = torch.cat([group for (group,) in self._rule_rows(minibatch, [acted])])
            sums += [acted[critic_index].sum(), self._ratio_weights(rows).sum()]
        return (torch.stack(sums).view(-1, 2),)

    def compute_gradients(
        self, minibatch: int, weight_sums: Tensor, *fields: Tensor
    ) -> tuple[Tensor]:
        """Write the gradients of critic and rules for a minibatch of the round of these `fields`.

        Return the sums of the minibatch's KL estimates [nats] and of their weights, shape [2].
        """
        batch = Round(*fields)
        self._compute_critic_gradients(minibatch, weight_sums, batch)
        objective, kl_sums = self._objective(minibatch, weight_sums, batch)
        set_gradients(self.optimisers["actor"], -objective)
        return (kl_sums,)

    def _compute_critic_gradients(self, minibatch: int, weight_sums: Tensor, batch: Round) -> None:
        index = self.minibatches.indices[-1][minibatch]
        worlds = Round(*(values[index] for values in batch))
        error = (self.critic(worlds.observations) - worlds.targets) / self.critic.scale
        squares = (worlds.acted * error.square()).sum()
        loss = 0.5 * squares / weight_sums[minibatch, 0].clamp(min=1.0)
        set_gradients(self.optimisers["critic"], loss)

    def _objective(
        self, minibatch: int, weight_sums: Tensor, batch: Round
    ) -> tuple[Tensor, Tensor]:
        """Return PPO's clipped objective of a minibatch, shape [], and its KL sums, shape [2]."""
        options, actor = self.options, self.actor
        groups = [Round(*rows) for rows in self._rule_rows(minibatch, batch)]
        if options.ratio == "world":
            (worlds,) = groups
            log_probs = [actor.log_prob(worlds.observations, worlds.actions)]
        else:
            log_probs = [
                actor.row_log_prob(species, rows.observations, rows.actions)
                for species, rows in enumerate(groups)
            ]
        log_ratio = torch.cat(
            [new - rows.log_probs for new, rows in zip(log_probs, groups, strict=True)]
        )
        advantages, acted = (
            torch.cat([getattr(rows, name) for rows in groups]) for name in ("advantages", "acted")
        )
        divergence = (acted * (torch.expm1(log_ratio) - log_ratio)).sum().detach()
        kl_sums = torch.stack((divergence, acted.sum()))
        if options.ratio == "world":
            log_ratio = particle_means(log_ratio, acted)
        weights, total = self._ratio_weights(acted), weight_sums[minibatch, 1]
        objective = clipped_objective(
            log_ratio, advantages, weights, total, clip=options.clip_range
        )
        if options.entropy_weight:
            objective = objective + options.entropy_weight * actor.entropy()
        return objective, kl_sums

    def descend_both(self, kl_sums: Tensor, rules_rate: Tensor, within_kl: Tensor) -> tuple[Tensor]:
        """Step the critic, and rules while `within_kl` is 1; update `within_kl` and return it."""
        self._descend(self.optimisers["critic"])
        # Rules that moved too far get the learning rate 0, without a synchronisation.
        divergence, count = kl_sums
        within_kl.mul_(divergence / count.clamp(min=1.0) <= self.schedule.target_kl)
        optimiser = self.optimisers["actor"]
        optimiser.param_groups[0]["lr"].copy_(within_kl * rules_rate)
        self._descend(optimiser)
        return (within_kl,)

    def _descend(self, optimiser: torch.optim.Optimizer) -> None:
        parameters = optimiser.param_groups[0]["params"]
        nn.utils.clip_grad_norm_(parameters, self.options.max_gradient_norm)
        optimiser.step()

    def _rule_rows(self, minibatch: int, values: Sequence[Tensor]) -> list[list[Tensor]]:
        """Return the rules' minibatch of tensors [T B, N, ...], group by group.

        A group is K particles of a species, [K, ...], or with `ratio="world"` some of the worlds.
        """
        indices = [group[minibatch] for group in self.minibatches.indices[:-1]]
        if self.options.ratio == "world":
            return [[value[index] for value in values] for index in indices]
        rows, total = [], self.actor.rules.spans[-1].stop
        for span, index in zip(self.actor.rules.spans, indices, strict=True):
            count = span.stop - span.start
            if count < total:
                index = index // count * total + span.start + index % count
            rows.append([value.flatten(0, 1)[index] for value in values])
        return rows

    def _ratio_weights(self, acted: Tensor) -> Tensor:
        """Return the weight of each likelihood ratio: `acted`, or 1 for worlds where any acted."""
        return acted.amax(dim=1, keepdim=True) if self.options.ratio == "world" else acted


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

    All tensors have one shape, [T, ...]. `values` are the critic's before each step, `next_values`
    those after it, before any restart; they count as 0 where an episode `terminated` in the step.
    `ended`: it terminated or was truncated.
    """
    errors = rewards + gamma * next_values.masked_fill(terminated, 0.0) - values
    discounts = (gamma * gae_lambda) * (~ended).to(rewards.dtype)
    advantages = torch.empty_like(errors)
    later = torch.zeros_like(errors[0])
    for step in reversed(range(len(errors))):
        later = errors[step] + discounts[step] * later
        advantages[step] = later
    return advantages


def particle_means(values: Tensor, weights: Tensor) -> Tensor:
    """Return weighted means [..., 1] of values [..., N] of particles; 0 where all weights are 0."""
    total = (values * weights).sum(dim=-1, keepdim=True)
    return total / weights.sum(dim=-1, keepdim=True).clamp(min=1e-8)


def standardised(values: Tensor, weights: Tensor, processes: ProcessGroup = ALONE) -> Tensor:
    """Return values minus their weighted mean at each step, over the standard deviation of all.

    The mean of a step is over its worlds: it depends on the step of the episode, which a critic
    learns only slowly. A single world has one mean over all steps. Values have shape [T, B, N] or
    [T, B, 1], weights [T, B, N]. Mean and deviation are over the worlds of all processes.
    """
    weights = weights if values.shape == weights.shape else weights.amax(-1, True)
    dims = (1, 2) if values.shape[1] * processes.count > 1 else (0, 1, 2)
    means, totals = (sums.sum(dims, keepdim=True) for sums in (values * weights, weights))
    processes.reduce([means, totals])
    centred = weights * (values - means / totals.clamp(min=1e-8))
    square, total = centred.square().sum(), weights.sum()
    processes.reduce([square, total])
    return centred / (square / total.clamp(min=1e-8) + 1e-16).sqrt()


def clipped_objective(
    log_ratio: Tensor, advantages: Tensor, weights: Tensor, total: Tensor, *, clip: float
) -> Tensor:
    """Return the weighted mean of min(r A, clip(r) A) for likelihood ratios r and advantages A.

    Logarithms of the ratios, advantages and weights have one shape: [K] for K particles, or [K, 1]
    for K worlds. clip(r) is in 1 ± `clip`. `total` is the sum of the weights, with several
    processes its mean over them. Source: Schulman et al., arXiv 1707.06347, equation 7.
    """
    ratio = log_ratio.exp()
    clipped = ratio.clamp(1.0 - clip, 1.0 + clip)
    gains = torch.minimum(ratio * advantages, clipped * advantages)
    return (weights * gains).sum() / total.clamp(min=1.0)


class GraphedFunction:
    """A method of tensors that runs as a CUDA graph on CUDA, and unchanged on a CPU.

    A graph reads and writes the same tensors in each call. So a call copies its arguments into
    `inputs` and the results into `outputs`, which it returns; a tensor is not copied into itself.
    The method gets `constants` before the inputs. The caller keeps its object alive.
    """

    def __init__(
        self,
        function: Callable[..., tuple[Tensor, ...]],
        inputs: Sequence[Tensor],
        outputs: Sequence[Tensor],
        *constants: Any,
        **options: Any,
    ) -> None:
        self._function, self._constants = WeakFunction(function), constants
        self._inputs, self._outputs = inputs, outputs
        self._graph = GraphedCallable(self._run, **options)

    def __call__(self, *arguments: Tensor) -> Sequence[Tensor]:
        """Return the results for arguments; the next call overwrites them."""
        _copy_each(arguments, self._inputs)
        self._graph()
        return self._outputs

    def _run(self) -> None:
        _copy_each(self._function()(*self._constants, *self._inputs), self._outputs)


def _copy_each(sources: Sequence[Tensor], targets: Sequence[Tensor]) -> None:
    for source, target in zip(sources, targets, strict=True):
        if source is not target:
            target.copy_(source)


class GraphedFunctions:
    """Methods of a `PPOLearner` of the same names, as graphs with their inputs and outputs."""

    def __init__(self, learner: PPOLearner) -> None:
        buffers, count = learner.buffers, learner.minibatches.count
        device, zeros = buffers.values.device, buffers.values.new_zeros
        graph = partial(GraphedFunction, device=device)
        self.draw_actions = graph(
            learner.draw_actions,
            [torch.zeros_like(buffers.observations[0])],
            [torch.zeros_like(part[0]) for part in (buffers.actions, buffers.log_probs)],
            generator=generator_to_register(learner.random),
        )
        values = [buffers.values, buffers.next_values]
        self.compute_values = graph(learner.compute_values, [buffers.observations], values)
        self.compute_advantages = graph(
            learner.compute_advantages,
            [buffers.rewards, *values, buffers.terminated, buffers.ended, buffers.acted],
            [buffers.advantages, buffers.targets],
            captured=not learner.processes.distributed,
        )
        # Updates share memory.
        pool = torch.cuda.graph_pool_handle() if device.type == "cuda" else None
        graph, batch = partial(graph, pool=pool), buffers.round
        weight_sums, kl_sums, within_kl = zeros(count, 2), zeros(2), buffers.within_kl
        self.sum_weights = graph(learner.sum_weights, [batch.acted], [weight_sums])
        self.compute_gradients = [
            graph(learner.compute_gradients, [weight_sums, *batch], [kl_sums], minibatch)
            for minibatch in range(count)
        ]
        self.descend_both = graph(
            learner.descend_both, [kl_sums, buffers.rules_rate, within_kl], [within_kl]
        )


def total_num_envs(progress: Progress, options: PPOOptions) -> int:
    """Return the number of worlds B of all processes, as `PPOOptions.num_envs` defines it."""
    problem, device, budget = progress.problem, progress.device, progress.budget
    if options.num_envs is not None:
        return options.num_envs
    if device.type != "cuda":
        return problem.num_envs
    process_count = progress.processes.count
    counts = [MANY_PARTICLES // problem.particle_count, WORLDS_PER_SEED // process_count]
    free = free_bytes(device)
    if free is not None:
        counts.append(int(MEMORY_FRACTION * free) // world_bytes(problem, options, device))
    if budget.particle_steps is not None:
        round_size = process_count * options.steps * problem.particle_count
        counts.append(budget.particle_steps // (MIN_ROUNDS * round_size))
    return max(problem.num_envs, process_count * min(counts))


def world_bytes(problem: Problem, options: PPOOptions, device: torch.device) -> int:
    """Return an estimate of the memory of a world, its steps in a round and gradients [bytes]."""
    interface, count = problem.interface, problem.particle_count
    columns = interface.perception_dim + interface.action_dim
    # A step stores observations, actions and rewards; a minibatch also gradients.
    stored = (options.steps + 1) * (columns + interface.action_dim + 16)
    hidden = 4 * problem.hidden_dim + 8 * CRITIC_WIDTH
    learned = -(-options.steps // options.minibatches) * (2 * columns + hidden)
    return needed_bytes(1, count, problem.physics, device) + 4 * count * (stored + learned)
