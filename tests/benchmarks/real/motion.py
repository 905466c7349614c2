"""Real jaw motion: speech and a clench of one person, chewing of another; models on them and on synthetic motion."""

from __future__ import annotations

import time
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from models import FOLDS, FREE, MODELS, components, errors_or_reason
from report import Origin, bars, curves, table, title
from sources import CHEWING, OPTOTRAK

from jawusd.fitting.checks import missing_movements, shown_parameters
from jawusd.fitting.data import SubjectAnatomy, TrainingData, select_poses
from jawusd.formats.markers import read_body, read_markers
from jawusd.geometry import (
    make_transform,
    rigid_fits,
    se3_inverse,
    se3_log,
    so3_exp,
    so3_log,
    transform_points,
)
from jawusd.pipeline.markers import marker_poses
from jawusd.synthetic.exercises import record
from jawusd.synthetic.person import Person

Array = np.ndarray

# Speech: the frame of the head has x up, y to the right and z to the front, its origin between the condyles and the
# incisal edges 37 mm below and 78 mm before it (go.m places the bite plate there); the condyles' and molars' places
# across are those of usual jaws.
T_ANATOMICAL_HEAD = np.array([[0.0, -1, 0, 0], [1, 0, 0, 37], [0, 0, 1, -78], [0, 0, 0, 1]])
SPEECH_LANDMARKS = np.array([[-37.0, 0, 78], [-37, -25, 45], [-37, 25, 45], [0, -50, 0], [0, 50, 0]])
HALF_WIDTH, FORWARD, DOWN = 50.0, 80.0, 40.0  # of usual jaws: condyles apart, incisors before and below them [mm]
USUAL = np.array([[0, -DOWN, FORWARD], [25, -DOWN, 45], [-25, -DOWN, 45], [HALF_WIDTH, 0, 0], [-HALF_WIDTH, 0, 0]])
SYNTHETIC_FRAMES, SYNTHETIC_SEED = 600, 1
OF_MARKERS = Origin(f"`{OPTOTRAK.repository}` plgrigid", OPTOTRAK.licence, "markers")
OF_MODELS = Origin(
    f"`{OPTOTRAK.repository}` (speech), `{CHEWING.repository}` (chewing), a synthetic person of jawusd",
    f"{OPTOTRAK.licence}; {CHEWING.licence}; ours",
    "models",
)


@dataclass(frozen=True)
class Take:
    """Hold the poses of a take as models see them, T_head_jaw as they were measured, and points on the jaw."""

    data: TrainingData
    T: Array
    points: Array


def speech(data: Path) -> tuple[Take, Take]:
    """Return the take of speech and the clench, measured at the four markers of the jaw."""
    folder = OPTOTRAK.found(data) / "plgrigid"
    plates = {name: str(folder / f"{name}.rig") for name in ("head", "jaw")}
    points = read_body(plates["jaw"]).points
    anatomy = SubjectAnatomy.of(T_ANATOMICAL_HEAD, SPEECH_LANDMARKS, points, None)
    spoken, clenched = (marker_poses(folder / f"{name}.asc", plates)[0] for name in ("dms1", "cln1"))
    taken = select_poses(np.arange(len(spoken)), spoken, anatomy).data
    return Take(taken, spoken, points), Take(taken, clenched, points)


def chewing(data: Path) -> Take:
    """Return the take of chewing, measured at its three markers; nothing but the motion tells how the head lies."""
    folder = CHEWING.found(data) / "XML_Processing"
    points = read_markers(folder / "Marker%d_Traj.txt").points
    T, _ = rigid_fits(points[0], points)
    anatomy = SubjectAnatomy.of(*anatomy_of_motion(T, points[0]), points[0], None)
    return Take(select_poses(np.arange(len(T)), T, anatomy).data, T, points[0])


