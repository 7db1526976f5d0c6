"""Values come back bit for bit; damaged bytes are refused in one line."""

import contextlib
import json
import tracemalloc
from dataclasses import replace
from pathlib import Path

import lz4.frame
import numpy as np
import pytest
import zstandard

from trihedron.pipeline.core.errors import RecordingError
from trihedron.pipeline.core.table import CHUNK, Column, Table
from trihedron.pipeline.core.types import CalibrationSigmas, Camera, DepthNoise, Frame, FrameReference, Keypoints, Map, Planes, Pose, Rotation
from trihedron.pipeline.record.codec import Decoder, Encoder, LegacyMessage, builds_on
from trihedron.pipeline.record.schemas import message_class
from trihedron.pipeline.record.table_codec import CHECKPOINT_EVERY, MAX_CHECKPOINTS

RNG = np.random.default_rng(0)


def keypoints(n=20):
    floats = [RNG.random(shape, dtype=np.float32) for shape in ((n, 2), (n, 3), (n,), (n,), (n,))]
    floats[1][::3] = np.nan
    octaves, descriptors = RNG.integers(0, 8, n, dtype=np.uint8), RNG.integers(0, 255, (n, 32), dtype=np.uint8)
    return Keypoints(7, 2**40, *floats[:4], octaves, floats[4], descriptors, "hamming")


def differing(a, b):
    """The fields that are not the same, bit for bit; those of tables by their columns."""
    assert type(a) is type(b)
    return [name for name in vars(a) if not same(getattr(a, name), getattr(b, name))]


def same(x, y):
    if isinstance(x, np.ndarray):
        return x.dtype == y.dtype and x.shape == y.shape and x.tobytes() == y.tobytes()
    if isinstance(x, Table):
        return x.size == y.size and all(np.array_equal(x.column(c), y.column(c)) for c in x.schema)
    return x == y


def there_and_back(value):
    return Decoder("file: topic /x").decode(Encoder().encode(value))


def test_arrays_scalars_text_and_nested_values():
    for n in (0, 1, 300):
        value = keypoints(n)
        assert differing(value, there_and_back(value)) == []
    color, depth = RNG.integers(0, 255, (48, 64, 3), dtype=np.uint8), RNG.random((48, 64), dtype=np.float32)
    depth[3, 4] = 0.0
    frame = Frame(1, 2, color, depth, Camera(64, 48, 50.0, 51.0, 31.5, 23.5, 15.0, DepthNoise(floor_m=0.002)))
    assert differing(frame, there_and_back(frame)) == []
    none = np.empty((0, 3, 3))
    rotation = Rotation(1, 2, np.eye(3), np.eye(3), none, none, np.empty(0, np.int32), np.empty(0), "tracks")
    assert differing(rotation, there_and_back(rotation)) == []


def test_a_nested_value_that_an_older_message_lacks_is_its_default():
    camera = Camera(64, 48, 50.0, 51.0, 31.5, 23.5, sigmas=CalibrationSigmas(focal=0.0))
    message = message_of(FrameReference(1, 2, camera))
    assert there_and_back(FrameReference(1, 2, camera)).camera.sigmas.focal == 0.0
    message.camera.ClearField("sigmas")
    assert Decoder("file: topic /frames").decode(message.SerializeToString()).camera.sigmas == CalibrationSigmas()


def test_large_arrays_of_every_element_type_and_shape():
    """Those that are transposed, and those of one column, which have as many bytes a row as elements have."""
    for n in (1024, 2000):
        value = keypoints(n)
        message = message_of(value)
        assert message.pixels.encoding == "columns"
        assert differing(value, there_and_back(value)) == []
    whole = next(iter(maps(1)))
    table, _ = Table.empty({"i": Column("i8"), "m": Column("f8", (3, 3))}).appended(i=np.arange(600) - 300, m=RNG.random((600, 3, 3)))
    assert differing(replace(whole, points=table), there_and_back(replace(whole, points=table))) == []


def test_symmetric_matrices_shrink():
    """Equal columns are runs of equal bytes after transposition: a third less, and the high bytes less still."""
    root = RNG.random((500, 3, 3))
    data = message_of(planes(500, root @ np.swapaxes(root, 1, 2))).covariance.data
    assert len(lz4.frame.compress(data)) < 0.7 * len(data) and len(data) == 500 * 72


