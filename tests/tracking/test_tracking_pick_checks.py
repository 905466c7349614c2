"""Contradicting picks and masks are reported with the mistake that explains them."""

from dataclasses import replace

import numpy as np
import pytest
from small_take import CAMERAS, MESHES, jaw_poses

from jawusd.base.errors import TrackingError
from jawusd.formats.capture import Bootstrap
from jawusd.geometry import transform_point, transform_points
from jawusd.tracking.contour.scan import prepare_scan
from jawusd.tracking.initialization.pick_causes import Setting, fitted_camera, shifted, zoomed
from jawusd.tracking.initialization.pick_checks import pick_findings

SCANS = [prepare_scan(mesh, name) for mesh, name in zip(MESHES, ("upper", "lower"), strict=True)]
TABLE = {camera.name: camera for camera in CAMERAS}
POSES = jaw_poses(3)[2]
VERTICES = tuple(np.asarray(mesh.vertices, float) for mesh in MESHES)
NOTHING = (np.empty((0, 2)), np.empty((0, 2)))


def picks(count=6, wrong=None, cameras=CAMERAS[:2]):
    """Return picks of crown vertices in two cameras, the first of one arch on a wrong vertex."""
    rng = np.random.default_rng(1)
    arches = {}
    for scan, vertices, pose in zip(SCANS, VERTICES, POSES, strict=True):
        crown = [int(np.linalg.norm(vertices - p, axis=1).argmin()) for p in scan.crown_vertices()]
        chosen = rng.choice(crown, count, replace=False)
        arches[scan.name] = []
        for k, vertex in enumerate(chosen):
            point = transform_point(pose, vertices[vertex])
            seen = [(c.name, c.project(point) + rng.normal(0.0, 1.0, 2)) for c in cameras]
            views = [{"camera": n, "x": float(p[0]), "y": float(p[1])} for n, p in seen]
            other = int(crown[0]) if scan.name == wrong and k == 0 else int(vertex)
            arches[scan.name].append({"vertex": other, "views": views})
    both = Bootstrap.model_validate({"frame": 7, **arches})
    return both.upper, both.lower


def pixels(cameras=CAMERAS):
    """Return some mask pixels of both arches in every camera."""
    rng = np.random.default_rng(0)
    crowns = [transform_points(pose, scan.crown_vertices()) for pose, scan in zip(POSES, SCANS, strict=True)]
    return {c.name: tuple(c.project(points[rng.choice(len(points), 300)]) for points in crowns) for c in cameras}


GIVEN = Setting(picks(), VERTICES, tuple(scan.crown_vertices() for scan in SCANS), TABLE)


def found(given=GIVEN, *guesses):
    guesses = guesses or (pixels(),)
    seen = [lambda source, camera, guess=guess: guess.get(source, NOTHING) for guess in guesses]
    return list(pick_findings(given, seen, list(TABLE), 7))


def only(given, *guesses):
    (finding,) = found(given, *guesses)
    return finding.kind, finding.severity


def test_masks_where_the_picks_place_the_scans_are_accepted():
    assert not found()


def test_missing_masks_are_not_a_contradiction():
    seen = pixels()
    seen["cam1"] = (np.empty((0, 2)), seen["cam1"][1])
    del seen["cam2"]
    assert not found(GIVEN, seen)


def test_arches_exchanged_in_one_camera_or_all_are_reported():
    seen = pixels()
    one = {name: pair[::-1] if name == "cam1" else pair for name, pair in seen.items()}
    (finding,) = found(GIVEN, one)
    assert (finding.kind, finding.severity) == ("masks_arches_exchanged", "error") and "cam1" in finding.message
    (finding,) = found(GIVEN, {name: pair[::-1] for name, pair in seen.items()})
    assert finding.kind == "masks_arches_exchanged" and "in every camera" in finding.message