def anatomy_of_motion(T: Array, markers: Array) -> tuple[Array, Array]:
    """Return T_anatomical_head and landmarks of a usual jaw placed by the motion alone.

    The jaw turns about the line across that moves least; the markers lie before it. Wide frames sink the markers.
    """
    turns = so3_log(T[:, :3, :3])
    left = np.linalg.svd(turns, full_matrices=False)[2][0]
    columns = np.concatenate([T[:, :3, :3], np.broadcast_to(-np.eye(3), T[:, :3, :3].shape)], axis=2).reshape(-1, 6)
    ridge = 1e-2 * len(T) * np.eye(6)  # holds the joint near the markers where the motion does not tell
    middle = markers.mean(axis=0)
    centred = -(T[:, :3, :3] @ middle + T[:, :3, 3] - middle).ravel()
    joint = middle + np.linalg.solve(columns.T @ columns + ridge, columns.T @ centred)[:3]
    front = middle - joint
    front -= left * (left @ front)
    front /= np.linalg.norm(front)
    # opening is the largest turn, and lowers what lies before the joint
    opening = turns[np.abs(turns @ left).argmax()] @ left
    left = left * np.sign(opening)
    R = np.stack([left, np.cross(front, left), front])
    tilt = so3_exp(np.array([-np.arctan2(DOWN, FORWARD), 0, 0]))
    place = transform_points(make_transform(tilt @ R, np.zeros(3)), (middle - joint)[None])[0]
    landmarks = USUAL * np.linalg.norm(place) / np.hypot(DOWN, FORWARD)
    landmarks = landmarks @ (tilt @ R) + joint
    return make_transform(tilt @ R, -(tilt @ R) @ landmarks[0]), landmarks


def synthetic() -> Take:
    """Return a take of a synthetic person with tracking noise."""
    person = Person(0)
    T = record(person, SYNTHETIC_FRAMES, SYNTHETIC_SEED).T_noisy
    anatomy = SubjectAnatomy.of(
        make_transform(np.eye(3), -person.landmarks[0]), person.landmarks, person.mandible_points, None
    )
    return Take(select_poses(np.arange(len(T)), T, anatomy).data, T, person.mandible_points)


def poses_against_the_maker(data: Path, out: Path) -> None:
    """Print noise in the clench, distance to the maker's poses, what speech lacks, and what PCA of markers leaves."""
    title("Markers to poses", OF_MARKERS)
    spoken, clenched = speech(data)
    maker = maker_poses(OPTOTRAK.found(data) / "plgrigid" / "rig1.asc")
    apart = se3_inverse(maker) @ spoken.T
    off = np.linalg.norm(transform_points(spoken.T, spoken.points) - transform_points(maker, spoken.points), axis=-1)
    still = transform_points(clenched.T, clenched.points)
    still = np.linalg.norm(still - still.mean(axis=0), axis=-1)
    twists = se3_log(clenched.T)
    turned = np.degrees(np.linalg.norm(twists[:, :3] - twists[:, :3].mean(axis=0), axis=1))
    angle = np.degrees(np.linalg.norm(so3_log(apart[:, :3, :3]), axis=1))
    table(
        ("quantity", "rms", "largest"),
        [
            ("noise of jaw markers in the clench [mm]", rms(still), f"{still.max():.3f}"),
            ("noise of the jaw's turn in the clench [degrees]", rms(turned), f"{turned.max():.3f}"),
            ("jaw markers from the maker's poses, speech [mm]", rms(off), f"{off.max():.4f}"),
            ("turn from the maker's, speech [degrees]", rms(angle), f"{angle.max():.4f}"),
        ],
        OF_MARKERS,
    )
    curves(out / "clench.png", {"jaw markers from their mean place": np.sqrt((still**2).mean(axis=1))}, "mm")
    lacking(spoken.data)
    incisor_path(data)


def rms(values: Array) -> str:
    """Return the root mean square of values, as it is printed."""
    return f"{np.sqrt((values**2).mean()):.4f}"


def maker_poses(path: Path) -> Array:
    """Return the maker's T_head_jaw (F, 4, 4): columns 8 to 10 are yaw, pitch and roll [degrees], 11 to 13 mm."""
    values = np.loadtxt(path)
    x, y, z = np.eye(3)
    yaw, pitch, roll = np.radians(values[:, 7:10]).T[..., None]
    return make_transform(so3_exp(yaw * z) @ so3_exp(pitch * y) @ so3_exp(roll * x), values[:, 10:13])


def lacking(data: TrainingData) -> None:
    """Print what of the envelope a take does not show."""
    shown, sentences = shown_parameters(data)
    u = data.displacement()
    low, high = np.percentile(u, [1, 99], axis=0)
    print(f"The incisal point moves by {high[1] - low[1]:.1f} mm down, {high[0] - low[0]:.1f} across, ", end="")
    print(f"{high[2] - low[2]:.1f} back and forth (1 to 99 % of the frames). Missing of the envelope:\n")
    for sentence in [*sentences, *missing_movements(np.stack([-u[:, 1], u[:, 0], u[:, 2]], axis=1), shown)]:
        print(f"- {sentence}")
    print()


