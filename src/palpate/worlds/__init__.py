"""What is real: MuJoCo scenes. Nothing else may look inside them."""
