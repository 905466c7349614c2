"""ARKit face captures: time codes, the rate found from them, moments without a face, and every fault by its line."""

import numpy as np
import pytest

from jawusd.errors import FormatError
from jawusd.formats.arkit import read_arkit

HEADER = "Timecode,BlendShapeCount,EyeBlinkLeft,JawForward,JawRight,JawLeft,JawOpen,HeadYaw"


def timecode(frame, rate, start_s=14 * 3600, sub=".207"):
    """Return HH:MM:SS:FF.fff of a frame."""
    second = (start_s + frame // rate) % 86400
    return f"{second // 3600:02d}:{second // 60 % 60:02d}:{second % 60:02d}:{frame % rate:02d}{sub}"


def take(path, frames, rate, header=HEADER, **more):
    """Write a capture whose JawOpen is a hundredth of the frame number."""
    rows = [f"{timecode(k, rate, **more)},61,0.5,0.1,0.2,0.3,{k / 1000},-3.5" for k in frames]
    path.write_text("\n".join([header, *rows, ""]))
    return path


@pytest.mark.parametrize("rate", [24, 25, 30, 60])
def test_frames_weights_and_rate_come_from_the_file(tmp_path, rate):
    frames = np.array([k for k in range(17, 17 + 4 * rate) if k % 11])  # with dropped frames
    found = read_arkit(take(tmp_path / "face.csv", frames, rate))
    assert found.fps == rate and found.timecode == timecode(int(frames[0]), rate)
    np.testing.assert_allclose(found.frames, frames - frames[0], atol=1e-6)
    np.testing.assert_allclose(found.weights[:, 0], frames / 1000)
    np.testing.assert_allclose(found.weights[0, 1:], [0.3, 0.2, 0.1])


def test_column_names_count_without_case_and_a_byte_order_mark_is_skipped(tmp_path):
    path = take(tmp_path / "face.csv", range(90), 30, header=HEADER.upper())
    path.write_bytes(b"\xef\xbb\xbf" + path.read_bytes())
    assert len(read_arkit(path).frames) == 90


def test_midnight_and_subframes(tmp_path):
    path = take(tmp_path / "face.csv", range(180), 60, start_s=86398)
    np.testing.assert_allclose(read_arkit(path).frames, np.arange(180), atol=1e-6)
    path.write_text(f"{HEADER}\n01:00:00:10.25,61,0,0,0,0,0,0\n01:00:00:11.75,61,0,0,0,0,0,0\n")
    np.testing.assert_allclose(read_arkit(path, fps=60).frames, [0, 1.5])


def test_rows_without_a_face_are_lost_not_closed(tmp_path):
    path = take(tmp_path / "face.csv", range(90), 30)
    lines = path.read_text().splitlines()
    lines[5] = f"{timecode(4, 30)},0"
    lines[6] = f"{timecode(5, 30)},0,,,,,,"
    path.write_text("\n".join(lines))
    weights = read_arkit(path).weights
    assert np.isnan(weights[4:6]).all() and np.isfinite(np.delete(weights, [4, 5], axis=0)).all()


def test_a_short_take_does_not_tell_its_rate(tmp_path):
    path = take(tmp_path / "face.csv", range(20), 60)
    with pytest.raises(FormatError, match="--fps"):
        read_arkit(path)
    assert read_arkit(path, fps=59.94).fps == 60000 / 1001


@pytest.mark.parametrize(
    ("row", "words"),
    [
        ("01:00:00:02,61,0,0,0,0,x,0", 'line 3, column "JawOpen": "x"'),
        ("01:00:00:02,61,0,0,0,nan,0,0", 'line 3, column "JawLeft" is nan'),
        ("01:00:00:02,61,0,0,0,0,0", "line 3 has 7 values"),
        ("1.5,61,0,0,0,0,0,0", 'line 3, column "Timecode": "1.5"'),
        ("01:00:00:01,61,0,0,0,0,0,0", 'line 3, column "Timecode" does not come after'),
        ("01:00:00:30,61,0,0,0,0,0,0", 'line 3, column "Timecode" counts frame 30'),
    ],
)
def test_each_fault_is_named_by_line_and_column(tmp_path, row, words):
    path = tmp_path / "face.csv"
    path.write_text(f"{HEADER}\n01:00:00:01,61,0,0,0,0,0,0\n{row}\n")
    with pytest.raises(FormatError, match=words):
        read_arkit(path, fps=30)


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("", "empty"),
        (HEADER, "no rows"),
        (HEADER.replace("JawOpen", "MouthOpen"), '"jawopen" 0 times'),
        (HEADER + ",jawopen", '"jawopen" 2 times'),
    ],
)
def test_tables_that_are_none(tmp_path, text, words):
    (tmp_path / "face.csv").write_text(text)
    with pytest.raises(FormatError, match=words):
        read_arkit(tmp_path / "face.csv")


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda w: 100 * w, ("line 5", "jawopen", "is 90", "percent", "divide all weights by 100")),
        (lambda w: (w - w.mean(0)) / w.std(0), ("0 to 1", "normalised")),
        (lambda w: 2 * w - 1, ("0 to 1", "normalised")),
    ],
)
def test_weights_on_another_scale_are_refused(tmp_path, change, words):
    weights = np.random.default_rng(0).uniform(0, 0.3, (60, 4))
    weights[3, 0] = 0.9  # open, left, right, forward
    weights[7] = 0.0

    def written(values):
        rows = [f"{timecode(k, 25)},61,0.5,{f},{r},{l},{o},0" for k, (o, l, r, f) in enumerate(values)]
        path = tmp_path / "face.csv"
        path.write_text("\n".join([HEADER, *rows]))
        return path

    assert read_arkit(written(weights)).weights.max() == 0.9
    assert read_arkit(written(1.3 * weights - 0.1)).weights.max() > 1  # gains and a personal neutral face
    with pytest.raises(FormatError) as error:
        read_arkit(written(change(weights)))
    assert all(word in str(error.value) for word in words)


