"""Navigation among movable obstacles: maps, regions, the planner, and its plans."""
