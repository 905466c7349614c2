"""Valid files in which results are kept or come from elsewhere, and what reads them: npz, tables, HDF5, JSON."""

import json

import numpy as np
from example_model import example_arrays, example_meta
from example_rig import example_motion

from jawusd.formats.model import JawModel, save_model
from jawusd.formats.tracks import Tracks, save_tracks
from jawusd.geometry import se3_exp


def write_archives(folder):
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


def read_tracks(place, path):
    from jawusd.pipeline.fit import read_motion
    from jawusd.pipeline.track import track_summary

    tracks, _ = read_motion(path)
    tracks.tracked()
    track_summary(tracks)


def read_model(place, path):
    from jawusd.evaluator import JawRig, load
    from jawusd.formats.model import load_model
    from jawusd.pipeline.fit import fit_summary

    rig = load(path)
    model = load_model(path)
    JawRig(model.arrays, model.meta)
    fit_summary(model)
    rig.margin(rig.encode(rig.pose([[5.0, 0.0, 0.0]]))[0])


def write_tables(folder, rig):
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
    actor = '#usda 1.0\ndef Xform "Actor" ( prepend apiSchemas = ["JawRigAPI"] ) {}\n'
    (place / "actor.usda").write_text(actor)  # the layer stands on it
    write_animation(place / "out.usdc", place / "actor.usda", kept.frames, kept.d, kept.fps or 24.0, rig=rig)


def motion_reader(rig):
    def read(place, path):
        from jawusd.cli.motion import read_motion

        _animated(rig, place, read_motion(rig, path))

    return read


def face_reader(rig):
    def read(place, path):
        from jawusd.cli.animate_commands import read_face

        _animated(rig, place, read_face(rig, path, None, None))

    return read


def read_foreign(place, path):
    from jawusd.pipeline.fit import TrajectoryOptions, read_trajectory

    names = {"frame": "Zeit", "tx": "X", "ty": "Y", "tz": "Z", "qw": "W", "qx": "A", "qy": "B", "qz": "C"}
    read_trajectory(path, TrajectoryOptions(names, "cm", True, 0))


def read_landmarks(place, path):
    from jawusd.pipeline.subject import subject_of_landmarks

    subject_of_landmarks(path, "x")


def write_hdf5(folder):
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


def read_hdf5(place, path):
    from jawusd.pipeline.fit import TrajectoryOptions, read_trajectory

    read_trajectory(path, TrajectoryOptions(rest_frame=0))


def write_library(folder):
    from jawusd.pipeline.library import open_library

    for kind in ("anchored", "additive"):
        _model(folder / kind, kind)
    open_library(folder)
    return folder


def read_library(place, path):
    from jawusd.pipeline.library import open_library

    for entry in open_library(place).entries:
        entry.landmarks()


def write_build(folder):
    from jawusd.pipeline.state import BuildState

    folder.mkdir(parents=True)
    state = BuildState(folder)
    (folder / "tracks.npz").write_bytes(b"x")
    state.finish("sync", "a" * 64, [], 1.0, {"offsets": {"cam0": 0, "cam1": 2}, "method": "light flash"})
    state.finish("track", "b" * 64, [folder / "tracks.npz"], 2.0, {"lost": [3], "frames": 40})
    return folder


def read_build(place, path):
    from jawusd.pipeline.state import BuildState

    state = BuildState(place)
    for name, wanted in (("sync", "a" * 64), ("track", "b" * 64)):
        record = state.valid(name, wanted)
        if record is not None and name == "sync":
            sum(record.result["offsets"].values())
    state.clear()


def write_journal(folder):
    from jawusd.pipeline.segment_record import Journal

    folder.mkdir(parents=True)
    journal = Journal(folder, "a", False)
    poses = np.stack([np.eye(4)] * 2).tolist()
    camera = {"frame": 1, "contrast": [0.5, 0.4], "pixels": [5, 6], "unexpected": [0.1, 0.2], "residual_px": [0.1, 0.2],
              "uncovered": [0.1, None], "outline": [[30, 2, 4], [40, 1, 4]]}  # fmt: skip
    for frame in range(3):
        journal.add(frame, {"poses": poses, "status": [1, 0], "cameras": {"cam0": camera}})
    return folder


def read_journal(place, path):
    from jawusd.pipeline.segment_record import Journal, summarise

    journal = Journal(place, "a", True)
    for frame in journal.entries:
        journal.known(frame)
    if journal.entries:
        summarise(journal.entries)
