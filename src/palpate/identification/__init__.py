"""Recordings to models: what the object's physics must be, and how far to trust the answer."""
