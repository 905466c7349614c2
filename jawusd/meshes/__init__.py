"""Scans and bones: reading, crown labels, rasterisation, solids, collision and contact.

This package must not import `media`, `capture` or `tracking`.
"""
