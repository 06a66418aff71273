"""PCD files as programs write them, and the compression of their columns."""

import numpy as np
import pytest

from tdf_jax._internal.errors import InputError
from tdf_jax.io.pcd import decompress_lzf
from tdf_jax.io.pointclouds import load_points

CLOUD = np.random.default_rng(0).normal(size=(40, 3)).astype(np.float32)
HEADER = {
    "VERSION": "0.7",
    "FIELDS": "x y z rgb",
    "SIZE": "4 4 4 4",
    "TYPE": "F F F U",
    "COUNT": "1 1 1 1",
    "WIDTH": "40",
    "HEIGHT": "1",
    "VIEWPOINT": "0 0 0 1 0 0 0",
    "POINTS": "40",
}
ROWS = np.zeros(40, [("xyz", "<f4", 3), ("rgb", "<u4")])
ROWS["xyz"], ROWS["rgb"] = CLOUD, np.arange(40) * 1000
TEXT = "".join("{:.9g} {:.9g} {:.9g} 1000\n".format(*point) for point in CLOUD).encode()
COLUMNS = CLOUD.T.tobytes() + ROWS["rgb"].tobytes()


def pcd(data, body, **changes):
    header = {**HEADER, **changes}
    lines = "".join(f"{key} {value}\n" for key, value in header.items() if value is not None)
    return f"# .PCD v0.7 - Point Cloud Data file format\n{lines}DATA {data}\n".encode() + body


def literal(data):
    """LZF in runs of bytes as they are, of up to 32."""
    return b"".join(bytes([len(data[i : i + 32]) - 1]) + data[i : i + 32] for i in range(0, len(data), 32))


def greedy(data):
    """LZF with references wherever one of at least three bytes fits, also into what it makes itself."""
    out, run, i, seen = bytearray(), bytearray(), 0, {}
    while i < len(data):
        start = seen.get(data[i : i + 3], -1)
        seen[data[i : i + 3]] = i
        length = 0
        if start >= 0 and i - start <= 8192 and i + 3 <= len(data):
            while i + length < len(data) and length < 264 and data[start + length] == data[i + length]:
                length += 1
        if length < 3:
            run.append(data[i])
            i += 1
            continue
        out += literal(bytes(run))
        run.clear()
        distance, short = i - start - 1, min(length - 2, 7)
        out.append(short << 5 | distance >> 8)
        if short == 7:
            out.append(length - 9)
        out.append(distance & 255)
        i += length
    return bytes(out + literal(bytes(run)))


def packed(data=COLUMNS, pack=literal, size=None):
    body = pack(data)
    return np.array([len(body), len(data) if size is None else size], "<u4").tobytes() + body


