"""Segment both arches in footage, guided by the projected scans.

Writes mask files that the user can edit; imports no other stage.
"""
