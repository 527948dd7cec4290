"""Markov chains and particles that sample any posterior."""