VALID = {
    "ascii": pcd("ascii", TEXT),
    "decimal commas, as in some countries": pcd("ascii", TEXT.replace(b".", b",")),
    "binary": pcd("binary", ROWS.tobytes()),
    "binary_compressed": pcd("binary_compressed", packed()),
    "binary_compressed with references": pcd("binary_compressed", packed(pack=greedy)),
    "no POINTS": pcd("binary", ROWS.tobytes(), POINTS=None),
    "no HEIGHT": pcd("binary", ROWS.tobytes(), HEIGHT=None),
    "no WIDTH and HEIGHT": pcd("binary", ROWS.tobytes(), WIDTH=None, HEIGHT=None),
    "no VIEWPOINT and COUNT": pcd("binary", ROWS.tobytes(), VIEWPOINT=None, COUNT=None),
    "COLUMNS as in version 0.5": pcd("ascii", TEXT, FIELDS=None, COLUMNS="x y z rgb"),
    "organised": pcd("binary", ROWS.tobytes(), WIDTH="8", HEIGHT="5"),
    "identity with -1": pcd("binary", ROWS.tobytes(), VIEWPOINT="0 0 0 -1 0 0 0"),
    "windows": pcd("ascii", TEXT).replace(b"\n", b"\r\n"),
    "windows header": pcd("binary", b"").replace(b"\n", b"\r\n") + ROWS.tobytes(),
    "no newline at the end": pcd("ascii", TEXT.rstrip()),
    "latin-1": pcd("ascii", TEXT).replace(b"# .PCD", "# Tülle".encode("latin-1")),
    "utf-16": pcd("ascii", TEXT).decode().encode("utf-16"),
    "double": pcd("binary", CLOUD.astype("<f8").tobytes(), FIELDS="x y z", SIZE="8 8 8", TYPE="F F F", COUNT="1 1 1"),
    "double, compressed": pcd(
        "binary_compressed",
        packed(CLOUD.T.astype("<f8").tobytes(), greedy),
        FIELDS="x y z",
        SIZE="8 8 8",
        TYPE="F F F",
        COUNT="1 1 1",
    ),
    "compressed in vain": pcd("binary_compressed", packed(pack=bytes)),
    "capital fields": pcd("binary", ROWS.tobytes(), FIELDS="X Y Z RGB"),
    "padding of no bytes": pcd(
        "binary", ROWS.tobytes(), FIELDS="x y z _ rgb _", SIZE="4 4 4 1 4 1", TYPE="F F F U U U", COUNT="1 1 1 0 1 0"
    ),
    "fields in another order": pcd(
        "binary", CLOUD[:, [2, 0, 1]].tobytes(), FIELDS="z x y", SIZE="4 4 4", TYPE="F F F", COUNT="1 1 1"
    ),
    "padding, packed as well": pcd(
        "binary_compressed",
        packed(COLUMNS + b"\7" * 160),
        FIELDS="x y z rgb _",
        SIZE="4 4 4 4 1",
        TYPE="F F F U U",
        COUNT="1 1 1 1 4",
    ),
    "padding, left out": pcd(
        "binary_compressed", packed(), FIELDS="x y z rgb _", SIZE="4 4 4 4 1", TYPE="F F F U U", COUNT="1 1 1 1 4"
    ),
    "histogram before": pcd(
        "binary_compressed",
        packed(b"\1" * 40 * 33 * 4 + COLUMNS, greedy),
        FIELDS="fpfh x y z rgb",
        SIZE="4 4 4 4 4",
        TYPE="F F F F U",
        COUNT="33 1 1 1 1",
    ),
}


@pytest.mark.parametrize("name", VALID)
def test_a_cloud_is_read_exactly_in_every_notation(tmp_path, name):
    (tmp_path / "cloud.pcd").write_bytes(VALID[name])
    np.testing.assert_array_equal(load_points(tmp_path / "cloud.pcd"), CLOUD)


def test_integers_are_read_and_scaled(tmp_path):
    millimetres = np.random.default_rng(0).integers(-500, 500, (40, 3)).astype("<i2")
    changes = {"FIELDS": "x y z", "SIZE": "2 2 2", "TYPE": "I I I", "COUNT": "1 1 1"}
    (tmp_path / "cloud.pcd").write_bytes(pcd("binary", millimetres.tobytes(), **changes))
    np.testing.assert_allclose(load_points(tmp_path / "cloud.pcd", scale=0.001), millimetres / 1000, rtol=1e-6)


