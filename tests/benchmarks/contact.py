"""Do teeth pass through teeth? python tests/benchmarks/contact.py [CAPTURE ...] [--persons 10] [--poses 2000]

CAPTURE is a folder with truth/truth.npz; the persons are synthetic, half of them of `synthetic.anatomy` (with bones),
half of `tests/support/subjects` (any bite, scanned). Each rig is fitted to the true motion with tracking noise.

The oracle shares nothing with the rig's clearances: random points of one surface, their nearest points among random
points of the other's outside (k-d tree), inside by winding numbers of all triangles (Barill et al. 2018, as libigl has
them: `pip install -c constraints.txt libigl`).
What is said of depth is beyond the depth of the closed bite by the same oracle [mm].

    bake        seconds of processor time to measure contact; error: of the clearances, as the rig states it
    grows       bytes that the layer with the tables grows by [MB]
    valid       random poses inside the bound: share deeper than 0.2 mm, and the deepest; near: the same of poses with
                less than 3 mm of opening, and before: of the bound without contact
    gap         at d1 = 0, over d2 and d3: median and 95th percentile of what the teeth are apart
    captured    share of captured poses inside the bound or within the rig's tolerance of it, and of those judged valid
    through     poses driven 1 mm and more through the closed teeth (less where scans overlap so far in the closed bite
                that the oracle cannot tell): share refused
"""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import igl
import numpy as np
from scipy.ndimage import binary_dilation
from scipy.spatial import cKDTree

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "support"))
from subjects.short_capture import ShortConfig, draw_capture

from jawusd.evaluator import JawRig
from jawusd.formats.capture import load_capture
from jawusd.formats.mesh import Mesh
from jawusd.geometry import se3_exp, se3_inverse, transform_points
from jawusd.pipeline.contact import condyle_solids, tooth_solids, with_condyle_contact, with_tooth_contact
from jawusd.pipeline.fit import fit_subject
from jawusd.pipeline.subject import Subject, _measured, load_meshes, subject_of_capture
from jawusd.rig.bake import decoder_layer
from jawusd.rig.table import DecoderTable, sample_valid
from jawusd.synthetic.anatomy import build_anatomy, opened_bite
from jawusd.synthetic.exercises import record
from jawusd.synthetic.person import Person

FRAMES = 600
NOISE = np.array([0.0004] * 3 + [0.04] * 3)  # of a tracked pose [rad, mm]
APART_MM = 0.12  # random points of a surface
REACH_MM = 7.0  # points farther from the other jaw in the closed bite are left out
NEAR_MM = 1.8
DEEP_MM = 0.2
THROUGH_MM = 1.0
AT_ONCE = 16  # points whose winding numbers are asked for, the deepest first


class Surface:
    """Random points of the outside of a scan, and who is inside it."""

    def __init__(self, mesh: Mesh, other: Mesh, rng: np.random.Generator) -> None:
        """Take the parts of a scan that lie near the other one in the closed bite."""
        self.solid = igl.FastWindingNumberBVH()
        self.solid.init(mesh.vertices.astype(float), mesh.faces.astype(np.int64))
        corners = mesh.vertices[mesh.faces]
        normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        area = 0.5 * np.linalg.norm(normals, axis=1)
        near = cKDTree(other.vertices).query(corners.mean(axis=1), distance_upper_bound=REACH_MM)[0] < np.inf
        chosen = np.flatnonzero(near & (area > 0))
        count = rng.poisson(area[chosen] / APART_MM**2)
        face = np.repeat(chosen, count)
        u, v = np.sqrt(rng.random(len(face))), rng.random(len(face))
        weights = np.stack([1.0 - u, u * (1.0 - v), u * v], axis=1)
        points = np.einsum("pk,pkc->pc", weights, corners[face])
        outward = normals[face] / (2.0 * area[face, None])
        centres = corners[chosen].mean(axis=1) + 0.01 * normals[chosen] / (2.0 * area[chosen, None])
        free = np.zeros(len(mesh.faces), dtype=bool)
        free[chosen] = self.solid.winding_number(centres) < 0.6
        self.points, self.normals = points[free[face]], outward[free[face]]
        self.tree = cKDTree(self.points)
        # cells of a millimetre with a point within NEAR_MM
        self.low = np.floor(self.points.min(axis=0)) - 4.0
        cells = np.floor(self.points - self.low).astype(int)
        self.near = np.zeros(cells.max(axis=0) + 5, dtype=bool)
        self.near[tuple(cells.T)] = True
        self.near = binary_dilation(self.near, np.ones((3, 3, 3)), iterations=int(np.ceil(NEAR_MM)))
        self.moving = self.points[rng.random(len(self.points)) < 0.08]

    def depth(self, points: np.ndarray, floor: float) -> float:
        """Return how deep the deepest of points (n, 3) lies [mm]; `floor` if none is deeper."""
        cells = np.floor(points - self.low).astype(int)
        near = ((cells >= 0) & (cells < self.near.shape)).all(axis=1)
        near[near] = self.near[tuple(cells[near].T)]
        points = points[near]
        if not len(points):
            return floor
        away, nearest = self.tree.query(points, distance_upper_bound=NEAR_MM)
        rows = np.flatnonzero((away < np.inf) & (away > floor))
        # behind all of the nearest points; before a sharp edge it is behind one of them only
        _, nearest = self.tree.query(points[rows], k=4)
        before = points[rows, None] - self.points[nearest]
        rows = rows[(np.einsum("nkc,nkc->nk", before, self.normals[nearest]) < 0).all(axis=1)]
        rows = rows[np.argsort(-away[rows])]
        for some in np.split(rows, range(AT_ONCE, len(rows), AT_ONCE)) if len(rows) else ():
            inside = self.solid.winding_number(points[some]) > 0.5
            if inside.any():
                return float(away[some[np.argmax(inside)]])
        return floor


