"""Identification by descent: gradients, least squares, and a network for what is left over."""
