"""Masks of both arches from footage, guided by projected scans."""
