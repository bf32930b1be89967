"""Methods compared on the same tasks, from the same seeds, for the same budget.

Behind `npa-envs compare`: `plan` says what is run, `run` spreads the runs over processes and is
what each of them does and records, and `report` shows it.
"""
