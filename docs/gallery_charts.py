"""Charts and drawn meshes of the guides, from a finished rig and from synthetic subjects; see make_gallery.py."""

import re
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Iterable
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import PolyCollection
from matplotlib.figure import Figure

import jawusd
from jawusd.cli.motion import kept_inside, read_motion
from jawusd.evaluator import JawRig
from jawusd.formats.arkit import shares_of
from jawusd.formats.mesh import Mesh, crown_face_mask
from jawusd.formats.model import load_model
from jawusd.formats.tracks import load_tracks
from jawusd.geometry import transform_point, transform_points
from jawusd.geometry.so3 import continuous_wxyz, matrix_from_wxyz
from jawusd.pipeline.bake import SHAPES
from jawusd.pipeline.library import open_library
from jawusd.report.figures import ranges_figure
from jawusd.report.solve_page import jaw_figure
from jawusd.report.style import BLACK, BLUE, GREEN, GREY, ORANGE, SKY, VERMILION, new_figure
from jawusd.rig import describe
from jawusd.rig.geo import read_geometry, read_gum
from jawusd.rig.placeholder import with_estimated_bones

ROOT = Path(__file__).resolve().parents[1]
D_NAMES = ("d1 opening", "d2 laterotrusion", "d3 protrusion")
LANDMARKS = ("incisal point", "left molar", "right molar", "left condyle", "right condyle")
LOWER = ("mandible", "lower_teeth")
ENAMEL, GUM, BONE = (0.94, 0.91, 0.84), (0.80, 0.50, 0.50), (0.86, 0.80, 0.68)
# Triangles (F, 3, 3) [mm], and their colour.
Part = tuple[np.ndarray, tuple[float, float, float]]
LIGHT = np.array([0.35, 0.55, 0.75])
# Views of a head: the axes across and up the picture, and towards the viewer, in anatomical axes.
FRONT = np.array([[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]])
SIDE = np.array([[0.0, 0.0, -1.0], [0.0, 1.0, 0.0], [1.0, 0.0, 0.0]])
OBLIQUE = np.array([[0.75, 0.0, -0.66], [-0.13, 0.98, -0.15], [0.65, 0.2, 0.74]])
SOLVED_FRAMES, FPS = (20, 140), 24.0  # of the example capture
MOUTHS = (9, 33, 6, 42, 45, 15)  # numbers of synthetic mouths
KEY_FRAMES, KEYS_FRAMES = 6, (180, 264)  # distance of the sparse keys, and the part of the take that is drawn


def incisal_point(rig: JawRig, d: np.ndarray, landmark: int = 0) -> np.ndarray:
    """Return where a landmark of the mandible is, from the closed bite to the left, up and forward [mm]."""
    A, point = rig.T_anatomical_skull, rig.landmarks[landmark]
    return transform_point(A @ rig.pose(d), point) - transform_point(A @ rig.T_rest, point)


def draw_meshes(axis: Axes, view: np.ndarray, parts: Iterable[Part]) -> None:
    """Draw triangles (F, 3, 3) [mm], each part in its colour, as seen along the third axis of a view (3, 3)."""
    corners, colours = [], []
    for triangles, colour in parts:
        seen = triangles @ view.T
        normal = np.cross(seen[:, 1] - seen[:, 0], seen[:, 2] - seen[:, 0])
        normal /= np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-12)
        shade = 0.45 + 0.55 * np.clip(normal @ (LIGHT / np.linalg.norm(LIGHT)), 0.0, 1.0)
        corners.append(seen[normal[:, 2] > 0])
        colours.append(np.clip(shade[normal[:, 2] > 0, None] * colour, 0.0, 1.0))
    drawn, inks = np.concatenate(corners), np.concatenate(colours)
    order = np.argsort(drawn[:, :, 2].mean(axis=1))
    axis.add_collection(PolyCollection(drawn[order, :, :2], facecolors=inks[order], edgecolors=inks[order], lw=0.15))
    axis.set_aspect("equal")
    axis.autoscale_view()
    axis.axis("off")


def triangles_of(mesh: Mesh, T: np.ndarray, chosen: np.ndarray | slice = slice(None)) -> np.ndarray:
    """Return the chosen faces of a mesh after a transform, shape (F, 3, 3)."""
    return transform_points(T, mesh.vertices)[mesh.faces[chosen]]


