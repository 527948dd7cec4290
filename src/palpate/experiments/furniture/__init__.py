"""Headline experiments with furniture."""
