"""Search for rules that nobody asked for: quality-diversity over rules."""

from npa_envs.agents.search.run import Elite, Growth, Search, tried_again
from npa_envs.agents.search.worlds import Found, SearchWorld

__all__ = ["Elite", "Found", "Growth", "Search", "SearchWorld", "tried_again"]
