"""Predictions learnt from examples without physics."""