class Oracle:
    """The depth of two scans in each other."""

    def __init__(self, upper: Mesh, lower: Mesh, T_rest: np.ndarray) -> None:
        """Measure the closed bite."""
        rng = np.random.default_rng(5)
        placed = Mesh(transform_points(T_rest, lower.vertices), lower.faces)
        self.upper, self.lower, self.T_rest = Surface(upper, placed, rng), Surface(placed, upper, rng), T_rest
        self.closed = 0.0
        self.closed = self.beyond(T_rest[None])[0]

    def beyond(self, T: np.ndarray, floor: float = 0.0) -> np.ndarray:
        """Return the depths [mm] of poses T_skull_mandible (n, 4, 4) beyond the closed bite; at least `floor`."""
        least, found = self.closed + floor, []
        for moved in T @ se3_inverse(self.T_rest):
            deep = self.upper.depth(transform_points(moved, self.lower.moving), least)
            found.append(self.lower.depth(transform_points(se3_inverse(moved), self.upper.moving), deep))
        return np.array(found) - self.closed

    def gap(self, T: np.ndarray) -> np.ndarray:
        """Return the distances of the surfaces [mm], shape (n,), 0 where they meet."""
        moved = (transform_points(M, self.lower.moving) for M in T @ se3_inverse(self.T_rest))
        apart = np.array([self.upper.tree.query(points)[0].min() for points in moved])
        return np.where(self.beyond(T, -self.closed) > -self.closed, 0.0, apart)


@dataclass(frozen=True)
class Case:
    """A person and the motion that was captured of them."""

    name: str
    subject: Subject
    poses: np.ndarray


