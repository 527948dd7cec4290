"""Appliances: things with doors, lids and drawers, before depth cameras and a hand."""
