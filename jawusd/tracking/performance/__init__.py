"""Solve the performance of a person whose rig exists: head pose and jaw parameters of every frame, from any cameras."""
