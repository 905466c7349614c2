"""Random subjects for tests and benchmarks: mouths, scanners, annotators and short captures with ground truth."""
