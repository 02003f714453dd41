"""Where envs live: worker processes, this process, remote clients.

No module outside this package knows where an env runs.
"""
