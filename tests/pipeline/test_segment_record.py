"""The record of a segmentation: finished frames, confidences, and masks to inspect."""

import json

import numpy as np
import pytest
from package_copy import ROOT

from jawusd.base.errors import FormatError
from jawusd.cli.text_capture import segment_lines
from jawusd.formats.capture import load_capture
from jawusd.formats.tracks import LOST, TRACKED
from jawusd.pipeline.segment_record import LEARNED, RECORD, SUMMARY, Journal, delete_masks, summarise, write_summary

POSES = np.stack([np.eye(4)] * 2).tolist()


def entries(count=40):
    """Return the records of a good take with two cameras."""
    rng = np.random.default_rng(0)
    out = {}
    for frame in range(count):
        cameras = {
            name: {
                "frame": frame + 2,
                "contrast": (0.8 + 0.02 * rng.normal(size=2)).tolist(),
                "unexpected": (0.02 + 0.005 * rng.normal(size=2)).tolist(),
                "residual_px": (0.7 + 0.03 * rng.normal(size=2)).tolist(),
                "uncovered": (0.01 + 0.002 * rng.normal(size=2)).tolist(),
                "outline": [[900 + int(20 * rng.normal()), 60, 100] for _ in range(2)],
                "pixels": [20000, 18000],
            }
            for name in ("cam0", "cam1")
        }
        out[frame] = {"poses": POSES, "status": [TRACKED, TRACKED], "cameras": cameras}
    return out


def test_a_record_is_taken_up_again_only_from_the_same_inputs(tmp_path):
    journal = Journal(tmp_path, "a", resume=False)
    journal.add(7, {"poses": POSES, "x": float("nan")})
    journal.add(8, {"poses": POSES, "status": [1, 3]})
    again = Journal(tmp_path, "a", resume=True)
    assert sorted(again.entries) == [7, 8]
    assert again.entries[7]["x"] is None
    poses, status = again.known(8)
    assert np.array_equal(poses, np.stack([np.eye(4)] * 2))
    assert status.tolist() == [1, 3]
    assert Journal(tmp_path, "b", resume=True).entries == {}


def test_a_record_without_resume_starts_anew(tmp_path):
    Journal(tmp_path, "a", resume=False).add(7, {"poses": POSES})
    assert Journal(tmp_path, "a", resume=False).entries == {}


def test_a_line_cut_short_is_forgotten(tmp_path):
    journal = Journal(tmp_path, "a", resume=False)
    journal.add(7, {"poses": POSES})
    journal.add(8, {"poses": POSES})
    path = tmp_path / RECORD
    path.write_text(path.read_text()[:-20])
    assert sorted(Journal(tmp_path, "a", resume=True).entries) == [7]
    assert all(json.loads(line) for line in path.read_text().splitlines())


def test_nothing_is_to_be_looked_at_in_an_even_take():
    assert min(row["confidence"] for row in summarise(entries())) > 0.5


@pytest.mark.parametrize(
    ("symptom", "value"),
    [
        ("contrast", 0.3),
        ("unexpected", 0.3),
        ("residual_px", 1.6),
        ("uncovered", 0.2),
        ("outline", [400, 560, 100]),  # most of it is not visible
    ],
)
def test_every_symptom_of_a_bad_mask_counts(symptom, value):
    take = entries()
    take[11]["cameras"]["cam1"][symptom][1] = value
    rows = summarise(take)
    worst = min(rows, key=lambda row: row["confidence"])
    assert (worst["frame"], worst["camera"], worst["own_frame"], worst["row"]) == (11, "cam1", 13, "lower")
    assert worst["reason"] == symptom
    assert worst["confidence"] < 0.5
    summary = {"look_at": [worst], "sheet": "sheet.png", "frames": 40, "masks": {"cam0": {}, "cam1": {}}}
    assert any("cam1 frame    13" in line for line in segment_lines(summary))


def test_lost_rows_have_no_confidence():
    take = entries()
    take[5]["status"] = [TRACKED, LOST]
    take[5]["cameras"]["cam0"]["residual_px"] = [0.7, None]
    rows = {(row["frame"], row["camera"]): row for row in summarise(take)}
    assert rows[5, "cam0"]["confidence"] == 0
    assert rows[5, "cam0"]["reason"] == "lost"


def test_masks_of_an_earlier_build_are_deleted_and_nothing_else(tmp_path):
    folder, outside = tmp_path / "masks", tmp_path / "outside" / "upper"
    outside.mkdir(parents=True)
    (outside / "000001.png").touch()
    made = [folder / camera / row / "000012.png" for camera in ("cam0", "cam1") for row in ("upper", "lower")]
    for path in (*made, folder / "look_at_these.png", folder / "segment.json"):
        path.parent.mkdir(parents=True, exist_ok=True)
        path.touch()
    (folder / "cam2").symlink_to(outside.parent)
    mine = folder / "cam1" / "lower" / "notes.png"
    mine.touch()
    delete_masks(folder)
    assert all(path.exists() for path in made)  # no record: the masks may be hand-drawn
    Journal(folder, "a", resume=False).add(7, {"poses": POSES})
    delete_masks(folder)
    assert sorted(path.name for path in folder.rglob("*")) == ["cam1", "cam2", "lower", "notes.png"]
    assert (outside / "000001.png").exists() and mine.exists()
    mine.unlink()
    (folder / "cam2").unlink()
    Journal(folder, "a", resume=False)
    delete_masks(folder)
    assert not folder.exists()
    delete_masks(folder)


@pytest.mark.parametrize("text", ["{", "[]", '{"pictures": 2}', '{"pictures": 2, "disagreement": [0.1]}', "\udcff"])
def test_damaged_notes_of_what_was_learned_are_an_error(tmp_path, text):
    capture = load_capture(ROOT / "examples" / "capture" / "capture.toml")
    (tmp_path / LEARNED).write_bytes(text.encode(errors="surrogateescape"))
    with pytest.raises(FormatError, match=LEARNED):
        write_summary(capture, entries(), tmp_path)
    assert not (tmp_path / SUMMARY).exists()
    (tmp_path / LEARNED).write_text('{"numbers": {}, "pictures": 2, "disagreement": [0.2, 0.1]}')
    assert write_summary(capture, entries(), tmp_path)["learned"]["disagreement"] == [0.2, 0.1]
