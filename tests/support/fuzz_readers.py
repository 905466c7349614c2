"""Every reader with valid files to damage: what is written, what is damaged and how, and what is called."""

import json
import shutil
from dataclasses import dataclass
from pathlib import Path

import cv2
import fuzz_mutate as mutate
import fuzz_structures as structures
import numpy as np
from example_model import example_arrays, example_meta
from example_rig import example_meshes, example_motion, example_rig
from package_copy import ROOT

from jawusd.formats.model import JawModel, save_model
from jawusd.formats.tracks import Tracks, save_tracks
from jawusd.geometry import se3_exp

EXAMPLE = ROOT / "examples" / "capture"
SIZE = (64, 48)


@dataclass(frozen=True)
class Target:
    """Hold one file to damage.

    Attributes:
        folder: a folder of valid files; copied for every input.
        file: the one that is damaged, below it.
        damage: (generator, bytes) to damaged bytes.
        read: called with the copied folder and the path of the damaged file.
        number: of the target among all.
    """

    folder: Path
    file: str
    damage: object
    read: object
    number: int


def make_targets(folder):
    """Write the valid files and return the targets by reader."""
    rig = example_rig("anchored")
    text, js = mutate.damaged_either, mutate.damaged_json
    found = {}

    def add(reader, place, file, damage, read):
        number = sum(map(len, found.values()))
        found.setdefault(reader, []).append(Target(place, file, damage, read, number))

    for place, file, read in _captures(folder / "capture"):
        add("capture.toml", place, file, text, read)
    for place, file, read in _cameras(folder / "cameras"):
        add("calibration", place, file, js if file.endswith("json") else text, read)
    add("PNG masks", _pngs(folder / "png"), "000000.png", mutate.damaged_png, _read_png)
    for name in _videos(folder / "video"):
        add("video masks", folder / "video", name, mutate.damaged_bytes, _read_video)
    for place, file, ascii_file in _meshes(folder / "mesh"):
        add("PLY, STL, OBJ", place, file, text if ascii_file else mutate.damaged_bytes, _read_mesh)
    tracks, models = _archives(folder / "npz")
    add("tracks npz", tracks, "tracks.npz", mutate.damaged_npz, _read_tracks)
    for place in models:
        add("model npz", place, "model.npz", mutate.damaged_npz, _read_model)
    place = _tables(folder / "tables", rig)
    for file in ("linear.json", "smooth.json"):
        add("keys", place, file, js, _motion(rig))
    for file in ("d.csv", "matrix.csv", "quaternion.csv", "rows.json"):
        add("CSV", place, file, js if file.endswith("json") else text, _motion(rig))
    add("CSV", place, "foreign.csv", text, _read_foreign)
    add("ARKit CSV", place, "face.csv", text, _face(rig))
    add("landmarks", place, "landmarks.json", js, _read_landmarks)
    for file in ("plain.h5", "whole.h5"):
        add("HDF5", _hdf5(folder / "hdf5"), file, structures.damaged_hdf5, _read_hdf5)
    add("library", _library(folder / "library"), "library.json", js, _read_library)
    add("build.json", _build(folder / "build"), "build.json", js, _read_build)
    add("journal", _journal(folder / "journal"), "segment.jsonl", text, _read_journal)
    for kind in ("additive", "anchored"):
        place = _rig(folder / f"rig_{kind}", kind)
        for file in ("actor.usda", "anim.usda"):
            add("usda", place, file, structures.damaged_layer(False), _read_rig)
        for file in ("rig.usdc", "geo.usdc", "anim.usdc"):
            add("usdc", place, file, structures.damaged_layer(True), _read_rig)
        add("usdz", place, "actor.usdz", mutate.damaged_zip, _read_rig)
        for file in ("actor.onnx", "actor_encode.onnx"):
            add("ONNX", place, file, mutate.damaged_bytes, _onnx(example_rig(kind)))
    return found


def _captures(folder):
    from jawusd.formats.capture import load_capture

    def read(place, path):
        capture = load_capture(path)
        for source in capture.cameras:
            for named in (source.video, source.masks and source.masks.upper, source.masks and source.masks.lower):
                anchor = named and (named.parent if "%" in named.name else named)
                if anchor and not anchor.resolve().is_relative_to(place.resolve()):
                    raise PermissionError(f"escaped: {named}")

    shutil.copytree(EXAMPLE, folder, ignore=shutil.ignore_patterns("*.mp4", "*.mkv", "*.ply", "*.npz"))
    for path in EXAMPLE.rglob("*"):
        if path.is_file():
            (folder / path.relative_to(EXAMPLE)).touch()
    toml = folder / "capture.toml"
    shutil.copy(EXAMPLE / "capture.toml", toml)
    patterns = toml.read_text().replace(".mkv", "/%06d.png")
    patterns = patterns.replace('method = "flash"', "offsets = {cam0=0,cam1=1,cam2=2}")
    anatomy = "\n[anatomy]\nT_anatomical_skull = [[1,0,0,0],[0,1,0,0],[0,0,1,0],[0,0,0,1]]\n"
    landmarks = "[anatomy.landmarks]\nincisor = [0.0, 1.0, 2.0]\n"
    (folder / "capture2.toml").write_text(patterns + anatomy + landmarks)
    for path in list(folder.rglob("*.mkv")):
        path.with_suffix("").mkdir()
    return [(folder, "capture.toml", read), (folder, "capture2.toml", read)]


