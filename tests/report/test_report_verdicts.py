"""Verdicts: a good build is good, and each planted fault is found at its stage."""

from dataclasses import replace

import numpy as np
import pytest
from example_model import held_out_arrays
from report_data import experiments, report_data

from jawusd.fitting.checks import bound_not_reached, missing_movements
from jawusd.formats.finding import Finding
from jawusd.formats.report import RigFacts, verdict_sentence
from jawusd.paper.figures import coverage_figure
from jawusd.report.figures import human_ranges, tracking_figure
from jawusd.report.verdicts import BAD, GOOD, LOOK, judge, summary


def grades(data):
    return {verdict.stage: verdict.grade for verdict in judge(data)}


def test_a_good_build_is_good():
    verdicts = judge(report_data())
    assert [verdict.stage for verdict in verdicts] == ["sync", "track", "fit", "bounds", "rig"]
    assert summary(verdicts)["grade"] == GOOD, [c for v in verdicts for c in v.checks if c.grade != GOOD]


def test_bounds_state_how_many_held_out_frames_the_tolerance_covers():
    data = report_data()
    data.model.arrays.update(held_out_arrays())
    bounds = next(verdict for verdict in judge(data) if verdict.stage == "bounds")
    assert "76 % of held-out frames" in " ".join(check.found for check in bounds.checks) and bounds.grade == GOOD


def late_camera(data):
    data.tracks.meta["delays_frames"]["cam1"] = -1.4
    return data


def uncovered(data):
    data.tracks.coverage_error[:] = 0.03
    return data


def blurred(data):
    data.tracks.residual_px[:] = 3.0
    return data


def unsure(data):
    data.tracks.sigma_mm[:, 4] = 2.0
    return data


def misfit(data):
    data.model.meta["errors"]["holdout"]["mandible"] = {"mean": 2.0, "max": 4.0}
    return data


def swapped(data):
    data.model.meta["warnings"] = [{"code": "swapped_jaws", "message": "Exchanged."}]
    return data


def beyond(data):
    data.model.d[:30, 1] = 30.0
    return data


def broken(data):
    return replace(data, rig=RigFacts(0.02, ("error: no mandible",)))


def coarse(data):
    return replace(data, rig=RigFacts(0.7, ()))


@pytest.mark.parametrize(
    ("fault", "stage"),
    [
        (late_camera, "sync"),
        (lambda data: report_data(lost=range(20)), "track"),
        (uncovered, "track"),
        (blurred, "track"),
        (unsure, "track"),
        (misfit, "fit"),
        (swapped, "fit"),
        (beyond, "bounds"),
        (broken, "rig"),
        (coarse, "rig"),
    ],
)
def test_each_fault_is_found_where_it_is(fault, stage):
    found = grades(fault(report_data()))
    assert found.pop(stage) == BAD and BAD not in found.values()


@pytest.mark.parametrize(
    "fault", [late_camera, uncovered, blurred, unsure, misfit, swapped, beyond, broken, coarse]
)  # fmt: skip
def test_every_fault_says_what_to_do(fault):
    verdicts = judge(fault(report_data()))
    assert all(check.todo for verdict in verdicts for check in verdict.checks if check.grade in (BAD, LOOK))
    sentence = verdict_sentence(summary(verdicts))
    assert sentence == f"Not usable. {summary(verdicts)['todo'][0]}" and sentence.endswith(".")


def test_the_sentence_of_a_build_names_what_to_record():
    said = ("There is no protrusion: record a protrusion.", "A gap: record slow circling between 4 and 31 mm.")
    found = summary(judge(report_data(experiments=experiments(sentences=said))))
    todo = "Re-record: a protrusion; slow circling between 4 and 31 mm."
    assert found["todo"] == [todo] and verdict_sentence(found) == f"Usable for animation. {todo}"
    assert verdict_sentence(summary(judge(report_data()))) == "Usable for animation."
    assert verdict_sentence({"grade": "look", "because": []}) == "Usable for animation."  # of an earlier build


def test_every_sentence_on_a_take_ends_in_a_movement_to_record():
    d = np.stack([np.linspace(0, 28, 60), np.linspace(-1, 1, 60), np.zeros(60)], axis=1)
    said = missing_movements(d, np.ones(3, dtype=bool))
    said += missing_movements(d[d[:, 0] < 5], np.ones(3, dtype=bool))
    said += missing_movements(np.array([[0.0, 9, 9], [40, 0, 0], [20, 9, 0], [20, -9, 9]]), np.ones(3, dtype=bool))
    said += missing_movements(np.array([[0.0, 9, 9], [40, 0, 0]]), np.ones(3, dtype=bool))
    said += bound_not_reached((d[:, :2], d[:, ::2]), (0.5, 0.5))
    assert len({tuple(one.split()[:2]) for one in said}) >= 6
    assert [one for one in said if ": record " not in one] == []


