"""Hinges at edges of flat pieces: of what has moved as no known joint moves."""
