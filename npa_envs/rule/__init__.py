"""The update rule and its files: the network that every particle runs, loading, saving."""

from npa_envs.rule.files import load_rule, save_rule, shipped_rules
from npa_envs.rule.rule import NPARule

__all__ = ["NPARule", "load_rule", "save_rule", "shipped_rules"]
