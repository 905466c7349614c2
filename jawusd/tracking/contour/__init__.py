"""Align both scans with the masks of one video frame: contour samples, correspondences, normal equations, quality.

Within `tracking`, this package imports only `config`.
"""
