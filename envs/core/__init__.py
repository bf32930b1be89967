"""Parts that environments have in common: configuration, tasks, worlds, spaces, views."""
