"""The stages wired together: sync, track, fit, refine, bake; resumable, one folder per actor."""
