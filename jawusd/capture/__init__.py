"""Synchronise and calibrate the cameras of a capture, and check calibrations and masks.

This package imports `media` and `formats`, but no other stage.
"""
