"""The least of a capture.toml, for tests that spoil it."""

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
