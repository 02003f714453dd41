"""From configs to a group that can be started.

`plan` decides which envs share a host, `start_orders` what a host is told, `devices` which GPU it
gets, `videos` what is filmed, and `build` puts the parts together. Nothing here runs once a group
is open, except that a replacement gets the same order again.
"""