def test_a_warning_is_called_a_warning_once():
    data = report_data()
    data.tracks.meta["findings"] = [Finding("odd", "warning", "used twice.", camera="left").as_json()]
    assert summary(judge(data))["because"] == ["track: warning camera left: used twice."]


def test_a_camera_that_is_not_used_asks_for_a_look():
    data = report_data()
    found = Finding("camera_not_used", "warning", "used in 0 of 60 frames.", camera="left")
    data.tracks.meta["findings"] = [found.as_json()]
    assert grades(data)["track"] == LOOK
    track = next(verdict for verdict in judge(data) if verdict.stage == "track")
    assert track.checks[-1].found == "left: used in 0 of 60 frames."


@pytest.mark.parametrize(
    ("kind", "severity", "grade"),
    [
        ("scan_misfit", "warning", BAD),
        ("scans_mirrored", "warning", BAD),
        ("frame_dropped", "warning", LOOK),
        ("registration_unknown", "note", GOOD),
    ],
)
def test_what_tracking_warns_of_counts(kind, severity, grade):
    data = report_data()
    data.tracks.meta["findings"] = [Finding(kind, severity, "something is wrong.").as_json()]
    assert grades(data)["track"] == grade
    track = next(verdict for verdict in judge(data) if verdict.stage == "track")
    assert ("something is wrong." in track.checks[-1].found) == (grade != GOOD)


@pytest.mark.parametrize("code", ["take_lacks", "not_shown"])
def test_missing_movements_and_unproven_times_ask_for_a_look(code):
    data = report_data(sync={"offsets": {}, "method": "taken as simultaneous"}, experiments=None)
    data.model.meta["warnings"] = [{"code": code, "message": "Record protrusion."}]
    assert grades(data) == {"sync": LOOK, "track": GOOD, "fit": GOOD, "bounds": LOOK, "rig": GOOD}
    bounds = next(verdict for verdict in judge(data) if verdict.stage == "bounds")
    assert [c.found for c in bounds.checks if c.name == "captured movements"] == ["Record protrusion."]


@pytest.mark.parametrize(("sentences", "grade"), [((), GOOD), (("Record slow circling.",), LOOK)])
def test_the_verdict_on_coverage_says_what_its_plot_says(sentences, grade):
    data = report_data(experiments=experiments(sentences=sentences))
    bounds = next(verdict for verdict in judge(data) if verdict.stage == "bounds")
    said = coverage_figure(data.experiments.coverage, data.actor).get_suptitle()
    assert bounds.grade == grade
    assert all(s in said and s in [check.found for check in bounds.checks] for s in sentences)
    assert ("No exercise is missing" in said) == (grade == GOOD) == ("covers the envelope" in bounds.sentence)


@pytest.mark.parametrize(
    ("code", "name"), [("few_poses", "poses of the take"), ("rotation_range", "human range")]
)  # fmt: skip
def test_warnings_of_the_fit_are_named_for_what_they_are(code, name):
    data = report_data()
    data.model.meta["warnings"] = [{"code": code, "message": "Odd."}]
    fit = next(verdict for verdict in judge(data) if verdict.stage == "fit")
    assert fit.grade == LOOK and [check.name for check in fit.checks if check.found == "Odd."] == [name]


def test_ranges_are_those_of_the_motion():
    data = report_data()
    A, rest = data.model.arrays["T_anatomical_skull"], data.model.arrays["T_rest"]
    shifts = np.zeros((60, 3))
    shifts[:30, 1] = np.linspace(0, -45, 30)
    shifts[30:45, 0], shifts[45:, 0] = 9.0, -3.0
    motion = np.tile(np.eye(4), (60, 1, 1))
    motion[:, :3, 3] = shifts
    data.tracks.raw_T_upper_lower[:] = np.linalg.inv(A) @ motion @ A @ rest
    rows = {row.name: row for row in human_ranges(data.tracks, data.model)}
    opening, left, right = (rows[n] for n in rows if n.startswith(("opening", "laterotrusion")))
    assert float(opening.found.split()[0]) == pytest.approx(45, abs=0.7) and opening.grade == GOOD
    assert left.found == "9.0 mm" and left.grade == GOOD
    assert right.found == "3.0 mm" and right.grade == LOOK and "less" in right.remark
    assert rows["rotation"].found == "0.0 deg"
    assert rows["travel of the left condyle"].grade == LOOK and "more" in rows["travel of the left condyle"].remark


def test_a_long_take_keeps_its_worst_frame_in_the_drawing():
    data = report_data(count=5000)
    data.tracks.residual_px[3333, 1] = 7.0
    lines = tracking_figure(data.tracks).axes[1].lines
    assert max(line.get_ydata().max() for line in lines) == 7.0
    assert all(len(line.get_xdata()) <= 1250 for line in lines)
