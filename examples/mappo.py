"""MAPPO: agents with policies of what each perceives, and a critic that sees the whole world.

    pip install 'npa-envs[envs]'
    python examples/mappo.py particles  # 64 particles of two species mix, by one shared policy
    python examples/mappo.py gardeners  # a keeper and a raider, each by a policy of its own

PettingZoo's parallel environments give and take dictionaries. Agents of one group share a policy.
"""

import argparse
import json
from pathlib import Path

import numpy as np
import torch
from torch import nn
from torch.distributions import Normal

from npa_envs.envs import gardeners_v0, particles_v0

parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
parser.add_argument("env", choices=["particles", "gardeners"])
parser.add_argument("--steps", type=int, default=8_192)
parser.add_argument("--curve", type=Path, help="to write; default: mappo_ENV.json")
given = parser.parse_args()

ROLLOUT, EPOCHS, PARTS, GAMMA, LAMBDA, CLIP, RATE = 256, 4, 8, 0.9, 0.95, 0.2, 1e-3

torch.set_num_threads(1)  # small worlds; a busy machine does not slow them down
torch.manual_seed(0)
if given.env == "particles":  # the world of npa/MixingSmall-v0
    world = {"particle_count": 64, "state_dim": 4, "state_scale": 0.1, "eps": 0.2, "eps0": 0.2}
    env = particles_v0.parallel_env("mixing", perception="per_species", max_cycles=32, **world)
    rows_of = {"particles": list(range(64))}
else:  # the brushes of npa/Gardener2DSmall-v0
    env = gardeners_v0.parallel_env(max_cycles=32, particle_count=256, push_length=0.1)
    rows_of = {"keeper": [0], "raider": [1]}
agents = env.possible_agents
observed = env.observation_space(agents[0]).shape[0]
acted = env.action_space(agents[0]).shape[0]


class Group(nn.Module):
    """An actor of what an agent observes, and a critic that also sees all particles' states."""

    def __init__(self):
        super().__init__()
        self.mean = nn.Sequential(nn.Linear(observed, 64), nn.Tanh(), nn.Linear(64, acted))
        self.log_std = nn.Parameter(-torch.ones(acted))
        self.particle = nn.Sequential(nn.Linear(env.state_space.shape[1], 64), nn.ReLU())
        self.value = nn.Sequential(nn.Linear(64 + observed, 64), nn.Tanh(), nn.Linear(64, 1))
        nn.init.zeros_(self.mean[-1].weight)
        self.optimiser = torch.optim.Adam(self.parameters(), lr=RATE)

    def actions(self, seen):
        return Normal(self.mean(seen), self.log_std.exp())

    def values(self, seen, state):
        """Return [T, agents] for observations [T, agents, O] and states [T, particles, S]."""
        world = self.particle(state).mean(dim=-2, keepdim=True).expand(*seen.shape[:-1], -1)
        return self.value(torch.cat((seen, world), dim=-1)).squeeze(-1)


def rows(values):
    """Return the values of all agents in a dictionary as a tensor, [agents, ...]."""
    return torch.as_tensor(np.stack([values[agent] for agent in agents]), dtype=torch.float32)


def step(action):
    """Act for all agents, [agents, A]; return their observations and rewards."""
    actions = dict(zip(agents, action.clamp(-1.0, 1.0).numpy(), strict=True))
    seen, reward, *_ = env.step(actions)
    return rows(seen), rows(reward)


def drawn():
    return 2.0 * torch.rand(len(agents), acted) - 1.0


@torch.no_grad()
def evaluation(act):
    """Return the first group's mean return, and its error; a raider acts at random meanwhile."""
    returns, first = [], next(iter(rows_of.values()))
    for seed in range(100, 100 + min(8, 2 + given.steps // 1024)):
        seen, total = rows(env.reset(seed=seed)[0]), 0.0
        while env.agents:
            action = drawn()
            action[first] = act(seen[first])
            seen, reward = step(action)
            total += reward[first].mean().item()
        returns.append(total)
    return float(np.mean(returns)), float(np.std(returns, ddof=1) / len(returns) ** 0.5)


groups = {group: Group() for group in rows_of}
learned = next(iter(groups.values())).mean
curve = []
rounds = max(1, given.steps // ROLLOUT)
for k in range(rounds):
    if k % 4 == 0:
        curve.append((k * ROLLOUT, *evaluation(learned)))
    print(f"{k * ROLLOUT} steps; return {curve[-1][1]:.2f} after {curve[-1][0]}", flush=True)

    # Act in whole episodes: each ends by its step limit.
    kept = []
    seen = rows(env.reset(seed=1000 + k)[0])
    for _ in range(ROLLOUT):
        state, action = torch.as_tensor(env.state()), drawn()
        with torch.no_grad():
            for group, chosen in rows_of.items():
                action[chosen] = groups[group].actions(seen[chosen]).sample()
        after, reward = step(action)
        goes_on = torch.tensor(float(bool(env.agents)))
        kept.append((seen, state, action, reward, after, torch.as_tensor(env.state()), goes_on))
        seen = after if env.agents else rows(env.reset()[0])
    all_seen, state, all_actions, all_rewards, all_after, state_after, goes_on = map(
        torch.stack, zip(*kept, strict=True)
    )

    # Learn, each group by itself. The state that the step limit cuts off has a value.
    for group, chosen in rows_of.items():
        model, seen, action = groups[group], all_seen[:, chosen], all_actions[:, chosen]
        with torch.no_grad():
            old = model.actions(seen).log_prob(action).sum(-1)
            values = model.values(seen, state)
            error = GAMMA * model.values(all_after[:, chosen], state_after) - values
            error += all_rewards[:, chosen]
            gains, later = torch.zeros_like(error), 0.0
            for t in reversed(range(ROLLOUT)):
                gains[t] = later = error[t] + GAMMA * LAMBDA * goes_on[t] * later
            target, gains = gains + values, (gains - gains.mean()) / (gains.std() + 1e-8)
        for part in (p for _ in range(EPOCHS) for p in torch.randperm(ROLLOUT).chunk(PARTS)):
            ratio = (model.actions(seen[part]).log_prob(action[part]).sum(-1) - old[part]).exp()
            clipped = ratio.clamp(1.0 - CLIP, 1.0 + CLIP)
            policy_loss = -torch.min(ratio * gains[part], clipped * gains[part]).mean()
            value_error = model.values(seen[part], state[part]) - target[part]
            model.optimiser.zero_grad()
            (policy_loss + 0.5 * value_error.square().mean()).backward()
            nn.utils.clip_grad_norm_(model.parameters(), 0.5)
            model.optimiser.step()

curve.append((rounds * ROLLOUT, *evaluation(learned)))
results = {
    "learned": curve[-1][1:],
    "zero": evaluation(lambda seen: torch.zeros(len(seen), acted)),
    "random": evaluation(lambda seen: drawn()[: len(seen)]),
}
path = given.curve or Path(f"mappo_{given.env}.json")
path.write_text(json.dumps({"env": f"{given.env}_v0", "curve": curve, **results}), encoding="utf-8")
print("returns, " + ", ".join(f"{k}: {mean:.2f} ± {e:.2f}" for k, (mean, e) in results.items()))
