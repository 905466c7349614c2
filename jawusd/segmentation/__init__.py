"""Masks of both rows of teeth from footage, guided by projected scans."""
