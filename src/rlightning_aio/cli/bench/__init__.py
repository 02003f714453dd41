"""`bench` and `tune`: measure envs in several runtimes and settings, and show the tables.

`measuring` runs one contender, in a process of its own (`apart`) where its env may end it. Nothing
here plays episodes for their results.
"""
