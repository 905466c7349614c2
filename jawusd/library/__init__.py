"""Libraries of rigs: an index of a folder, and jaw motion for a subject without a capture.

Imports only `base`, `geometry`, `formats` and `evaluator`.
"""
