"""What belongs to an episode rather than to a request.

`continuity` counts steps up to the limits of auto_reset, and follows envs whose episode was lost or
restored until they have shown a state; `snapshot_format` is the format of saved states; `seeds` are
the seeds of resets. It knows slots and rows, no hosts.

Rule: a checkpoint comes before the reply to the request that caused it, and counts once that
request was answered. A restored state is shown by a reset `AS_RESTORED`, which begins no episode.
"""
