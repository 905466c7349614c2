"""The first frames of the example capture, masks alone: a capture that builds in seconds."""

import json
import os
import re
import shutil
from pathlib import Path

import numpy as np
from package_copy import ROOT

EXAMPLE = ROOT / "examples" / "capture"


def write_short(folder: Path, frames: int, without: tuple[str, ...] = ()) -> Path:
    """Write a capture of the example's first frames, its files linked, and return its folder.

    Args:
        folder: where to.
        frames: how many; a model needs 15.
        without: scans left out, such as "skull".
    """
    for name in ("scans", "masks"):
        for source in sorted((EXAMPLE / name).rglob("*")):
            target = folder / source.relative_to(EXAMPLE)
            target.parent.mkdir(parents=True, exist_ok=True)
            if source.is_file():
                _link(source, target)
    _link(EXAMPLE / "calibration.toml", folder / "calibration.toml")
    text = shortened((EXAMPLE / "capture.toml").read_text(), frames)
    text = re.sub(r'(?m)^method = "flash"\n', "", text)
    for name in without:
        text = re.sub(rf'(?m)^{name} = "scans/.*\n', "", text)
    with np.load(EXAMPLE / "truth" / "truth.npz") as truth:
        offsets = zip(truth["camera_names"].tolist(), truth["offsets"].tolist(), strict=True)
        given = ", ".join(f"{name} = {offset}" for name, offset in offsets)
    text = text.replace("[sync]\n", f"[sync]\noffsets = {{ {given} }}\n")
    (folder / "capture.toml").write_text(text)
    return folder


def shortened(text: str, frames: int) -> str:
    """Return the text of the example's capture.toml with its first frames, without clips and boards."""
    text = re.sub(r"frames = \[20, \d+\]", f"frames = [20, {20 + frames}]", text)
    return re.sub(r"(?m)^video = .*\n|^\[boards\]\n(?:\w+ = .*\n)+", "", text)


def _link(source: Path, target: Path) -> None:
    try:
        os.link(source, target)
    except OSError:
        shutil.copy(source, target)


def results(folder: Path) -> dict[str, bytes | str]:
    """Return every array of a build's tracks and model, and of its rig's table, as bytes by name."""
    from pxr import Usd

    found: dict[str, bytes | str] = {}
    for file in ("first_pass.npz", "tracks.npz", "model.npz"):
        with np.load(folder / file, allow_pickle=False) as archive:
            for name in archive.files:
                found[f"{file}:{name}"] = _without_times(name, archive[name])
    stage = Usd.Stage.Open(str(folder / "rig.usdc"))
    for attribute in stage.GetDefaultPrim().GetAttributes():
        value = attribute.Get()
        found[f"rig:{attribute.GetName()}"] = np.asarray(value).tobytes() if hasattr(value, "__len__") else str(value)
    return found


def _without_times(name: str, array: np.ndarray) -> bytes | str:
    return json.dumps(json.loads(str(array)), sort_keys=True) if name == "meta" else array.tobytes()
