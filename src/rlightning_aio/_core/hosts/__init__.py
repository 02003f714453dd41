"""Where envs live: worker processes, this process, Ray, remote clients.

The seam is `base` and `messages`: what a group asks of a host, and what a host reports. Each folder
is a way to carry requests to envs, except `running`, the code that runs an env wherever it lives,
and `filming`. No module outside this package knows where an env runs; none here imports `group`.

Which host implements which optional protocol of `base`:

- `process`: `Source` (its link), `Polled`, `Killable`, `Inspectable`, `Measured`; `Aborting` for
  awaitable envs.
- `here.inline`: `Executing`, `Aborting` until a request begins; `Source` while envs compute in
  threads.
- `here.loop`: `Polled`, `Inspectable`, `Aborting`, `SharesThread`.
- `env_server`: `Source`, `Polled`, `Membership`; `Aborting` by the end of the session.
- `ray`: `Source`, `Killable`.
"""
