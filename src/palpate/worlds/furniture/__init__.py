"""Furniture on real wheels in a room, in MuJoCo."""
