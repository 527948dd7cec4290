"""What objects and the robot do when one moves the other: carrying, constraints, belief."""
