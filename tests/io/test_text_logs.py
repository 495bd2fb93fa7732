"""Logs: every dialect of text, what is odd about a log, and what is said where one cannot be read."""

import gzip
import re

import numpy as np
import pytest

import switchfit as sf
from switchfit.runtime.errors import InputError


@pytest.fixture
def write(tmp_path):
    """Write a text file and return its path."""

    def write(text, name="a.csv", encoding="utf-8"):
        path = tmp_path / name
        path.write_bytes(text.encode(encoding))
        return path

    return write


# --- dialects ---------------------------------------------------------------------------------------------------------

DIALECTS = {
    "commas": "t,x,y\n0,1,2\n1,3,4\n",
    "semicolons": "t;x;y\n0;1;2\n1;3;4",
    "tabs": "t\tx\ty\n0\t1\t2\n1\t3\t4\n",
    "columns of spaces": "  t    x    y\n0.0  1.0  2.0\n1.0  3.0  4.0\n",
    "spaces around cells, a byte order mark": "\ufeff t , x , y\r\n 0 , 1 , 2 \r\n1, 3, 4\r\n",
    "comments, quotes, exponents": '# a comment\n\n"t","x","y"\n0,1,2\n\n# another\n1,3e0,4.0\n',
    "names in a comment": "# logger 3\n# t x y\n0 1 2\n1 3 4\n",
    "names behind a percent sign": "%time,x,y\n0,1,2\n1,3,4\n",
    "separators at the ends of lines": "t;x;y;\n0;1;2;\n1;3;4;\n",
    "separators at the ends of rows alone": "t;x;y\n0;1;2;\n1;3;4;\n",
    "decimal commas": "t;x;y\n0,0;1,0;2,0\n1,0;3,0;4,0\n",
    "decimal commas in columns of tabs": "t\tx\ty\n0,0\t1,0\t2\n1\t3\t4,0\n",
    "a line of units": "t,x,y\ns,m,m\n0,1,2\n1,3,4\n",
    "units in brackets": "t [s],x [m],y [m]\n0,1,2\n1,3,4\n",
    "three lines": "Time;Position along X;Position along Y\ns;m;m\nt;x;y\n0;1;2\n1;3;4\n",
    "a preamble": "Logger 3\nfirmware: 1.2\n\nt,x,y\n0,1,2\n1,3,4\n",
    "a note of Excel": "sep=;\nt;x;y\n0;1;2\n1;3;4\n",
    "old line ends": "t,x,y\r0,1,2\r1,3,4\r",
}


@pytest.mark.parametrize("text", DIALECTS.values(), ids=DIALECTS)
def test_dialects(write, text):
    log = sf.read_log(write(text))
    np.testing.assert_array_equal(log.times, [0, 1])
    assert log.channels == ("x", "y")
    np.testing.assert_array_equal(log[["y", "x"]], [[2, 1], [4, 3]])
    unit = "m" if re.search(r"\[m\]|^s.m.m$", text, re.MULTILINE) else ""
    assert log.units == {"x": unit, "y": unit}
    assert log.time_unit == ("s" if unit else "")
    np.testing.assert_array_equal(sf.read_log(write(text), columns=["y", "x"])["y"], [2, 4])


@pytest.mark.parametrize("encoding", ["utf-8", "utf-8-sig", "latin-1", "utf-16"])
def test_encodings_and_compression(write, tmp_path, encoding):
    text = "Zeit [µs];Längsweg [°]\n0;1,5\n1;2,5\n"
    path = write(text, encoding=encoding)
    for file in (path, tmp_path / "a.csv.gz"):
        log = sf.read_log(file)
        assert (log.channels, log.units, log.time_unit) == (("Längsweg",), {"Längsweg": "°"}, "us")
        np.testing.assert_array_equal(log["Längsweg [°]"], [1.5, 2.5])
        (tmp_path / "a.csv.gz").write_bytes(gzip.compress(path.read_bytes()))


