"""Synthetic subjects: jaw motion, anatomy, and rendered captures with ground truth.

The kinematics are independent of the models that jawusd fits. This package imports no other stage.
"""
