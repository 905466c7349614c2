"""Segment the teeth of both arches in footage, guided by the projected scans; masks are files that users can edit."""
