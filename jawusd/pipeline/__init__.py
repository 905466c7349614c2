"""The stages wired together: sync, track, fit, aid, bake; resumable, one folder per actor."""
