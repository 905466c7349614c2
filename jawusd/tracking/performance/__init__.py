"""Solve performances of a subject with a known rig: head pose and jaw parameters of every frame, from masks.

Reading order: coordinates, instant, attempts, motion, forward, unknowns, system, smoother, shot.
This package may import `tracking.contour` and `tracking.initialization`, but not `tracking.region` or
`tracking.sequence`.
"""