def keys(out: Path) -> Figure:
    """Draw the keys of the guide as they were set, and the motion inside the bound that `jawusd animate` writes."""
    rig, page = jawusd.load(out / "actor.usda"), (ROOT / "docs" / "guides" / "animate.md").read_text()
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "keys.json"
        file.write_text(re.search(r"echo '(\{.*\})' > keys\.json", page)[1])
        keyed = read_motion(rig, file)
    kept, _ = kept_inside(rig, keyed)
    figure, axes = new_figure(7.2, 4.6, 2, 1, sharex=True, height_ratios=[2.2, 1.0])
    for name, colour, wished, written in zip(D_NAMES, (BLACK, BLUE, VERMILION), keyed.d.T, kept.d.T, strict=True):
        axes[0].plot(keyed.frames, wished, "--", color=colour, lw=1)
        axes[0].plot(kept.frames, written, color=colour, lw=1.8, label=name)
    axes[0].set(ylabel="parameter [mm]", title="dashed: as keyed    solid: moved inside the bound")
    axes[0].legend(frameon=False)
    axes[1].plot(keyed.frames, rig.margin(keyed.d), "--", color=GREY, lw=1)
    axes[1].plot(kept.frames, rig.margin(kept.d), color=GREEN, lw=1.8)
    axes[1].axhline(0.0, color=BLACK, lw=0.8)
    axes[1].fill_between(keyed.frames, np.fmin(rig.margin(keyed.d), 0.0), 0.0, color=VERMILION, alpha=0.25, lw=0)
    axes[1].set(ylabel="margin [mm]\n0: the bound", xlabel="frame")
    return figure


def arkit(out: Path) -> Figure:
    """Draw the path of the lower incisal point and of a condyle for each jaw shape of ARKit, from weight 0 to 1."""
    rig = jawusd.load(out / "actor.usda")
    figure, axes = new_figure(8.2, 3.9, 1, 3)
    share = np.linspace(0.0, 1.0, 81)
    for row, (name, colour) in enumerate(zip(SHAPES, (BLUE, GREEN, SKY, VERMILION), strict=True)):
        weights = np.zeros((len(share), len(SHAPES)))
        weights[:, row] = share
        d = rig.project(rig.denormalized(shares_of(weights)))
        for axis, landmark, across in ((axes[0], 0, 2), (axes[1], 0, 0), (axes[2], 3, 2)):
            path = incisal_point(rig, d, landmark)[:, [across, 1]]
            axis.plot(*path.T, color=colour, lw=1.6, label=name)
            axis.plot(*path[40], "o", color=colour, ms=4)
            axis.plot(*path[-1], "s", color=colour, ms=5)
    titles = ("incisal point, from the side", "incisal point, from the front", "left condyle, from the side")
    for axis, title, across in zip(axes, titles, ("forward", "left", "forward"), strict=True):
        axis.set(title=title, xlabel=f"{across} [mm]", ylabel="up [mm]", aspect="equal")
    figure.legend(*axes[0].get_legend_handles_labels(), loc="outside lower center", ncols=4, frameon=False)
    figure.suptitle("weight 0 to 1; dot: half weight, square: full weight", fontsize=9)
    return figure


