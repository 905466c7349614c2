"""Libraries of rigs: the index of a folder, and jaw motion for a subject without a capture."""
