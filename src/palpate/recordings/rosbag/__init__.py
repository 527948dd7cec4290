"""Logs of ROS as recordings."""
