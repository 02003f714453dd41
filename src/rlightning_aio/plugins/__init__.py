"""Optional parts, each over a library or a protocol of its own.

Rule: a plug-in uses only names that ``docs/reference`` lists, and nothing else imports it: entry
points in pyproject.toml name its backends and its clients of policy servers.
(`rlightning_aio.legacy` is the public path of ``legacy``.)
"""
