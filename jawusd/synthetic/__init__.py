"""Synthetic subjects, independent of the models that jawusd fits: motion, anatomy, captures with ground truth."""
