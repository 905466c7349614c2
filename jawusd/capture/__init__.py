"""Synchronise and calibrate the cameras of a capture, and check calibrations and masks.

Reads `media` and `formats`; imports no other stage.
"""
