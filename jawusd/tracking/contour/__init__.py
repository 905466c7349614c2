"""Align both scans with the masks of one frame: contour samples, correspondences, normal equations, quality.

Imports no other subpackage of tracking, only `config`.
"""
