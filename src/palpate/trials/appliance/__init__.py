"""Appliances that are handled, and what is believed of them meanwhile."""
