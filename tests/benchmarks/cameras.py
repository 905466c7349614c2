"""Read camera files of public repositories; print how far 1,000 points lie from where each program's model puts them.

    python tests/benchmarks/cameras.py FOLDER

FOLDER has clones of some of the repositories below, each under its name, as `git clone` makes them; others are left
out. The models are stated once more here, by other readers than jawusd's: OpenCV's FileStorage and projectPoints,
tomllib, and ElementTree with the formulas of Metashape's manual (appendix "Camera models", frame camera) and of Epic's
"RealityCapture XMP Camera Math". Lenses of 3DEqualizer have no pose in these files and get a made-up camera; their
points are roots of the formulas in the Lens Distortion Plugin Kit (tests/cameras/test_camera_3de.py).
"""

from __future__ import annotations

import argparse
import re
import sys
import tempfile
import tomllib
from collections.abc import Callable, Iterator
from pathlib import Path
from xml.etree import ElementTree

import cv2
import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "formats"))

import test_camera_3de as of_3de

from jawusd.base.errors import CalibrationError
from jawusd.cameras.files import load_cameras_file

SIZE = (1920, 1080)  # of pictures whose size the file does not hold
Project = Callable[[np.ndarray], np.ndarray]
SAMPLES = (
    ("Metashape XML", "metashape-automation", "cameras.xml"),
    ("RealityScan XMP", "geomapi", "tests/testfiles/img"),
    ("OpenCV YAML, stereo", "PRiMEStereoMatch", "data"),
    ("OpenCV YAML, EasyMocap", "trackmesh_gui", "intri.yml"),
    ("aniposelib TOML", "sleap-anipose", "tests/data/minimal_session/calibration.toml"),
    ("Caliscope TOML", "caliscope", "tests/sessions/4_cam_recording/camera_array.toml"),
    ("Pose2Sim TOML", "pose2sim", "Pose2Sim/S00_Demo_Session/S00_Calibration/Calib_qualisys.toml"),
    *(
        ("3DEqualizer lens", "mayaMatchMoveSolver", f"lib/cppbind/mmlens/tests/test_file_3de_{name}.nk")
        for name in ("classic_1", "radial_std_deg4_1")
    ),
)


def opencv(R: np.ndarray, t: np.ndarray, K: np.ndarray, lens: np.ndarray) -> Project:
    """Return OpenCV's projection, of world points (N, 3)."""
    turn = cv2.Rodrigues(np.asarray(R, float))[0] if np.shape(R) == (3, 3) else np.asarray(R, float)
    return lambda world: cv2.projectPoints(world, turn, np.asarray(t, float), K, lens)[0][:, 0]


def of_toml(path: Path) -> dict[str, Project]:
    """Return the projections of a TOML, by the names jawusd gives."""
    tables = tomllib.loads(path.read_text())
    cameras = tables.get("cameras", tables)
    found = {table.get("name", f"cam_{key}"): table for key, table in cameras.items() if "matrix" in table}
    return {
        name: opencv(one["rotation"], one["translation"], np.array(one["matrix"]), np.array(one["distortions"]))
        for name, one in found.items()
    }


def of_yaml(path: Path) -> dict[str, Project]:
    """Return the projections of OpenCV's stereo sample, or of EasyMocap's pair of files."""
    pair = path.is_dir()
    inside, outside = (
        cv2.FileStorage(str(file), cv2.FILE_STORAGE_READ)
        for file in (
            (path / "intrinsics.yml", path / "extrinsics.yml") if pair else (path, path.with_name("extri.yml"))
        )
    )

    def of(key: str) -> np.ndarray:
        node = outside.getNode(key)
        return (inside.getNode(key) if node.empty() else node).mat()

    if pair:
        poses = {"1": (np.eye(3), np.zeros(3)), "2": (of("R"), of("T"))}
        return {name: opencv(*pose, of(f"M{name}"), of(f"D{name}")) for name, pose in poses.items()}
    names = inside.getNode("names")
    listed = [name for name in (names.at(k).string() for k in range(names.size())) if of(f"T_{name}") is not None]
    return {name: opencv(of(f"Rot_{name}"), of(f"T_{name}"), of(f"K_{name}"), of(f"dist_{name}")) for name in listed}


def of_metashape(path: Path) -> dict[str, Project]:
    """Return the projections that Metashape's manual states, from the middle of the first pixel."""
    root = ElementTree.parse(path).getroot()
    place = root.find(".//component/transform")
    R0, t0, scale = np.eye(3), np.zeros(3), 1.0
    if place is not None:
        texts = {node.tag: node.text for node in place}
        R0 = np.array(texts["rotation"].split(), float).reshape(3, 3) if "rotation" in texts else R0
        t0 = np.array(texts["translation"].split(), float) if "translation" in texts else t0
        scale = float(texts.get("scale", 1.0))
    out = {}
    for node in root.iter("camera"):
        if node.find("transform") is None:
            continue
        T = np.array(node.find("transform").text.split(), float).reshape(4, 4)
        sensor = root.find(f".//sensor[@id='{node.get('sensor_id')}']")
        lens = sensor.find("calibration[@class='adjusted']")
        size = lens.find("resolution")
        own = {child.tag: float(child.text) for child in lens if child.tag in ("f", "cx", "cy", "b1", "b2")}
        own |= {c.tag: float(c.text) for c in lens if re.fullmatch("[kp][1-4]", c.tag)}

        def project(world, T=T, own=own, size=size):
            inside = ((world - t0) @ R0 / scale - T[:3, 3]) @ T[:3, :3]
            x, y = inside[:, 0] / inside[:, 2], inside[:, 1] / inside[:, 2]
            r2 = x * x + y * y
            k = 1 + sum(own.get(f"k{n}", 0.0) * r2**n for n in (1, 2, 3, 4))
            p1, p2 = own.get("p1", 0.0), own.get("p2", 0.0)
            dx, dy = x * k + p1 * (r2 + 2 * x * x) + 2 * p2 * x * y, y * k + p2 * (r2 + 2 * y * y) + 2 * p1 * x * y
            u = float(size.get("width")) / 2 + own.get("cx", 0.0) + dx * (own["f"] + own.get("b1", 0.0))
            v = float(size.get("height")) / 2 + own.get("cy", 0.0) + dy * own["f"]
            return np.column_stack([u + dy * own.get("b2", 0.0), v]) - 0.5

        out[Path(node.get("label")).stem] = project
    return out


