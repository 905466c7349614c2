"""ARKit face captures: time codes, the rate found from them, moments without a face, and every fault by its line."""

import numpy as np
import pytest

from jawusd.base.errors import FormatError
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
    np.testing.assert_allclose(found.X[:, 0], frames / 1000)
    np.testing.assert_allclose(found.X[0, 1:], [0.3, 0.2, 0.1])


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
    weights = read_arkit(path).X
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
        ("01:00:00:01,61,0,0,0,0,0,0", 'line 3, column "Timecode" is not later than'),
        ("01:00:00:30,61,0,0,0,0,0,0", 'line 3, column "Timecode" has frame number 30'),
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
        (HEADER.replace("JawOpen", "MouthOpen"), 'has 0 columns named "jawopen"'),
        (HEADER + ",jawopen", 'has 2 columns named "jawopen"'),
    ],
)
def test_tables_that_are_none(tmp_path, text, words):
    (tmp_path / "face.csv").write_text(text)
    with pytest.raises(FormatError, match=words):
        read_arkit(tmp_path / "face.csv")


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda w: 100 * w, ("line 5", "JawOpen", "is 90", "percent", "divide all weights by 100")),
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

    assert read_arkit(written(weights)).X.max() == 0.9
    assert read_arkit(written(1.3 * weights - 0.1)).X.max() > 1  # gains and a personal neutral face
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


def codes_of(times, number, subframes=True, left_out=0, separator=":", start=0):
    """Return time codes of times [frames of the code] by counting one by one, with subframes or without."""
    whole = np.floor(np.asarray(times) + 1e-9).astype(int)
    counted = drop_frame_codes(int(whole[-1]) + 1, number, left_out, separator, start)
    return [
        counted[k][:-4] + (f"{time - k:.3f}"[1:] if subframes else "") for time, k in zip(times, whole, strict=True)
    ]


def written(path, codes):
    path.write_text("\n".join([HEADER, *(f"{code},61,0,0,0,0,0,0" for code in codes)]))
    return path


FACTOR = 1000 / 1001
# name: samples per code number, numbers per second, subframes, left out, separator, --fps, wanted frames per second
RATES = {
    "60 samples on a code of 30": (2, 30, True, 0, ":", 60, 60),
    "60 on 30, the code's rate given": (2, 30, True, 0, ":", 30, 30),
    "60 on 30, none given": (2, 30, True, 0, ":", None, 30),
    "48 on 24": (2, 24, True, 0, ":", 48, 48),
    "50 on 25, codes repeated": (2, 25, False, 0, ":", 50, 50),
    "60 on 30, codes repeated, none given": (2, 30, False, 0, ":", None, 30),
    "120 on 30, codes repeated": (4, 30, False, 0, ":", 120, 120),
    "60 on 24, codes repeated": (2.5, 24, False, 0, ":", 60, 60),
    "60 on 25": (2.4, 25, True, 0, ":", 60, 60),
    "30 on 60": (0.5, 60, True, 0, ":", 30, 30),
    "30 on 60, none given": (0.5, 60, True, 0, ":", None, 60),
    "2 on 60, none given": (1 / 30, 60, True, 0, ":", None, 60),
    "15, given": (1, 15, True, 0, ":", 15, 15),
    "drop frame at 30": (1, 30, True, 2, ";", 30, 30 * FACTOR),
    "drop frame, unmarked, at 30": (1, 30, True, 2, ":", 30, 30 * FACTOR),
    "drop frame of 30 at 60": (2, 30, True, 2, ";", 60, 60 * FACTOR),
    "drop frame of 30 at 59.94, codes repeated": (2, 30, False, 2, ";", 59.94, 60 * FACTOR),
    "59.94 on a code of 29.97 that leaves nothing out": (2, 30, True, 0, ":", 59.94, 60 * FACTOR),
}


@pytest.mark.parametrize("case", RATES)
def test_the_rates_of_code_and_samples_are_told_apart(tmp_path, case):
    per_number, number, subframes, left_out, separator, fps, wanted = RATES[case]
    times = np.arange(round(150 * number * per_number)) / per_number  # two starts of a minute
    path = written(tmp_path / "face.csv", codes_of(times, number, subframes, left_out, separator))
    found = read_arkit(path, fps=fps)
    assert found.fps == pytest.approx(wanted, rel=1e-12)
    factor = FACTOR if abs(wanted % 1) > 1e-6 else 1
    late = np.abs(found.frames / found.fps - times / number / factor)
    # codes without subframes leave the place of 2 or 3 samples within them open
    assert late.max() < (1 / number / per_number if per_number % 1 and not subframes else 1e-3 / number)


@pytest.mark.parametrize(("subframes", "fps"), [(True, 60), (False, 60), (False, 30)])
def test_samples_on_half_numbers_that_are_missing_leave_gaps_alone(tmp_path, subframes, fps):
    rows = np.array([k for k in range(1, 600) if k % 37 and k % 90 != 3])  # begins with the second half of a number
    found = read_arkit(written(tmp_path / "face.csv", codes_of(rows / 2, 30, subframes)), fps=fps)
    wanted = (rows - 1) * fps / 60
    off = np.abs(found.frames - wanted) * 60 / fps
    assert off.max() < 1e-2 if subframes else off[0] == 0 and off.max() < 1.01 and np.median(off) < 1e-6


def test_midnight_in_drop_frame_with_half_numbers(tmp_path):
    seconds = ("23:59:58", "23:59:59", "00:00:00", "00:00:01")  # no minute that leaves numbers out
    codes = [f"{second};{k:02d}{half}" for second in seconds for k in range(30) for half in (".00", ".50")]
    found = read_arkit(written(tmp_path / "face.csv", codes), fps=60)
    np.testing.assert_allclose(found.frames, np.arange(240), atol=1e-6)
    assert found.fps == 60 * FACTOR


@pytest.mark.parametrize(
    ("number", "fps", "words"),
    [
        (30, 24, ("has frame number 29", "count 30 frames per second", "--resample")),
        (25, 24, ("has frame number 24", "count 25 frames per second")),
        (24, 30, ("count 24 frames per second", "at 30 frames per second")),
        (15, None, ("frame rate cannot be found", "--fps")),
        (15, 50, ("frame rate cannot be found",)),
    ],
)
def test_a_rate_that_does_not_fit_the_code_is_refused(tmp_path, number, fps, words):
    path = written(tmp_path / "face.csv", codes_of(np.arange(5 * number), number))
    with pytest.raises(FormatError) as error:
        read_arkit(path, fps=fps)
    assert all(word in str(error.value) for word in words)


def test_short_takes_with_half_numbers_count_at_half_the_given_rate(tmp_path):
    path = written(tmp_path / "face.csv", codes_of(np.arange(10, 30) / 2, 30))
    np.testing.assert_allclose(read_arkit(path, fps=60).frames, np.arange(20), atol=1e-6)
