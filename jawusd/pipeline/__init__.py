"""The stages wired together: sync, track, fit, bake; resumable, one folder per actor."""
