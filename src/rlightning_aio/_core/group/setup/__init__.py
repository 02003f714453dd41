"""From configs to a group that can be started.

`plan` checks configs, `start_orders` decides which envs share a host and what it is told, and
`build` puts the parts together. Nothing here runs once a group is open, except that a replacement
gets the same order again.
"""
