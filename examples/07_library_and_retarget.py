"""Keep actors in a library, give one another's performance, and rig somebody without a capture.

The actor of the rig is joined by four made-up persons (`jawusd.synthetic`). The last one's performance is carried to
the actor and written as an animation layer; a fifth person has no capture, only five landmarks, and gets a rig from
those and the library. She is made up, too: the stated error is checked against the rig that a capture would have given.
"""

import argparse
import json
from pathlib import Path

import numpy as np

import jawusd
from jawusd.evaluator import JawRig
from jawusd.fitting import FittingConfig, fit_model
from jawusd.formats.model import JawModel, save_model
from jawusd.geometry import LANDMARKS, make_transform, transform_points
from jawusd.pipeline.library import add_rig, open_library, personal_rig, plot_ranges, retarget
from jawusd.rig import write_animation
from jawusd.synthetic.exercises import record
from jawusd.synthetic.person import Person

NAMES, NEWCOMER, FRAMES, FPS = ("ada", "ben", "cem", "dee"), 5, 500, 24.0


def captured(seed: int, name: str) -> JawModel:
    """Return the model of a made-up person, fitted to a take as a tracker would deliver it."""
    person = Person(seed)
    return fit_model(
        (np.arange(FRAMES), record(person, FRAMES, seed=1).T_noisy),
        T_anatomical_skull=make_transform(np.eye(3), -person.landmarks[0]),
        landmarks=person.landmarks,
        mandible_vertices=person.mandible_points,
        config=FittingConfig(holdout_folds=0),
        actor=name,
    )


def main() -> None:
    """Fill the library, retarget, and make a rig from landmarks."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("rig", nargs="?", type=Path, default=Path("out/actor.usda"))
    parser.add_argument("-o", "--out", type=Path, default=Path("people"))
    options = parser.parse_args()
    models = {name: captured(seed, name) for seed, name in enumerate(NAMES)}
    for name, model in models.items():
        save_model(options.out / name / "model.npz", model)
    add_rig(options.out, options.rig, "actor", force=True)
    library = open_library(options.out)
    for entry in library.entries:
        width_mm, (_, opening_mm) = entry.condylar_distance_mm, entry.ranges_mm["opening"]
        print(f"{entry.actor:<8} opens {opening_mm:.1f} mm, condyles {width_mm:.1f} mm apart")
    print(plot_ranges(library.entries, options.out, force=True)[0])

    actor, dee = jawusd.load(options.rig), models["dee"]
    carried = retarget(JawRig(dee.arrays, dee.meta), actor, dee.frames.astype(float), dee.d)
    write_animation(options.out / "anim_dee.usdc", options.rig, carried.frames, carried.d, FPS, rig=actor)
    valid = actor.validate(actor.pose(carried.d)).valid.sum()
    rising = [np.diff(d, axis=0) > 0 for d in (carried.d, dee.d)]
    same = (rising[0] == rising[1]).mean()
    print(f"dee's motion on the actor: {valid} of {len(dee.d)} frames valid; {same:.1%} of the steps go the same way")

    she, face = Person(NEWCOMER), options.out / "newcomer.json"
    marks = dict(zip(LANDMARKS, she.landmarks.tolist()))
    face.write_text(json.dumps({"format": "jawusd-landmarks/1", "units": "mm", "landmarks": marks}))
    made = personal_rig(face, library, closest=False, name="newcomer", progress=lambda stage, done, total: None).model
    save_model(options.out / "newcomer.npz", made)
    print(made.meta["warnings"][-1]["message"])
    own, rig = (JawRig(model.arrays, model.meta) for model in (captured(NEWCOMER, "her own"), made))
    d = rig.denormalized(own.normalized(own.captured_d))
    away = transform_points(rig.pose(d), she.landmarks) - transform_points(own.pose(own.captured_d), she.landmarks)
    print(f"in truth, against the rig she would get from a capture: {np.linalg.norm(away, axis=-1).mean():.2f} mm")


if __name__ == "__main__":
    main()
