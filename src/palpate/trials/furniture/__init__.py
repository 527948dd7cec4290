"""Agents and planners among furniture."""
