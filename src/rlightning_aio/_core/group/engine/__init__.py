"""The engine: it sends requests, waits for hosts, applies what they report, hands out results.

`core` puts it together. `steps` (with `actions`), `resets`, `calls`, `snapshots`, `aborts` and
`agent_steps` are the operations; `waiting` waits, `intake` applies reports, `results` makes
batches. `actions` refuses what doesn't fit the space before anything is sent. An operation is a
generator, so the same code serves both public groups. What a death means is decided in
`supervision`; what is in flight is in `state`.
"""
