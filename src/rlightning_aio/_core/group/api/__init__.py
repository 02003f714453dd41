"""The public groups and what they hand out.

`facade` and `interface` are what both groups share, `aio` and `sync` add how they wait, and
`episode` is one episode of an awaiting program. They check arguments and keep the life cycle. No
rule of stepping, resetting or supervising is here: it is in `engine`, once for both.
"""
