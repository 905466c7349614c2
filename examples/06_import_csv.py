"""Make a rig from a motion-capture system's table, without cameras: python examples/06_import_csv.py [-o rig_mocap]

A marker system tracks a clip on the lower teeth and writes metres, its own column names, and poses of the clip, not of
the scan. The example writes such a file from the truth of examples/capture, so that the result can be checked. On the
command line:

    jawusd fit clip.csv --columns frame=Frame,tx=X,ty=Y,tz=Z,qw=W,qx=I,qy=J,qz=K --length-unit m --rest-frame 36 \\
        --capture examples/capture -o model.npz && jawusd bake model.npz --capture examples/capture -o rig_mocap
"""

import argparse
from pathlib import Path

import numpy as np

import jawusd
from jawusd.formats.capture import load_capture
from jawusd.geometry import make_transform, so3_exp, transform_points, wxyz_from_matrix
from jawusd.pipeline.bake import bake_subject
from jawusd.pipeline.fit import TrajectoryOptions, fit_subject, read_motion
from jawusd.pipeline.subject import subject_of_capture

CAPTURE = Path(__file__).parent / "capture"
COLUMNS = {"frame": "Frame", "tx": "X", "ty": "Y", "tz": "Z", "qw": "W", "qx": "I", "qy": "J", "qz": "K"}
T_MANDIBLE_CLIP = make_transform(so3_exp([0.4, -0.2, 0.9]), [4.0, -15.0, 22.0])  # where the clip happens to sit [mm]
NOISE_MM, REST_FRAME = 0.1, 36


def write_clip_table(path: Path) -> tuple[np.ndarray, np.ndarray]:
    """Write what the marker system exports; return frame numbers (F,) and the true T_skull_mandible (F, 4, 4)."""
    with np.load(CAPTURE / "truth" / "truth.npz") as truth:
        frames, T = truth["frames"], np.linalg.inv(truth["T_world_upper"]) @ truth["T_world_lower"]
    clip = T @ T_MANDIBLE_CLIP
    places = clip[:, :3, 3] + np.random.default_rng(0).normal(scale=NOISE_MM, size=(len(T), 3))
    rows = np.column_stack([frames, places / 1000, wxyz_from_matrix(clip[:, :3, :3])])
    np.savetxt(path, rows, delimiter=",", header=",".join(COLUMNS.values()), comments="", fmt="%.9g")
    return frames, T


def main() -> None:
    """Write the table, import it, fit, bake, compare."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("-o", "--out", type=Path, default=Path("rig_mocap"))
    options = parser.parse_args()
    options.out.mkdir(parents=True, exist_ok=True)
    table = options.out / "clip.csv"
    frames, T_true = write_clip_table(table)

    motion, _ = read_motion(table, TrajectoryOptions(columns=COLUMNS, length_unit="m", rest_frame=REST_FRAME))
    subject = subject_of_capture(load_capture(CAPTURE))
    model = fit_subject(subject, motion)
    bake_subject(subject, model, options.out)
    rig = jawusd.load(options.out / "actor.usda")
    print(f"{table}: {len(frames)} poses; opening up to {rig.d_range[0, 1]:.1f} mm")
    points = subject.meshes["mandible"].vertices[::20]
    away = transform_points(rig.pose(rig.encode(T_true)[0]), points) - transform_points(T_true, points)
    error_mm = np.linalg.norm(away, axis=-1).mean(axis=1)
    print(f"rig against the truth: {error_mm.mean():.2f} mm over the mandible, worst frame {error_mm.max():.2f}")
    print(options.out / "actor.usda")


if __name__ == "__main__":
    main()