def _cameras(folder):
    from jawusd.formats.camera_files import load_cameras_file

    folder.mkdir(parents=True)
    shutil.copy(EXAMPLE / "calibration.toml", folder / "calibration.toml")
    (folder / "cameras.txt").write_text(
        "# cameras\n1 OPENCV 1280 720 1000 1001 640 360 0.1 -0.02 0.001 0.002\n"
        "2 SIMPLE_RADIAL 1280 720 1000 640 360 0.1\n"
    )
    (folder / "images.txt").write_text(
        "1 0.9 0.1 -0.2 0.1 10 20 600 1 cam0/0001.png\n1.0 2.0 -1\n2 1 0 0 0 0 0 600 2 cam1.png\n\n"
    )
    pose = [[1.0, 0, 0, 1], [0, 1.0, 0, 2], [0, 0, 1.0, 600], [0, 0, 0, 1]]
    lens = {"w": 1280, "h": 720, "fl_x": 1000.0, "fl_y": 1000.0, "cx": 640.0, "cy": 360.0, "k1": 0.1, "k2": 0.01}
    frames = [{"file_path": f"images/cam{k}.png", "transform_matrix": pose} for k in range(2)]
    data = {"camera_model": "OPENCV", "applied_scale": 2.0, **lens, "frames": frames}
    (folder / "transforms.json").write_text(json.dumps(data))

    def read(place, path):
        for camera in load_cameras_file(path, 10.0):
            camera.projection_matrix()

    return [(folder, name, read) for name in ("calibration.toml", "cameras.txt", "images.txt", "transforms.json")]


def _picture(k):
    image = np.zeros(SIZE[::-1], np.uint8)
    image[10 : 30 + k, 12:40] = 255
    return image


def _pngs(folder):
    folder.mkdir(parents=True)
    for k in range(2):
        cv2.imwrite(str(folder / f"{k:06d}.png"), _picture(k))
    return folder


def _read_png(place, path):
    from jawusd.imaging.masks import MaskReader, mask_size_px

    mask_size_px(place / "%06d.png")
    with MaskReader(place / "%06d.png", SIZE) as reader:
        for frame in range(2):
            reader.read(frame)


def _videos(folder):
    from jawusd.imaging.video_writer import VideoWriter

    folder.mkdir(parents=True)
    for name, lossless in (("mask.mkv", True), ("mask.mp4", False)):
        with VideoWriter(folder / name, SIZE, 24.0, lossless=lossless) as writer:
            for k in range(5):
                writer.write(_picture(k))
    return "mask.mkv", "mask.mp4"


def _read_video(place, path):
    from jawusd.imaging.audio import read_sound
    from jawusd.imaging.masks import MaskReader
    from jawusd.imaging.video import Video

    video = Video(path)
    with MaskReader(path, video.size_px) as reader:
        for frame in range(min(video.count, 8)):
            reader.read(frame)
    read_sound(path, 16000)


def _meshes(folder):
    import trimesh

    folder.mkdir(parents=True)
    mesh = trimesh.creation.icosphere(1, 40.0)
    mesh.visual.vertex_colors = np.full((len(mesh.vertices), 4), 255, np.uint8)
    for name, options in (
        ("text.ply", {"encoding": "ascii"}), ("bytes.ply", {}), ("bytes.stl", {}), ("text.obj", {}),
    ):  # fmt: skip
        mesh.export(folder / name, **options)
    mesh.export(folder / "text.stl", file_type="stl_ascii")
    return [(folder, name, name.startswith("text")) for name in
            ("text.ply", "bytes.ply", "bytes.stl", "text.stl", "text.obj")]  # fmt: skip


def _read_mesh(place, path):
    from jawusd.imaging.meshio import load_mesh, tooth_labels

    tooth_labels(load_mesh(path))


