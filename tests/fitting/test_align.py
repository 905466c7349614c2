"""Face models aligned with rigs by noisy points of 20 synthetic heads, and points that are refused."""

import numpy as np
import pytest
from example_model import example_arrays, example_meta

import jawusd
from jawusd.base.errors import FittingError, FormatError
from jawusd.evaluator import JawRig
from jawusd.fitting.align import rig_points
from jawusd.formats.alignment import load_alignment, load_correspondences, save_alignment
from jawusd.geometry import LANDMARKS, make_transform, random_rotation, se3_inverse, so3_log, transform_points
from jawusd.synthetic.person import Person

SIGMA = {"incisor": 0.8, "molar_left": 1.2, "molar_right": 1.2, "chin": 2.0, "condyle_left": 2.0, "condyle_right": 2.0}
CHIN_MM = [0.0, -34.0, -2.0]  # from the lower incisal point
UNIT_MM = 1000.0


class Head:
    """A rig with the landmarks of a synthetic person, and a face model of the same person in other axes and metres."""

    def __init__(self, seed):
        rng = np.random.default_rng([seed, 0xA119])
        self.rig = JawRig({**example_arrays(), "landmarks": Person(seed).landmarks}, example_meta())
        self.T = make_transform(random_rotation(rng), rng.normal(0, 200, 3))
        self.chin = transform_points(self.rig.T_rest, self.rig.landmarks[:1])[0] + CHIN_MM
        self.rng = rng

    def marked(self, size=1.0, names=tuple(SIGMA), noise=1.0):
        """Return points of the model, marked with noise of `SIGMA`; `size` is the true length of its metre."""
        true = {**rig_points(self.rig), "chin": self.chin}
        back = se3_inverse(self.T)
        seen = {name: true[name] + noise * SIGMA[name] * self.rng.normal(size=3) for name in names}
        return {name: transform_points(back, p[None])[0] / (UNIT_MM * size) for name, p in seen.items()}

    def align(self, marked, **settings):
        return jawusd.align(self.rig, marked, {"chin": self.chin}, sigma_mm=SIGMA, unit_mm=UNIT_MM, **settings)

    def errors(self, found, size=1.0):
        """Return the displacement (5, 3) [mm] of the closed landmarks by the error of an alignment."""
        closed = transform_points(self.rig.T_rest, self.rig.landmarks)
        return found.to_skull(transform_points(se3_inverse(self.T), closed) / (UNIT_MM * size)) - closed


@pytest.fixture(scope="module")
def heads():
    return [Head(seed) for seed in range(20)]


@pytest.mark.parametrize("scale", [False, True])
def test_condyles_are_found_and_the_error_stated_is_true(heads, scale):
    """Ten markings of each head: condyles within 2 mm in the mean; squared error over variance is near 1."""
    size, errors, z2 = 0.93 if scale else 1.0, [], []
    for head in heads:
        for _ in range(10):
            found = head.align(head.marked(size), scale=scale)
            off = head.errors(found, size)
            stated = np.array([found.teeth_mm, found.condyles_mm])
            errors.append(np.linalg.norm(off, axis=1))
            z2.append(np.array([(off[:3] ** 2).sum(1).mean(), (off[3:] ** 2).sum(1).mean()]) / stated**2)
            assert (found.unit_mm == UNIT_MM) != scale and abs(found.unit_mm / (UNIT_MM * size) - 1) < 0.15
    teeth, condyles = np.mean(np.array(errors)[:, :3]), np.mean(np.array(errors)[:, 3:])
    assert teeth < 1.2 and condyles < (2.5 if scale else 2.0)
    assert (np.mean(z2, axis=0) > 0.7).all() and (np.mean(z2, axis=0) < 1.5).all()


def test_without_noise_the_alignment_is_exact(heads):
    found = heads[0].align(heads[0].marked(noise=0.0, size=0.9), scale=True)
    assert np.abs(heads[0].errors(found, 0.9)).max() < 1e-9 and found.unit_mm == pytest.approx(900)
    assert np.linalg.norm(so3_log(found.matrix[:3, :3].T @ heads[0].T[:3, :3])) < 1e-9


def test_one_point_marked_wrongly_moves_the_others_little(heads):
    """The chin is 25 mm off: it counts little, its distance shows it, and the stated error grows."""
    head, worse = heads[1], []
    for _ in range(20):
        marked = head.marked()
        good = head.align(marked)
        spoilt = head.align({**marked, "chin": np.add(marked["chin"], [0.0, 0.025, 0.0])})
        assert max(spoilt.off_mm, key=spoilt.off_mm.get) == "chin" and spoilt.off_mm["chin"] > 15
        assert spoilt.condyles_mm > good.condyles_mm
        worse.append(np.linalg.norm(head.errors(spoilt) - head.errors(good), axis=1)[:3].mean())
    assert np.mean(worse) < 2.0


def test_points_that_cannot_be_aligned_are_refused(heads):
    head = heads[2]
    marked = head.marked()

    def refused(words, points, points_rig=None, **settings):
        with pytest.raises(FittingError, match=words):
            jawusd.align(head.rig, points, points_rig, **{"sigma_mm": SIGMA, "unit_mm": UNIT_MM, **settings})

    two = {name: marked[name] for name in ("molar_left", "molar_right")}
    refused("2 points .* at least 3", two)
    refused('provides no point "chin"', marked)
    at = {"chin": head.chin}
    middle = np.mean(transform_points(head.rig.T_rest, head.rig.landmarks)[1:3], axis=0)
    line = {**two, "middle": 0.5 * (two["molar_left"] + two["molar_right"])}
    refused("on a line", line, {"middle": middle}, sigma_mm=1.0)
    refused("the median distance of the points", marked, at, unit_mm=100.0)
    swapped = {name: marked[name.replace("left", "RIGHT").replace("right", "left").lower()] for name in marked}
    refused("left and right exchanged", swapped, at)
    for wrong in ({"sigma_mm": 0.0}, {"unit_mm": -1.0}, {"sigma_mm": np.nan}):
        with pytest.raises(ValueError, match="above 0"):
            jawusd.align(head.rig, marked, at, **{"sigma_mm": SIGMA, "unit_mm": UNIT_MM, **wrong})


def test_files(heads, tmp_path):
    found = heads[3].align(heads[3].marked(), joint=[0.0, 0.01, 0.02])
    save_alignment(tmp_path / "T.json", found)
    assert load_alignment(tmp_path / "T.json") == found and set(found.off_mm) == set(SIGMA) > set(LANDMARKS)
    (tmp_path / "T.json").write_text(found.model_copy(update={"T_skull_model": ((2, 0, 0, 0),) * 4}).model_dump_json())
    with pytest.raises(FormatError, match="rigid"):
        load_alignment(tmp_path / "T.json")
    text = '{"format": "jawusd-correspondences/1", "unit_mm": 1000, "points": {"incisor": {"model": [0, 0, 0]}}}'
    (tmp_path / "points.json").write_text(text)
    with pytest.raises(FormatError, match="sigma_mm"):
        load_correspondences(tmp_path / "points.json")
