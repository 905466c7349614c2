"""Find the poses of the first frame: from picks, or by search."""
