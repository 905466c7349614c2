"""Frames by presentation time, masks, overlays and clips: the pictures of a capture, read and written.

Owns PyAV and the decoding by OpenCV; knows meshes only as what overlays draw.
"""
