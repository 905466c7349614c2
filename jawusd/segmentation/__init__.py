"""Segment the teeth of both arches in footage, guided by the projected scans.

The package writes mask files that the user can edit; it imports no other stage.
"""
