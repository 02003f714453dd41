"""Many envs used as one: `group` from the public classes down to its tables.

Imports run down: `api` (the two public groups), `setup` (what is started), `timeline`, `engine`
(send, wait, apply, hand out; snapshots are taken and restored there), `supervision` (deaths, hangs,
restarts), `tables` (what all parts share), `state` (the single tables: requests, episodes, hosts),
`drivers` (how a procedure waits).
Decisions get the time as an argument, or from `Tables.clock`; only drivers, `api` and what measures
(`sums`, `timeline`) read a clock, and none knows where an env runs.

Six verbs say how something ends. A request *ends* with its answer, and is *dropped* without one; a
caller that no longer waits *leaves* its requests to others, or has them *aborted*, so that nobody
gets the answer. Envs, hosts and calls are *closed* in order, and workers are *killed* by force. (To
*release* is to give back memory and descriptors.)
"""