def sparse_keys(out: Path) -> Figure:
    """Draw a part of the take with a key at every frame, and interpolated between keys that are farther apart."""
    rig, model = jawusd.load(out / "actor.usda"), load_model(out / "model.npz")
    d = model.d[np.isfinite(model.d).all(axis=1)]
    true, at = rig.pose(d), np.arange(len(d) // KEY_FRAMES * KEY_FRAMES)
    low, share = at // KEY_FRAMES * KEY_FRAMES, ((at % KEY_FRAMES) / KEY_FRAMES)[:, None]
    high, quaternions = np.minimum(low + KEY_FRAMES, len(d) - 1), continuous_wxyz(true[:, :3, :3])
    sparse = true[at].copy()
    sparse[:, :3, :3] = matrix_from_wxyz((1 - share) * quaternions[low] + share * quaternions[high])
    sparse[:, :3, 3] = (1 - share) * true[low, :3, 3] + share * true[high, :3, 3]
    every, few = (transform_point(rig.T_anatomical_skull @ T, rig.landmarks[0]) for T in (true[at], sparse))
    figure, axes = new_figure(8.2, 3.4, 1, 2)
    part = slice(KEYS_FRAMES[0], KEYS_FRAMES[1] + 1)
    axes[0].plot(*every[part, :2].T, color=BLUE, lw=1.4, label="a key at every frame")
    axes[0].plot(*few[part, :2].T, "--", color=VERMILION, lw=1.2, label=f"a key at every {KEY_FRAMES}th frame")
    axes[0].plot(*few[part][::KEY_FRAMES, :2].T, "o", color=VERMILION, ms=3.5)
    axes[0].set(title="incisal point, from the front", xlabel="left [mm]", ylabel="up [mm]", aspect="equal")
    axes[0].set_xticks([-4, 0, 4])
    axes[1].plot(at, np.linalg.norm(every - few, axis=1), color=VERMILION, lw=1)
    axes[1].set(title="distance of the two [mm]", xlabel="frame of the take", ylim=(0, None))
    figure.legend(*axes[0].get_legend_handles_labels(), loc="outside lower center", ncols=2, frameon=False)
    return figure


def library(out: Path) -> Figure:
    """Draw the ranges of the actors in the library that examples/07_library_and_retarget.py makes."""
    script = ROOT / "examples" / "07_library_and_retarget.py"
    with tempfile.TemporaryDirectory() as people:
        command = [sys.executable, script, out / "actor.usda", "-o", people]
        subprocess.run(list(map(str, command)), check=True, stdout=subprocess.DEVNULL)
        return ranges_figure([(entry.actor, entry.ranges_mm) for entry in open_library(people).entries])


def poses(out: Path) -> Figure:
    """Draw where the five landmarks of the mandible were in every captured pose, with the closed jaw behind them."""
    rig, tracks = jawusd.load(out / "actor.usda"), load_tracks(out / "tracks.npz")
    meshes, A = read_geometry(out / "actor.usda", describe(out / "actor.usda")["prim"]), rig.T_anatomical_skull
    figure, axes = new_figure(8.2, 4.0, 1, 2)
    for axis, view, title in zip(axes, (SIDE, FRONT), ("from the left", "from the front"), strict=True):
        closed = [(triangles_of(meshes[name], A @ rig.T_rest), (0.93, 0.93, 0.93)) for name in LOWER if name in meshes]
        draw_meshes(axis, view, closed)
        for number, (name, colour) in enumerate(zip(LANDMARKS, (VERMILION, ORANGE, GREEN, BLUE, SKY), strict=True)):
            path = transform_point(A @ tracks.T_upper_lower, rig.landmarks[number]) @ view.T
            axis.plot(*path[:, :2].T, ".", color=colour, ms=2.5, label=name)
        axis.set_title(title)
        axis.autoscale_view()
    words = axes[1].get_legend_handles_labels()
    figure.legend(*words, loc="outside lower center", ncols=5, frameon=False, markerscale=3)
    return figure


def model(out: Path) -> Figure:
    """Draw how the jaw turns and how far a condyle slides, over opening and protrusion, with the captured poses."""
    rig = jawusd.load(out / "actor.usda")
    opening, forward = np.linspace(*rig.d_range[0], 140), np.linspace(*rig.d_range[2], 120)
    d = np.zeros((len(forward), len(opening), 3))
    d[..., 0], d[..., 2] = opening, forward[:, None]
    omega = rig.twist(d)[..., :3]
    slide = np.linalg.norm(incisal_point(rig, d, 3), axis=-1)
    outside = ~rig.is_inside(d)
    figure, axes = new_figure(8.2, 3.3, 1, 2, sharey=True)
    turned = np.rad2deg(np.linalg.norm(omega, axis=-1))
    titles = "rotation of the jaw [degrees]", "displacement of the left condyle [mm]"
    for axis, values, title in zip(axes, (turned, slide), titles, strict=True):
        filled = axis.contourf(opening, forward, np.ma.masked_where(outside, values), 12, cmap="viridis")
        axis.plot(rig.captured_d[:, 0], rig.captured_d[:, 2], ".", color="white", ms=1.6)
        axis.set(title=title, xlabel="d1 opening [mm]")
        figure.colorbar(filled, ax=axis)
    axes[0].set_ylabel("d3 protrusion [mm]")
    return figure


def skin(out: Path) -> Figure:
    """Draw the jaw of a synthetic person as found from the skin behind closed lips, with the true one."""
    sys.path.insert(0, str(ROOT / "tests" / "support"))
    from skin_takes import Skin

    person = Skin(0)
    points, d, seen = person.calibration()
    found = jawusd.fit_skin(person.rig, points, d, seen, 0.15)
    seen_points, T = person.closed_speech(360)
    true, solved = person.rig.encode(T).d, found(seen_points)
    seconds = np.arange(len(true)) / 24.0
    figure, axes = new_figure(8.2, 4.4, 3, 1, sharex=True)
    for row, (axis, name) in enumerate(zip(axes, D_NAMES, strict=True)):
        sigma = np.sqrt(solved.covariance[:, row, row])
        low, high = solved.d[:, row] - 2 * sigma, solved.d[:, row] + 2 * sigma
        axis.fill_between(seconds, low, high, color=SKY, alpha=0.4, lw=0, label="from the skin, 2 sigma")
        axis.plot(seconds, solved.d[:, row], color=BLUE, lw=1.2, label="from the skin")
        axis.plot(seconds, true[:, row], "--", color=BLACK, lw=1.0, label="true")
        axis.set_ylabel(name.replace(" ", "\n") + " [mm]")
    axes[-1].set_xlabel("time [s]")
    figure.legend(*axes[0].get_legend_handles_labels(), loc="outside upper center", ncols=3, frameon=False)
    return figure


def arch_parts(mesh: Mesh, T: np.ndarray, crown: np.ndarray) -> list[Part]:
    """Return the crowns (faces of a mask) and the gum of a scan as parts to draw."""
    return [(triangles_of(mesh, T, crown), ENAMEL), (triangles_of(mesh, T, ~crown), GUM)]


def subjects(out: Path) -> Figure:
    """Draw the teeth of synthetic subjects from the front, in occlusion."""
    sys.path.insert(0, str(ROOT / "tests" / "support"))
    from subjects.bite import build_bite
    from subjects.traits import draw_traits

    figure, axes = new_figure(8.2, 3.9, 2, 3)
    for axis, number in zip(axes, MOUTHS, strict=True):
        traits = draw_traits(number)
        bite = build_bite(traits)
        arches = (bite.upper.mesh, bite.lower.mesh)
        draw_meshes(axis, FRONT, [part for m in arches for part in arch_parts(m, np.eye(4), crown_face_mask(m))])
        axis.set_title(traits.bite)
    return figure


def head(out: Path) -> Figure:
    """Draw two scans in occlusion, and the head that is estimated from them."""
    actor = out / "actor.usda"
    rig, prim = jawusd.load(actor), describe(actor)["prim"]
    scans, gums = {k: m for k, m in read_geometry(actor, prim).items() if k.endswith("teeth")}, read_gum(actor, prim)
    made, _ = with_estimated_bones(rig, scans)
    A = rig.T_anatomical_skull
    place = {name: A @ rig.T_rest if name in LOWER else A for name in made}
    teeth = [part for name in scans for part in arch_parts(scans[name], place[name], ~gums[name])]
    bones = [(triangles_of(mesh, place[name]), BONE) for name, mesh in made.items() if name not in scans]
    figure, axes = new_figure(8.2, 3.6, 1, 3)
    for axis, view, parts, title in (
        (axes[0], FRONT, teeth, "two scans in occlusion"),
        (axes[1], OBLIQUE, teeth + bones, "with the estimated head"),
        (axes[2], SIDE, teeth + bones, "from the left"),
    ):
        draw_meshes(axis, view, parts)
        axis.set_title(title)
    return figure


def capture_of(folder: Path, frames: tuple[int, int], cameras: int, *, masks: bool) -> Path:
    """Write a part of the example capture to a folder: some frames, the first cameras, and masks or footage alone."""
    shutil.copytree(ROOT / "examples" / "capture", folder, dirs_exist_ok=True)
    top, *blocks = (folder / "capture.toml").read_text().split("[[camera]]")
    last, end = blocks[-1].split("[boards]")
    kept = [*blocks[:-1], last][:cameras]
    picks = "[bootstrap]" + end.split("[bootstrap]")[1]
    text = "[[camera]]".join([re.sub(r"frames = .*", f"frames = {list(frames)}", top), *kept]) + picks * (cameras > 1)
    (folder / "capture.toml").write_text(text if masks else re.sub(r"masks\..*\n", "", text))
    return folder


def run_jawusd(*words: str | Path) -> None:
    """Run a command of jawusd."""
    subprocess.run([sys.executable, "-m", "jawusd", *map(str, words)], check=True, stdout=subprocess.DEVNULL)


def solve(out: Path) -> Figure:
    """Draw the example's jaw as solved from the masks of one camera, with its expected errors."""
    with tempfile.TemporaryDirectory() as folder:
        shot, take = capture_of(Path(folder) / "shot", SOLVED_FRAMES, 1, masks=True), Path(folder) / "take.npz"
        run_jawusd("solve", out, shot, "-o", take)
        tracks = load_tracks(take)
    return jaw_figure(tracks, tracks.solved, FPS)


CHARTS = (keys, arkit, sparse_keys, library, poses, model, skin, subjects, head, solve)
