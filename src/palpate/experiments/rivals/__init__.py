"""Rivals that need other frameworks."""
