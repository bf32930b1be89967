"""Methods compared on the same tasks, from the same seeds, for the same budget.

For `npa-envs compare`: `plan` lists the runs, `run` distributes them over processes and has the
program of such a process, and `report` makes tables and pictures.
"""
