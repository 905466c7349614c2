"""Bring the cameras of a capture together in time and space."""
