"""What an action may do to the world: how stiff, how hard."""
