"""Deaths, hangs and restarts.

`supervisor` decides what becomes of a host that ended or hung: a replacement, a later attempt, or
giving up. `hang_detector` says who is late, `shutdown` ends hosts, `fault_messages` words the
errors, `workers` and `hint` describe hosts to users. What a loss means for an episode is in
`episodes`.
"""
