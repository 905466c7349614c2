"""What errors print, and that they cross process boundaries whole."""

import pickle

import pytest

from jawusd.base.errors import CalibrationError, TrackingError


@pytest.mark.parametrize(
    ("error", "printed"),
    [
        (TrackingError("no masks"), "no masks"),
        (TrackingError("no masks", frame=7, hint="Add some."), "frame 7: no masks Add some."),
        (
            CalibrationError("no board.", path="a.mp4", camera="left", frame=0),
            "a.mp4: camera left, frame 0: no board.",
        ),
    ],
)
def test_errors_print_where_first_and_survive_pickling(error, printed):
    copy = pickle.loads(pickle.dumps(error))
    assert str(error) == str(copy) == printed
    assert type(copy) is type(error) and vars(copy) == vars(error)
