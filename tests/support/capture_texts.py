"""The least of a capture.toml, and of the files it names, for tests that spoil it."""

import numpy as np

from jawusd.media.writers import VideoWriter

HEAD = """format = "jawusd-capture/1"
name = "x"
fps = 24.0
"""
TABLES = """[scans]
upper_teeth = "u.ply"
lower_teeth = "l.ply"
[[camera]]
name = "left"
video = "left.mp4"
[[camera]]
name = "right"
video = "right.mp4"
"""


def write_media(folder):
    """Write the clips and scans that TABLES names."""
    import trimesh

    for first, name in enumerate(("left", "right")):
        with VideoWriter(folder / f"{name}.mp4", (64, 48), 24.0) as writer:
            for k in range(8):
                writer.write(np.full((48, 64), 25 * k + first, np.uint8))
    for name in ("u", "l"):
        trimesh.creation.box((60, 10, 50)).subdivide().subdivide().export(folder / f"{name}.ply")
