"""Tracking by image colours, without masks: of independent arches (`tracker`, `take`) and of a rig (`rig_tracker`).

Read in order: colours, edges, creases, view, appearance, jaw_priors, search, tracker, take; then rig_tracker, live.
May import the other parts of `tracking`, which must not import this one.
"""
