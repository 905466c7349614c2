"""Random persons: bites measured on the meshes, and masks compared with cv2's projection."""

from pathlib import Path

import cv2
import numpy as np
import pytest
import trimesh
from scipy.spatial import cKDTree
from subjects.annotator import FINER, MaskDrawer, draw_annotator
from subjects.bite import Bite, build_bite
from subjects.scanner import FORMATS, Scanner, encoded, scanned
from subjects.short_capture import ShortConfig, write_short_capture
from subjects.traits import draw_traits

from jawusd.cameras.calibration import load_calibration
from jawusd.formats.capture import load_capture
from jawusd.formats.mesh import tooth_labels
from jawusd.meshes.meshio import load_mesh

SEEDS = (0, 1, 3, 7, 8, 11, 16, 18, 20, 22)  # every kind of bite and gum, brackets, gaps of up to four teeth


@pytest.fixture(scope="module")
def bites() -> list[Bite]:
    return [build_bite(draw_traits(seed)) for seed in SEEDS]


@pytest.fixture(scope="module")
def capture(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("person")
    write_short_capture(folder, ShortConfig(3, frames=6, without_picks=0.0))
    return folder


def _solid(arch) -> trimesh.Trimesh:
    faces = arch.mesh.faces[(arch.tooth[arch.mesh.faces] != 0).all(1)]
    return trimesh.Trimesh(arch.mesh.vertices, faces, process=False)


def _winding_number(points: np.ndarray, mesh: trimesh.Trimesh) -> np.ndarray:
    """Return the winding number of a closed mesh at points, by solid angles (van Oosterom and Strackee 1983)."""
    a, b, c = np.moveaxis(mesh.triangles[None] - points[:, None, None], 2, 0)
    la, lb, lc = (np.linalg.norm(v, axis=-1) for v in (a, b, c))
    triple = np.einsum("pfi,pfi->pf", a, np.cross(b, c))
    dots = la * lb * lc + (a * b).sum(-1) * lc + (b * c).sum(-1) * la + (c * a).sum(-1) * lb
    return np.arctan2(triple, dots).sum(1) / (2 * np.pi)


def _edge(mesh: trimesh.Trimesh, up: float) -> np.ndarray:
    """Return the incisal edge at the midline from sections with planes."""
    ends = []
    for x in np.linspace(-4.0, 4.0, 17):
        section = mesh.section(plane_origin=[x, 0, 0], plane_normal=[1, 0, 0])
        if section is None:
            continue
        points = section.vertices
        points = points[points[:, 2] > points[:, 2].max() - 9.0]
        ends.append(points[(up * points[:, 1]).argmax()])
    return np.median(ends, axis=0)


@pytest.mark.slow
def test_bites_cover_the_human_range(bites: list[Bite]) -> None:
    edges = np.array([[_edge(_solid(b.upper), -1.0), _edge(_solid(b.lower), 1.0)] for b in bites])
    overbite, overjet = edges[:, 1, 1] - edges[:, 0, 1], edges[:, 0, 2] - edges[:, 1, 2]
    assert overbite.min() < -1.0 and overbite.max() > 5.0
    assert overjet.min() < -1.0 and overjet.max() > 7.0
    usual = [i for i, b in enumerate(bites) if abs(b.overbite_mm) < 4]  # both measure the same edges
    np.testing.assert_allclose(np.median(np.abs(overbite[usual] - [bites[i].overbite_mm for i in usual])), 0, atol=0.5)
    assert {draw_traits(seed).bite for seed in SEEDS} >= {"normal", "deep", "open", "large overjet", "crossbite"}
    kinds = {draw_traits(seed).bite for seed in range(80)}
    assert {"normal", "deep", "open", "underbite", "large overjet", "crossbite"} <= kinds


def test_the_population_varies_in_everything() -> None:
    persons = [draw_traits(seed) for seed in range(100)]
    assert {p.gums for p in persons} == {"dipping", "continuous", "crowns"}
    missing = [k for p in persons for a in (p.upper, p.lower) for k in np.argwhere(a.present == 0)[:, 1]]
    assert min(missing) <= 1 and max(missing) == 6  # incisors and second molars
    heights = [p.upper.height_scale.mean() for p in persons]
    assert min(heights) < 0.75 and max(heights) > 1.1
    assert any(p.upper.brackets for p in persons) and any((p.upper.overlap_mm < -0.5).any() for p in persons)


@pytest.mark.slow
def test_teeth_touch_in_occlusion_and_do_not_run_into_one_another(bites: list[Bite]) -> None:
    for seed, bite in zip(SEEDS, bites, strict=True):
        upper, lower = _solid(bite.upper), _solid(bite.lower)
        a, b = (trimesh.sample.sample_surface_even(mesh, 60_000, seed=0)[0] for mesh in (upper, lower))
        gap = cKDTree(a).query(b)[0].min()
        assert gap < 0.35, (seed, gap)
        deepest = 0.0
        for tooth in upper.split(only_watertight=True):  # closed crowns define their interior
            near = lower.vertices[((lower.vertices > tooth.bounds[0]) & (lower.vertices < tooth.bounds[1])).all(1)]
            if len(near):
                inside = near[_winding_number(near, tooth) > 0.5]
                surface = trimesh.sample.sample_surface_even(tooth, 4000, seed=0)[0]
                deepest = max(deepest, cKDTree(surface).query(inside)[0].max(initial=0.0))
        assert deepest < 0.15, (seed, deepest)


def test_masks_show_the_scans_at_the_true_poses(capture: Path) -> None:
    described = load_capture(capture)
    cameras = load_calibration(described.calibration)
    with np.load(capture / "truth" / "truth.npz", allow_pickle=False) as truth:
        frame, shares = 2, []
        for c, camera in enumerate(cameras):
            for jaw in ("upper", "lower"):
                own = int(truth["frames"][frame] - truth["offsets"][c])
                mask = cv2.imread(str(capture / "masks" / camera.name / jaw / f"{own:06d}.png"), 0)
                assert mask.shape == camera.size_px[::-1] and set(np.unique(mask)) == {0, 255}
                mesh = load_mesh(getattr(described.scans, f"{jaw}_teeth"))
                T = truth[f"T_world_{jaw}"][frame]
                points = mesh.vertices[tooth_labels(mesh) > 0] @ T[:3, :3].T + T[:3, 3]
                R, t = truth["R"][c], truth["t"][c]
                pixels = cv2.projectPoints(points, cv2.Rodrigues(R)[0], t, truth["K"][c], truth["dist"][c])[0][:, 0]
                drawn = np.zeros_like(mask)
                at = np.clip(np.rint(pixels).astype(int), 0, np.array(camera.size_px) - 1)
                drawn[at[:, 1], at[:, 0]] = 1
                around = cv2.dilate(drawn, np.ones((9, 9), np.uint8))
                shares.append((mask > 0)[around == 0].sum() / (mask > 0).sum())
    assert np.median(shares) < 0.02, shares


def test_picks_hit_their_vertices(capture: Path) -> None:
    described = load_capture(capture)
    cameras = {camera.name: camera for camera in load_calibration(described.calibration)}
    with np.load(capture / "truth" / "truth.npz", allow_pickle=False) as truth:
        poses = {jaw: truth[f"T_world_{jaw}"][0] for jaw in ("upper", "lower")}
    misses = []
    for jaw, picks in (("upper", described.bootstrap.upper), ("lower", described.bootstrap.lower)):
        assert len(picks) >= 3
        vertices = load_mesh(getattr(described.scans, f"{jaw}_teeth")).vertices
        for pick in picks:
            point = vertices[pick.vertex] @ poses[jaw][:3, :3].T + poses[jaw][:3, 3]
            misses += [cameras[view.camera].project(point) - [view.x, view.y] for view in pick.views]
    assert np.abs(misses).max() < 8.0 and 0.5 < np.std(misses) < 3.0


def test_same_seed_same_capture(tmp_path: Path, capture: Path) -> None:
    write_short_capture(tmp_path, ShortConfig(3, frames=6, without_picks=0.0))
    files = sorted(p.relative_to(capture) for p in capture.rglob("*") if p.is_file() and p.suffix != ".npz")
    assert len(files) > 20
    for file in files:
        assert (tmp_path / file).read_bytes() == (capture / file).read_bytes(), file


@pytest.mark.slow
@pytest.mark.parametrize("format_", FORMATS)
def test_every_format_reads_back(format_: str, bites: list[Bite], tmp_path: Path) -> None:
    paint = "none" if format_.startswith("stl") else "painted"
    scanner = Scanner(format_, paint, 8_000, 0.01, True)
    mesh = scanned(bites[0].upper.mesh, scanner, np.random.default_rng(0))
    path = tmp_path / f"scan{scanner.suffix}"
    path.write_bytes(encoded(mesh, scanner))
    back = load_mesh(path)
    np.testing.assert_allclose(back.vertices, mesh.vertices, atol=1e-4)
    assert 5_000 < len(back.faces) < 12_000
    if paint == "painted":
        share = (tooth_labels(back) > 0).mean()
        assert 0.1 < share < 0.95


def test_continuous_scans_are_one_surface() -> None:
    seed = next(s for s in range(50) if draw_traits(s).gums == "continuous")
    arch = build_bite(draw_traits(seed)).upper
    mesh = scanned(arch.mesh, Scanner("ply", "painted", 60_000, 0.0, False), np.random.default_rng(0))
    crown = tooth_labels(mesh) > 0
    on_line = np.zeros(len(mesh.vertices), bool)
    mixed = mesh.faces[(crown[mesh.faces].sum(1) % 3) != 0]
    on_line[mixed] = True
    assert on_line.sum() > 14 * 30  # crown and gum share the vertices of the cervical line


@pytest.mark.parametrize(("gum_mm", "edge_px"), [(-0.12, 0.0), (0.1, 0.8), (0.0, 0.35), (0.0, -0.35)])
def test_annotators_draw_gum_and_edges_where_they_see_them(gum_mm: float, edge_px: float) -> None:
    from dataclasses import replace

    who = replace(
        draw_annotator(0, 1), gum_mm=np.array([gum_mm, gum_mm]), gum_tooth_mm=np.zeros((2, 14)), edge_px=edge_px,
        camera_px=np.zeros(1), wobble_px=0.0, papilla=0.0, sliver_px=2.0, missing=0.0, gross=0.0,
    )  # fmt: skip
    first, last = [], []
    for part in range(FINER):  # subpixel shifts: averaged over all edge positions, a third of a pixel has an effect too
        tooth = np.zeros((FINER * 300, FINER * 400), np.uint8)
        tooth[FINER * 100 + part : FINER * 200 + part, FINER * 100 : FINER * 300] = 1
        gum = np.zeros(tooth.shape, bool)
        gum[FINER * 60 : FINER * 100 + part, FINER * 100 : FINER * 300] = True
        hand = MaskDrawer(who, 0, 0, (1920, 1080), np.random.default_rng(0))
        column = np.flatnonzero(hand.draw(tooth, gum, (0, 0), FINER * 10.0)[:300, 200])
        first.append(column[0])
        last.append(column[-1])
    middle = (FINER - 1) / (2 * FINER)  # centre of the subpixels
    assert np.mean(first) == pytest.approx(100 + middle - 10 * gum_mm, abs=0.35)
    assert np.mean(last) == pytest.approx(199 + middle + edge_px, abs=0.35)
    if gum_mm == 0.0:
        assert np.sign(np.mean(last) - 199 - middle) == np.sign(edge_px)
