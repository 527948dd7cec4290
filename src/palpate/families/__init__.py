"""What each family of objects brings to every stage."""