def of_realityscan(folder: Path) -> dict[str, Project]:
    """Return the projections that Epic's reference states, from the middle of the first pixel."""
    out = {}
    for path in sorted(folder.glob("*.xmp")):
        text = path.read_text()

        def numbers(key, text=text):
            return np.array(re.search(rf'xcr:{key}[>=]"?([^"<]+)', text)[1].split(), float)

        R, place, terms = numbers("Rotation").reshape(3, 3), numbers("Position"), numbers("DistortionCoeficients")
        f, shift = numbers("FocalLength35mm")[0] / 36, [numbers(f"PrincipalPoint{a}")[0] for a in "UV"]

        def project(world, R=R, place=place, terms=terms, f=f, shift=shift):
            own = (world - place) @ R.T
            x, y = own[:, 0] / own[:, 2], own[:, 1] / own[:, 2]
            r2 = x * x + y * y
            k, (t1, t2) = 1 + sum(c * r2 ** (n + 1) for n, c in enumerate(terms[:4])), terms[4:]
            dx, dy = x * k + 2 * t1 * x * y + t2 * (r2 + 2 * x * x), y * k + t1 * (r2 + 2 * y * y) + 2 * t2 * x * y
            side, middle = max(SIZE), np.array(SIZE) / 2
            return (f * np.column_stack([dx, dy]) + shift) * side + middle - 0.5

        out[path.stem] = project
    return out


def points_seen(camera: object) -> np.ndarray:
    """Return 1,000 world points all over a camera's picture, up to 27 degrees off its axis."""
    rng = np.random.default_rng(3)
    half = np.minimum(np.array(camera.size_px) / 2 / camera.K[[0, 1], [0, 1]], 0.5)
    own = np.column_stack([rng.uniform(-half, half, (1000, 2)), np.ones(1000)]) * rng.uniform(0.5, 2.0, (1000, 1))
    return (own - camera.T_cam_world[:3, 3]) @ camera.T_cam_world[:3, :3]


def away_3de(path: Path) -> float:
    """Return how far points lie from where a lens of 3DEqualizer puts them [px]."""
    text = path.read_text() + "\n"
    model, order = (
        (of_3de.CLASSIC, ["Distortion", "Anamorphic_Squeeze", "Curvature_X", "Curvature_Y", "Quartic_Distortion"])
        if "Classic" in text
        else (of_3de.RADIAL, [re.sub("[ -]+", "_", name) for name in of_3de.NAMES[of_3de.RADIAL]])
    )
    node = text[: text.index("}\n", text.index("LD_")) + 1]
    values = [float(re.search(rf"^ *{name} ([-\d.]+)$", node, re.M)[1]) for name in order]
    of_3de.OFFSET = (0.0, 0.0)
    world, wanted = of_3de.seen(model, values)
    with tempfile.TemporaryDirectory() as scratch:
        script = Path(scratch) / "shot.nk"
        script.write_text(text + of_3de.camera_node(win_translate="{0 0}"))
        (camera,) = load_cameras_file(script, 10.0, {"left": SIZE})
    return float(np.abs(camera.project(10.0 * world) - wanted).max())


READERS = {"Metashape": of_metashape, "RealityScan": of_realityscan, "OpenCV": of_yaml}


def rows(folder: Path) -> Iterator[tuple[str, str, int, float]]:
    """Yield kind, file, cameras and the largest distance [px] of every sample there is."""
    for kind, repository, inner in SAMPLES:
        path = folder / repository / inner
        if not path.exists():
            continue
        if kind.startswith("3DE"):
            try:
                yield kind, inner, 1, away_3de(path)
            except CalibrationError as error:
                print(f"{kind}: {inner}: refused: {error.statement()}")
            continue
        wanted = next((read for name, read in READERS.items() if kind.startswith(name)), of_toml)(path)
        cameras = load_cameras_file(path, 1.0, dict.fromkeys(wanted, SIZE))
        if sorted(wanted) != sorted(camera.name for camera in cameras):
            raise RuntimeError(f"{path}: cameras {[camera.name for camera in cameras]}, not {list(wanted)}")
        worst = 0.0
        for camera in cameras:
            world = points_seen(camera)
            worst = max(worst, float(np.abs(camera.project(world) - wanted[camera.name](world)).max()))
        yield kind, inner, len(cameras), worst


def main() -> None:
    """Run."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path)
    for kind, inner, count, away in rows(parser.parse_args().folder):
        print(f"{kind:24} {count:3} cameras  {away:.5f} px  {inner}", flush=True)


if __name__ == "__main__":
    main()
