"""Synchronise and calibrate the cameras of a capture."""
