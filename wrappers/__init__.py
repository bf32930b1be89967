"""Adapters between environments and the libraries that train on them, as `npa_envs.wrappers`.

Holds Gymnasium and PettingZoo wrappers and the adapters to Stable-Baselines3 and other trainers.
They use the public API only.
"""
