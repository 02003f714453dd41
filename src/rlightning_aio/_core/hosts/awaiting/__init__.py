"""Awaitable envs: each is a task that runs its requests one after another.

`awaited_envs` is the executor of many, under `here.loop` and, with `worker_loop`, in a worker;
`event_loop` notices who blocks the loop. The runner of a single env is in `running`.
"""
