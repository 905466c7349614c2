"""What a tracked take says of synchronisation: cameras that are late, and frames that were dropped or doubled."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from jawusd.formats.finding import Finding
from jawusd.tracking.config import TrackingConfig
from jawusd.tracking.contour.frame_record import FrameRecord, whole_frames
from jawusd.tracking.sequence.delay_steps import delay_steps
from jawusd.tracking.sequence.extrinsics import Extrinsics
from jawusd.tracking.sequence.frame_shifts import FrameShifts
from jawusd.tracking.sequence.nuisance import Nuisances
from jawusd.tracking.sequence.results import outline_variance

_CLEARLY = 4.0  # standard deviations
_LATE_FRAMES = 0.7  # cameras that run freely are up to half a frame apart
# Step of a delay in mid take of footage without masks [frames]. The one valid take of a drawn person that was looked at
# (30 frames) showed 0.02; a rate of false alarms is not known. Steps are missed where the jaw is fast.
_STEP_FRAMES = 0.5


def time_findings(
    names: Sequence[str],
    records: Mapping[int, FrameRecord],
    nuisances: Nuisances,
    extrinsics: Extrinsics,
    config: TrackingConfig,
    shifts: FrameShifts | None = None,
) -> list[Finding]:
    """Return cameras that are a frame late or early, from the start or from some frame on.

    Args:
        names: of the cameras.
        records: of all frames.
        nuisances, extrinsics, config: of the take.
        shifts: which instants masks show; without masks, steps are looked for among delays of parts of a frame.

    Kinds: "camera_late" [frames], "frame_dropped" [frames].
    """
    late = {k: float(nuisances.delays[k]) for k in range(len(names)) if _is_late(nuisances, k)}
    if shifts is None:
        return [*_late(names, late), *_step_of_delay(names, records, extrinsics, config)]
    late = {camera: frames for camera, frames in late.items() if not shifts.is_timely(camera)}
    shift = shifts.clearest()
    if shift is None:
        return _late(names, late)
    if shift.frame is None:
        return _late(names, late or {shift.camera: float(shift.frames)})
    return [*_late(names, late), _dropped(names[shift.camera], shift.frames, shift.frame)]


def _is_late(nuisances: Nuisances, camera: int) -> bool:
    limit = max(_LATE_FRAMES, _CLEARLY * float(nuisances.sigma_delays[camera]))
    return abs(float(nuisances.delays[camera])) > limit


def _late(names: Sequence[str], frames: Mapping[int, float]) -> list[Finding]:
    """Say that cameras are late by so many frames."""
    return [
        Finding(
            "camera_late",
            "warning",
            f"its pictures are {abs(late):.1f} frames {'later' if late > 0 else 'earlier'} than its offset "
            f"says; below {_LATE_FRAMES} frames is usual.",
            value=round(late, 2),
            limit=_LATE_FRAMES,
            camera=names[camera],
            hint=f"Check its offset in [sync]: {round(late):+d} frames would fit better.",
        )
        for camera, late in frames.items()
    ]


def _step_of_delay(
    names: Sequence[str], records: Mapping[int, FrameRecord], extrinsics: Extrinsics, config: TrackingConfig
) -> list[Finding]:
    """Say that the delay of a camera changes in mid take."""
    steps = delay_steps(records, outline_variance(records, config), extrinsics, whole_frames(records))
    # Poses follow the camera in part, so that the others seem to step the other way: the clearest step is its own.
    clearest = max(range(len(steps)), key=lambda c: abs(steps[c].step) / steps[c].sigma, default=None)
    if clearest is None:
        return []
    found = steps[clearest]
    if abs(found.step) <= max(_STEP_FRAMES, _CLEARLY * found.sigma):
        return []
    return [_dropped(names[clearest], found.step, found.frame)]


def _dropped(name: str, step: float, frame: int) -> Finding:
    return Finding(
        "frame_dropped",
        "warning",
        f"its delay changes by {step:+.1f} frames near here: a frame was dropped or doubled; below "
        f"{_STEP_FRAMES} frames is usual.",
        value=round(step, 2),
        limit=_STEP_FRAMES,
        camera=name,
        frame=frame,
        hint="Export the clip again at a constant frame rate, or cut the take there.",
    )
