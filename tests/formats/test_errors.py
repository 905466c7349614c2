"""What errors print, and that they cross process boundaries whole."""

import pickle

import pytest

from jawusd.base.errors import CalibrationError, TrackingError, errors_name_file


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


@pytest.mark.parametrize(("path", "named"), [(None, "a.csv: no rows."), ("b.csv", "b.csv: no rows.")])
def test_readers_name_their_file_unless_another_is_named(path, named):
    @errors_name_file
    def read(file, words):
        raise TrackingError(words, path=path)

    with pytest.raises(TrackingError) as error:
        read("a.csv", words="no rows.")
    assert str(error.value) == named
