"""The tasks of several species, one file each."""
