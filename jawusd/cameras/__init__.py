"""Calibrated cameras from jawusd and other programs: one module per file format, registered by `files`."""
