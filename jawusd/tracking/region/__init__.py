"""Tracking on the colours of pictures, without masks."""
