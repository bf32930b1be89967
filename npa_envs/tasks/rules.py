"""Rules of tasks: untrained ones, and whether others have their shape."""

from __future__ import annotations

import torch

from npa_envs.rule.rule import NPARule


def untrained_rule(
    generator: torch.Generator,
    *,
    state_dim: int,
    hidden_dim: int,
    eps0: float,
    alpha: float,
    space_dim: int = 2,
    static: bool = False,
    readout_dim: int = 0,
    readout_hidden_dim: int = 0,
) -> NPARule:
    """Return a rule on the CPU whose weights are drawn from `generator` alone.

    Args:
        generator: On the CPU; torch's own randomness is left as it is.
        state_dim: State channels C.
        hidden_dim: Width of the hidden layer.
        eps0: Perception radius that the rule is trained at [length units].
        alpha: Largest displacement in one step, as a fraction of ε (dimensionless).
        space_dim: Space dimension D.
        static: Particles never move.
        readout_dim: Outputs of the read-out network; 0 for none.
        readout_hidden_dim: Width of its hidden layer.
    """
    with torch.random.fork_rng(devices=()):
        torch.manual_seed(int(torch.randint(2**31, (), generator=generator)))
        return NPARule(
            space_dim,
            state_dim,
            hidden_dim,
            eps0=eps0,
            alpha=alpha,
            static=static,
            readout_dim=readout_dim,
            readout_hidden_dim=readout_hidden_dim,
        )


def differing_fields(given: NPARule, wanted: NPARule) -> list[str]:
    """Return the names of the hyper-parameters in which a rule differs from one of a task.

    Args:
        given: The rule.
        wanted: A rule that the task has made.
    """
    own = wanted.hyper_parameters()
    return [name for name, value in given.hyper_parameters().items() if value != own.get(name)]