def _archives(folder):
    folder.mkdir(parents=True)
    rng = np.random.default_rng(0)
    poses = [se3_exp(rng.normal(size=(4, 6)) * 0.2) for _ in range(6)]
    cov = np.broadcast_to(np.eye(6) * 1e-3, (4, 6, 6))
    tracks = Tracks(
        np.arange(4), *poses, np.ones((4, 2), np.int8), np.zeros(4, bool), np.full((4, 2, 2), 0.01),
        np.ones((4, 2, 2), bool), cov, cov, cov, np.full((4, 5), 0.05), np.full((4, 2), 0.5), np.full((4, 2), 800.0),
        ("a", "b"), {"config": {"gate_px": 2.5}},
    )  # fmt: skip
    (folder / "tracks").mkdir()
    save_tracks(folder / "tracks" / "tracks.npz", tracks)
    return folder / "tracks", [_model(folder / kind, kind) for kind in ("anchored", "additive")]


def _model(folder, kind):
    folder.mkdir(parents=True)
    model = JawModel(
        example_arrays(kind, 12) if kind == "anchored" else example_arrays(kind), np.arange(3), np.zeros((3, 3)),
        np.zeros(3), np.ones(3, bool), example_meta(kind),
    )  # fmt: skip
    save_model(folder / "model.npz", model)
    return folder


def _read_tracks(place, path):
    from jawusd.pipeline.stages import read_motion
    from jawusd.pipeline.summary import track_summary

    tracks = read_motion(path)
    tracks.tracked()
    track_summary(tracks)


def _read_model(place, path):
    from jawusd.evaluator import JawRig, load
    from jawusd.formats.model import load_model
    from jawusd.pipeline.summary import fit_summary

    rig = load(path)
    model = load_model(path)
    JawRig(model.arrays, model.meta)
    fit_summary(model)
    rig.margin(rig.encode(rig.pose([[5.0, 0.0, 0.0]]))[0])


def _tables(folder, rig):
    from jawusd.formats.poses import write_parameters, write_poses

    folder.mkdir(parents=True)
    frames, d = example_motion(6)
    T = rig.pose(d)
    write_parameters(folder / "d.csv", frames, d)
    write_poses(folder / "matrix.csv", frames, T)
    rows = ["frame,tx,ty,tz,qw,qx,qy,qz", "1,0,0,0,1,0,0,0", "2,0.5,-1,2,0.99,0.01,0,0.02"]
    (folder / "quaternion.csv").write_text("\n".join(rows) + "\n")
    (folder / "foreign.csv").write_text("Zeit;X;Y;Z;W;A;B;C\n0;0;0;0;1;0;0;0\n1;0;-1;0;1;0;0.01;0\n")
    (folder / "rows.json").write_text(json.dumps([{"frame": k, "d1": 1.0 * k, "d2": 0.1, "d3": 0.2} for k in range(4)]))
    for name in ("linear", "smooth"):
        keys = [{"frame": 8.0 * k, "d": [2.0 * k, 0.1, 0.2]} for k in range(4)]
        (folder / f"{name}.json").write_text(json.dumps({"fps": 24.0, "interpolation": name, "keys": keys}))
    face = ["Timecode,BlendShapeCount,JawForward,JawRight,JawLeft,JawOpen"]
    face += [f"14:03:5{k // 30}:{k % 30:02d}.000,61,0.01,0,0.02,0.31" for k in range(0, 90, 10)]
    (folder / "face.csv").write_text("\n".join(face) + "\n")
    names = ("incisor", "molar_left", "molar_right", "condyle_left", "condyle_right")
    marks = dict(zip(names, rig.arrays["landmarks"].tolist()))
    data = {"format": "jawusd-landmarks/1", "units": "mm", "landmarks": marks, "T_anatomical_skull": np.eye(4).tolist()}
    (folder / "landmarks.json").write_text(json.dumps(data))
    return folder


def _animated(rig, place, motion):
    from jawusd.cli.motion import kept_inside
    from jawusd.rig.animation import write_animation

    kept, _ = kept_inside(rig, motion)
    write_animation(place / "out.usdc", place / "actor.usda", kept.frames, kept.d, kept.fps or 24.0, rig=rig)


def _motion(rig):
    def read(place, path):
        from jawusd.cli.motion import read_motion

        _animated(rig, place, read_motion(rig, path))

    return read


def _face(rig):
    def read(place, path):
        from jawusd.cli.motion import read_face

        _animated(rig, place, read_face(rig, path, None))

    return read


def _read_foreign(place, path):
    from jawusd.pipeline.trajectories import TrajectoryOptions, read_trajectory

    names = {"frame": "Zeit", "tx": "X", "ty": "Y", "tz": "Z", "qw": "W", "qx": "A", "qy": "B", "qz": "C"}
    read_trajectory(path, TrajectoryOptions(names, "cm", True, 0))


