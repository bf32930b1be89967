"""Quality-diversity search by MAP-Elites: many different rules of high quality, without a task.

An archive of cells keeps an elite in each: the best rule whose worlds fall into the cell.
"""

from npa_envs.agents.search.candidate_evaluation import Found, SearchWorld
from npa_envs.agents.search.quality_diversity import Elite, Growth, Search, tried_again

__all__ = ["Elite", "Found", "Growth", "Search", "SearchWorld", "tried_again"]
