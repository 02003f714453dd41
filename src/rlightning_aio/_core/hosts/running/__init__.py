"""Run an env: build it, step and reset it, write its rows, take and put back its state.

It is the same code in a worker, in this process and in a Ray actor; `awaited_runner` is its form
for awaitable envs. It knows nothing of frames, pipes and processes.
"""
