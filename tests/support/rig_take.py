"""A short take of a jaw with a rig: masks of its teeth, and its solution."""

import cv2
import numpy as np
import small_take
from bumpy_teeth import disturbed, render_masks

from jawusd.geometry import se3_exp, transform_point
from jawusd.tracking.contour.scan import teeth_centre
from jawusd.tracking.contour.views import MaskViews
from jawusd.tracking.performance.coordinates import Coordinates
from jawusd.tracking.performance.shot import Shot, solve_performance

COUNT = 26
HIDDEN = range(12, 16)  # lips closed


def write_masks(out, jaw, truth, cameras, grown_px=(0.0, 0.0), hidden=HIDDEN, misfits=None):
    """Write the masks of the take, whose outlines lie `grown_px` outside of the upper and lower teeth.

    `misfits` are twists of the mandible away from the rig's pose, by frame.
    """
    rng = np.random.default_rng(0)
    for camera in cameras:
        for row in small_take.ROWS:
            (out / camera.name / row).mkdir(parents=True)
        for k, (d, head) in enumerate(zip(*truth)):
            if k in hidden:
                continue
            lower = head @ se3_exp((misfits or {}).get(k, np.zeros(6))) @ jaw.pose(d)
            shown = small_take.MESHES, np.stack([head, lower]), camera, None, 0.3, rng
            masks = {grown: render_masks(*shown, grown_px=grown) for grown in sorted(set(grown_px))}
            for r, row in enumerate(small_take.ROWS):
                mask = masks[grown_px[r]][r]
                cv2.imwrite(str(small_take.png(out, camera.name, row, k)), (mask > 127).astype(np.uint8) * 255)
    return out


def solved(jaw, scans, truth, folder, cameras, off_mm=1.0, seed=4, **options):
    """Solve the take with some cameras from a disturbed start."""
    d, head = truth
    names = [camera.name for camera in cameras]
    capture = small_take.make_capture(
        folder, COUNT, cameras=[small_take.source(folder, n) for n in names], bootstrap=None
    )
    start = np.stack([head[0], head[0] @ jaw.pose(d[0])])
    start = disturbed(start, off_mm, 0.01, np.random.default_rng(seed))
    table = {camera.name: camera for camera in cameras}
    with MaskViews(capture.cameras, table, small_take.OFFSETS, teeth_centre(scans, start), 7.2, 1) as views:
        frames = (small_take.FIRST, small_take.FIRST + COUNT)
        pose = Coordinates(jaw, scans).pose_of(start)
        shot = Shot(views, tuple(names), frames, small_take.FIRST, pose, 25.0, **options)
        return solve_performance(jaw, scans, shot)


def tip_error_mm(jaw, found, truth):
    tip = jaw.landmarks[0]
    return np.linalg.norm(transform_point(jaw.pose(found.d), tip) - transform_point(jaw.pose(truth[0]), tip), axis=-1)


def seen():
    return np.setdiff1d(np.arange(COUNT), HIDDEN)
