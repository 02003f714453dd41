"""Awaitable envs: each is a task that runs its requests one after another.

`awaited_envs` is the executor of many, under `hosts.loop` and in a worker;
`event_loop` notices who blocks the loop. The runner of a single env is in `running`. Each env has
one task from its making to its close, because clients may be bound to the task that opened them.
"""
