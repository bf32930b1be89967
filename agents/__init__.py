"""Policies and baselines, imported as `npa_envs.agents`.

Holds policies made of gradient-trained rules, scripted and random ones, and their evaluation. They
use the public API only.
"""

from npa_envs.agents.evaluation import Episodes, evaluate_policy
from npa_envs.agents.policies import (
    Interface,
    MendPolicy,
    PaintPolicy,
    Policy,
    RandomPolicy,
    RulePolicy,
    SpreadPolicy,
    ZeroPolicy,
    interface_of,
)

__all__ = [
    "Episodes",
    "Interface",
    "MendPolicy",
    "PaintPolicy",
    "Policy",
    "RandomPolicy",
    "RulePolicy",
    "SpreadPolicy",
    "ZeroPolicy",
    "evaluate_policy",
    "interface_of",
]
