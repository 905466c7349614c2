"""Mistakes in scans, calibration, masks or picks that can make picks and masks contradict one another.

Each candidate mistake is yielded with corrected inputs; `pick_checks` tests whether picks and masks then agree.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import combinations

import numpy as np
from scipy.optimize import least_squares

from jawusd.base.arrays import Array
from jawusd.formats.capture import Pick
from jawusd.geometry import Camera, se3_exp, transform_points
from jawusd.tracking.initialization.bootstrap import SIZE_HINT, exchanged, picked_size, placed, than, with_cameras
from jawusd.tracking.initialization.magnification import zoomed

_SIZE_SHARE = 0.02  # minimum relative error of the scan size, estimated from the picks, for it to be a possible mistake
# Prior standard deviations of a camera's errors: shift as a fraction of the image width, and relative focal length; and
# standard deviation of a click [mm].
_SHIFT, _FOCAL, _CLICK_MM = 0.05, 0.1, 0.3
_MOST_ZOOM = np.log(2.0)  # bound on the log of the focal-length factor, which would overflow for random clicks
_STEP = np.array([0.1, 0.1, 0.1, 1.0, 1.0, 1.0])  # scale of the pose unknowns [rad, mm]: about their usual error


@dataclass(frozen=True, eq=False)
class Setting:
    """All inputs that determine the projections of the scans, as given or with a mistake corrected."""

    picks: tuple[Sequence[Pick], Sequence[Pick]]  # picks on the upper and on the lower arch
    vertices: tuple[Array, Array]  # vertices of both scans, as indexed by the picks [mm]
    crowns: tuple[Array, Array]  # some points of both scans' crowns [mm]
    cameras: Mapping[str, Camera]  # calibrated cameras by name
    #: for each camera name, the name of the camera whose masks it uses; by default, its own
    sources: Mapping[str, str] = field(default_factory=dict)
    exchanged: frozenset[str] = frozenset()  # cameras for which the masks of the two arches are swapped


@dataclass(frozen=True, eq=False)
class Mistake:
    """A possible mistake, and the inputs after correcting it."""

    kind: str
    message: str
    hint: str
    setting: Setting
    correctable: bool = False  # whether tracking corrects the mistake, provided that the picks agree with one another
    camera: str | None = None


def possible_mistakes(given: Setting) -> Iterator[Mistake]:
    """Yield every mistake that can be corrected; those of single cameras take longest and come last."""
    message = "the scans are mirrored: left and right are exchanged"
    hint = "Export them again without mirroring; one axis may have been negated."
    yield Mistake("scans_mirrored", message, hint, _with_scans(given, np.array([-1.0, 1.0, 1.0])))
    vertices = given.vertices[::-1]
    if all(pick.vertex < len(own) for own, picks in zip(vertices, given.picks, strict=True) for pick in picks):
        message, hint = "upper_teeth and lower_teeth in [scans] are exchanged", "Exchange the names of these files."
        yield Mistake("scans_exchanged", message, hint, replace(given, vertices=vertices, crowns=given.crowns[::-1]))
    yield from _exchanges(given)
    size = picked_size(given.picks, given.vertices, given.cameras)
    if abs(size - 1.0) > _SIZE_SHARE:
        message = f"the picks show teeth {than(1.0 / size - 1.0)} than the scans: the scale of the scans or of the "
        message += "calibration is wrong"
        yield Mistake("scan_size", message, SIZE_HINT, _with_scans(given, np.full(3, 1.0 / size)), True)
    yield from _wrong_lenses(given)


def _exchanges(given: Setting) -> Iterator[Mistake]:
    """Yield swaps of calibrations, of cameras in the picks, and of masks."""
    message = "the two cameras of the picks are exchanged"
    hint = "Exchange the camera names within every pick of [bootstrap]."
    upper, lower = (with_cameras(picks, lambda names: names[::-1]) for picks in given.picks)
    yield Mistake("picks_views_exchanged", message, hint, replace(given, picks=(upper, lower)))
    for a, b in combinations(given.cameras, 2):
        both, other = f"cameras {a} and {b}", {a: b, b: a}
        message = f"the calibrations of {both} are exchanged"
        hint = f"Exchange the names {a} and {b} in the calibration."
        cameras = {name: given.cameras[other.get(name, name)] for name in given.cameras}
        yield Mistake("calibrations_exchanged", message, hint, replace(given, cameras=cameras))
        message, hint = f"{both} are exchanged in the picks", "Exchange these names in [bootstrap]."
        upper, lower = (exchanged(picks, a, b) for picks in given.picks)
        yield Mistake("picks_cameras_exchanged", message, hint, replace(given, picks=(upper, lower)))
        message, hint = f"the masks of {both} are exchanged", f"Exchange the masks of {both}."
        yield Mistake("masks_cameras_exchanged", message, hint, replace(given, sources=other))
    message, hint = "the masks of the upper and lower teeth are exchanged in", "Exchange masks.upper and masks.lower"
    for name in given.cameras:
        swapped = replace(given, exchanged=frozenset([name]))
        yield Mistake("masks_arches_exchanged", f"{message} camera {name}", f"{hint} of camera {name}.", swapped)
    message, hint = f"{message} every camera", f"{hint}, or upper_teeth and lower_teeth in [scans] and the picks."
    yield Mistake("masks_arches_exchanged", message, hint, replace(given, exchanged=frozenset(given.cameras)))


def _with_scans(given: Setting, factors: Array) -> Setting:
    vertices, crowns = ((own[0] * factors, own[1] * factors) for own in (given.vertices, given.crowns))
    return replace(given, vertices=vertices, crowns=crowns)


def _wrong_lenses(given: Setting) -> Iterator[Mistake]:
    """Yield mistakes of cameras whose images may be shifted or scaled relative to their calibration."""
    for name, camera in given.cameras.items():
        for zooms in (False, True):
            fitted = fitted_camera(given.picks, given.vertices, given.cameras, name, zooms)
            if fitted is None:
                continue
            setting = replace(given, cameras={**given.cameras, name: fitted})
            if zooms:
                share = float(fitted.K[0, 0] / camera.K[0, 0] - 1.0)
                kind = "focal_length"
                cause = f"if its focal length is changed by {share:+.1%}: the calibrated focal length is wrong"
            else:
                px = float(np.hypot(*(fitted.K[:2, 2] - camera.K[:2, 2])))
                kind = "principal_point"
                cause = f"if its images are shifted by {px:.0f} px: its principal point is wrong, or it was turned"
            message = f"the calibration of camera {name} contradicts the picks; it agrees {cause}"
            hint = "Calibrate it again, with the lens and mode of the recording."
            yield Mistake(kind, message, hint, setting, True, name)


def shifted(camera: Camera, shift_px: Array) -> Camera:
    """Return a camera with its principal point moved by `shift_px` (2,)."""
    K = camera.K.copy()
    K[:2, 2] += shift_px
    return replace(camera, K=K)


def fitted_camera(
    picks: Sequence[Sequence[Pick]],
    vertices: Sequence[Array],
    cameras: Mapping[str, Camera],
    name: str,
    zooms: bool,
) -> Camera | None:
    """Return a camera whose principal point or focal length, with the poses of the scans, is adjusted to the picks.

    Return None if no pick has a pixel in that camera, or if the picks of an arch lie on a line.
    """
    if all(view.camera != name for own in picks for pick in own for view in pick.views):
        return None
    given = cameras[name]
    width = float(given.size_px[0])

    def changed(x: Array) -> Camera:
        if not zooms:
            return shifted(given, x[:2] * _SHIFT * width)
        return zoomed(given, float(np.exp(np.clip(x[0] * _FOCAL, -_MOST_ZOOM, _MOST_ZOOM))))

    found = [placed(own, points, cameras) for own, points in zip(picks, vertices, strict=True)]
    starts = [start for start in found if start is not None]
    if len(starts) < len(found):
        return None
    sights = [_sights(own, points) for own, points in zip(picks, vertices, strict=True)]

    def residuals(x: Array) -> Array:
        """Return pick errors and camera changes, each divided by its prior standard deviation."""
        table = {**cameras, name: changed(x)}
        out = [x[:2]]
        for k, (start, seen) in enumerate(zip(starts, sights, strict=True)):
            T = se3_exp(x[2 + 6 * k : 8 + 6 * k] * _STEP)
            about, middle, views = seen
            everything = transform_points(start, middle + transform_points(T, about))
            for camera_name, which, pixels in views:
                camera, points = table[camera_name], everything[which]
                mm_per_px = camera.depth(points) / float(camera.K[0, 0])
                out.append(((camera.project(points) - pixels) * mm_per_px[:, None] / _CLICK_MM).ravel())
        return np.concatenate(out)

    return changed(least_squares(residuals, np.zeros(14), method="lm", max_nfev=250).x)


def _sights(picks: Sequence[Pick], vertices: Array) -> tuple[Array, Array, list[tuple[str, list[int], Array]]]:
    """Return the picked points relative to their mean (P, 3), the mean (3,), and indices and pixels by camera."""
    points = np.stack([vertices[pick.vertex] for pick in picks])
    middle = points.mean(axis=0)
    seen: dict[str, list[tuple[int, list[float]]]] = {}
    for k, pick in enumerate(picks):
        for view in pick.views:
            seen.setdefault(view.camera, []).append((k, [view.x, view.y]))
    views = [(name, [k for k, _ in own], np.array([pixel for _, pixel in own])) for name, own in seen.items()]
    return points - middle, middle, views
