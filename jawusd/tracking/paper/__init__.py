"""The energy and the solver of the paper, for comparison."""