def planes(n, covariance):
    f8, labels = np.zeros, np.zeros((2, 2), np.uint8)
    return Planes(0, 0, f8((n, 4)), covariance, f8((n, 4, 4)), np.zeros(n, np.int32), np.zeros((n, 4, 3), np.float32), labels, 2)


def test_label_images_are_stored_small():
    labels = np.zeros((240, 320), np.uint8)
    labels[50:150, 60:200] = 1
    f8 = np.zeros
    planes = Planes(0, 0, f8((1, 4)), f8((1, 3, 3)), f8((1, 4, 4)), np.zeros(1, np.int32), np.zeros((1, 48, 3), np.float32), labels, 2)
    assert len(Encoder().encode(planes)) < 3000
    assert differing(planes, there_and_back(planes)) == []


def test_a_colour_image_is_stored_by_the_steps_between_its_rows():
    """Of a shade that goes on downwards almost nothing is left; any image comes back; bytes that do not fit the shape are refused."""
    camera, depth = Camera(64, 48, 50.0, 51.0, 31.5, 23.5, 15.0), np.ones((48, 64), np.float32)
    shade = (RNG.integers(0, 255, (1, 64, 3)) + 7 * np.arange(48)[:, None, None]).astype(np.uint8)  # past 255 and on from 0
    sizes = []
    for color in (shade, RNG.integers(0, 255, (48, 64, 3), dtype=np.uint8)):
        value = Frame(1, 2, color, depth, camera)
        assert differing(value, there_and_back(value)) == []
        message = message_of(value)
        array = message.color
        sizes.append(len(array.data))
        for shape in ((48, 64, 4), (47, 64, 3), (48 * 64 * 3,), (48, 64)):
            array.shape[:] = shape
            assert "array 'color' does not have the" in refusal(message)
    assert array.encoding == "rows" and sizes[0] < 400 and sizes[1] > 9000


def test_a_column_s_step_is_told():
    whole = next(iter(maps(1)))
    table, _ = Table.empty({"x": Column("f8", (3,), 2.0**-20)}).appended(x=RNG.random((300, 3)))
    value = replace(whole, points=table)
    found = there_and_back(value)
    assert differing(value, found) == [] and found.points.schema == table.schema
    for wrong in ("-1.0", "NaN", '"0.5"', "0.5, 2"):
        message = message_of(value)
        message.points.layout = message.points.layout.replace("9.5367431640625e-07", wrong)
        assert "Map does not fit: " in refusal(message)


def maps(count):
    """Successive versions of a map whose points grow and change."""
    empty = Table.empty({"x": Column("f8")})
    points = Table.empty({"position_m": Column("f8", (3,)), "alive": Column("?")})
    for i in range(count):
        if i:
            points = points.updated(np.array([i - 1]), position_m=np.full((1, 3), -float(i)))
        points, _ = points.appended(position_m=np.full((100, 3), float(i)), alive=np.ones(100, bool))
        yield Map(i, i, i, empty, points, empty, empty, empty, empty, empty)


def test_tables_are_written_as_changes_and_rebuilt():
    encoder, decoder = Encoder(), Decoder("file: topic /map")
    sizes, backs = [], []
    for value in maps(3 * CHECKPOINT_EVERY + 5):
        message = encoder.encode(value)
        sizes.append(len(message))
        backs.append(builds_on(message))
        assert differing(value, decoder.decode(message)) == []
    assert max(sizes[20:CHECKPOINT_EVERY]) < 25_000  # a chunk or two, however large the map
    assert {i: back for i, back in enumerate(backs) if back != 1} == {k * CHECKPOINT_EVERY: [0, 0, 64, 64][k] for k in range(4)}
    assert sizes[CHECKPOINT_EVERY] > 150_000  # whole again: nearly all of it is new
    assert sizes[3 * CHECKPOINT_EVERY] < 1.2 * sizes[CHECKPOINT_EVERY]  # the map is three times as large, what changed is as much


def chain(messages, last):
    """The messages that the last one builds on, itself among them."""
    found = [last]
    while back := builds_on(messages[found[-1]]):
        found.append(found[-1] - back)
    return [messages[k] for k in reversed(found)]