def test_exchanged_scans_are_reported():
    turned = replace(GIVEN, vertices=GIVEN.vertices[::-1], crowns=GIVEN.crowns[::-1])
    assert only(turned) == ("scans_exchanged", "error")
    # The exchange of scans is not tried if picked vertices do not exist on the other scan.
    wrong = {**TABLE, "cam0": TABLE["cam1"], "cam1": TABLE["cam0"]}
    last = max(pick.vertex for pick in GIVEN.picks[1])
    assert max(pick.vertex for pick in GIVEN.picks[0]) > last
    short = replace(GIVEN, cameras=wrong, vertices=(VERTICES[0], VERTICES[1][: last + 1]))
    assert only(short) == ("calibrations_exchanged", "error")


def test_exchanged_masks_of_cameras_are_reported():
    seen = pixels()
    (finding,) = found(GIVEN, {**seen, "cam0": seen["cam1"], "cam1": seen["cam0"]})
    assert finding.kind == "masks_cameras_exchanged" and "cam0 and cam1" in finding.message


def test_masks_elsewhere_are_a_warning_and_the_best_guess_counts():
    seen = pixels()
    away = {name: tuple(p + [0, 300.0 if name == "cam1" else 0] for p in pair) for name, pair in seen.items()}
    (finding,) = found(GIVEN, away)
    assert (finding.kind, finding.severity, finding.camera) == ("masks_off_picks", "warning", "cam1")
    assert finding.value == pytest.approx(0.0) and not found(GIVEN, away, seen)


def test_exchanged_calibrations_are_distinguished_from_exchanged_picks():
    wrong = {**TABLE, "cam0": TABLE["cam1"], "cam1": TABLE["cam0"]}
    assert only(replace(GIVEN, cameras=wrong)) == ("calibrations_exchanged", "error")
    other = tuple(
        [
            p.model_copy(
                update={"views": tuple(v.model_copy(update={"camera": n}) for v, n in zip(p.views, ("cam1", "cam0")))}
            )
            for p in own
        ]
        for own in GIVEN.picks
    )
    assert only(replace(GIVEN, picks=other))[0] in ("picks_views_exchanged", "picks_cameras_exchanged")


def test_mirrored_scans_are_distinguished_from_exchanged_arches():
    flip = np.array([-1.0, 1.0, 1.0])
    mirrored = [tuple(own * flip for own in both) for both in (GIVEN.vertices, GIVEN.crowns)]
    assert only(replace(GIVEN, vertices=mirrored[0], crowns=mirrored[1])) == ("scans_mirrored", "error")


@pytest.mark.parametrize(("size", "severity"), [(1.3, "error"), (0.75, "error")])
def test_scans_of_another_size_are_reported(size, severity):
    larger = [tuple(size * own for own in both) for both in (GIVEN.vertices, GIVEN.crowns)]
    assert only(replace(GIVEN, vertices=larger[0], crowns=larger[1])) == ("scan_size", severity)


def test_pictures_shifted_or_scaled_against_their_calibration_are_reported():
    camera = TABLE["cam1"]
    off = shifted(camera, np.array([0.03 * camera.size_px[0], 0.0]))
    (finding,) = found(replace(GIVEN, cameras={**TABLE, "cam1": off}))
    assert (finding.kind, finding.camera) == ("principal_point", "cam1")
    (finding,) = found(replace(GIVEN, cameras={**TABLE, "cam1": zoomed(camera, 1.15)}))
    assert "focal length" in finding.message and "cam1" in finding.message


def test_a_wrong_pick_is_rejected_without_another_mistake():
    wrong = replace(GIVEN, picks=picks(wrong="upper"))
    (finding,) = found(wrong)
    assert (finding.kind, finding.severity) == ("pick_wrong", "warning") and "pick 1" in finding.message


def test_contradictions_without_a_single_cause_are_an_error():
    turned = tuple([p.model_copy(update={"vertex": q.vertex}) for p, q in zip(own, own[::-1])] for own in GIVEN.picks)
    with pytest.raises(TrackingError, match="contradict one another"):
        found(replace(GIVEN, picks=turned))


def test_no_focal_length_is_fitted_to_random_picks():
    """For scans in inches, five times the focal length would fit better; worse ones would overflow."""
    inches = tuple(vertices / 25.4 for vertices in VERTICES)
    camera = fitted_camera(GIVEN.picks, inches, TABLE, "cam0", True)
    assert camera.K[0, 0] <= 2 * TABLE["cam0"].K[0, 0] * (1 + 1e-9)
