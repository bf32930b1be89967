"""Environments over the engine, imported as `npa_envs.envs`.

Holds the Gymnasium environments (one world, or worlds batched on one device) and the PettingZoo
environments (several species in one world). They define spaces, rewards, termination and rendering
and call `npa_envs` for everything that moves: no kernels and no physics live here.
"""
