"""Performances of a subject with a known rig: head pose and jaw parameters of every frame, from masks of any cameras.

Read in order: coordinates, instant, attempts, motion, forward, unknowns, system, smoother, shot.
May import `tracking.contour` and `tracking.initialization`, but not `tracking.region` or `tracking.sequence`.
"""
