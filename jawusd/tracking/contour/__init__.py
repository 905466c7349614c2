"""Align scans with masks at one instant: contour samples, correspondences, normal equations, quality."""
