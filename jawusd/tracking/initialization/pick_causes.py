"""Which mistake in scans, calibration, masks or picks explains why picks or masks contradict one another?

Each mistake that can be undone is undone in turn; the one is named after which all picks agree and the masks lie on
the scans as the picks place them.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from itertools import combinations, islice

import numpy as np
from scipy.spatial import cKDTree

from jawusd.base.arrays import Array
from jawusd.base.errors import TrackingError
from jawusd.formats.capture import Pick
from jawusd.geometry import Camera, transform_points
from jawusd.tracking.contour.scan import ARCH_NAMES, ARCHES
from jawusd.tracking.initialization.bootstrap import TOLERANCE_MM, picked_size, picks_miss_mm, pose_from_picks
from jawusd.tracking.initialization.pick_cameras import fitted_camera

_CLOSE_MM = 1.0  # mask pixels this near to a projected crown point count as covered
ON = 0.85  # share of a camera's masks on the scans, from which they count as placed rightly
# A mistake is believed if undoing it leaves less than this share of the doubt that is left as given; one that tracking
# makes up for, which is a warning, also if picks that had to be left out fit then.
_PROOF, _PROOF_BY_PICKS = 0.5, 0.75
# What weighs as much as one another: share of masks off the scans, and distance of the picks from their vertices [mm].
_OFF, _MISS_MM = 0.05, 0.3
_UNSEEN = 0.25  # share off the scans that a camera without masks at the instant counts as: it may be elsewhere
_SURE = 1.0  # doubt that an exchange leaves, below which nothing else is looked for
_ALIKE = 0.15  # doubt by which a mistake may be worse than the likeliest one and still be named beside it
_MOST_TRIED = 400  # mistakes: all of 15 cameras; those of 64 are 6,000, which would take most of an hour
# Size of the scans by the picks, less 1, from which it may be a mistake.
_SIZE_SHARE = 0.02

#: Pixels of the masks of both arches at the instant of the picks, shape (N, 2) each, N = 0 without a mask; by the
#: camera whose masks they are, and the camera by whose frame numbers they are taken.
Seen = Callable[[str, str], tuple[Array, Array]]


@dataclass(frozen=True, eq=False)
class Setting:
    """Hold everything that places the scans in the pictures, as given or with a mistake undone.

    Attributes:
        picks: on both arches.
        vertices: of both scans, which the picks name [mm].
        crowns: some points of both scans' crowns [mm].
        cameras: by name.
        sources: the camera whose masks are taken for each camera, itself if not named.
        exchanged: cameras in which the arches' masks are exchanged.
    """

    picks: tuple[Sequence[Pick], Sequence[Pick]]
    vertices: tuple[Array, Array]
    crowns: tuple[Array, Array]
    cameras: Mapping[str, Camera]
    sources: Mapping[str, str] = field(default_factory=dict)
    exchanged: frozenset[str] = frozenset()


@dataclass(frozen=True, eq=False)
class Evidence:
    """Hold how well picks and masks agree with a setting."""

    poses: Array  # T_world_upper, T_world_lower, shape (2, 4, 4)
    wrong: Mapping[str, list[int]]  # picks left out, by arch
    miss_mm: float  # rms distance of the picks, those left out counting as just too far
    on: Mapping[str, float]  # share of each camera's masks that lies on the scans, without cameras that have none
    unseen: int  # cameras without masks at this instant

    @property
    def doubt(self) -> float:
        """Return how badly everything fits: 0.2 to 1.5 where nothing is wrong."""
        off = np.array([1.0 - on for on in self.on.values()] + [_UNSEEN] * self.unseen)
        return float(off.mean() if self.on else 0.0) / _OFF + self.miss_mm / _MISS_MM

    @property
    def left_out(self) -> int:
        """Return how many picks were left out."""
        return sum(len(numbers) for numbers in self.wrong.values())

    @property
    def placed(self) -> bool:
        """Tell whether the masks of all cameras lie on the scans."""
        return all(on >= ON for on in self.on.values())

    @property
    def good(self) -> bool:
        """Tell whether nothing is left to be explained."""
        return self.placed and not self.left_out


def evidence(setting: Setting, seen: Sequence[Seen], masked: Sequence[str]) -> Evidence:
    """Place the scans by the picks of a setting and look where the masks of `masked` cameras lie.

    `seen` gives the masks once per guess of the time offsets; the best one counts for each camera.

    Raises:
        TrackingError: the picks contradict one another.
    """
    poses, wrong, misses = [], {}, []
    for picks, vertices, name in zip(setting.picks, setting.vertices, ARCH_NAMES, strict=True):
        pose, wrong[name] = pose_from_picks(picks, vertices, setting.cameras, name)
        misses.append(np.minimum(picks_miss_mm(picks, vertices, setting.cameras, pose), TOLERANCE_MM))
        poses.append(pose)
    rms = float(np.sqrt(np.mean(np.concatenate(misses) ** 2)))
    on = _covered(setting, poses, seen, masked)
    return Evidence(np.stack(poses), wrong, rms, on, len(masked) - len(on))


def _covered(setting: Setting, poses: Sequence[Array], seen: Sequence[Seen], masked: Sequence[str]) -> dict[str, float]:
    """Return which share of each camera's masks lies on the scans, at its best guess of the time offsets."""
    on = {}
    for name in masked:
        camera = setting.cameras[name]
        points = [transform_points(pose, own) for pose, own in zip(poses, setting.crowns, strict=True)]
        depth = float(np.mean([camera.depth(own.mean(0)) for own in points]))
        if not all((camera.depth(own) > 0).all() for own in points):
            on[name] = 0.0
            continue
        trees = [cKDTree(camera.project_pinhole(own)) for own in points]
        reach_px = _CLOSE_MM * float(camera.K[0, 0]) / depth
        source, arches = setting.sources.get(name, name), (1, 0) if name in setting.exchanged else ARCHES
        shares = []
        for guess in seen:
            pixels = [camera.undistort_pixels(own) if len(own) else own for own in guess(source, name)]
            near = [trees[arches[arch]].query(pixels[arch])[0] < reach_px for arch in ARCHES if len(pixels[arch])]
            shares += [float(np.mean([own.mean() for own in near]))] if near else []
        if shares:
            on[name] = max(shares)
    return on


