"""Segment both arches in footage, guided by the projected scans.

Produces mask files that a person can edit; imports no other stage.
"""
