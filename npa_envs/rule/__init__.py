"""The update rule, the network that every particle runs; loading and saving it."""

from npa_envs.rule.files import load_rule, save_rule, shipped_rules
from npa_envs.rule.rule import NPARule

__all__ = ["NPARule", "load_rule", "save_rule", "shipped_rules"]
