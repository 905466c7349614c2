"""Run every command on the files of folders, in one process: python names_driver.py FOLDER ...; prints how each ended.

A folder holds what `tests/cli/test_names_of_any_bytes.py` makes. It may be named relative to the working directory.
"""

import contextlib
import io
import json
import sys
import traceback


def calls(folder):
    """Return the words of one call of every command, or two, by a name for it."""
    rig, capture, out = f"{folder}/rig", f"{folder}/capture", f"{folder}/out"
    scans = ["--upper-teeth", f"{capture}/scans/upper_teeth.ply", "--lower-teeth", f"{capture}/scans/lower_teeth.ply"]
    return {
        "init": ["init", f"{folder}/footage"],
        "doctor": ["doctor"],
        "cameras": ["cameras", f"{capture}/calibration.toml", "-o", f"{out}/cameras.usda"],
        "cameras colmap": ["cameras", f"{capture}/calibration.toml", "-o", f"{out}/colmap"],
        "build": ["build", f"{folder}/broken", "-o", f"{out}/built"],
        "build --dry-run": ["build", capture, "-o", f"{out}/built", "--dry-run"],
        "build-many": ["build-many", f"{folder}/list.txt", "-o", f"{out}/many", "--fresh", "--resume"],
        "track": ["track", f"{folder}/broken", "-o", f"{out}/tracks.npz"],
        "fit": ["fit", f"{folder}/poses.csv", *scans, "-o", f"{out}/model.npz"],
        "bake": ["bake", f"{rig}/model.npz", *scans, "-o", f"{out}/baked"],
        "demo": ["demo", "-o", f"{folder}/poses.csv/demo", "--frames", "24"],
        "check": ["check", f"{folder}/broken", "--report", f"{out}/check.json"],
        "calibrate": ["calibrate", capture, "-o", f"{out}/calibration.toml"],
        "sync": ["sync", capture],
        "segment": ["segment", f"{folder}/broken", "-o", f"{out}/masks"],
        "scans": ["scans", f"{folder}/broken", "-o", f"{out}/labels"],
        "plates": ["plates", capture, rig],
        "photos": ["photos", f"{folder}/line.png", *scans, "-o", f"{out}/photos"],
        "info": ["info", rig],
        "pose of a model": ["pose", f"{rig}/model.npz", "--d", "10", "0", "0"],
        "pose": ["pose", rig, "--d", "10", "0", "0"],
        "validate": ["validate", rig],
        "validate poses": ["validate", f"{rig}/actor.usda", f"{folder}/poses.csv"],
        "ik": ["ik", rig, "--point", "0", "0", "0", "--target", "0", "-5", "0"],
        "encode": ["encode", rig, f"{folder}/poses.csv", "-o", f"{out}/d.csv"],
        "animate": ["animate", rig, f"{folder}/keys.json", "-o", f"{rig}/anim_keys.usdc"],
        "animate glb": ["animate", rig, f"{folder}/keys.json", "-o", f"{out}/anim.glb"],
        "arkit-fit": ["arkit-fit", rig, f"{folder}/face.csv", f"{folder}/d.csv", "-o", f"{out}/arkit.npz"],
        "align": ["align", rig, f"{folder}/points.json", "-o", f"{out}/T_skull_model.json"],
        "skin-fit": ["skin-fit", rig, f"{folder}/d.csv", f"{folder}/face.csv", "-o", f"{out}/skin.npz"],
        "arkit-table": ["arkit-table", rig, "-o", f"{out}/joint.csv"],
        "rebake": ["rebake", f"{rig}/actor.usda", f"{rig}/anim_keys.usdc", "-o", f"{rig}/anim_baked.usdc"],
        "publish": ["publish", rig, "-o", f"{out}/published"],
        "solve": ["solve", rig, f"{folder}/broken", "-o", f"{out}/solved.csv"],
        "live": ["live", rig, f"{folder}/broken"],
        "retarget": ["retarget", f"{rig}/anim_keys.usdc", "--from", rig, "--to", rig, "-o", f"{rig}/anim_other.usdc"],
        "library": ["library", folder, "--plot", f"{out}/figures"],
        "report": ["report", rig],
        "view": ["view", rig, "--no-browser", "--port", "0"],
        "view of a capture": ["view", f"{folder}/broken", "--no-browser", "--port", "0"],
    }


def ended(words):
    """Return the exit code of a call, what it printed, and its traceback if it had one."""
    from jawusd.cli import main

    out, err = (io.TextIOWrapper(io.BytesIO(), encoding=sys.stdout.encoding, write_through=True) for _ in range(2))
    code, trace = 0, ""
    sys.argv = ["jawusd", *words]
    with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
        try:
            main.main()
        except SystemExit as end:
            code = end.code or 0
        except BaseException:
            trace = traceback.format_exc()
    texts = [stream.buffer.getvalue().decode(stream.encoding, "replace") for stream in (out, err)]
    return {"code": code, "out": texts[0], "err": texts[1], "trace": trace}


def main():
    """Run all calls and print a JSON list with an object for each folder."""
    from jawusd.viewer.server import PageServer

    PageServer.wait = lambda self: self.stop()
    folders = sys.argv[1:]  # which `ended` replaces
    print(json.dumps([{name: ended(words) for name, words in calls(folder).items()} for folder in folders]))


if __name__ == "__main__":
    main()