def drop_frame_codes(count, number, left_out, separator, start=0):
    """Count time codes on, as SMPTE ST 12-1 describes: the first numbers of a minute are left out but every tenth."""
    codes, minute, second, frame = [], 0, 0, 0
    for k in range(start + count):
        if k >= start:
            codes.append(f"{minute // 60:02d}:{minute % 60:02d}:{second:02d}{separator}{frame:02d}.000")
        frame += 1
        if frame == number:
            frame, second = 0, second + 1
        if second == 60:
            second, minute = 0, minute + 1
            frame = left_out if minute % 10 else 0
    return codes


@pytest.mark.parametrize(("number", "left_out"), [(30, 2), (60, 4)])
@pytest.mark.parametrize(("separator", "fps"), [(";", None), (":", None), (";", True), (":", True)])
def test_drop_frame_keeps_to_the_clock(tmp_path, number, left_out, separator, fps):
    """Over an hour, within a millisecond of the frames counted one by one; every 7th row, and all of two minutes."""
    count = 3600 * number
    kept = sorted({*range(0, count, 7), *range(50 * number, 130 * number)})
    codes = np.array(drop_frame_codes(count, number, left_out, separator))[kept]
    path = tmp_path / "face.csv"
    path.write_text("\n".join([HEADER, *(f"{code},61,0,0,0,0,0,0" for code in codes)]))
    found = read_arkit(path, fps=round(number * 1000 / 1001, 2) if fps else None)
    assert found.fps == number * 1000 / 1001
    times, expected = found.frames / found.fps, np.array(kept) * 1001 / 1000 / number
    np.testing.assert_allclose(times, expected, atol=1e-3)


@pytest.mark.parametrize(("number", "fps"), [(30, 29.97), (60, 59.94), (24, 23.976)])
def test_codes_that_leave_nothing_out_count_every_number(tmp_path, number, fps):
    path = tmp_path / "face.csv"
    codes = [timecode(k, number, sub=".000") for k in range(130 * number)]
    path.write_text("\n".join([HEADER, *(f"{code},61,0,0,0,0,0,0" for code in codes)]))
    np.testing.assert_allclose(read_arkit(path, fps=fps).frames, np.arange(130 * number))
    assert read_arkit(path, fps=fps).fps == number * 1000 / 1001
    assert read_arkit(path).fps == number
