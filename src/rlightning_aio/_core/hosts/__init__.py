"""Where envs live: worker processes, this process, Ray, remote clients.

The seam is `base` and `messages`: what a group asks of a host, and what a host reports. Each folder
is a way to carry requests to envs, except `running`, the code that runs an env wherever it lives.
`inline` and `loop` run envs in the trainer's own process: no message is packed on the way, and an
env that dies there takes the trainer along.
No module outside this package knows where an env runs; none here imports `group`.

Which host can do what, beside what all can (`base`): `process` and `ray` are `Killable`,
`inline` is `Executing`, `env_server` is `Killable` and `SelfStarting`. Requests are aborted by
`inline`, `loop`, and by `process` where envs are awaitable.
"""
