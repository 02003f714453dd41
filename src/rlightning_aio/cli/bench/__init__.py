"""`bench`: measures envs in several runtimes and settings, and shows the table.

`measuring` runs one contender, in a process of its own (`apart`) where its env may end it. Nothing
here plays episodes for their results.
"""
