"""Find the frames of an animation that this jaw cannot do, and repair them: python examples/02_pose_and_validate.py

An animator's shot reached for more than the actor has: the captured motion, exaggerated by half, and one frame keyed as
a turn about a wrong axis. jawusd says which frames are impossible, why and by how much, and writes the nearest possible
ones to poses_valid.csv. With a table of your own (frame, m00 ... m33 or quaternions): --poses shot.csv
"""

import argparse
from pathlib import Path

import numpy as np

import jawusd
from jawusd.evaluator import JawRig
from jawusd.formats.poses import read_poses, write_poses
from jawusd.geometry import transform_point

EXAGGERATED = 1.5
WRONG_AXIS_MM = np.array([0.0, 40.0, 0.0])  # a hinge far above the bite
WRONG_TURN_RAD = 0.25


def animators_shot(rig: JawRig) -> tuple[np.ndarray, np.ndarray]:
    """Return frame numbers (F,) and poses (F, 4, 4) of a shot that asks for too much."""
    d = rig.captured_d[::4] * EXAGGERATED
    poses = rig.pose(d)
    c, s = np.cos(WRONG_TURN_RAD), np.sin(WRONG_TURN_RAD)
    hinge = np.eye(4)
    hinge[:3, :3] = [[1, 0, 0], [0, c, -s], [0, s, c]]
    hinge[:3, 3] = WRONG_AXIS_MM - hinge[:3, :3] @ WRONG_AXIS_MM
    A = rig.T_anatomical_skull
    poses[-1] = np.linalg.inv(A) @ hinge @ A @ rig.T_rest
    return np.arange(len(poses)), poses


def main() -> None:
    """Judge, repair, judge again."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("rig", nargs="?", type=Path, default=Path("out/actor.usda"))
    parser.add_argument("--poses", type=Path, help="Table of poses to judge instead of the example's shot.")
    parser.add_argument("-o", "--out", type=Path, default=Path("poses_valid.csv"))
    options = parser.parse_args()
    rig = jawusd.load(options.rig)
    frames, poses = animators_shot(rig) if options.poses is None else read_poses(options.poses)
    verdicts = rig.validate(poses)
    words = verdicts.words()
    valid, margin_mm = verdicts.valid, verdicts.margin_mm
    for k in np.flatnonzero(~valid)[-4:]:
        off = f"{verdicts.residual_mm[k]:.1f} mm from the model, {max(-margin_mm[k], 0):.1f} mm beyond the bound"
        print(f"frame {frames[k]}: {words[k]}: {off}")
    print(f"{(~valid).sum()} of {len(frames)} frames are impossible for this jaw")

    repaired = np.where(valid[:, None, None], poses, rig.pose(rig.project(verdicts.d)))
    print(f"valid after the repair: {rig.validate(repaired).valid.sum()} of {len(frames)}")
    incisor = rig.landmarks[0]
    moved_mm = np.linalg.norm(transform_point(repaired, incisor) - transform_point(poses, incisor), axis=1)
    print(f"farthest move of the incisal point: {moved_mm.max():.1f} mm, in frame {frames[moved_mm.argmax()]}")
    write_poses(options.out, frames, repaired)
    print(options.out)


if __name__ == "__main__":
    main()
