"""What belongs to an episode rather than to a request.

`episodes` counts steps up to the limits of auto_reset, follows envs whose episode was lost until a
result has reported that, and reads the seeds of resets; `snapshot_format` is the format of saved
states. They know slots and rows, no hosts.
"""
