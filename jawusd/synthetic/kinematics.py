"""Temporomandibular joint: two condyles on curved eminences, driven by opening, lateral and protrusion controls.

Poses are in the scan frame (x to the subject's left, y up, z anterior, mm); at the identity, the teeth are in
occlusion. The mandible has four joint coordinates: the pitch about the condylar axis, the forward slide of each
condyle, and the side shift. The heights of the condyles follow from the eminences, and their lateral positions from
the constant distance between them, so that both condyles stay on their slopes in every pose.
Joint surfaces, guidance and ranges follow textbook TMJ mechanics (Posselt 1952, Okeson 2019) and are independent of the
models that jawusd fits.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from jawusd.base.arrays import Array
from jawusd.geometry import make_transform, so3_exp
from jawusd.meshes.bones import JointShape, eminence_path

# Pitch [rad] at which the tooth guidance, a Gaussian of pitch, has decreased by a factor of e.
_CONTACT_FADE_RAD = np.deg2rad(4.0)
# Rounding of corners in the tooth guidance [mm], since cusps are blunt.
_CUSP_ROUNDING_MM = 0.3


@dataclass(frozen=True)
class Joint(JointShape):
    """Parameters of one subject's joint; pairs are (left, right), lengths are in mm, angles in rad."""

    medial_slope: Array  # drop of a condyle per mm towards the midline, shape (2,)
    bennett_rad: Array  # angle between each condyle's path on the balancing side and the sagittal plane, shape (2,)
    side_shift_mm: Array  # immediate side shift towards each working side, shape (2,)
    lateral_max_mm: Array  # maximum difference of the two slides for each working side, shape (2,)
    lateral_shrink: float  # fraction by which `lateral_max_mm` shrinks at full opening
    working_share: float  # fraction of the slide difference that the balancing condyle contributes with closed teeth
    rotation_max_rad: float  # pitch at full opening
    rotation_bend: float  # curvature of pitch over opening (0: proportional)
    slide_open_mm: float  # forward slide of the condyles at full opening
    slide_limit_mm: float  # maximum forward slide of a condyle
    slide_early: float  # fraction of the opening slide that starts early; the rest lags behind the rotation
    slide_onset: float  # opening (0..1) around which the early part of the slide becomes proportional to opening
    protrusion_max_mm: float  # forward slide in full protrusion at zero opening
    retrusion_max_mm: float  # backward slide in full retrusion at zero opening
    hinge_share: float  # fraction of the opening slide reversed by retrusion below half opening
    deviation_mm: Array  # lateral deviation of the opening path: S-shaped part and one-sided part, shape (2,)
    protrusive_guidance: Array  # protrusive tooth guidance: initial slope, later slope, transition length [mm], (3,)
    lateral_guidance: Array  # lateral tooth guidance, in the same order, shape (3,)

    @property
    def lever_mm(self) -> float:
        """Return the forward distance from the condylar axis to the lower incisors [mm]."""
        return float(self.incisor[2] - self.condyles[:, 2].mean())


def smoothstep(x: ArrayLike) -> Array:
    """Return a smooth step from 0 to 1 for x in 0..1, with zero slope at both ends; x has any shape."""
    x = np.clip(np.asarray(x, dtype=np.float64), 0.0, 1.0)
    return x * x * (3.0 - 2.0 * x)


def eminence(joint: Joint, side: int, slide_mm: ArrayLike, medial_mm: ArrayLike = 0.0) -> Array:
    """Return the height of a condyle centre (side 0 left, 1 right) relative to rest [mm], negative down the eminence.

    Slides forward (any shape) follow `eminence_path`; `medial_mm` is the displacement towards the midline, same shape.
    """
    slide = np.asarray(slide_mm, dtype=np.float64)
    return eminence_path(joint, side, slide) - joint.medial_slope[side] * np.asarray(medial_mm) * smoothstep(
        slide / 8.0
    )


