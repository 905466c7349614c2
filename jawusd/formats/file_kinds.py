"""What kind of file a name says: video, picture or mesh."""

from __future__ import annotations

from pathlib import PurePath

VIDEOS = (".mp4", ".mov", ".mkv", ".avi", ".webm", ".m4v", ".mxf", ".mts", ".mpg", ".y4m")
PICTURES = (".png", ".tif", ".tiff", ".exr", ".dpx", ".jpg", ".jpeg")
MESHES = (".ply", ".stl", ".obj", ".dcm")

# What keys of a capture.toml cannot name, by what they are for.
_WRONG = {
    "scans": (("a video", VIDEOS), ("a picture", PICTURES)),
    "footage": (("a mesh", MESHES), ("a calibration", (".toml", ".json", ".xml", ".csv", ".yml", ".yaml"))),
    "calibration": (("a mesh", MESHES), ("a video", VIDEOS), ("a picture", PICTURES)),
}
_NEEDED = {
    "scans": "a mesh is needed (.ply, .stl, .obj or .dcm)",
    "footage": "a video or numbered pictures are needed",
    "calibration": "a calibration is needed; clips of a board go into [boards] videos",
}
_GROUPS = {
    **dict.fromkeys(("upper_teeth", "lower_teeth", "mandible", "skull"), "scans"),
    **dict.fromkeys(("video", "videos", "upper", "lower"), "footage"),
    "calibration": "calibration",
}


def wrong_kind(key: str, path: PurePath) -> str | None:
    """Return what a file is that a key of capture.toml cannot name, and what is needed; None if it may be named.

    Args:
        key: that names the file: `upper_teeth`, `video`, `calibration`, ...
        path: the file; its suffix tells.
    """
    group = _GROUPS.get(key, "")
    for kind, suffixes in _WRONG.get(group, ()):
        if path.suffix.lower() in suffixes:
            return f"is {kind}; {_NEEDED[group]}."
    return None
