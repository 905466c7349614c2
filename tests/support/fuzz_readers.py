"""Every reader with valid files to damage: what is written, what is damaged and how, and what is called."""

import json
import tomllib
from dataclasses import dataclass
from pathlib import Path
from random import Random

import fuzz_captured as captured
import fuzz_grammar as grammar
import fuzz_mutate as mutate
import fuzz_recorded as recorded
import fuzz_rigged as rigged
import fuzz_structures as structures
from example_rig import example_rig


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

    for place, file, read in captured.write_captures(folder / "capture"):
        add("capture.toml", place, file, text, read)
    for place, file, read in captured.write_cameras(folder / "cameras"):
        add("calibration", place, file, js if file.endswith("json") else text, read)
    add("PNG masks", captured.write_pngs(folder / "png"), "000000.png", mutate.damaged_png, captured.read_png)
    for name in captured.write_videos(folder / "video"):
        add("video masks", folder / "video", name, mutate.damaged_bytes, captured.read_video)
    for place, file, ascii_file in captured.write_meshes(folder / "mesh"):
        add("PLY, STL, OBJ", place, file, text if ascii_file else mutate.damaged_bytes, captured.read_mesh)
    tracks, models = recorded.write_archives(folder / "npz")
    add("tracks npz", tracks, "tracks.npz", mutate.damaged_npz, recorded.read_tracks)
    for place in models:
        add("model npz", place, "model.npz", mutate.damaged_npz, recorded.read_model)
    place = recorded.write_tables(folder / "tables", rig)
    for file in ("linear.json", "smooth.json"):
        add("keys", place, file, js, recorded.motion_reader(rig))
    for file in ("d.csv", "matrix.csv", "quaternion.csv", "rows.json"):
        add("CSV", place, file, js if file.endswith("json") else text, recorded.motion_reader(rig))
    add("CSV", place, "foreign.csv", text, recorded.read_foreign)
    add("ARKit CSV", place, "face.csv", text, recorded.face_reader(rig))
    add("landmarks", place, "landmarks.json", js, recorded.read_landmarks)
    for file in ("plain.h5", "whole.h5"):
        add("HDF5", recorded.write_hdf5(folder / "hdf5"), file, structures.damaged_hdf5, recorded.read_hdf5)
    add("library", recorded.write_library(folder / "library"), "library.json", js, recorded.read_library)
    add("build.json", recorded.write_build(folder / "build"), "build.json", js, recorded.read_build)
    add("journal", recorded.write_journal(folder / "journal"), "segment.jsonl", text, recorded.read_journal)
    for kind in ("additive", "anchored"):
        place = rigged.write_rig(folder / f"rig_{kind}", kind)
        for file in ("actor.usda", "anim.usda"):
            add("usda", place, file, structures.damaged_layer(False), rigged.read_rig)
        for file in ("rig.usdc", "geo.usdc", "anim.usdc"):
            add("usdc", place, file, structures.damaged_layer(True), rigged.read_rig)
        add("usdz", place, "actor.usdz", mutate.damaged_zip, rigged.read_rig)
        for file in ("actor.onnx", "actor_encode.onnx"):
            add("ONNX", place, file, mutate.damaged_bytes, rigged.onnx_reader(example_rig(kind)))
        add("USD grammar", place, "anim.usda", _from_grammar, rigged.read_shot)
    for reader, suffix, write in (("TOML schemas", ".toml", grammar.toml_text), ("JSON schemas", ".json", json.dumps)):
        known = {t.file: t for targets in list(found.values()) for t in targets if t.file.endswith(suffix)}
        for t in known.values():
            add(reader, t.folder, t.file, _from_schema(write), t.read)
    for place, file, read in captured.write_foreign_cameras(folder / "foreign"):
        add("foreign cameras", place, file, text, read)
    return found


def _from_grammar(rng, data):
    return grammar.usd_text(Random(int(rng.integers(2**62)))).encode("utf-8", "surrogatepass")


def _from_schema(write):
    """Return a damager that takes the words of a valid file, and its schema, and writes another file that has it."""

    def damaged(rng, data):
        is_toml = write is grammar.toml_text
        valid = tomllib.loads(data.decode()) if is_toml else json.loads(data)
        schema = grammar.capture_schema() if "scans" in valid else grammar.schema_of(valid)
        made = grammar.from_schema(schema, Random(int(rng.integers(2**62))), valid, grammar.words_of(valid))
        return write(made if isinstance(made, dict) or not is_toml else {"": made}).encode("utf-8", "surrogatepass")

    return damaged
