"""One env made of several: stepped one after another, or a single one with the form of several.

Sub-environments that a simulator steps by itself are in its own adapter.
"""