@pytest.mark.parametrize(
    "text",
    [
        "t,x,y\n0,,1\n1,2,\n2,,\n,3,4\n",
        "t;x;y;\n0;;1;\n1;2;;\n2;;;\n;3;4;\n",
        "t,x,y\n0,NA,1\n1,2,nan\n2,,N/A\nNULL,3,4\n",
        't,x,y\n0,"",1\n1,2,""\n2,,\n,3,4\n',
    ],
)
def test_missing_cells(write, text):
    """Those that NumPy's reader is given, and those that are read one by one."""
    log = sf.read_log(write(text), repair="drop-missing-times")
    np.testing.assert_array_equal(log.times, [0, 1, 2])
    np.testing.assert_array_equal(log[["x", "y"]], [[np.nan, 1], [2, np.nan], [np.nan, np.nan]])
    with pytest.raises(InputError, match=r"the time of sample 4 is missing \(line 5\)"):
        sf.read_log(write(text))


def test_headers_of_other_shapes(write):
    log = sf.read_log(write("t,left,left,right,right\ns,m,rad,m,rad\n,x,yaw,x,yaw\n0,1,2,3,4\n1,1,2,3,4\n"))
    assert log.channels == ("left.x", "left.yaw", "right.x", "right.yaw")
    assert log.units["right.yaw"] == "rad"
    without = sf.read_log(write("0.0 1.0\n0.1 2.0\n"))
    np.testing.assert_array_equal([without.times, without["column 2"]], [[0, 0.1], [1, 2]])
    text = sf.read_log(write("t,mode,x\n0,push,1\n1,push,2\n2,,3\n3,brake,4\n"))
    assert text.channels == ("x",)
    assert text.events == ((0.0, "mode", "push"), (3.0, "mode", "brake"))


def test_every_name_in_the_header_leads_to_its_channel(write):
    log = sf.read_log(write("Time;Position along X\ns;m\nt;x\n0;1\n1;2\n"))
    for name in ("x", "Position along X"):
        assert name in log
        np.testing.assert_array_equal(log[name], [1, 2])
    with pytest.raises(InputError, match=r"a\.csv has no column 'z'; its columns are x\."):
        log["z"]
    with pytest.raises(TypeError, match=r'indexed by a name or a list of names, as in log\["x"\]; got 3'):
        log[3]


@pytest.mark.parametrize(
    ("header", "unit", "seconds"),
    [
        ("t", "", 1), ("t [ms]", "ms", 1e-3), ("time (msec)", "ms", 1e-3), ("t_s", "s", 1), ("Time_us", "us", 1e-6),
        ("timestamp [µs]", "us", 1e-6), ("t_min", "min", 60), ("elapsed time [h]", "h", 3600), ("__time", "", 1),
        ("time (indoors)", "", 1), ("millis", "ms", 1e-3), ("seconds_elapsed", "s", 1), ("time_usec", "us", 1e-6),
    ],
)  # fmt: skip
def test_units_of_time(write, header, unit, seconds):
    path = write(f"x,{header}\n5,0\n6,36\n7,72\n")
    log, converted = sf.read_log(path), sf.read_log(path, time_unit="s")
    assert (log.time_unit, converted.time_unit) == (unit, "s")
    np.testing.assert_array_equal(log.times, [0, 36, 72])
    np.testing.assert_allclose(converted.times, log.times * seconds, rtol=1e-15)


@pytest.mark.parametrize(
    ("header", "times"),
    [
        ("t_motor,t,x", 1),  # a temperature
        ("date,x,time", 2),
        ("x,lap_time,time", 2),
        ("field.header.seq,x,field.header.stamp", 2),
        ("x,start_time,y", 1),
        ("k,x,y", 0),  # the first one, as it rises
        ("x,T,hours", 2),
        ("x,T,y", 1),  # as [T, Y] = ode45(...) has it
    ],
)
def test_which_column_has_the_times(write, header, times):
    log = sf.read_log(write(f"{header}\n0,10,20\n1,11,21\n2,12,22\n"))
    np.testing.assert_array_equal(log.times, 10 * times + np.arange(3))


