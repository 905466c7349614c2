"""Track a whole take: frame by frame, its nuisances, smoothing and the second pass with the jaw model."""
