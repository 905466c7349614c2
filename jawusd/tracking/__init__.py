"""Poses of both rows of teeth from masks in several views."""
