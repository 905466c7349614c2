"""Valid files that a capture is made of, and what reads them: cameras, pictures, videos, meshes."""

import json
import shutil
from pathlib import Path

import cv2
import numpy as np
from package_copy import ROOT

EXAMPLE = ROOT / "examples" / "capture"
SIZE = (64, 48)


def write_captures(folder):
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


def write_cameras(folder):
    from jawusd.cameras.files import load_cameras_file

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


_METASHAPE = """<document><chunk><sensors><sensor id="0" label="s" type="frame"><resolution width="1280" height="720"/>
<calibration type="frame" class="adjusted"><resolution width="1280" height="720"/><f>1000</f><cx>3</cx><k1>-0.1</k1>
<k4>0.01</k4><p1>0.001</p1></calibration></sensor></sensors><cameras><camera id="0" sensor_id="0" label="cam0.jpg">
<transform>1 0 0 1 0 1 0 2 0 0 1 3 0 0 0 1</transform></camera></cameras><transform><scale>0.5</scale></transform>
</chunk></document>
"""
_XMP = """<x:xmpmeta xmlns:x="adobe:ns:meta/"><rdf:RDF xmlns:rdf="http://www.w3.org/1999/02/22-rdf-syntax-ns#">
<rdf:Description xmlns:xcr="http://www.capturingreality.com/ns/xcr/1.1#" xcr:DistortionModel="brown3"
xcr:FocalLength35mm="38" xcr:PrincipalPointU="0.01" xcr:PrincipalPointV="0">
<xcr:Rotation>1 0 0 0 1 0 0 0 1</xcr:Rotation><xcr:Position>1 2 3</xcr:Position>
<xcr:DistortionCoeficients>-0.1 0.1 0 0 0 0</xcr:DistortionCoeficients>
</rdf:Description></rdf:RDF></x:xmpmeta>
"""
_YAML = """%YAML:1.0
---
image_width: 1280
image_height: 720
camera_matrix: !!opencv-matrix
   rows: 3
   cols: 3
   dt: d
   data: [ 1000., 0., 640., 0., 1000., 360., 0., 0., 1. ]
R: !!opencv-matrix
   rows: 3
   cols: 1
   dt: d
   data: [ 0.1, 0.2, 0.3 ]
T: !!opencv-matrix
   rows: 3
   cols: 1
   dt: d
   data: [ 1., 2., 3. ]
"""
_NUKE = """#! nuke
Axis {
 inputs 0
 translate {1 2 3}
 scaling {2 2 2}
}
Camera {
 rot_order ZXY
 translate {{curve i x1 1.0 x2 1.0} {curve i x1 2.0 x2 2.0} {curve i x1 60.0 x2 60.0}}
 rotate {{curve i x1 1.0 x2 1.0} 10 {curve i x1 3.0 x2 3.0}}
 focal {{curve i x1 35 x2 35}}
 haperture 36
 vaperture 20.25
 name cam0
}
set N1 [stack 0]
push $N1
"""
_LENS = """cam0
3.6 2.025 3.5 1.7778 0.0 0.0 1.0
0
3DE4 Radial - Standard, Degree 4
Distortion - Degree 2
0.03
1
35.0 0.03 -1.0 0.0 1.0 0.0 SMOOTH
Quartic Distortion - Degree 4
0.01
0
<end_of_file>
"""


def write_foreign_cameras(folder):
    from jawusd.cameras.files import load_cameras_file

    texts = {"metashape/cameras.xml": _METASHAPE, "xmp/cam0.xmp": _XMP, "yaml/cam0.yml": _YAML}
    texts["csv/cameras.csv"] = "#name,x,y,alt,heading,pitch,roll,f,k1\ncam0.jpg,1,2,3,10,20,30,35,-0.1\n"
    texts |= {"nuke/shot.nk": _NUKE, "nuke/cam0.txt": _LENS}
    for name, text in texts.items():
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_text(text)

    def read(place, path):
        source = place / "shot.nk" if path.suffix == ".txt" else path
        for camera in load_cameras_file(source, 10.0, {"cam0": (1280, 720)}):
            camera.projection_matrix()

    return [(folder / Path(name).parent, Path(name).name, read) for name in texts]


def _picture(k):
    image = np.zeros(SIZE[::-1], np.uint8)
    image[10 : 30 + k, 12:40] = 255
    return image


def write_pngs(folder):
    folder.mkdir(parents=True)
    for k in range(2):
        cv2.imwrite(str(folder / f"{k:06d}.png"), _picture(k))
    return folder


def read_png(place, path):
    from jawusd.media.masks import MaskReader, mask_size_px

    mask_size_px(place / "%06d.png")
    with MaskReader(place / "%06d.png", SIZE) as reader:
        for frame in range(2):
            reader.read(frame)


def write_videos(folder):
    from jawusd.media.writers import VideoWriter

    folder.mkdir(parents=True)
    for name, lossless in (("mask.mkv", True), ("mask.mp4", False)):
        with VideoWriter(folder / name, SIZE, 24.0, lossless=lossless) as writer:
            for k in range(5):
                writer.write(_picture(k))
    return "mask.mkv", "mask.mp4"


def read_video(place, path):
    from jawusd.media.containers import read_sound
    from jawusd.media.masks import MaskReader
    from jawusd.media.video import Video

    video = Video(path)
    with MaskReader(path, video.size_px) as reader:
        for frame in range(min(video.count, 8)):
            reader.read(frame)
    read_sound(path, 16000)


def write_meshes(folder):
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


def read_mesh(place, path):
    from jawusd.formats.mesh import tooth_labels
    from jawusd.meshes.meshio import load_mesh

    tooth_labels(load_mesh(path))
