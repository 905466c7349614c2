"""Scans and bones: reading, crown labels, rasterisation, solids, collision, contact and parametric bones.

This package must not import `media`, `capture` or `tracking`.
"""
