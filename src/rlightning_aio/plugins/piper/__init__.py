"""The backend ``piper``: a Piper robot arm, through the vendor's SDK.

Rule: a plug-in. Nothing else imports this package; the entry points in pyproject.toml name
`backend.BACKEND`, which describes it without importing the SDK.
"""
