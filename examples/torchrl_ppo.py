"""TorchRL's PPO grows a heart's size and colour: every particle runs one small policy.

pip install 'npa-envs[torchrl]'
python examples/torchrl_ppo.py
"""

import argparse
import json
from pathlib import Path

import gymnasium as gym
import torch
from torch.distributions import Independent, Normal

try:
    from tensordict.nn import AddStateIndependentNormalScale, TensorDictModule
    from torchrl.collectors import Collector
    from torchrl.modules import MLP, ProbabilisticActor, ValueOperator
    from torchrl.objectives import ClipPPOLoss
    from torchrl.objectives.value import GAE
except ImportError as error:
    raise SystemExit(f"{error}: pip install 'npa-envs[torchrl]'") from error

import npa_envs  # noqa: F401 (registers the ids)
from npa_envs.agents import RandomPolicy, ZeroPolicy, evaluate_policy
from npa_envs.wrappers import NPATorchRLEnv

parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
parser.add_argument("--steps", type=int, default=15_360, help="of all worlds together")
parser.add_argument("--curve", type=Path, default=Path("torchrl_ppo.json"), help="to write")
given = parser.parse_args()

torch.set_num_threads(1)  # enough for small worlds
torch.manual_seed(0)
name = "npa/Morphogenesis2D-v0"
task = {
    "target": "heart",
    "particle_count": 128,
    "eps": 0.15,
    "seed_radius": 0.4,
    "colour_weight": 20.0,
}
task |= {"state_dim": 4, "state_scale": 0.1, "max_episode_steps": 32, "output": "torch"}
envs = gym.make_vec(name, num_envs=16, autoreset_mode="disabled", **task)
test_envs = gym.make_vec(name, num_envs=16, **task)
env = NPATorchRLEnv(envs, rows=True)  # batch size [16, 128]: worlds, particles
env.set_seed(0)

perceived, acted = (space.shape[-1] for space in (envs.observation_space, envs.action_space))
sizes = {"num_cells": [64, 64], "activation_class": torch.nn.Tanh}
scale = AddStateIndependentNormalScale(acted, scale_mapping="exp", init_value=-1.0)
network = torch.nn.Sequential(MLP(perceived, acted, **sizes), scale)
actor = ProbabilisticActor(
    TensorDictModule(network, ["observation"], ["loc", "scale"]),
    in_keys=["loc", "scale"],
    distribution_class=lambda loc, scale: Independent(Normal(loc, scale), 1),
    return_log_prob=True,
)
critic = ValueOperator(MLP(perceived, 1, **sizes))
estimate = GAE(gamma=0.5, lmbda=0.95, value_network=critic)
loss = ClipPPOLoss(actor, critic, entropy_bonus=False, normalize_advantage=True)
optimizer = torch.optim.Adam(loss.parameters(), lr=1e-3)


def policy(observations):
    with torch.no_grad():
        return network(observations)[0]  # the means


def evaluation(policy):
    episodes = evaluate_policy(test_envs, policy, seeds=range(100, 132))
    return episodes.mean_return, episodes.standard_error


curve = [(0, *evaluation(policy))]
rounds = max(1, given.steps // (16 * 16))  # 16 steps of 16 worlds
frames = 16 * env.batch_size.numel()  # counted in rows
options = {"frames_per_batch": frames, "total_frames": rounds * frames}
collector = Collector(env, actor, auto_register_policy_transforms=False, **options)
for k, batch in enumerate(collector, start=1):
    with torch.no_grad():
        estimate(batch)  # [16, 128, 16]
    samples = batch.reshape(-1)
    for _ in range(4):
        for chosen in torch.randperm(len(samples), device=env.device).split(4096):
            parts = loss(samples[chosen])
            optimizer.zero_grad()
            (parts["loss_objective"] + parts["loss_critic"]).backward()
            optimizer.step()
    if k % 6 == 0 or k == rounds:
        curve.append((k * 16 * 16, *evaluation(policy)))
        print(f"{curve[-1][0]} steps: {curve[-1][1]:.2f}", flush=True)

results = {
    "learned": curve[-1][1:],
    "zero": evaluation(ZeroPolicy(test_envs)),
    "random": evaluation(RandomPolicy(test_envs)),
}
given.curve.write_text(json.dumps({"env": name, "curve": curve, **results}), encoding="utf-8")
print("returns, " + ", ".join(f"{k}: {mean:.2f} ± {e:.2f}" for k, (mean, e) in results.items()))
