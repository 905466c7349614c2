"""Tracking of independent arches (`tracker`, `take`) or of a rig (`rig_tracker`) by image colours, without masks.

Reading order: colours, edges, view, appearance, jaw_priors, search, tracker, take; then instant_images,
rig_tracker, performance.
This package may import the other parts of `tracking`; they must not import it.
"""
