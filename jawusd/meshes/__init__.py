"""Scans and bones: reading, crown labels, rasterisation, solids, collision and contact.

May not import `media`, `capture` or `tracking`.
"""
