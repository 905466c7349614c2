"""Random subjects for tests and benchmarks: mouths, scanners, annotators, short captures."""
