"""Quality-diversity search: many different rules of high quality, without a task."""

from npa_envs.agents.search.candidates import Found, SearchWorld
from npa_envs.agents.search.quality_diversity import Elite, Growth, Search, tried_again

__all__ = ["Elite", "Found", "Growth", "Search", "SearchWorld", "tried_again"]