DAMAGED = {
    "truncated text": (pcd("ascii", TEXT[:-60]), "has 3. points; its header promises 40|row without the 4 numbers"),
    "truncated binary": (pcd("binary", ROWS.tobytes()[:-1]), "truncated: 40 points are 640 bytes, and it has 639"),
    "too long": (pcd("binary", ROWS.tobytes() + b"\1" * 16), "too long: 40 points are 640 bytes"),
    "truncated compressed": (pcd("binary_compressed", packed()[:-1]), "truncated: its data is"),
    "compressed of another size": (pcd("binary_compressed", packed(size=100)), "is 100 bytes when unpacked"),
    "compressed noise": (
        pcd("binary_compressed", np.array([4, 640], "<u4").tobytes() + b"\xff\xff\xff\xff"),
        "refers to what is before its beginning",
    ),
    "WIDTH and POINTS": (pcd("ascii", TEXT, WIDTH="39"), "promises 39 x 1 points and 40 POINTS"),
    "no count": (pcd("ascii", TEXT, WIDTH=None, HEIGHT=None, POINTS=None), "neither WIDTH nor POINTS"),
    "no FIELDS": (pcd("ascii", TEXT, FIELDS=None), "has no line FIELDS"),
    "no DATA": (pcd("ascii", b"").replace(b"DATA ascii\n", b""), "has no line DATA"),
    "unknown DATA": (pcd("zipped", b""), "its DATA is zipped; expected ascii, binary or binary_compressed"),
    "SIZE": (pcd("binary", ROWS.tobytes(), SIZE="4 4 4"), "has 4 FIELDS, 4 of TYPE and 3 of SIZE"),
    "COUNT": (pcd("binary", ROWS.tobytes(), COUNT="1 1 1"), "has 4 FIELDS and 3 entries of COUNT"),
    "a row with more numbers": (pcd("ascii", TEXT.replace(b"1000\n", b"1000 1\n", 1)), "a row without the 4 numbers"),
}
UNSUPPORTED = {
    "viewpoint": (
        pcd("ascii", TEXT, VIEWPOINT="0 0 1.5 1 0 0 0"),
        "has the VIEWPOINT 0 0 1.5 1 0 0 0, .*sensor or of the world; expected 0 0 0 1 0 0 0; move the points",
    ),
    "turned viewpoint": (pcd("ascii", TEXT, VIEWPOINT="0 0 0 0.7 0.7 0 0"), "has the VIEWPOINT 0 0 0 0.7 0.7 0 0"),
    "no z": (pcd("ascii", TEXT, FIELDS="x y depth rgb"), "has the fields x y depth rgb; expected x, y and z"),
    "x twice": (pcd("ascii", TEXT, FIELDS="x x y z"), "has the fields x x y z; expected x, y and z .* once each"),
}


@pytest.mark.parametrize("name", DAMAGED)
def test_damaged_files_say_how(tmp_path, name):
    content, message = DAMAGED[name]
    (tmp_path / "cloud.pcd").write_bytes(content)
    with pytest.raises(InputError, match=rf"cloud.pcd cannot be read as .pcd \(.*({message}).*\); save it again"):
        load_points(tmp_path / "cloud.pcd")


@pytest.mark.parametrize("name", UNSUPPORTED)
def test_features_that_are_not_read_are_named(tmp_path, name):
    content, message = UNSUPPORTED[name]
    (tmp_path / "cloud.pcd").write_bytes(content)
    with pytest.raises(InputError, match=f"cloud.pcd {message}") as error:
        load_points(tmp_path / "cloud.pcd")
    assert "save it again" not in str(error.value)


def test_missing_measurements_of_an_organised_cloud_are_counted(tmp_path):
    rows = ROWS.copy()
    rows["xyz"][3:10] = np.nan
    (tmp_path / "cloud.pcd").write_bytes(pcd("binary", rows.tobytes(), WIDTH="8", HEIGHT="5"))
    with pytest.raises(InputError, match="7 of the 40 points of .*cloud.pcd are NaN"):
        load_points(tmp_path / "cloud.pcd")


def test_unpacking_returns_what_was_packed():
    rng = np.random.default_rng(0)
    for data in (b"a", b"ab" * 500, bytes(range(256)) * 40, rng.integers(0, 3, 5000, np.uint8).tobytes(), b"\0" * 9000):
        for pack in (literal, greedy):
            assert decompress_lzf(pack(data), len(data)) == data
    # By the definition of the format: abc, then seven bytes from three back, and a long reference one back.
    assert decompress_lzf(b"\x02abc\xa0\x02", 10) == b"abcabcabca"
    assert decompress_lzf(b"\x00a\xe0\x05\x00", 15) == b"a" * 15


def test_unpacking_refuses_damage():
    for data, message in ((b"\x05ab", "ends within a run"), (b"\x00a\xe0", "ends within a reference")):
        with pytest.raises(ValueError, match=message):
            decompress_lzf(data, 10)
    with pytest.raises(ValueError, match="at least 3 bytes, and it promises 10"):
        decompress_lzf(b"\x02abc", 10)
    with pytest.raises(ValueError, match="at least 4 bytes, and it promises 2"):
        decompress_lzf(literal(b"abcd"), 2)