@dataclass(frozen=True, eq=False)
class Mistake:
    """Hold a mistake and the setting with it undone."""

    kind: str
    message: str
    hint: str
    setting: Setting
    correctable: bool = False  # by the tracker, if the picks do not contradict one another
    camera: str | None = None


def explanation(
    given: Setting, found: Evidence | None, seen: Sequence[Seen], masked: Sequence[str]
) -> tuple[Mistake, Evidence] | None:
    """Return the mistake that explains best why a setting does not fit, and the evidence with it undone; else None.

    `found` is the evidence as everything is given, None if the picks contradict one another.
    """
    allowed = 0 if found is None else found.left_out
    tried: list[tuple[Mistake, Evidence]] = []
    for mistake in islice(_mistakes(given), _MOST_TRIED):
        if mistake.camera is not None and any(not m.correctable and e.doubt < _SURE for m, e in tried):
            break  # those of single cameras, which take longest, come last
        try:
            undone = evidence(mistake.setting, seen, masked)
        except TrackingError:
            continue
        if undone.left_out <= allowed and undone.placed:
            tried.append((mistake, undone))
    if not tried:
        return None
    mistake, undone = min(tried, key=lambda one: one[1].doubt)
    if found is not None:
        by_picks = mistake.correctable and undone.left_out < found.left_out
        if undone.doubt > (_PROOF_BY_PICKS if by_picks else _PROOF) * found.doubt:
            return None
    alike = [other for other, left in tried if other is not mistake and left.doubt < undone.doubt + _ALIKE]
    if mistake.correctable and alike:
        said = "; or else ".join(one.message for one in (mistake, *(one for one in alike if one.correctable)))
        mistake = replace(mistake, message=said)
    return mistake, undone


def _mistakes(given: Setting) -> Iterator[Mistake]:
    """Yield every mistake that can be undone."""
    yield Mistake(
        "scans_mirrored",
        "the scans are mirrored: left and right are exchanged",
        "Export them again without mirroring; one axis may have been negated.",
        _with_scans(given, np.array([-1.0, 1.0, 1.0])),
    )
    yield from _exchanged_scans(given)
    yield from _exchanges(given)
    size, _ = picked_size(given.picks, given.vertices, given.cameras)
    if abs(size - 1.0) > _SIZE_SHARE:
        yield Mistake(
            "scan_size",
            f"the picks show teeth {abs(1.0 / size - 1.0):.1%} {'smaller' if size > 1.0 else 'larger'} than the scans: "
            "the scale of the scans is wrong, or the calibration's lengths",
            "Check the scans' unit and scaling, and the square size of the calibration board.",
            _with_scans(given, np.full(3, 1.0 / size)),
            True,
        )
    yield from _wrong_lenses(given)


