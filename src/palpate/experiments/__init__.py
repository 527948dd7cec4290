"""Experiments and commands: from what a person asks for to a folder they can read."""
