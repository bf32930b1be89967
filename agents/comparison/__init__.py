"""Methods compared on the same tasks, from the same seeds, for the same budget.

Behind `npa-envs compare`: `plan` says what is run, `scheduler` spreads the runs over processes,
`run` is what each process does and records, and `report` shows it.
"""
