"""Results of stages of a build that did nothing, of the kinds that `--resume` expects."""

_TRACK = {
    "frames": 2,
    "tracked": 2,
    "lost": [],
    "recovered": 0,
    "without_a_camera": 0,
    "prior_aided": 0,
    "calibration_rescaled_px": {},
    "sigma_mm": {"incisor": 0.1},
    "coverage_error_percent": None,
}
_RESULTS = {"track": _TRACK, "refine": _TRACK, "report": {"capture": "../capture"}}


def stage_result(name, offsets):
    """Return the result of a stage by its name, with the offsets of the cameras where it is the one that finds them."""
    return {"offsets": offsets, "method": "given"} if name == "sync" else _RESULTS.get(name, {})
