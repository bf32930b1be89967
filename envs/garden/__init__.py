"""Environments in which a trained rule runs the particles, and an agent acts from outside.

`brushwork.py` has what an agent does with its brushes, `task.py` the worlds and what is seen of
them, `worlds.py` the batch that is stepped, `forms.py` spaces, `environments.py` the two classes
that the environments of `npa_envs.envs` are made of.
"""
