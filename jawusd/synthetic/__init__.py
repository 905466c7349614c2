"""Synthetic persons: jaw motion, anatomy, and rendered captures with ground truth.

The kinematics share nothing with the models that jawusd fits; imports no other stage.
"""
