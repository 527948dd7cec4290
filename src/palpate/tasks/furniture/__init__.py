"""What is wanted of furniture."""
