"""The jaw behind closed lips from skin in the footage: python tests/benchmarks/skin_footage.py [--persons 4]

Three cameras film skin that slides and lags over the bone (`tests/support/skin_shot.py`). Poses of the teeth are true,
with 0.1 mm of noise in d, and known where the lips are parted. Prints mean and 95th percentile of the error at the
incisal point [mm] in frames with closed lips, squared error over the variance that is stated, the fraction of these
frames in which too few points are found, and the errors of a chin that is rigid with the bone and of linear
interpolation between the frames with visible teeth.

By default, skin is drawn as dots. `--rendered FOLDER` renders freckles with OpenGL, which takes minutes a person, and
keeps the captures in FOLDER. `--size` sets the size of their images [px].
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "support"))
from face_takes import Performer
from skin_dots import DottedFace
from skin_shot import write_skin_shot

from jawusd.evaluator.skin import SkinJaw
from jawusd.fitting.face import on_bone
from jawusd.fitting.shot_skin import in_head, jaw_of_points
from jawusd.formats.capture import load_capture
from jawusd.geometry import transform_points
from jawusd.pipeline.cameras import load_cameras, open_videos
from jawusd.pipeline.solve_skin import SkinOfFootage
from jawusd.segmentation.picture import ColourFootage

SIGMA_MM, CLOSED = 0.1, 0.95


def drawn(seed):
    """Return cameras, footage, poses of head and jaw (F, 4, 4), and where teeth are seen and lips closed (F,)."""
    face = DottedFace(seed, frames=360, closings=((150, 200), (270, 330)))
    return face.cameras, face, face.T_world_head, face.T_jaw, face.seen, face.closed


def rendered(seed, folder, size_px):
    """Return the same of a rendered capture."""
    if not (folder / "capture.toml").exists():
        write_skin_shot(folder, seed, size_px=tuple(size_px))
    capture = load_capture(folder / "capture.toml")
    cameras = {camera.name: camera for camera in load_cameras(capture)}
    footage = ColourFootage(open_videos(capture), dict.fromkeys(cameras, 0))
    with np.load(folder / "truth" / "truth.npz") as truth:
        shown = truth["in_sight_px"]
        seen = (shown > 0.12 * np.median(shown, axis=0)).all(axis=1) & (truth["closed"] < 0.3)
        return cameras, footage, truth["T_world_upper"], truth["T_upper_lower"], seen, truth["closed"]


def scores(seed, shot):
    """Return the printed figures of a person."""
    cameras, footage, heads, T_jaw, seen, closed = shot
    rig, rng = Performer(seed).rig, np.random.default_rng(0)
    true = rig.encode(T_jaw).d
    d = np.where(seen[:, None], true + SIGMA_MM * rng.normal(size=true.shape), 0.0)
    points = SkinOfFootage(rig, cameras, footage).followed(list(range(len(d))), d, seen, heads)
    X = in_head(points, heads, seen)
    found = jaw_of_points(rig, X, d, seen, 0.15).jaw
    rows = np.flatnonzero((closed > CLOSED) & found.familiar)
    found = SkinJaw(*(part[rows] for part in found))
    often = X[:, np.isfinite(X[..., 0]).mean(axis=0) > 0.9]
    learned = np.flatnonzero(seen & np.isfinite(often).all(axis=(1, 2)))
    T_skull_face, mandible_mm, chosen = on_bone(rig, often[learned], rig.pose(d[learned]))
    whole = np.isfinite(often[rows][:, chosen]).all(axis=(1, 2))
    chin = rig.ik(mandible_mm, transform_points(T_skull_face, often[rows[whole]][:, chosen])).d
    at = np.flatnonzero(seen)
    between = np.stack([np.interp(rows, at, column) for column in d[at].T], axis=1)
    incisor = rig.landmarks[:1]

    def error_mm(d, rows=rows):
        apart = transform_points(rig.pose(d), incisor) - transform_points(T_jaw[rows], incisor)
        return np.linalg.norm(apart, axis=-1)[:, 0]

    by_skin = error_mm(rig.project(found.d))
    z2 = ((found.d - true[rows]) ** 2 / np.einsum("fii->fi", found.covariance)).mean()
    lost = 1 - len(rows) / (closed > CLOSED).sum()
    chin_mm = error_mm(chin, rows[whole]).mean()
    return [by_skin.mean(), np.quantile(by_skin, 0.95), z2, lost, chin_mm, error_mm(between).mean()]


def line(row):
    """Return one row of the table."""
    return "{:4.2f}  {:4.2f}  {:4.2f}  {:4.2f}  {:5.2f}  {:12.2f}".format(*row)


def main():
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--persons", type=int, default=4)
    parser.add_argument("--rendered", type=Path)
    parser.add_argument("--size", type=int, nargs=2, default=(480, 360), metavar=("WIDTH", "HEIGHT"))
    options = parser.parse_args()
    print("person  mean   p95    z2  lost   chin  interpolated")
    rows = []
    for seed in range(1, options.persons + 1):
        folder = options.rendered and options.rendered / f"person_{seed}"
        rows.append(scores(seed, drawn(seed) if folder is None else rendered(seed, folder, options.size)))
        print(f"{seed:6d}  {line(rows[-1])}", flush=True)
    print(f"  mean  {line(np.mean(rows, axis=0))}\n worst  {line(np.max(rows, axis=0))}")


if __name__ == "__main__":
    main()