def joint_pose(
    joint: Joint, pitch_rad: ArrayLike, slides_mm: ArrayLike, shift_mm: ArrayLike, lifts_mm: ArrayLike
) -> Array:
    """Return the mandible poses T_skull_mandible (..., 4, 4) that put both condyles on their eminences.

    Args:
        pitch_rad: opening rotation about the condylar axis, shape (...).
        slides_mm: forward slide of the (left, right) condyle, shape (..., 2).
        shift_mm: shift of the condylar midpoint to the left, shape (...).
        lifts_mm: distance of the (left, right) condyle below its eminence, shape (..., 2).
    """
    pitch, slides, shift, lifts = (np.asarray(value) for value in (pitch_rad, slides_mm, shift_mm, lifts_mm))
    left, right = joint.condyles
    rest_axis = left - right
    distance = joint.condylar_distance_mm
    spread = np.full(pitch.shape, rest_axis[0])
    middle_x = (left[0] + right[0]) / 2 + shift
    for _ in range(4):  # condyle heights and lateral positions are coupled; each iteration adds two correct digits
        y_left = left[1] + eminence(joint, 0, slides[..., 0], left[0] - middle_x - spread / 2) - lifts[..., 0]
        y_right = right[1] + eminence(joint, 1, slides[..., 1], middle_x - spread / 2 - right[0]) - lifts[..., 1]
        dy, dz = y_left - y_right, rest_axis[2] + slides[..., 0] - slides[..., 1]
        spread = np.sqrt(distance**2 - dy**2 - dz**2)
    unit, rest_unit = np.stack([spread, dy, dz], -1) / distance, rest_axis / distance
    middle = np.stack([middle_x, (y_left + y_right) / 2, (left[2] + right[2] + slides.sum(-1)) / 2], -1)
    normal = np.cross(np.broadcast_to(rest_unit, unit.shape), unit)
    sine = np.linalg.norm(normal, axis=-1)
    scale = np.where(sine > 1e-9, np.arcsin(np.minimum(sine, 1.0)) / np.maximum(sine, 1e-9), 1.0)
    R = so3_exp(normal * scale[..., None]) @ so3_exp(pitch[..., None] * rest_unit)
    return make_transform(R, middle - R @ ((left + right) / 2))


def controlled_pose(
    joint: Joint, opening: ArrayLike, lateral: ArrayLike, protrusion: ArrayLike, extra_mm: ArrayLike | None = None
) -> Array:
    """Return T_skull_mandible (..., 4, 4) for controls; outside the ranges of the controls, extrapolate smoothly.

    Args:
        opening: from 0 (closed) to 1 (wide open), shape (...).
        lateral: from -1 (right) to 1 (left), relative to the range at this opening, shape (...).
        protrusion: from -1 (retruded) to 1 (protruded), relative to the range at this opening, shape (...).
        extra_mm: small movements outside the three controls: side shift, and lift of the left and of the right condyle,
            shape (..., 3); None means zero.
    """
    opening, lateral, protrusion = np.broadcast_arrays(
        *(np.asarray(c, dtype=np.float64) for c in (opening, lateral, protrusion))
    )
    extra = np.zeros((*opening.shape, 3)) if extra_mm is None else np.asarray(extra_mm, dtype=np.float64)
    wide = np.clip(opening, -0.1, 1.15)
    share = _coupling(joint, np.maximum(wide, 0.0))
    habitual_mm = joint.slide_open_mm * share
    mean_mm = habitual_mm + protrusion * _protrusive_range(joint, wide, share, protrusion)
    difference_mm = lateral * _lateral_range(joint, wide, mean_mm, lateral)
    balancing = joint.working_share - 0.45 * smoothstep(wide)
    slides = _slides(mean_mm, difference_mm, balancing)
    shift = _side_shift(joint, wide, difference_mm, balancing)
    pitch = joint.rotation_max_rad * wide * (1.0 + joint.rotation_bend * (1.0 - wide))
    pitch = _guided(joint, pitch, slides, mean_mm - habitual_mm, difference_mm)
    return joint_pose(joint, pitch, slides, shift + extra[..., 0], extra[..., 1:])


def _coupling(joint: Joint, opening: Array) -> Array:
    """Return the fraction of the full condylar slide at an opening; the slide starts early but lags behind rotation."""
    onset = joint.slide_onset
    early = opening**2 * (1.0 + onset) / (opening + onset)
    return joint.slide_early * early + (1.0 - joint.slide_early) * smoothstep(opening)


