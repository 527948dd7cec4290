"""What is wanted of a tip in a maze, and of a point between obstacles."""