def _read_landmarks(place, path):
    from jawusd.pipeline.subject import subject_of_landmarks

    subject_of_landmarks(path, "x")


def _hdf5(folder):
    import h5py

    if folder.is_dir():
        return folder
    folder.mkdir(parents=True)
    for name, whole in (("plain.h5", False), ("whole.h5", True)):
        with h5py.File(folder / name, "w") as file:
            group = file.create_group("T_model_origin_mand_landmark_t")
            group["translations"] = np.zeros((5, 3))
            group["rotations"] = np.tile([1.0, 0, 0, 0], (5, 1))
            group.attrs["unit"], group.attrs["sample_rate"] = "mm", 100.0
            if whole:
                group.create_dataset("transformations", data=np.tile(np.eye(4), (5, 1, 1)), compression="gzip")
    return folder


def _read_hdf5(place, path):
    from jawusd.pipeline.trajectories import TrajectoryOptions, read_trajectory

    read_trajectory(path, TrajectoryOptions(rest_frame=0))


def _library(folder):
    from jawusd.pipeline.library import open_library

    for kind in ("anchored", "additive"):
        _model(folder / kind, kind)
    open_library(folder)
    return folder


def _read_library(place, path):
    from jawusd.pipeline.library import open_library

    for entry in open_library(place).entries:
        entry.landmarks()


def _build(folder):
    from jawusd.pipeline.state import BuildState

    folder.mkdir(parents=True)
    state = BuildState(folder)
    (folder / "tracks.npz").write_bytes(b"x")
    state.finish("sync", "a" * 64, [], 1.0, {"offsets": {"cam0": 0, "cam1": 2}, "method": "light flash"})
    state.finish("track", "b" * 64, [folder / "tracks.npz"], 2.0, {"lost": [3], "frames": 40})
    return folder


def _read_build(place, path):
    from jawusd.pipeline.state import BuildState

    state = BuildState(place)
    for name, wanted in (("sync", "a" * 64), ("track", "b" * 64)):
        record = state.valid(name, wanted)
        if record is not None and name == "sync":
            sum(record.result["offsets"].values())
    state.clear()


def _journal(folder):
    from jawusd.pipeline.journal import Journal

    folder.mkdir(parents=True)
    journal = Journal(folder, "a", False)
    poses = np.stack([np.eye(4)] * 2).tolist()
    camera = {"frame": 1, "contrast": [0.5, 0.4], "pixels": [5, 6], "unexpected": [0.1, 0.2], "residual_px": [0.1, 0.2],
              "uncovered": [0.1, None], "outline": [[30, 2, 4], [40, 1, 4]]}  # fmt: skip
    for frame in range(3):
        journal.add(frame, {"poses": poses, "status": [1, 0], "cameras": {"cam0": camera}})
    return folder


def _read_journal(place, path):
    from jawusd.pipeline.journal import Journal
    from jawusd.pipeline.segment_summary import summarise

    journal = Journal(place, "a", True)
    for frame in journal.entries:
        journal.known(frame)
    if journal.entries:
        summarise(journal.entries)


def _rig(folder, kind):
    from jawusd.rig.animation import write_animation
    from jawusd.rig.bake import bake_rig

    frames, d = example_motion(8)
    bake_rig(folder, example_rig(kind), example_meshes(), name="a", fps=24.0, frames=frames, d=d, table_size=17)
    for name in ("anim.usda", "anim.usdc"):
        write_animation(folder / name, folder / "actor.usda", frames, d, 24.0)
    return folder


def _read_rig(place, path):
    from pxr import Sdf

    from jawusd.rig import describe, load_rig
    from jawusd.rig.geo_read import read_geometry, read_gum
    from jawusd.rig.motion_read import read_parameters_of_stage, read_poses_of_stage

    shown = path if path.suffix == ".usdz" or path.name.startswith("anim") else place / "actor.usda"
    try:
        rig = load_rig(shown)
        rig.margin(rig.pose([[5.0, 0.1, 0.0]])[:, :3, 3])
        describe(shown)
        if path.name == "geo.usdc":
            read_geometry(path)
            read_gum(path)
        if path.name.startswith("anim"):
            read_parameters_of_stage(shown)
            read_poses_of_stage(shown)
    finally:
        inside = str(place.resolve())
        for layer in Sdf.Layer.GetLoadedLayers():
            real = layer.realPath
            if real and not real.startswith(inside) and "/pxr/" not in real and "generatedSchema" not in real:
                raise PermissionError(f"escaped: {real}")


def _onnx(rig):
    def read(place, path):
        from jawusd.rig.onnx_check import onnx_error_mm

        onnx_error_mm(path, rig, np.array([[5.0, 0.2, 0.1]]))

    return read
