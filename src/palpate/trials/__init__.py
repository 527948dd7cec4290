"""Closed loops: a controller in a world, judged by a task."""