@pytest.mark.parametrize("rows", ["2026-03-29T01:59:30Z 2026-03-29T01:59:32Z", "29.03.2026 30.03.2026", "23:59 24:00"])
def test_a_first_column_of_dates_that_rise_has_the_times(write, rows):
    first, last = rows.split()
    assert sf.read_log(write(f"Zeitstempel;x\n{first};1\n{last};2\n")).time_name == "Zeitstempel"
    with pytest.raises(InputError, match=r"no column is called time; .*or call it time in the file"):
        sf.read_log(write(f"Zeitstempel;x\n{last};1\n{first};2\n"))


def test_a_channel_that_is_asked_for_is_a_temperature(write):
    path = write("run,T,y\n0,20,5\n1,19,6\n2,21,7\n")
    log = sf.read_log(path, columns=["T"])
    assert (log.time_name, log["T"].tolist()) == ("run", [20, 19, 21])
    assert sf.read_log(path).time_name == "T"


NOVEMBER, MAY = "2023-11-14 22:13:20", "2024-05-01 12:00:00"
TIMES = [
    # Since 1970; nanoseconds too, which doubles cannot hold
    ("timestamp,x\n1700000000.25,1\n1700000000.5,2", [0, 0.25], "s", NOVEMBER),
    ("timestamp,x\n1700000000250,1\n1700000000500,2", [0, 250], "ms", NOVEMBER),
    ("timestamp,x\n1700000000250000001,1\n1700000000500000001,2", [0, 250_000_000], "ns", NOVEMBER),
    # Since boot, in microseconds
    ("timestamp,x\n1700000000,1\n1700004001,2", [1.7e9, 1700004001], "", None),
    # Dates
    ("time,x\n2024-05-01T12:00:00Z,1\n2024-05-01T12:00:01.5Z,2", [0, 1.5], "s", MAY),
    ("time;x\n2024-05-01 12:00:00,000;1,0\n2024-05-01 12:00:01,500;2,0", [0, 1.5], "s", MAY),
    ("time;x\n01.05.2024 12:00:00;1\n01.05.2024 12:00:01.5;2", [0, 1.5], "s", MAY),
    ("time;x\n2024/05/01 12:00:00;1\n2024/5/1 12:00:01.5;2", [0, 1.5], "s", MAY),
    ("time,x\n2024-05-01T14:00:00+02:00,1\n2024-05-01T14:00:01.5+02:00,2", [0, 1.5], "s", MAY),
    ("Date,Time,x\n2024-05-01,12:00:00,1\n2024-05-01,12:00:01.5,2", [0, 1.5], "s", MAY),
    # Times of day
    ("time,x\n12:00:01.5,1\n12:01,2", [43201.5, 43260], "s", None),
    ("time,x\n23:59:59,1\n00:00:01.5,2", [86399, 86401.5], "s", None),
]


@pytest.mark.parametrize(("text", "times", "unit", "start"), TIMES)
def test_times(write, text, times, unit, start):
    log = sf.read_log(write(text))
    np.testing.assert_array_equal(log.times, times)
    assert log.time_unit == unit
    assert (log.start and f"{log.start:%Y-%m-%d %H:%M:%S}") == start
    np.testing.assert_array_equal(log["x"], [1, 2])
    if unit == "ms":
        words = f"a.csv: 2 samples, 0 to 250 ms from {NOVEMBER} UTC\n  channels: x"
        assert str(log).endswith(words)


