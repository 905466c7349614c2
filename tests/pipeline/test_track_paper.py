"""`jawusd track --solver paper` on two rendered frames, run as a program."""

import json

import cv2
import numpy as np
import pytest
import trimesh
from bumpy_teeth import arch, jaw_poses, make_cameras, render_masks, vertex_error_mm
from run_jawusd import program

from jawusd.cameras.calibration import save_calibration
from jawusd.cli.text_build import track_lines
from jawusd.formats.mesh import Mesh
from jawusd.formats.tracks import load_tracks
from jawusd.geometry import transform_point
from jawusd.pipeline.track import track_summary

ROWS = ("upper", "lower")
CAMERAS = make_cameras((30.0, -30.0))
POSES = jaw_poses(2)
GREEN = (40, 200, 60)


def painted(mesh: Mesh) -> Mesh:
    """Paint the incisal edge of the front teeth green."""
    colors = mesh.colors.copy()
    x, y, z = mesh.vertices.T
    colors[(colors[:, 0] > 200) & (np.abs(x) < 11) & (np.abs(y) < 2.5) & (z > -7)] = GREEN
    return Mesh(mesh.vertices, mesh.faces, colors)


MESHES = (painted(arch(True)), painted(arch(False)))


@pytest.fixture
def capture(tmp_path):
    folder = tmp_path / "capture"
    lines = ['format = "jawusd-capture/1"\nname = "two"\nunits = "mm"\nfps = 25.0\ncalibration = "calibration.toml"']
    lines += ["frames = [0, 2]\n[scans]", *(f'{row}_teeth = "{row}.ply"' for row in ROWS)]
    for camera in CAMERAS:
        lines.append(f'[[camera]]\nname = "{camera.name}"')
        for r, row in enumerate(ROWS):
            (folder / camera.name / row).mkdir(parents=True)
            lines.append(f'masks.{row} = "{camera.name}/{row}/%06d.png"')
            for k in range(len(POSES)):
                mask = render_masks((arch(True), arch(False)), POSES[k], camera, (7.5, -16.0), fine=2)[r]
                cv2.imwrite(str(folder / camera.name / row / f"{k:06d}.png"), mask)
    lines.append("[bootstrap]\nframe = 0")
    for r, row in enumerate(ROWS):
        trimesh.Trimesh(MESHES[r].vertices, MESHES[r].faces, vertex_colors=MESHES[r].colors, process=False).export(
            folder / f"{row}.ply"
        )
        for vertex in (100, 900, 1500, 2000):
            place = transform_point(POSES[0, r], MESHES[r].vertices[vertex])
            views = ", ".join(
                f'{{ camera = "{c.name}", x = {c.project(place)[0]:.1f}, y = {c.project(place)[1]:.1f} }}'
                for c in CAMERAS
            )
            lines.append(f"[[bootstrap.{row}]]\nvertex = {vertex}\nviews = [{views}]")
    save_calibration(folder / "calibration.toml", CAMERAS)
    (folder / "capture.toml").write_text("\n".join(lines))
    return folder


def test_the_command_tracks_with_the_papers_method(capture, tmp_path):
    result = program("track", capture, "-o", tmp_path / "t.npz", "--solver", "paper", "--jobs", "1", "--json")
    assert result.returncode == 0, result.stderr
    summary = json.loads(result.stdout)
    assert summary["tracked"] == 2 and summary["lost"] == [] and set(summary["sigma_mm"].values()) == {None}
    tracks = load_tracks(tmp_path / "t.npz")
    assert tracks.meta["solver"] == "paper" and tracks.meta["backend"] == "cpu"
    for r, row in enumerate(ROWS):
        for found, pose in zip(getattr(tracks, f"T_world_{row}"), POSES[:, r]):
            assert vertex_error_mm(MESHES[r], found, pose) < 0.6
    assert "  expected error (1 sigma, median) [mm]: not known" in track_lines(track_summary(tracks))
