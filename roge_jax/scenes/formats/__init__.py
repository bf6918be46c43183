"""Readers of the layouts in which posed photos and camera paths are written, one file a family.

Each takes a place and returns a `Reading`; `scenes.readers` says which one reads what.
"""
