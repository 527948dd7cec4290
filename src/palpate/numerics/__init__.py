"""Arithmetic that knows no object: devices, small systems, geometry."""