def _exchanged_scans(given: Setting) -> Iterator[Mistake]:
    """Yield the exchange of the two scans, if the picks' vertices are there then."""
    vertices = given.vertices[::-1]
    if all(pick.vertex < len(own) for own, picks in zip(vertices, given.picks, strict=True) for pick in picks):
        yield Mistake(
            "scans_exchanged",
            "upper_teeth and lower_teeth in [scans] are exchanged",
            "Exchange the names of these files.",
            replace(given, vertices=vertices, crowns=given.crowns[::-1]),
        )


def _exchanges(given: Setting) -> Iterator[Mistake]:
    """Yield exchanges of calibrations, of cameras in the picks, and of masks."""
    yield Mistake(
        "picks_views_exchanged",
        "the two cameras of the picks are exchanged",
        "Exchange the camera names within every pick of [bootstrap].",
        replace(given, picks=_with_views(given, lambda names: names[::-1])),
    )
    for a, b in combinations(given.cameras, 2):
        other = {a: b, b: a}
        yield Mistake(
            "calibrations_exchanged",
            f"the calibrations of cameras {a} and {b} are exchanged",
            f"Exchange the names {a} and {b} in the calibration.",
            replace(given, cameras={name: given.cameras[other.get(name, name)] for name in given.cameras}),
        )
        yield Mistake(
            "picks_cameras_exchanged",
            f"the picks name cameras {a} and {b} the wrong way round",
            "Exchange these names in [bootstrap].",
            replace(given, picks=_with_views(given, partial(_renamed, other))),
        )
        yield Mistake(
            "masks_cameras_exchanged",
            f"the masks of cameras {a} and {b} are exchanged",
            f"Exchange the masks of cameras {a} and {b}.",
            replace(given, sources=other),
        )
    hint = "Exchange masks.upper and masks.lower"
    for name in given.cameras:
        message = f"the masks of the upper and lower teeth are exchanged in camera {name}"
        turned = replace(given, exchanged=frozenset([name]))
        yield Mistake("masks_arches_exchanged", message, f"{hint} of camera {name}.", turned)
    yield Mistake(
        "masks_arches_exchanged",
        "the masks of the upper and lower teeth are exchanged in every camera",
        f"{hint}, or upper_teeth and lower_teeth in [scans] and the picks.",
        replace(given, exchanged=frozenset(given.cameras)),
    )


def _with_scans(given: Setting, factors: Array) -> Setting:
    vertices, crowns = ((own[0] * factors, own[1] * factors) for own in (given.vertices, given.crowns))
    return replace(given, vertices=vertices, crowns=crowns)


def _renamed(other: Mapping[str, str], names: list[str]) -> list[str]:
    return [other.get(name, name) for name in names]


def _with_views(given: Setting, renamed: Callable[[list[str]], list[str]]) -> tuple[Sequence[Pick], Sequence[Pick]]:
    """Return the picks with the cameras of their views renamed."""

    def changed(pick: Pick) -> Pick:
        names = renamed([view.camera for view in pick.views])
        views = [v.model_copy(update={"camera": name}) for v, name in zip(pick.views, names, strict=True)]
        return pick.model_copy(update={"views": tuple(views)})

    upper, lower = given.picks
    return [changed(pick) for pick in upper], [changed(pick) for pick in lower]


def _wrong_lenses(given: Setting) -> Iterator[Mistake]:
    """Yield cameras whose pictures may be shifted or scaled against their calibration."""
    for name, camera in given.cameras.items():
        for zooms in (False, True):
            fitted = fitted_camera(given.picks, given.vertices, given.cameras, name, zooms)
            if fitted is None:
                continue
            setting = replace(given, cameras={**given.cameras, name: fitted})
            if zooms:
                share = float(fitted.K[0, 0] / camera.K[0, 0] - 1.0)
                kind, cause = "focal_length", f"with a focal length {share:+.1%}: its focal length is wrong"
            else:
                px = float(np.hypot(*(fitted.K[:2, 2] - camera.K[:2, 2])))
                kind = "principal_point"
                cause = f"with its pictures shifted by {px:.0f} px: its principal point is wrong, or it was turned"
            message = f"the calibration of camera {name} contradicts the picks, and agrees {cause}"
            hint = "Calibrate it again, with the lens and mode of the recording."
            yield Mistake(kind, message, hint, setting, True, name)
