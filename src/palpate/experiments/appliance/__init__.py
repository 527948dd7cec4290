"""Reproductions of what is claimed of appliances."""
