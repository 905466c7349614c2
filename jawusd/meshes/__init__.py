"""Scans and bones: reading, crown labels, rasterisation, solids, collision, contact and parametric bones."""
