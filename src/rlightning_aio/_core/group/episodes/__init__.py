"""What belongs to an episode rather than to a request.

`episodes` counts steps up to the limits of auto_reset, and follows envs whose episode was lost
until a result has reported that; `snapshot_format` is the format of saved states; `seeds` are the
seeds of resets. It knows slots and rows, no hosts.
"""
