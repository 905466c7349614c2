"""Key a jaw, write the shot as OpenUSD, and check what any program will see: python examples/04_keys_to_usd.py [RIG]

Four keys become keys.json (what `jawusd animate` reads), then an animation layer that sublayers the actor. The layer is
read back with plain OpenUSD, as a DCC without jawusd does, and compared with the evaluator at and between the frames.
"""

import argparse
import json
from pathlib import Path

import numpy as np
from pxr import Usd, UsdGeom

import jawusd
from jawusd.rig import write_animation

FPS = 24.0


def main() -> None:
    """Key, write, read back, compare."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("rig", nargs="?", type=Path, default=Path("out/actor.usda"))
    parser.add_argument("-o", "--out", type=Path, default=Path("anim_shot.usdc"))
    options = parser.parse_args()
    rig = jawusd.load(options.rig)

    # Keys as shares of this person's own ranges: the same keys suit every actor.
    shares = np.array([[0, 0, 0], [0.6, 0, 0], [0.25, 0.5, 0], [0, 0, 0]])
    frames, keys = np.array([1, 13, 25, 37]), rig.denormalized(shares)
    document = {
        "fps": FPS,
        "interpolation": "smooth",
        "keys": [{"frame": int(f), "d": d.tolist()} for f, d in zip(frames, keys)],
    }
    options.out.with_suffix(".keys.json").write_text(json.dumps(document, indent=1))

    times = np.arange(frames[0], frames[-1] + 1.0)
    wanted = rig.interpolate(frames, keys, times, method="smooth", inside=False)
    kept = rig.keep_inside(times, wanted)
    moved = np.linalg.norm(kept.d[kept.given] - wanted, axis=1) > 1e-6
    print(f"{moved.sum()} of {len(times)} frames were moved to stay inside the bound")
    write_animation(options.out, options.rig, kept.times, kept.d, FPS)

    stage = Usd.Stage.Open(str(options.out))
    mandible = UsdGeom.Xformable(stage.GetDefaultPrim().GetPrimAtPath("geo/Mandible"))
    incisor = np.append(rig.landmarks[0], 1.0)
    print(f"{options.out}: frames {stage.GetStartTimeCode():g} .. {stage.GetEndTimeCode():g}")
    for label, at in (("at whole frames", times), ("half way between", times[:-1] + 0.5)):
        # USD's matrices act on row vectors: transposed, they are ours.
        seen = np.array([np.array(mandible.GetLocalTransformation(float(t))).T for t in at])
        d_at = np.stack([np.interp(at, kept.times, column) for column in kept.d.T], axis=1)
        away_mm = np.linalg.norm((seen - rig.pose(d_at)) @ incisor, axis=1)
        print(f"{label}: OpenUSD and the evaluator differ by at most {away_mm.max():.4f} mm at the incisal point")


if __name__ == "__main__":
    main()
