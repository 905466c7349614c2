"""The page of file formats: the modules of jawusd.formats that read or write one, and the files of a rig's folder."""

from jawusd.rig import layout

#: Title and module of every file, in groups.
FILES = {
    "What goes in": {
        "Capture: capture.toml": "jawusd.formats.capture",
        "List of captures": "jawusd.formats.capture_list",
        "Cameras of any program": "jawusd.cameras.files",
        "Cameras: TOML of aniposelib, Pose2Sim and Caliscope": "jawusd.cameras.calibration",
        "Cameras: Metashape XML": "jawusd.cameras.metashape",
        "Cameras: RealityScan XMP and CSV": "jawusd.cameras.realityscan",
        "Cameras: COLMAP text, read and written": "jawusd.cameras.colmap",
        "Cameras: nerfstudio JSON": "jawusd.cameras.nerfstudio",
        "Cameras: OpenCV YAML, XML and JSON": "jawusd.cameras.opencv",
        "Cameras: 3DEqualizer": "jawusd.cameras.equalizer",
        "Lenses: 3DEqualizer": "jawusd.cameras.equalizer_lens",
        "Landmarks: landmarks.json": "jawusd.formats.landmarks",
        "Poses and parameters: CSV and JSON; joint table": "jawusd.formats.poses",
        "Tables of text of any locale": "jawusd.base.tables",
        "Marker positions: tables, probes and rigid bodies": "jawusd.formats.markers",
        "Keys: keys.json": "jawusd.formats.keys",
        "Faces: CSV of columns or points": "jawusd.formats.face_table",
        "Face models: correspondences and alignment in JSON, jaw motion in npz": "jawusd.formats.alignment",
        "ARKit face captures: CSV": "jawusd.formats.arkit",
    },
    "What comes out": {
        "Tracks: tracks.npz": "jawusd.formats.tracks",
        "Model: model.npz": "jawusd.formats.model",
        "Solved performance: CSV, and arrays in tracks.npz": "jawusd.formats.performance",
        "Jaw from skin: skin.npz": "jawusd.evaluator.skin",
        "Photographs: photos.json": "jawusd.formats.photographs",
        "glTF for the web: .glb": "jawusd.formats.gltf",
        "Library: library.json": "jawusd.library.index",
        "State of a build: build.json": "jawusd.pipeline.state",
        "Masks made by segment: segment.json": "jawusd.pipeline.segment_record",
        "Paper's experiments": "jawusd.formats.experiments",
    },
    "What they share": {
        "Meshes; labels of crown and gum: SCAN.labels.npz": "jawusd.formats.mesh",
        "Meshes: PLY": "jawusd.formats.mesh_ply",
        "Meshes: STL and OBJ": "jawusd.formats.mesh_reading",
        "Findings": "jawusd.formats.finding",
        "Clips and time code": "jawusd.formats.clips",
        "Numbered pictures and kinds of files": "jawusd.formats.file_names",
        "Paths and allowed folders": "jawusd.base.inputs",
    },
}

FOLDER = f"""# Files

This page lists every file that jawusd reads or writes. Each has a dataclass, a reader and a writer. The text comes from
their docstrings. Readers check version, units, shapes and finite numbers, and name the field that is wrong. Writers
write a temporary file and rename it, so incomplete files never appear. Files of a newer version are refused, and files
of an older version are upgraded. There are no pickles.

## The folder of a rig

| file | holds |
|---|---|
| `{layout.ACTOR_FILE}` | the interface: default prim `{layout.ACTOR}`, [attributes](usd.md) `jaw:*`; names the others |
| `{layout.RIG_FILE}` | the arrays of the exact model and the sampled table |
| `{layout.GEO_FILE}` | meshes: `{layout.SKULL}` and `{layout.MANDIBLE}`, which moves |
| `{layout.PROXY_FILE}` | the same with about a tenth of the faces: variant set `{layout.DETAIL}` |
| `{layout.ONNX_FILE}`, `{layout.ENCODE_FILE}` | decoder (d to pose, twist, margin) and encoder (pose to d), float32 |
| `anim_capture.usdc` | the captured motion as plain transforms; variant set `{layout.MOTION}` |
| `{layout.SKEL_FILE}` | the same as a UsdSkel skeleton, whose keys can be edited |
| `{layout.PACKAGE_FILE}` | one file for viewers, without ONNX |
| `cameras.usda` | the calibrated cameras |
| `tracks.npz`, `first_pass.npz` | [poses of both arches][jawusd.formats.tracks], final and of the first pass |
| `model.npz` | the [fitted model][jawusd.formats.model], all that `jawusd.evaluator.load` needs |
| `report.html` | the quality of the build, on one self-contained page |
| `build.json` | finished stages, with their input files and versions |

"""


def page():
    """Return the page as Markdown."""
    parts = [FOLDER]
    for group, files in FILES.items():
        parts.append(f"## {group}\n\n")
        for title, module in files.items():
            options = [f'heading: "{title}"', f'toc_label: "{title}"', "heading_level: 3"]
            parts.append("\n      ".join([f"::: {module}\n    options:", *options]) + "\n\n")
    return "".join(parts)
