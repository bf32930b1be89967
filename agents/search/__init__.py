"""Quality-diversity search: many different rules of high quality, without a task."""

from npa_envs.agents.search.run import Elite, Growth, Search, tried_again
from npa_envs.agents.search.worlds import Found, SearchWorld

__all__ = ["Elite", "Found", "Growth", "Search", "SearchWorld", "tried_again"]
