"""Colours of real pictures against guessed poses, without any mask."""

import numpy as np
import pytest
from package_copy import ROOT

from jawusd.formats.capture import load_capture
from jawusd.geometry import make_transform
from jawusd.imaging.video import Video
from jawusd.pipeline.prepare import load_cameras, load_meshes
from jawusd.segmentation.camera import CameraSegmenter
from jawusd.segmentation.config import SegmentationConfig

LEARNED, WIDE_OPEN = 60, 90


@pytest.fixture(scope="module")
def scene():
    """Return the example's first camera, two pictures, scans, and true poses by frame."""
    capture = load_capture(ROOT / "examples" / "capture" / "capture.toml")
    meshes = load_meshes(capture)
    with np.load(capture.folder / "truth" / "truth.npz") as truth:
        poses = np.stack([truth["T_world_upper"], truth["T_world_lower"]], axis=1)
        by_frame = dict(zip(truth["frames"].tolist(), poses, strict=True))
    frames = Video(capture.cameras[0].video).frames(LEARNED, WIDE_OPEN + 1, colour="rgb")
    pictures = {frame.index: frame.image for frame in frames if frame.index in (LEARNED, WIDE_OPEN)}
    return load_cameras(capture)[0], pictures, (meshes["upper_teeth"], meshes["lower_teeth"]), by_frame


def test_the_true_pose_agrees_better_than_displaced_ones(scene):
    camera, pictures, meshes, poses = scene
    segmenter = CameraSegmenter(camera, meshes, poses[LEARNED], SegmentationConfig())
    image = pictures[WIDE_OPEN]
    displaced = [poses[WIDE_OPEN]]
    for shift in np.concatenate([np.eye(3), -np.eye(3)]) * [3.0, 3.0, 12.0]:  # depth shows little in one camera
        moved = poses[WIDE_OPEN].copy()
        moved[1] = make_transform(np.eye(3), camera.T_cam_world[:3, :3].T @ shift) @ moved[1]
        displaced.append(moved)
    guesses = np.stack(displaced)
    assert not segmenter.agreement(image, guesses).any()  # nothing is known of the colours yet
    segmenter.segment(pictures[LEARNED], poses[LEARNED], 0)
    true, *others = segmenter.agreement(image, guesses)
    assert true > 0 and max(others) < 0.99 * true
