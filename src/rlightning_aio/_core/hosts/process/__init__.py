"""Worker processes: their handle, the link to them, and their own program.

`host` and `link` are the trainer's side; `worker` is the worker's. `fork_server` is a program of
its own that imports only the standard library until it has forked; `fork_messages` is what it is
told. It notices that a worker has died; what becomes of it, `supervision` decides.
"""