def _protrusive_range(joint: Joint, opening: Array, share: Array, protrusion: Array) -> Array:
    """Return the largest forward slide of both condyles [mm] or, for negative protrusion, the backward slide."""
    forward = joint.protrusion_max_mm * (1.0 - 0.85 * np.clip(share, 0.0, 1.1))
    hinge = joint.hinge_share * joint.slide_open_mm * share * (1.0 - smoothstep((opening - 0.3) / 0.5))
    backward = joint.retrusion_max_mm * (1.0 - np.clip(opening, 0.0, 1.0)) + 0.15 + hinge
    return np.where(protrusion > 0, forward, backward)


def _lateral_range(joint: Joint, opening: Array, mean_mm: Array, lateral: Array) -> Array:
    """Return the maximum difference between both condyles' slides [mm], limited by the balancing condyle's stop."""
    own = np.where(lateral > 0, joint.lateral_max_mm[0], joint.lateral_max_mm[1])
    own = own * (1.0 - joint.lateral_shrink * np.clip(opening, 0.0, 1.1) ** 1.1)
    room = (joint.slide_limit_mm + 1.2 - mean_mm) / (joint.working_share - 0.45 * smoothstep(opening))
    return np.maximum(-0.6 * np.logaddexp(-own / 0.6, -room / 0.6), 0.3)


def _slides(mean_mm: Array, difference_mm: Array, balancing: Array) -> Array:
    """Return the slides of the (left, right) condyle; in a movement to the left, the right condyle is balancing."""
    forward, backward = balancing * np.abs(difference_mm), (1.0 - balancing) * np.abs(difference_mm)
    to_left = difference_mm > 0
    left = mean_mm + np.where(to_left, -backward, forward)
    right = mean_mm + np.where(to_left, forward, -backward)
    return np.stack([left, right], -1)


def _side_shift(joint: Joint, opening: Array, difference_mm: Array, balancing: Array) -> Array:
    """Return the left shift of the condyles' midpoint [mm]: Bennett movement and deviation of the opening path."""
    size = np.abs(difference_mm)
    # The Bennett angle belongs to the balancing condyle, which is the right one in a movement to the left.
    tangent = np.tan(np.where(difference_mm > 0, joint.bennett_rad[1], joint.bennett_rad[0]))
    immediate = np.where(difference_mm > 0, joint.side_shift_mm[0], joint.side_shift_mm[1])
    bennett = tangent * balancing * size + immediate * np.tanh(size / 1.5) * (1.0 - smoothstep(opening / 0.6))
    wander = joint.deviation_mm[0] * np.sin(2 * np.pi * np.clip(opening, 0.0, 1.0))
    return np.sign(difference_mm) * bennett + wander + joint.deviation_mm[1] * smoothstep(opening)


def _guided(joint: Joint, pitch: Array, slides: Array, forward_mm: Array, difference_mm: Array) -> Array:
    """Return the pitch including tooth contact; near closure, only tooth guidance determines the incisors' height."""
    lateral_mm = difference_mm * joint.lever_mm / joint.condylar_distance_mm
    drop_mm = _glide(joint.protrusive_guidance, _soft_positive(forward_mm))
    drop_mm = drop_mm + _glide(joint.lateral_guidance, np.hypot(lateral_mm, _CUSP_ROUNDING_MM) - _CUSP_ROUNDING_MM)
    condyles_mm = (eminence(joint, 0, slides[..., 0]) + eminence(joint, 1, slides[..., 1])) / 2
    contact = (drop_mm + condyles_mm) / joint.lever_mm
    return pitch + contact * np.exp(-((pitch / _CONTACT_FADE_RAD) ** 2))


def _glide(guidance: Array, distance_mm: Array) -> Array:
    """Return the drop of the lower incisors [mm] at a glide distance [mm]: steep at first, then flatter."""
    steep, flat, transition_mm = guidance
    return flat * distance_mm + (steep - flat) * transition_mm * -np.expm1(-distance_mm / transition_mm)


def _soft_positive(x: Array) -> Array:
    """Return the positive part of a value, with a rounded corner; the result is 0 at 0."""
    return (x + np.hypot(x, _CUSP_ROUNDING_MM) - _CUSP_ROUNDING_MM) / 2
