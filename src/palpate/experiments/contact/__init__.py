"""Reproductions of contact: mazes, and walls that are touched."""
