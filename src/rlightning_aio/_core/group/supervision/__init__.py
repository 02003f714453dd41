"""Deaths, hangs and restarts.

`supervisor` decides what becomes of a host that ended or hung: a replacement, a later attempt, or
giving up. `hang_detector` says who is late (of awaitable envs, their host), `shutdown` ends hosts,
`fault_messages` words the errors, `workers` describes hosts to users and names envs that no limit
ends, `hint` suggests a faster setting, `places` knows hosts whose workers start themselves,
`env_losses` counts losses of single envs, and `renewals` replaces workers before they fail.
What a loss means for an episode is in `state.episodes`.

Rule: a hang ends as a death. A signal has a hung worker write its stacks, which works inside C
code, too; then its fork server kills it. If no death is reported within `times.OBEY`, the fork
server has hung as well, and is killed with all its workers. An exception under `on_env_error:
restart` is counted in the same table as deaths, and the far end rebuilds the env before its reset.
"""
