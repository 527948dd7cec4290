"""Headline experiments with ropes."""
