"""Envs as Ray actors: the host here, the actor there, and the rows that travel.

Only `host` imports Ray. The actor runs envs with the code of `running`. It has rows of its own;
their contents are sent as columns, one call for a batch. Replies arrive on Ray's threads and go
through an `Inbox`, whose descriptor the drivers watch.
"""
