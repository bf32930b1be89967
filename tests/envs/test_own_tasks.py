"""What a user's task returns is checked: mistakes are errors that name the method."""

import random as python_random

import numpy as np
import pytest
import torch
from support.refusals import refused

from npa_envs import NPAError, world_mean
from npa_envs.envs import EnvTask, NPAEnv, NPAVectorEnv, Start

N, C = 9, 4


class Gather(EnvTask):
    """Particles are to come to the origin; nothing is wrong with it."""

    def seed(self, random):
        x = 0.5 * random.uniform(N, 2)
        return x, x.new_zeros(*x.shape[:2], C)

    def losses(self, x, s):
        return {"away": world_mean(x.square().sum(dim=-1, keepdim=True))[:, 0]}

    def particle_losses(self, x, s):
        return x.square().sum(dim=-1)


def changed(method, change):
    """Return a task with a change of what one method returns."""

    def answer(self, *given):
        return change(getattr(Gather, method)(self, *given))

    return type("MyTask", (Gather,), {method: answer})


def environments(task, device="cpu", **keywords):
    given = {"particle_count": N, "state_dim": C, "eps": 0.3, "device": str(device)} | keywords
    single = type("MyEnv", (NPAEnv,), {"task_type": task})
    vector = type("MyVectorEnv", (NPAVectorEnv,), {"task_type": task})
    return single(**given), vector(3, **given)


def away(change):
    return lambda losses: {"away": change(losses["away"])}


def drawing(draw):
    def change(answer):
        draw()
        return answer

    return change


FIRST = {
    "no pair": ("seed", lambda a: a[0], "MyTask.seed must return positions and states, got a Tens"),
    "one dimension more": (
        "seed",
        lambda a: (torch.cat((a[0], a[0][..., :1]), 2), a[1]),
        r"positions of MyTask\.seed must be a torch\.float32 .* shape \(\d, 9, 2\).*\(\d, 9, 3\)",
    ),
    "double states": ("seed", lambda a: (a[0], a[1].double()), r"states of .*got torch\.float64"),
    "arrays": ("seed", lambda a: (a[0].cpu().numpy(), a[1]), "positions of .*got a ndarray"),
    "NaN positions": ("seed", lambda a: (a[0] / 0, a[1]), r"positions of MyTask\.seed .* finite"),
    "no Start": ("start", lambda a: tuple(a), r"MyTask\.start must return a Start, got a tuple"),
    "no worlds": ("fresh", lambda a: a.x, r"MyTask\.fresh must return positions and states, got a"),
    "a float goal": (
        "fresh",
        lambda a: Start(a.x, a.s, goal=a.x[:, 0, 0]),
        r"goal of MyTask\.fresh must be a torch\.int64",
    ),
    "no mapping": ("losses", lambda a: a["away"], r"MyTask\.losses .* by name, .* got Tensor"),
    "no term": ("losses", lambda a: {}, r"MyTask\.losses .* at least one, got \[\]"),
    "no name": ("losses", lambda a: {1: a["away"]}, r"MyTask\.losses .* by name"),
    "one loss for all": ("losses", away(torch.mean), r"term 'away' of MyTask\.losses must .*\(\)"),
    "NaN": ("losses", away(lambda a: (a - 9.0).sqrt()), r"term 'away' of MyTask\.losses .* finite"),
    "torch draws": (
        "seed",
        drawing(lambda: torch.rand(3)),
        r"MyTask\.seed .* got draws from torch",
    ),
    "NumPy draws": ("fresh", drawing(np.random.rand), r"MyTask\.fresh .* draws from NumPy's: draw"),
    "Python draws": ("seed", drawing(python_random.random), r"MyTask\.seed .* draws from Python's"),
    "losses of a particle": (
        "particle_losses",
        lambda a: a[:, :1],
        r"losses of MyTask\.particle_losses must .* got .*\(\d, 1\)",
    ),
    "NaN for particles": (
        "particle_losses",
        lambda a: a / 0 * 0,
        r"losses of MyTask\.particle_losses must be finite",
    ),
    "random losses": ("losses", drawing(lambda: torch.rand(3)), r"MyTask\.losses must not draw"),
}
"""The method that is wrong, how, and what `reset` says of it."""


@pytest.mark.parametrize("case", FIRST)
def test_reset_says_what_is_wrong_with_an_own_task(case, device):
    method, change, message = FIRST[case]
    for env in environments(changed(method, change), device, reward="particle"):
        refused(message, env.reset, seed=0)


@pytest.mark.parametrize("output", ["numpy", "torch"])
def test_losses_that_are_not_finite_later_are_an_error_of_the_step(output, device):
    class Late(Gather):
        def losses(self, x, s):
            parts = super().losses(x, s)
            return parts | {"late": torch.where(s[:, 0, 0] > 1.5, torch.nan, 0.0)}

    for env in environments(Late, device, update_prob=1.0, output=output):
        env.reset(seed=0)
        action = np.zeros(env.action_space.shape, np.float32)
        action[-1, ..., 2] = 1.0
        if action.ndim == 2:
            action[:, 2] = 1.0
        env.step(action)
        refused(r"term 'late' of Late\.losses must be finite.* 1 of", env.step, action)
        env.reset(seed=0)
        env.step(action)


def test_losses_keep_their_names(device):
    class Fickle(Gather):
        called = 0

        def losses(self, x, s):
            self.called += 1
            return super().losses(x, s) if self.called < 2 else {"far": x[:, 0, 0]}

    for env in environments(Fickle, device):
        env.reset(seed=0)
        with pytest.raises(NPAError, match=r"same terms .* got \['far'\] after \['away'\]"):
            env.step(np.zeros(env.action_space.shape, np.float32))
