"""Synchronise and calibrate the cameras of a capture, and check calibrations and masks."""
