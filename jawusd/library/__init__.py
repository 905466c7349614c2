"""An index of a folder of rigs, and jaw motion for a person without a capture."""
