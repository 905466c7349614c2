"""Headers of results: what is derived from them, and values of other types."""

import math

import pytest

from jawusd.base.errors import FormatError
from jawusd.formats.notes import TracksMeta, check_notes, registration_sizes

MOVED = {"frames": [3], "applied": True, "shift_mm": [0.3, 0.0, 0.4], "turn_deg": [0.0, 2.0, 0.0], "T": [[1.0]]}


def test_registrations_have_lengths_and_unknown_sigmas_are_nan():
    known = registration_sizes({**MOVED, "shift_sigma_mm": [0.1, 0.0, 0.0], "turn_sigma_deg": [0.0, 0.0, 0.2]})
    assert known == pytest.approx((0.5, 2.0, 0.1, 0.2))
    shift_mm, turn_deg, *sigmas = registration_sizes(MOVED)
    assert (shift_mm, turn_deg) == pytest.approx((0.5, 2.0)) and all(map(math.isnan, sigmas))


@pytest.mark.parametrize(
    ("meta", "name"),
    [({"fps": "24"}, "fps"), ({"registration": {"frames": [1]}}, "registration"), ({"painted": [1]}, "painted")],
)
def test_values_of_other_types_are_named(meta, name, tmp_path):
    check_notes({"registration": MOVED, "of another program": 1}, TracksMeta, tmp_path / "tracks.npz")
    with pytest.raises(FormatError, match=rf'tracks.npz: "meta" has an invalid "{name}'):
        check_notes(meta, TracksMeta, tmp_path / "tracks.npz")
