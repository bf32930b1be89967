"""MAPPO: agents with policies of what each perceives, and a critic that sees the whole world.

    pip install 'npa-envs[envs]'
    python examples/mappo.py particles  # 64 particles of two species mix, by one shared policy
    python examples/mappo.py gardeners  # a keeper and a raider, each by a policy of its own

Arrays in PettingZoo's dictionaries have a row for each world. Agents of one group share a policy.
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

WORLDS, CYCLES, EPOCHS, PARTS, GAMMA, LAMBDA, CLIP, RATE = 8, 32, 4, 8, 0.9, 0.95, 0.2, 1e-3
ROLLOUT = WORLDS * CYCLES  # steps of worlds in a round

torch.set_num_threads(1)  # enough for small worlds
torch.manual_seed(0)
many = {"max_cycles": CYCLES, "world_count": WORLDS, "autoreset_mode": "disabled"}
if given.env == "particles":  # the world of npa/MixingSmall-v0
    world = {"particle_count": 64, "state_dim": 4, "state_scale": 0.1, "eps": 0.2, "eps0": 0.2}
    envs = particles_v0.batched("mixing", perception="per_species", **many, **world)
    rows_of = {"particles": list(range(64))}
else:  # the brushes of npa/Gardener2DSmall-v0
    envs = gardeners_v0.batched(particle_count=256, push_length=0.1, **many)
    rows_of = {"keeper": [0], "raider": [1]}
agents = envs.possible_agents
observed = envs.single_observation_spaces[agents[0]].shape[0]
acted = envs.single_action_spaces[agents[0]].shape[0]
envs.reset(seed=0)
state_width = envs.state().shape[-1]


def rows(values):
    """Return the values of all agents in a dictionary as a tensor, [worlds, agents, ...]."""
    return torch.as_tensor(np.stack([values[a] for a in agents], axis=1), dtype=torch.float32)


def step(action):
    """Act for all agents; return their observations and rewards, [worlds, agents, ...]."""
    chosen = action.clamp(-1.0, 1.0).numpy()
    seen, reward, *_ = envs.step({agent: chosen[:, k] for k, agent in enumerate(agents)})
    return rows(seen), rows(reward)


def drawn():
    return 2.0 * torch.rand(WORLDS, len(agents), acted) - 1.0


class Group(nn.Module):
    """An actor of what an agent observes, and a critic that also sees all particles' states."""

    def __init__(self):
        super().__init__()
        self.mean = nn.Sequential(nn.Linear(observed, 64), nn.Tanh(), nn.Linear(64, acted))
        self.log_std = nn.Parameter(-torch.ones(acted))
        self.particle = nn.Sequential(nn.Linear(state_width, 64), nn.ReLU())
        self.value = nn.Sequential(nn.Linear(64 + observed, 64), nn.Tanh(), nn.Linear(64, 1))
        nn.init.zeros_(self.mean[-1].weight)
        self.optimiser = torch.optim.Adam(self.parameters(), lr=RATE)

    def actions(self, seen):
        return Normal(self.mean(seen), self.log_std.exp())

    def values(self, seen, state):
        """Return [..., agents] for observations [..., agents, O], states [..., particles, S]."""
        world = self.particle(state).mean(dim=-2, keepdim=True).expand(*seen.shape[:-1], -1)
        return self.value(torch.cat((seen, world), dim=-1)).squeeze(-1)


@torch.no_grad()
def evaluation(act):
    """Return the first group's mean return, and its error; a raider acts at random meanwhile."""
    first, seen, returns = next(iter(rows_of.values())), rows(envs.reset(seed=100)[0]), 0.0
    for _ in range(CYCLES):
        action = drawn()
        action[:, first] = act(seen[:, first])
        seen, reward = step(action)
        returns = returns + reward[:, first].mean(dim=1)
    return returns.mean().item(), returns.std().item() / WORLDS**0.5


groups = {group: Group() for group in rows_of}
learned = next(iter(groups.values())).mean
curve = []
rounds = max(1, given.steps // ROLLOUT)
for k in range(rounds):
    if k % 4 == 0:
        curve.append((k * ROLLOUT, *evaluation(learned)))
    print(f"{k * ROLLOUT} steps; return {curve[-1][1]:.2f} after {curve[-1][0]}", flush=True)

    kept, seen = [], rows(envs.reset(seed=1000 + k * WORLDS)[0])
    for _ in range(CYCLES):
        state, action = torch.as_tensor(envs.state()), drawn()
        with torch.no_grad():
            for group, chosen in rows_of.items():
                action[:, chosen] = groups[group].actions(seen[:, chosen]).sample()
        after, reward = step(action)
        kept.append((seen, state, action, reward, after, torch.as_tensor(envs.state())))
        seen = after
    all_seen, state, all_actions, all_rewards, all_after, state_after = map(
        torch.stack, zip(*kept, strict=True)
    )

    # Learn, each group by itself. The state that the step limit cuts off has a value.
    for group, chosen in rows_of.items():
        model, seen, action = groups[group], all_seen[:, :, chosen], all_actions[:, :, chosen]
        with torch.no_grad():
            old = model.actions(seen).log_prob(action).sum(-1)
            values = model.values(seen, state)
            error = GAMMA * model.values(all_after[:, :, chosen], state_after) - values
            error += all_rewards[:, :, chosen]
            gains, later = torch.zeros_like(error), 0.0
            for t in reversed(range(CYCLES)):
                gains[t] = later = error[t] + GAMMA * LAMBDA * later
            target, gains = gains + values, (gains - gains.mean()) / (gains.std() + 1e-8)
        tensors = [each.flatten(0, 1) for each in (seen, state, action, old, target, gains)]
        for part in (p for _ in range(EPOCHS) for p in torch.randperm(ROLLOUT).chunk(PARTS)):
            seen, world, action, before, goal, gain = (each[part] for each in tensors)
            ratio = (model.actions(seen).log_prob(action).sum(-1) - before).exp()
            clipped = ratio.clamp(1.0 - CLIP, 1.0 + CLIP)
            policy_loss = -torch.min(ratio * gain, clipped * gain).mean()
            value_error = model.values(seen, world) - goal
            model.optimiser.zero_grad()
            (policy_loss + 0.5 * value_error.square().mean()).backward()
            nn.utils.clip_grad_norm_(model.parameters(), 0.5)
            model.optimiser.step()

curve.append((rounds * ROLLOUT, *evaluation(learned)))
results = {
    "learned": curve[-1][1:],
    "zero": evaluation(lambda seen: torch.zeros(*seen.shape[:2], acted)),
    "random": evaluation(lambda seen: drawn()[:, : seen.shape[1]]),
}
path = given.curve or Path(f"mappo_{given.env}.json")
path.write_text(json.dumps({"env": f"{given.env}_v0", "curve": curve, **results}), encoding="utf-8")
print("returns, " + ", ".join(f"{k}: {mean:.2f} ± {e:.2f}" for k, (mean, e) in results.items()))
