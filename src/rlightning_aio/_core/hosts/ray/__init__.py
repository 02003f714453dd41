"""Envs as Ray actors: the host here, the actor there, and the rows that travel.

Only `cluster` imports Ray. The actor runs envs with the code of `running`.
"""