# --- what is wrong is said --------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", r"a\.csv is empty; it needs a line with the names"),
        ("t,x\n", r"a\.csv has a header but no rows"),
        ("t,y\n0,1\n", r"a\.csv has no column 'x'; its columns are t, y\."),
        ("t,x,x\n0,1,2\n", r"a\.csv has 2 columns 'x'; rename all but one"),
        ("t,x\n0,1\n\n1,two\n", r"a\.csv, line 4, column 'x': 'two' is not a number; leave the cell empty"),
        ('# a\nt,x\n0,1\n\n1,"2\n2,3"\n3,a\n', r"a\.csv, line 6, column 'x': '22,3' is not a number"),
        ("t,x\n0,1\n1,1_0\n", r"a\.csv, line 3, column 'x': '1_0' is not a number"),
        ("t,x\n0,1\n1\n", r"a\.csv, line 3: 1 fields where the header has 2; is a field missing\? repair='drop-bro"),
        ("t,x\n0,5,1,5\n1,5,2,5\n", r"a\.csv, line 2: 4 fields .* decimal commas\? Then separate fields by semicolons"),
        ("t;x\n0,5;1.5\n1;2\n", r"with decimal commas and with decimal points: '0,5' in line 2, '1\.5' in line 2"),
        ('t,x\n0,1\n1,"2\n' + "3" * 200_000, r"a\.csv, line 4: field larger .*; is a quotation mark missing"),
        ("t,x\n0,1\n,2\n", r"a\.csv, column 't': the time of sample 2 is missing \(line 3\)\. repair='drop-missing"),
        ("time,x\n12:00:00,1\nnoon,2\n", r"line 3, column 'time': 'noon' is not a time of day such as 12:34"),
        ("time,x\n2024-05-01,1\n05/01/2024,2\n", r"line 3, column 'time': '05/01/2024' is not a date that can be read"),
        ("y,x\n0,1\n-1,2\n", r"a\.csv: no column is called time; its columns are y, x\. Name the one"),
    ],
)  # fmt: skip
def test_text_that_cannot_be_read(write, text, message):
    with pytest.raises(InputError, match=message):
        sf.read_log(write(text), columns=["x"])


CUT_OFF = gzip.compress(b"t,x\n0,1\n" * 100, mtime=0)[:-20]


@pytest.mark.parametrize(
    ("name", "content", "message"),
    [
        ("missing.csv", None, r"There is no file .*missing\.csv; check the name"),
        ("", None, "is a folder; name a file in it"),
        ("a.bin", b"t,x\n\xff\xfe\x00", r"a\.bin is not a text file \(byte 6 is 0\); export it as CSV"),
        ("odd.csv", b"\xff\xfet", r"odd\.csv cannot be read as text in UTF-16: "),
        ("a.csv.gz", CUT_OFF, r"gz cannot be read as a file that is compressed by gz"),
        ("word " * 1000, None, r"path must name a file, with at most 255 characters; got '.*word word"),
        ("/dev/zero", None, "is a device; name a file"),
    ],
)
def test_files_that_are_no_text(name, content, message, tmp_path):
    if content:
        (tmp_path / name).write_bytes(content)
    with pytest.raises((InputError, ValueError), match=message):
        sf.read_log(tmp_path / name)


# --- quality ----------------------------------------------------------------------------------------------------------


def issues_of(log):
    return {issue.kind: str(issue) for issue in log.issues}


def table(times, values=None, name="x"):
    values = np.sin(np.arange(len(times))) if values is None else values
    return f"t [s],{name}\n" + "".join(f"{t},{v}\n" for t, v in zip(times, values, strict=True))


ROWS_OF_5 = "".join(f"{k},7,,{k}\n" for k in range(5))


