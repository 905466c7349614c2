"""Track a whole take: frame by frame, then with whole-take corrections, smoothing, and a pass with the jaw model.

This package imports `follow`, `initialization`, `contour` and `config`, but never `performance` or `region`.
"""