def incisor_path(data: Path) -> None:
    """Print how the points of `JMA_position.txt`, beside the chewing take, move: not as points of a jaw do."""
    points = read_markers(CHEWING.found(data) / "XML_Processing" / "JMA_position.txt").points
    T, _ = rigid_fits(points[0], points)
    moved = np.linalg.norm(points - points[0], axis=-1).max()
    turned = np.degrees(np.linalg.norm(so3_log(T[:, :3, :3]), axis=1)).max()
    print(f"`{CHEWING.repository}` JMA_position.txt: {len(points)} frames of {points.shape[1]} points are read;")
    print(f"they move by {moved:.0f} mm and turn by {turned:.1f} degrees at most. No jaw opens so far without")
    print("turning: these are points carried along a path, no poses, and no model is fitted to them.\n")


def noise_floor(take: Take, clench: Take) -> None:
    """Print what a model of three parameters would leave if the motion were its own: the clench's noise beside it."""
    root = take.data.metric.twist_root()
    anatomical = T_ANATOMICAL_HEAD @ clench.T @ se3_inverse(T_ANATOMICAL_HEAD)
    still, moved = se3_log(anatomical) @ root, se3_log(take.data.motion) @ root
    axes = np.linalg.svd(moved - moved.mean(axis=0), full_matrices=False)[2]
    left = (still - still.mean(axis=0)) @ axes[3:].T
    floor = np.sqrt((left**2).sum(axis=1).mean())
    print(f"Noise of the clench in the three directions that PCA leaves out: {floor:.3f} mm.")
    placed = transform_points(take.T, take.points).reshape(len(take.T), -1)
    fold = np.arange(len(placed)) * FOLDS // len(placed)
    held_out = [(fold != k, fold == k) for k in range(FOLDS)]
    for name, parts in {"seen": [(fold >= 0, fold >= 0)], "unseen": held_out}.items():
        told = ", ".join(f"{pca_of_markers(placed, parts, count) / np.sqrt(len(take.points)):.3f}" for count in FREE)
        print(f"PCA of the marker coordinates themselves leaves {told} mm with 1, 2, 3 components, {name} frames.")
    print()


def pca_of_markers(placed: Array, parts: list[tuple[Array, Array]], count: int) -> float:
    """Return the rms length of what components leave of rows (N, 3 M), fitted to some rows and tried on others."""
    squares = 0.0
    for seen, tried in parts:
        mean, axes = components(placed[seen], count)
        off = placed[tried] - mean
        squares += float((off**2).sum() - ((off @ axes.T) ** 2).sum())
    return float(np.sqrt(squares / len(placed)))


def models(data: Path, out: Path) -> None:
    """Print the hold-out errors of every model with 1, 2, 3 parameters on speech, chewing and a synthetic person."""
    title("Models of jaw motion", OF_MODELS)
    spoken, clench = speech(data)
    noise_floor(spoken, clench)
    takes = {"speech": spoken, "chewing": chewing(data), "synthetic": synthetic()}
    print("rms at the measured points [mm] of contiguous fifths of the take that were left out, by parameters;")
    print("poses: from how many of the others, evenly spread, a model learns.\n")
    drawn: dict[str, dict[str, float]] = {}
    reasons: list[str] = []
    table(
        ("model", "poses", *(f"{name} {k}" for name in takes for k in FREE), "seconds"),
        (model_row(name, takes, drawn, reasons) for name in MODELS),
        OF_MODELS,
    )
    for reason in dict.fromkeys(reasons):
        print(f"- {reason}")
    bars(out / "models_speech.png", drawn, "rms of unseen speech [mm]")


def model_row(name: str, takes: dict[str, Take], drawn: dict[str, dict[str, float]], reasons: list[str]) -> list[str]:
    """Return a row of the table of models; adds to the plot of speech and to why models cannot be fitted."""
    most = MODELS[name].most
    begun, cells = time.process_time(), [name, "all" if most is None else str(most)]
    for take_name, take in takes.items():
        found = errors_or_reason(take.data, MODELS[name])
        if isinstance(found, str):
            reasons.append(f"{name}, {take_name}: {found}")
            cells += ["-"] * len(FREE)
            continue
        figures = np.sqrt((found**2).mean(axis=1))
        cells += [f"{figure:.3f}" for figure in figures]
        if take_name == "speech":
            drawn[name] = {f"{k} parameters": float(figure) for k, figure in zip(FREE, figures, strict=True)}
    return [*cells, f"{time.process_time() - begun:.0f}"]
