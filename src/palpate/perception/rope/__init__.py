"""A rope in pictures and among markers."""