@pytest.mark.parametrize(
    ("text", "said"),
    [
        (table(range(20)), {}),
        (table([0, 1, 2, 3, 9, 10, 20, 21, 22, 30]), {}),  # uneven is no gap
        (table(range(9), np.linspace(0, 6, 9), "yaw"), {}),
        (table([*range(10), *range(50, 60)]), {"gap": "line 12: a gap of 41 s after 9 s, where samples are typically"}),
        (table([0, 1, 1, 1, 2]), {"repeated time": "line 4 (and 1 more): the time 1 s stands there twice; repair='"}),
        (table([0, 1, 3, 2, 4, 5]), {"unsorted times": "line 5: times are not in order, 2 s is written too late; rep"}),
        (table([*range(20), *range(5)]), {"clock jump": "line 22: the clock jumps back by 19 s, to 0 s; if these ar"}),
        (f"t,a,b,c\n{ROWS_OF_5}", {"constant": "constant in all samples: a.", "empty": "without any value: b."}),
        ("t,x,y\n0,1,1\n1,ERR,2\n2,3,3\n", {"text": "line 3: 'ERR' in column 'x' is not a number, and the column is"}),
        ("t,x,x,y\n0,1,2,3\n1,2,3,4\n", {"repeated name": "has several columns 'x', which are left out"}),
    ],
)  # fmt: skip
def test_what_is_odd_is_said(write, text, said):
    found = issues_of(sf.read_log(write(text)))
    assert found.keys() == {f"log: {kind}" for kind in said}
    for kind, message in said.items():
        assert message in found[f"log: {kind}"]


@pytest.mark.parametrize(
    ("times", "repair", "samples", "said"),
    [
        ([0, 1, 1, 1, 2], "drop-duplicates", [0, 1, 4], "the first sample is kept"),
        ([0, 1, 3, 2, 4, 5], ("sort", "drop-duplicates"), [0, 1, 3, 2, 4, 5], ""),
        ([0, "", 2], "drop-missing-times", [0, 2], "line 3: without a time; left out"),
    ],
)
def test_repairs(write, times, repair, samples, said):
    mended = sf.read_log(write(table(times)), repair=repair)
    np.testing.assert_array_equal(mended.times, sorted(times[k] for k in samples))
    np.testing.assert_array_equal(mended["x"], np.sin(np.array(samples, dtype=float)))
    assert said in " ".join(issues_of(mended).values())


@pytest.mark.parametrize(
    ("name", "turn"), [("yaw", 2 * np.pi), ("heading", 360), ("ang [deg]", 360), ("q [rad]", 2 * np.pi)]
)
def test_wrapped_angles(write, name, turn):
    true = np.linspace(0, 2.5 * turn, 60)
    path = write(table(range(60), (true + turn / 2) % turn - turn / 2, name))
    log = sf.read_log(path)
    (channel,) = log.channels
    assert f"line 14 (and 2 more): the angle {channel!r} jumps by a turn of" in issues_of(log)["log: wrapped angle"]
    mended = sf.read_log(path, repair=f"unwrap:{channel}")
    np.testing.assert_allclose(mended[channel], true, atol=1e-9 * turn)
    assert "unwrapped" in issues_of(mended)["log: wrapped angle"]


@pytest.mark.parametrize(
    ("repair", "message"),
    [
        ("unwrap:x", "repair='unwrap:x' needs an angle in rad or deg; its unit is 'm'"),
        ("sore", r"repair must be among sort, drop-duplicates, .* and unwrap:CHANNEL; got 'sore'"),
    ],
)
def test_repairs_that_cannot_be_done(write, repair, message):
    with pytest.raises(InputError, match=message):
        sf.read_log(write(table(range(9), name="x [m]")), repair=repair)


def test_broken_lines(write):
    path = write("t,x,y\n0,1,1\n1,2,2\nt,x,y\n2,ERR,3\n3,4,4\n4,5,5\n5,6")
    log = sf.read_log(path, repair="drop-broken-lines")
    np.testing.assert_array_equal([log.times, log["x"]], [[0, 1, 3, 4], [1, 2, 4, 5]])
    assert "line 4 (and 2 more): broken; left out." in issues_of(log)["log: broken lines"]
    assert sf.read_log(write("t,x\n0,1\n1,2\n"), repair="drop-broken-lines").issues == ()  # with numbers alone
