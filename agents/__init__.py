"""Policies of trained rules, scripted and random policies, and their evaluation.

They are imported as `npa_envs.agents` and use the public API only.
"""

from npa_envs.agents.evaluation import Episodes, evaluate_policy
from npa_envs.agents.network_policies import NetworkPolicy, load_policy, shipped_policies
from npa_envs.agents.policies import (
    MendPolicy,
    PaintPolicy,
    Policy,
    RandomPolicy,
    RulePolicy,
    SpreadPolicy,
    ZeroPolicy,
    interface_of,
)
from npa_envs.envs.core.config import Interface

__all__ = [
    "Episodes",
    "Interface",
    "MendPolicy",
    "NetworkPolicy",
    "PaintPolicy",
    "Policy",
    "RandomPolicy",
    "RulePolicy",
    "SpreadPolicy",
    "ZeroPolicy",
    "evaluate_policy",
    "interface_of",
    "load_policy",
    "shipped_policies",
]
