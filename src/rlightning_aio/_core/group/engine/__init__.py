"""The engine: it sends requests, waits for hosts, applies what they report, hands out results.

`core` answers the calls of a group; `steps` is its short way for ordinary steps. `dispatch` sends,
`waiting` and `poller` wait, `intake` applies reports, `results` makes batches. An operation is a
generator, so the same code serves both public groups. Deaths are decided in `supervision`.
"""
