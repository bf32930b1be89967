"""Policies and baselines, imported as `npa_envs.agents`.

Holds reinforcement-learning and evolution-strategy baselines, policies made of gradient-trained
rules, and scripted ones. They use the public API only.
"""
