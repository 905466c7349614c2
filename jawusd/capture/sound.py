"""Align cameras in time by what their microphones heard: generalised cross-correlation.

Knapp & Carter 1976, with partial whitening: full whitening (PHAT) lets bands that hold only noise count as much as
the voice, none lets a hum win. One sample is 1/16000 s; sound needs 3 ms per metre, so cameras metres apart are off by
that.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from scipy.fft import irfft, next_fast_len, rfft

from jawusd.base.errors import SyncError
from jawusd.media.audio import Sound

RATE_HZ = 16000
_WHITENING = 0.75
_LOWEST_HZ = 80.0  # below it is mains hum and wind
_APART_S = 0.02  # two peaks closer than this are one
_LEAST_SIGMAS = 9.0  # the largest of millions of chance correlations stays below 6
_SECOND_PEAK = 0.7  # of the highest; more is a rhythm that fits several ways


class SoundMatch(NamedTuple):
    """Say how two sounds lie in time."""

    delay_s: float  # time of an event in the reference's file minus that in the other's [s]
    confidence: float  # 1 minus the height of the second peak over that of the first, 0 .. 1


def match_sounds(sound: Sound, reference: Sound) -> SoundMatch:
    """Find the delay between two sounds of one scene.

    Raises:
        SyncError: one is silent, they have nothing in common, or several delays fit as well.
    """
    if not (np.ptp(sound.samples) > 0 and np.ptp(reference.samples) > 0):
        raise SyncError("the sound is silent.")
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
            f"the sounds have nothing in common: the best match stands out {peak / sigma:.1f} sigma, at least "
            f"{_LEAST_SIGMAS:g} are needed."
        )
    if second > _SECOND_PEAK * peak:
        other = lags[far][int(np.argmax(correlation[far]))] / sound.rate_hz
        raise SyncError(
            f"the sounds match with {lags[at] / sound.rate_hz:.2f} s and with {other:.2f} s of delay alike."
        )
    before, after = correlation[at - 1], correlation[(at + 1) % size]
    bend = before - 2 * peak + after
    exact = lags[at] + (0.5 * (before - after) / bend if bend < 0 else 0.0)
    delay = exact / sound.rate_hz + reference.start_s - sound.start_s
    return SoundMatch(float(delay), 1 - max(0.0, second) / peak)
