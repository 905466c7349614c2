"""Track a whole take: frame by frame, with whole-take corrections, smoothing, and a second pass with the jaw model.

Imports `initialization`, `contour` and `config`; never `performance` or `region`.
"""