def test_a_value_is_read_from_few_messages():
    """Of 4000 versions any is had from those since its checkpoint, and the checkpoints since the whole."""
    values, encoder = [], Encoder()
    table, ids = Table.empty({"x": Column("f8", (2,)), "alive": Column("?")}).appended(x=RNG.random((3000, 2)), alive=np.ones(3000, bool))
    for k in range(4000):
        if k % 7 == 3:
            table, _ = table.appended(x=RNG.random((20, 2)), alive=np.ones(20, bool))
        table = table.updated(ids[[k % 3000, 5]], x=RNG.random((2, 2)))
        if k in (100, 2500):
            table = table.emptied(np.array([1, 3]) + k // 1000)
        if k == 3000:
            table = table.updated(np.array([300]), alive=np.ones(1, bool))  # in a chunk that was given back
        values.append(replace(next(iter(maps(1))), points=table))
    messages = [encoder.encode(value) for value in values]
    for k in (0, 1, 63, 64, 99, 100, 127, 500, 1023, 1024, 2499, 2501, 2999, 3000, 3063, 3999):
        found = chain(messages, k)
        assert len(found) <= MAX_CHECKPOINTS + CHECKPOINT_EVERY
        value = Decoder("x").decode_last(found)
        assert differing(values[k], value) == []
        assert [value.points.is_empty(i) for i in range(12)] == [values[k].points.is_empty(i) for i in range(12)]
    wholes = [k for k, message in enumerate(messages) if builds_on(message) == 0]
    assert wholes == list(range(0, 4000, MAX_CHECKPOINTS * CHECKPOINT_EVERY))
    with pytest.raises(RecordingError, match="a change without the version before it"):
        Decoder("x").decode_last(found[1:])
    with pytest.raises(RecordingError, match="does not fit"):
        Decoder("x").decode_last([*found[:-8], found[-1]])  # rows of those left out are missing
    decoder = Decoder("x")
    for message in (*messages[:64], messages[65]):
        decoder.decode(message)
    with pytest.raises(RecordingError, match="a change without the version before it"):
        decoder.decode(messages[128])


def test_copied_fields_stay_in_rows():
    """A point of the key points is, in the tracks of the next frame, the same twelve bytes."""
    message = message_of(keypoints(300))
    assert message.points_m.encoding == "raw" and len(message.points_m.data) == 3600


def test_chunks_that_were_given_back_are_not_written_and_stay_given_back():
    """A table of which all but the newest 600 rows are dead, however many there were; one chunk was begun, filled and given back between messages."""
    encoder, decoder = Encoder(), Decoder("file: topic /map")
    table, sizes = Table.empty({"x": Column("f8", (3,)), "alive": Column("?")}), []
    for count in (*range(100, 200), 3 * CHUNK, 5):
        table, _ = table.appended(x=RNG.random((count, 3)), alive=np.ones(count, bool))
        table = table.emptied(np.arange(max(len(table) - 600, 0) // CHUNK))
        value = replace(next(iter(maps(1))), points=table)
        message = encoder.encode(value)
        sizes.append(len(message))
        found = decoder.decode(message)
        assert differing(value, found) == []
        assert [found.points.is_empty(k) for k in range(len(table) // CHUNK)] == [table.is_empty(k) for k in range(len(table) // CHUNK)]
        assert differing(value, there_and_back(value)) == []  # whole
    assert len(table) > 14_000 and max(sizes) < 35_000
    for wrong in ([0, 0], [-1], [len(table) // CHUNK]):
        message = message_of(value)
        kept = [array for array in message.points.arrays if array.name != "emptied"]
        del message.points.arrays[:]
        message.points.arrays.extend(kept)
        message.points.arrays.add(name="emptied", dtype="i4", shape=[len(wrong)], encoding="raw", data=np.array(wrong, np.int32).tobytes())
        with pytest.raises(RecordingError, match="does not fit"):
            Decoder("x").decode(message.SerializeToString())


def test_of_a_touched_chunk_only_the_rows_that_changed_are_written():
    table, ids = Table.empty({"x": Column("f8", (8,))}).appended(x=np.arange(2000.0).reshape(250, 8))
    encoder, decoder = Encoder(), Decoder("x")
    whole = next(iter(maps(1)))
    decoder.decode(encoder.encode(replace(whole, points=table)))
    moved = table.updated(ids[[3, 77, 200]], x=np.full((3, 8), -1.0))
    grown, _ = moved.appended(x=np.zeros((20, 8)))  # fills the chunk and begins the next
    for version, rows in ((moved, [3, 77, 200]), (grown, [*range(250, 270)])):
        message = message_class("Map").FromString(encoder.encode(replace(whole, points=version)))
        written = {array.name: array for array in message.points.arrays}
        assert set(written) == {"x", "rows0"} and len(written["x"].data) == 64 * len(rows)
        assert np.frombuffer(written["rows0"].data, np.int32).tolist() == rows
        assert differing(replace(whole, points=version), decoder.decode(message.SerializeToString())) == []
    message = message_class("Map").FromString(encoder.encode(replace(whole, points=grown.updated(ids[:1], x=np.ones((1, 8))))))
    for array in message.points.arrays:
        if array.name == "rows0":
            array.data = b"\xff" * 4
    with pytest.raises(RecordingError, match="Map does not fit"):
        decoder.decode(message.SerializeToString())


@pytest.mark.parametrize("rows", [[3, 3, 200], [77, 3, 200], [-1, 3, 200]])
def test_rows_that_are_listed_twice_or_out_of_order_are_refused(rows):
    """However the message is read: which of two values a row has would depend on the reader."""
    table, ids = Table.empty({"x": Column("f8", (8,))}).appended(x=np.arange(2000.0).reshape(250, 8))
    encoder, decoder, whole = Encoder(), Decoder("x"), next(iter(maps(1)))
    first = encoder.encode(replace(whole, points=table))
    decoder.decode(first)
    message = message_class("Map").FromString(encoder.encode(replace(whole, points=table.updated(ids[[3, 77, 200]], x=np.zeros((3, 8))))))
    next(array for array in message.points.arrays if array.name == "rows0").data = np.array(rows, np.int32).tobytes()
    changed = message.SerializeToString()
    for read in (lambda: decoder.decode(changed), lambda: Decoder("x").decode_last([first, changed])):
        with pytest.raises(RecordingError, match=r"^x: frame \d+: Map does not fit: points\.x: rows of another size"):
            read()


def test_changes_depend_on_values_not_on_who_holds_them():
    versions = list(maps(3))
    copies = [Decoder("x").decode(Encoder().encode(v)) for v in versions]
    one, two = Encoder(), Encoder()
    for version, copy in zip(versions, copies):
        assert one.encode(version) == two.encode(copy)


def test_the_messages_are_those_of_the_library():
    """Written field by field, they are what the protobuf library reads, and what it writes is read; also zeros, empty arrays and large numbers."""
    frame = Frame(0, -(2**62), np.zeros((48, 64, 3), np.uint8), np.ones((48, 64), np.float32), Camera(64, 48, 50.0, 51.0, 31.5, 23.5))
    pose = Pose(2**40, 2**62, np.eye(4), np.eye(6), np.eye(4), -1, np.zeros(3, np.int32), 0, "lost", "where is — ‘it’?")
    for value in (keypoints(0), keypoints(300), frame, pose, *maps(1)):
        message = message_of(value)
        assert (message.index, message.stamp_ns, message.version) == (value.index, value.stamp_ns, value.version)
        assert differing(value, Decoder("x").decode(message.SerializeToString())) == []
    assert message_of(frame).camera.fx == 50.0 and message_of(pose).reason == pose.reason and message_of(pose).submap == 0


def message_of(value):
    return message_class(type(value).__name__).FromString(Encoder().encode(value))


def refusal(message):
    with pytest.raises(RecordingError) as error:
        Decoder("a.mcap: topic /keypoints").decode(message if isinstance(message, bytes) else message.SerializeToString())
    return str(error.value)


def test_damaged_and_foreign_values_are_refused():
    assert refusal(b"\xff\xff\xff") == (
        "a.mcap: topic /keypoints: holds a message that is no value of trihedron; the file is damaged; record it again"
    )
    message = message_of(keypoints())
    message.type = "Keypoint"
    assert refusal(message) == "a.mcap: topic /keypoints: holds the unknown type 'Keypoint'; read it with the version that wrote it"
    message = message_of(keypoints())
    message.version = 9
    assert refusal(message) == (
        "a.mcap: topic /keypoints: holds Keypoints version 9, this program reads version 1; read it with the version that wrote it"
    )
    message = message_of(keypoints())
    message.ClearField("sigma_px")
    assert refusal(message) == "a.mcap: topic /keypoints: frame 7: Keypoints does not fit: 'sigma_px'; the file is damaged; record it again"
    message = message_of(keypoints())
    message.pixels.shape[0] = 1 << 50
    assert refusal(message) == (
        "a.mcap: topic /keypoints: array 'pixels' claims type 'f4' and shape (1125899906842624, 2); the file is damaged; record it again"
    )
    for text in (",1", "f4,f4", "i4, (2)f8", "O", "M8[ns]", "V16", "(2,)f4"):  # some of which NumPy evaluates
        message = message_of(keypoints())
        message.pixels.dtype = text
        assert f"array 'pixels' claims type '{text}' and shape (20, 2)" in refusal(message)
        message = message_of(next(iter(maps(1))))
        message.points.layout = message.points.layout.replace('"?"', json.dumps(text))
        assert f"a column of type {text!r}" in refusal(message)
    message = message_of(keypoints())
    message.points_m.shape[0] = 19
    assert refusal(message) == (
        "a.mcap: topic /keypoints: array 'points_m' does not have the 228 bytes of its shape (19, 3); the file is damaged; record it again"
    )
    message = message_of(keypoints())
    message.pixels.encoding = "zstd_planes"
    assert refusal(message) == (
        "a.mcap: topic /keypoints: array 'pixels' has the encoding 'zstd_planes', this program reads raw, columns, zstd, rows; "
        "read it with the version that wrote it"
    )
    message = message_of(keypoints())
    message.pixels.dtype = "str"
    assert "frame 7: Keypoints does not fit" in refusal(message)
    change = list(maps(2))
    encoder = Encoder()
    encoder.encode(change[0])
    assert "keyframes: a change without the version before it" in refusal(encoder.encode(change[1]))


LEARNED = ("calibration_information", "calibration_score")


def test_a_value_of_an_older_version_names_the_version_and_the_fields():
    """As `Pose` was before sub-maps, with a field that there is no more."""
    message = legacy("pose")
    message.version = 1
    later = {
        *LEARNED,
        "disagreement",
        "submap",
        "unrecognised",
        "map_covariance",
        "noise_scale",
        "repeats",
        "sensitivity",
        "relative_sensitivity",
        "twist",
    }
    later |= {"reference_twist", "keyframe_covariance", "lost_from", "missing", "depth_scale_sigma", "turn_difference", "usual_turn_difference"}
    later |= {"plane_offsets", "turn_by_lag"}
    kept = [array for array in message.arrays if array.name not in later]
    del message.arrays[:]
    message.arrays.extend([*kept, type(kept[0])(name="quality", dtype="float", encoding="raw", data=bytes(8))])
    assert refusal(message) == (
        "a.mcap: topic /keypoints: holds Pose version 1, this program reads version 11, with the field 'calibration_information', "
        "'calibration_score', 'confirmations', 'depth_disagreement', 'depth_scale_sigma', 'disagreement', 'jumps', 'keyframe_covariance', "
        "'lost_from', 'map_covariance', 'missing', "
        "'noise_scale', 'plane_offsets', 'reference_twist', "
        "'relative_sensitivity', 'repeats', 'scale_difference', 'sensitivity', 'submap', 'turn_by_lag', 'turn_difference', 'twist', 'unrecognised', "
        "'usual_accelerations', 'usual_depth_disagreement', 'usual_turn_difference' "
        "that it lacks, "
        "without its field 'quality'; upgrade what can be read of it with: trihedron convert SRC DST.mcap"
    )


def test_an_image_that_claims_to_be_larger_than_its_shape_is_not_decoded():
    color = RNG.integers(0, 255, (48, 64, 3), dtype=np.uint8)
    frame = Frame(1, 2, color, np.zeros((48, 64), np.float32), Camera(64, 48, 50.0, 51.0, 31.5, 23.5))
    for name, size in (("color", 9216), ("depth_m", 12288)):
        for data in (zstandard.compress(bytes(1 << 24)), zstandard.compress(bytes(16)), b"no frame of zstd", b""):
            message = message_of(frame)
            getattr(message, name).data = data
            assert f"array '{name}' does not have the {size} bytes" in refusal(message)


@pytest.mark.parametrize("cut", [False, True])
def test_random_damage_never_raises_anything_else(cut):
    """Of 2000 values with three bytes changed, some can be read still; of those cut off besides, none."""
    data = Encoder().encode(keypoints())
    rng, read = np.random.default_rng(1), 0
    for _ in range(2000):
        damaged = bytearray(data)
        for at in rng.integers(0, len(data), 3):
            damaged[at] = rng.integers(0, 256)
        with contextlib.suppress(RecordingError):
            Decoder("x").decode(bytes(damaged[: rng.integers(1, len(data)) if cut else None]))
            read += 1
    assert read == 0 if cut else 0 < read < 2000


def legacy(kind):
    """A message of format 4."""
    return LegacyMessage.FromString((Path(__file__).parents[1] / "fuzz" / "seeds" / f"message_legacy_{kind}").read_bytes()[1:])


SHAPES = [[], [-1], [1] * 65, [0] * 65, [2**62] * 20, [0] + [2**62] * 20, [0, 2**62], [2**63 - 1, 0], [10**6, 0, 10**6]]


def test_an_array_is_of_one_gibibyte_at_most():
    """A shape of so many bytes is looked for, the next larger one is refused at once."""
    for rows, cause in ((1 << 27, "does not have the 1073741824 bytes of its shape"), ((1 << 27) + 1, "claims type 'f4' and shape")):
        message = message_of(keypoints())
        message.pixels.shape[0] = rows
        assert f"array 'pixels' {cause} ({rows}, 2)" in refusal(message)


@pytest.mark.parametrize("encoding", ["raw", "columns", "zstd", "rows"])
@pytest.mark.parametrize("shape", SHAPES, ids=lambda shape: f"{len(shape)} axes {max(shape, default=None)}")
def test_a_shape_that_no_array_has_is_one_line(shape, encoding):
    old, new = legacy("keypoints"), message_of(keypoints())
    for message, array in ((old, old.arrays[0]), (new, new.pixels)):
        array.data, array.encoding = bytes(0 if shape else 4), encoding
        array.shape[:] = shape
        cause = r"^x: (array 'pixels' (claims|does not have the 4 bytes)|frame \d: Keypoints does not fit)"
        with pytest.raises(RecordingError, match=cause):
            Decoder("x").decode(message.SerializeToString())


HEADERS = {  # text of a table's header, cause
    "[" * 100_000: "recursion",
    '{"a":' * 100_000: "recursion",
    '{"size": [1], "back": 0, "schema": {}, "rows": {}}': "not 'list'",
    '{"size": 1e999, "back": 0, "schema": {}, "rows": {}}': "cannot convert float infinity to integer",
    f'{{"size": {"9" * 5000}, "back": 0, "schema": {{}}, "rows": {{}}}}': "the limit \\(4300",
    '{"size": 0, "back": 1e999, "schema": {}, "rows": {}}': "cannot convert float infinity to integer",
    '{"size": 100000000, "back": 0, "schema": {}, "rows": {}}': "keyframes: rows are missing",
    '{"size": 1000000000, "back": 0, "schema": {}, "rows": {}}': "keyframes: a table of 1000000000 rows",
    '{"size": 0, "back": 0, "schema": {"a": ["f8", [4611686018427387904, 4611686018427387904], 0]}, "rows": {}}': "too big",
    "null": "not subscriptable",
}


@pytest.mark.parametrize("header", HEADERS, ids=lambda text: text[:50])
def test_a_table_whose_header_is_no_header_is_one_line(header):
    """Nothing is allocated for rows that are not there."""
    map = next(iter(maps(1)))
    old, new = legacy("map"), message_of(map)
    old.version = map.version
    next(array for array in old.arrays if array.name == "keyframes#").data = header.encode()
    new.keyframes.layout = header
    for message in (old, new):
        data = message.SerializeToString()
        tracemalloc.start()
        try:
            with pytest.raises(RecordingError, match=rf"^x: frame \d+: Map does not fit: .*{HEADERS[header]}") as caught:
                Decoder("x").decode(data)
            assert tracemalloc.get_traced_memory()[1] < 20e6 and len(str(caught.value)) < 400
        finally:
            tracemalloc.stop()
