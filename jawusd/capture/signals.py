"""Signals for synchronisation: light flashes and sound.

The mean brightness of an image falls and rises with the room light. The times of these steps, matched between two
cameras, give their offset in whole frames. A step during an exposure results in an image of intermediate brightness,
which gives the time of the step to a fraction of a frame. If the shutter never closes, every step falls into an
exposure; otherwise only some steps do.

Sounds are matched by generalised cross-correlation (Knapp & Carter 1976) with partial whitening: full whitening (PHAT)
weights noisy bands as much as the voice, while without whitening hum dominates. The resolution is 1/16000 s, but sound
travels at 3 ms per metre, which causes errors for cameras that are metres apart.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.fft import irfft, next_fast_len, rfft

from jawusd.base.arrays import Array
from jawusd.base.errors import SyncError
from jawusd.media.clip import Clip
from jawusd.media.containers import Sound

_FIRST_WINDOW_S = 4.0  # initial length of the part of a video searched at each end; doubled until a flash is found
_SPARSE = 8  # pixel step in both directions when the mean brightness of an image is computed
_CONTRAST = 0.3  # minimum relative brightness change of a flash; moving people cause a few per cent
_ABRUPT_FRAMES = 3  # maximum duration of a light step [frames]
_TOLERANCE_FRAMES = 1.0  # maximum time difference of matched light steps [frames]
_DROPPED_S = 0.5  # maximum offset difference at which unmatched light steps indicate dropped frames
_FEWEST_STEPS = 2
_BETWEEN_FRAMES = 0.15  # maximum distance from a frame boundary at which a step counts as lying between two exposures
RATE_HZ = 16000
_WHITENING = 0.75
_LOWEST_HZ = 80.0  # minimum frequency of the sound that is used; excludes mains hum and wind
_APART_S = 0.02  # minimum distance of separate correlation peaks
_LEAST_SIGMAS = 9.0  # minimum height of the correlation peak [sigma]; random peaks stay below 6
_SECOND_PEAK = 0.7  # maximum height of the second correlation peak relative to the highest; exceeded by periodic sound


@dataclass(frozen=True)
class Step:
    """A sudden change of the brightness of a video."""

    time_frames: float  # time in frames of the video; the exposure of frame k starts at time k
    rising: bool  # True if the light is switched on, False if it is switched off
    slack_frames: float = 0.0  # duration by which the step may be earlier because images before it are missing


@dataclass(frozen=True)
class Offset:
    """Time offset of a camera: its frame k is simultaneous with frame k + `frames` of the reference camera."""

    frames: int  # offset in whole frames
    exact_frames: float  # offset including its estimated sub-frame part
    spread_frames: float  # maximum deviation of a matched light step from exact_frames; 0 for sound
    matched_steps: int  # number of light steps found in both cameras; 0 for sound
    confidence: float  # fraction of matched light steps, or see `match_sounds`; 0 to 1


def find_steps(brightness: Array, first_frame: int = 0) -> list[Step]:
    """Return the light steps in the brightness (n,) of successive images, 0 to 255; none if all changes are small."""
    if len(brightness) < 2 or brightness.max() - brightness.min() < _CONTRAST * brightness.max():
        return []
    contrast = brightness.max() - brightness.min()
    bright = brightness >= brightness.min() + contrast / 2
    crossings = np.flatnonzero(bright[1:] != bright[:-1]) + 1
    limits = [0, *crossings.tolist(), len(brightness)]
    steps = []
    for before, at, after in zip(limits[:-2], limits[1:-1], limits[2:]):
        first, last = max(before, at - _ABRUPT_FRAMES), min(after, at + _ABRUPT_FRAMES)
        around = brightness[first:last]
        low, high = around.min(), around.max()
        if high - low < contrast / 2:
            continue  # skip slow changes, as caused by clouds, a dimmer or automatic exposure
        lit = float(((around - low) / (high - low)).sum())
        rising = bool(bright[at])
        steps.append(Step(first_frame + (last - lit if rising else first + lit), rising))
    return steps


def match_steps(steps: list[Step], reference: list[Step], fps: float) -> Offset:
    """Estimate the time offset of a camera from its light steps and those of the reference camera.

    Raises:
        SyncError: fewer than two steps match, the offset is ambiguous, or frames were dropped.
    """
    candidates = {round(r.time_frames - s.time_frames) for s in steps for r in reference if s.rising == r.rising}
    ranked = sorted((_aligned(steps, reference, offset) for offset in candidates), key=lambda a: (-len(a[0]), a[1]))
    if not ranked or len(ranked[0][0]) < _FEWEST_STEPS:
        raise SyncError(
            f"the light steps at frames {_listed(steps)} do not match those of the reference camera at "
            f"{_listed(reference)}."
        )
    pairs, spread, exact = ranked[0]
    _check_dropped_frames(steps, reference, pairs, exact, _DROPPED_S * fps)
    for other_pairs, other_spread, other in ranked[1:]:
        if len(other_pairs) == len(pairs) and other_spread < spread + 0.5 and abs(other - exact) > _TOLERANCE_FRAMES:
            raise SyncError(f"the light flashes match equally well at offsets of {exact:.0f} and {other:.0f} frames.")
    confidence = 2 * len(pairs) / (len(steps) + len(reference))
    return Offset(round(exact), exact, spread, len(pairs), confidence)


def _check_dropped_frames(
    steps: list[Step], reference: list[Step], pairs: list[tuple[int, int]], exact: float, reach_frames: float
) -> None:
    """Raise an error if unmatched light steps would match at a slightly different offset."""
    lone_steps, lone_partners = (
        [step for k, step in enumerate(own) if k not in {pair[side] for pair in pairs}]
        for side, own in enumerate((steps, reference))
    )
    for step in lone_steps:
        for partner in lone_partners:
            other = partner.time_frames - step.time_frames
            if step.rising == partner.rising and abs(other - exact) < reach_frames:
                matched = steps[pairs[0][0]].time_frames
                (early, before), (late, after) = sorted([(matched, exact), (step.time_frames, other)])
                raise SyncError(
                    f"the offset is {before:.1f} frames at frame {early:.0f} and {after:.1f} at frame {late:.0f}: "
                    "frames were dropped while recording."
                )


def _aligned(steps: list[Step], reference: list[Step], offset: int) -> tuple[list[tuple[int, int]], float, float]:
    """Return index pairs of light steps that match at an offset, and their spread and exact offset [frames]."""
    pairs, differences, slacks = [], [], []
    for i, step in enumerate(steps):
        for j, partner in enumerate(reference):
            difference = partner.time_frames - step.time_frames
            low, high = difference - partner.slack_frames, difference + step.slack_frames
            if step.rising == partner.rising and low - _TOLERANCE_FRAMES <= offset <= high + _TOLERANCE_FRAMES:
                pairs.append((i, j))
                differences.append(difference)
                slacks.append(step.slack_frames + partner.slack_frames)
                break
    if not pairs:
        return [], 0.0, float(offset)
    # Only the most precise pairs determine the offset.
    best = np.array(differences)[np.array(slacks) == min(slacks)]
    exact = float(np.median(best))
    return pairs, float(np.abs(best - exact).max()), exact


def to_frames(steps: list[Step], numbers: NDArray[np.int64]) -> list[Step]:
    """Convert the times of light steps from image indices to frame numbers; `numbers` (n,) are those of the images."""
    out = []
    for step in steps:
        nearest = round(step.time_frames)
        between = abs(step.time_frames - nearest) < _BETWEEN_FRAMES and 0 < nearest < len(numbers)
        picture = nearest if between else min(int(step.time_frames), len(numbers) - 1)
        # A light step between two exposures may have occurred at any time in the gap between them. The time of a step
        # within an exposure is known from the brightness of the image.
        gap = float(numbers[picture] - numbers[picture - 1] - 1) if between else 0.0
        out.append(Step(float(numbers[picture]) + step.time_frames - picture, step.rising, max(0.0, gap)))
    return out


def find_flashes(video: Clip) -> tuple[list[Step], str]:
    """Return light steps near both ends of a video in temporal order, and why there are too few; "" if enough.

    The search is widened until there are enough.

    Raises:
        CaptureError: the video cannot be decoded.
    """
    window = max(2, round(_FIRST_WINDOW_S * video.fps))
    head: list[Step] = []
    tail: list[Step] = []
    while 2 * window < video.count:
        if len(head) < _FEWEST_STEPS:
            head = find_steps(_brightness(video, 0, window))
        if len(tail) < _FEWEST_STEPS:
            tail = find_steps(_brightness(video, video.count - window, video.count), video.count - window)
        if min(len(head), len(tail)) >= _FEWEST_STEPS:
            return head + tail, ""
        window *= 2
    brightness = _brightness(video, 0, video.count)
    steps = find_steps(brightness)
    if len(steps) >= _FEWEST_STEPS:
        return steps, ""
    return steps, (
        f"shows no light flash: {len(steps)} sudden changes, brightness {brightness.min():.0f} to "
        f"{brightness.max():.0f} of 255 over all {video.count} frames; a flash changes brightness by more than "
        f"{_CONTRAST:.0%} and back"
    )


def _brightness(video: Clip, first: int, last: int) -> Array:
    return np.array([mean_brightness(frame.image) for frame in video.frames(first, last, threads=1)])


def mean_brightness(image: NDArray[np.uint8]) -> float:
    """Return the mean brightness of an image, computed from every 8th pixel in both directions."""
    return float(image[::_SPARSE, ::_SPARSE].mean())


def _listed(steps: list[Step]) -> str:
    return ", ".join(f"{step.time_frames:.1f} ({'on' if step.rising else 'off'})" for step in steps)


def match_sounds(sound: Sound, reference: Sound) -> tuple[float, float]:
    """Return the time [s] of an event in the reference recording minus that in the other, and the confidence, 0 to 1.

    The confidence is 1 minus the ratio of the second-highest correlation peak to the highest.

    Raises:
        SyncError: a recording is silent, the sounds do not match, or the delay is ambiguous.
    """
    if not (np.ptp(sound.samples) > 0 and np.ptp(reference.samples) > 0):
        raise SyncError("the recording is silent.")
    count = len(sound.samples) + len(reference.samples)
    size = next_fast_len(count, real=True)
    cross = rfft(reference.samples, size) * np.conj(rfft(sound.samples, size))
    cross *= np.abs(cross) ** -_WHITENING if np.abs(cross).min() > 0 else (np.abs(cross) + 1e-12) ** -_WHITENING
    cross[: int(_LOWEST_HZ * size / sound.rate_hz)] = 0
    correlation = irfft(cross, size)
    lags = np.fft.fftfreq(size, 1 / size).astype(np.int64)
    possible = (lags > -len(sound.samples)) & (lags < len(reference.samples))
    correlation[~possible] = 0
    at = int(np.argmax(correlation))
    peak = float(correlation[at])
    sigma = 1.4826 * float(np.median(np.abs(correlation[possible])))
    far = np.abs(lags - lags[at]) > _APART_S * sound.rate_hz
    second = float(correlation[far].max()) if far.any() else 0.0
    if peak < _LEAST_SIGMAS * sigma:
        raise SyncError(
            f"the sounds do not match: the height of the correlation peak is {peak / sigma:.1f} sigma; at least "
            f"{_LEAST_SIGMAS:g} sigma are needed."
        )
    if second > _SECOND_PEAK * peak:
        other = lags[far][int(np.argmax(correlation[far]))] / sound.rate_hz
        raise SyncError(
            f"the sounds match equally well at delays of {lags[at] / sound.rate_hz:.2f} s and {other:.2f} s."
        )
    before, after = correlation[at - 1], correlation[(at + 1) % size]
    bend = before - 2 * peak + after
    exact = lags[at] + (0.5 * (before - after) / bend if bend < 0 else 0.0)
    delay = exact / sound.rate_hz + reference.start_s - sound.start_s
    return float(delay), 1 - max(0.0, second) / peak