def cases(options: argparse.Namespace) -> Iterator[Case]:
    """Return the persons."""
    for folder in options.captures:
        capture = load_capture(folder)
        truth = np.load(folder / "truth" / "truth.npz")["T_upper_lower"]
        yield Case(capture.name, subject_of_capture(capture, load_meshes(capture)), truth)
    for seed in range(options.persons // 2):
        person = Person(seed)
        anatomy = build_anatomy(person)
        controls, none = record(person, FRAMES, seed).controls, np.zeros((FRAMES, 3))
        poses = person.pose_with_extra(opened_bite(person, anatomy.occlusion, controls, none), none)
        meshes = {"upper_teeth": anatomy.upper.mesh, "lower_teeth": anatomy.lower.mesh, "mandible": anatomy.mandible}
        yield Case(f"person {seed}", Subject(f"person {seed}", np.eye(4), person.landmarks, meshes), poses)
    for seed in range(options.persons - options.persons // 2):
        drawn = draw_capture(ShortConfig(seed, FRAMES))
        scans = {"upper_teeth": drawn.scans[0], "lower_teeth": drawn.scans[1]}
        T = drawn.T_scan_bite
        poses = np.array([T @ drawn.motion.jaw(float(t)) @ se3_inverse(T) for t in range(FRAMES)])
        name = f"anybody {seed}, {drawn.traits.bite}"
        yield Case(name, _measured(name, scans, None, None, {}), poses)


def measure(case: Case, count: int) -> str:
    """Return a row of the table."""
    rng = np.random.default_rng(3)
    noisy = se3_exp(rng.normal(size=(len(case.poses), 6)) * NOISE) @ case.poses
    frames = np.arange(len(noisy))
    plain = fit_subject(Subject(**{**vars(case.subject), "meshes": {}}), (frames, noisy))
    print(f"  fitted after {time.process_time():.0f} s", file=sys.stderr)
    start = time.process_time()
    axes, landmarks, rest = (plain.arrays[name] for name in ("T_anatomical_skull", "landmarks", "T_rest"))
    model = with_tooth_contact(plain, tooth_solids(case.subject.meshes, axes, rest))
    model = with_condyle_contact(model, condyle_solids(case.subject.meshes, axes, landmarks, rest))
    bake_s = time.process_time() - start
    rig, old = JawRig(model.arrays, model.meta), JawRig(plain.arrays, plain.meta)
    if rig.contact is None:
        return f"{case.name:<28} {model.meta['contact']}"
    oracle = Oracle(case.subject.meshes["upper_teeth"], case.subject.meshes["lower_teeth"], rig.T_rest)
    print(f"  oracle ready after {time.process_time():.0f} s", file=sys.stderr)
    inside = oracle.beyond(rig.pose(sample_valid(rig, count, 1)))
    near = oracle.beyond(rig.pose(low_openings(rig, count, rng)))
    closed = low_openings(rig, 300, rng)
    closed[:, 0] = 0.0
    gap = oracle.gap(rig.pose(closed[rig.margin(closed) >= 0]))
    captured = rig.validate(noisy)
    kept = (captured.margin_mm >= rig.limits.margin_mm).mean()
    through = low_openings(rig, 600, rng) - [3.0, 0.0, 0.0] * rng.uniform(0.3, 1.0, (600, 1))
    T = rig.pose(through)
    deep = min(THROUGH_MM, NEAR_MM - oracle.closed - 0.1)
    T = T[oracle.beyond(T, deep - 0.1) > deep]
    refused = (~rig.validate(T).valid).mean() if len(T) else np.nan
    before = oracle.beyond(old.pose(low_openings(old, count // 4, rng)))
    grows = (layer_size(rig) - layer_size(old)) / 2**20
    return (
        f"{case.name:<28}{oracle.closed:6.2f}{bake_s:7.1f}{rig.contact.error_mm:7.3f}{grows:7.2f}"
        f"{(inside > DEEP_MM).mean():9.2%}{inside.max():6.2f}{(near > DEEP_MM).mean():9.2%}{near.max():6.2f}"
        f"{(before > DEEP_MM).mean():9.2%}{np.median(gap):7.2f}{np.quantile(gap, 0.95):6.2f}"
        f"{kept:9.2%}{captured.valid.mean():9.2%}{refused:9.2%} of {len(T)}"
    )


def low_openings(rig: JawRig, count: int, rng: np.random.Generator) -> np.ndarray:
    """Return parameters (count, 3) inside the bound with less than 3 mm of opening."""
    low, high = rig.d_range.T
    d = rng.uniform(low, [low[0] + 3.0, *high[1:]], (400 * count, 3))
    return d[rig.margin(d) >= 0][:count]


def layer_size(rig: JawRig) -> int:
    """Return the bytes of the layer with the rig's tables, but for the sampled decoder."""
    axes = (np.array([0.0, 1.0]),) * 3
    layer = decoder_layer(rig, DecoderTable("grid", axes, np.zeros((2, 2, 2, 6), np.float32)))
    path = Path(f"/tmp/jawusd_contact_{time.time_ns()}.usdc")
    layer.Export(str(path))
    size = path.stat().st_size
    path.unlink()
    return size


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("captures", nargs="*", type=Path)
    parser.add_argument("--persons", type=int, default=10)
    parser.add_argument("--poses", type=int, default=2000)
    options = parser.parse_args()
    print(
        f"{'':<28}{'closed':>6}{'bake s':>7}{'error':>7}{'grows':>7}{'valid':>9}{'worst':>6}{'near':>9}{'worst':>6}"
        f"{'before':>9}{'gap':>7}{'95 %':>6}{'captured':>9}{'valid':>9}{'through':>9}"
    )
    for case in cases(options):
        print(measure(case, options.poses), flush=True)


if __name__ == "__main__":
    main()
