from jawusd.formats.finding import Finding


def test_a_finding_says_where_what_and_what_to_do():
    finding = Finding("camera_late", "warning", "lags by 1.0 frames.", camera="left", frame=7, hint="Synchronise.")
    assert finding.line() == "warning: camera left, frame 7: lags by 1.0 frames. Synchronise."
    assert finding.as_json() == {
        "kind": "camera_late",
        "severity": "warning",
        "message": "lags by 1.0 frames.",
        "camera": "left",
        "frame": 7,
        "hint": "Synchronise.",
    }


def test_a_finding_without_a_place_begins_with_what_was_found():
    assert Finding("scans_apart", "error", "9 mm apart.").line() == "error: 9 mm apart."
