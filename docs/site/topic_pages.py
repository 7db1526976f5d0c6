"""Write the pages of the topics of a recording from the types.

Each has the fields with their element types, shapes and units, and a decoder in plain mcap and NumPy, which the tests run."""

from __future__ import annotations

import inspect
from typing import Any, get_args, get_type_hints

import numpy as np

from trihedron.pipeline.core.slots import SLOTS
from trihedron.pipeline.core.table import CHUNK, Column, Table
from trihedron.pipeline.core.types import Frame, FrameReference, Map
from trihedron.pipeline.record.array_codec import SCALARS
from trihedron.pipeline.record.codec import FRAMES_TOPIC, TIMING_TOPIC
from trihedron.pipeline.record.schemas import field_text, hints_of, is_nested, own_fields
from trihedron.plugins.mapping.landmarks import empty_map
from trihedron.tools.plugins import first_sentence

NUMBERS = {bool: "bool", int: "sfixed64", float: "double", str: "string"}
DENSE = "An array of every pixel: recorded only with `record.topics=[{}]`."
ABOUT = {
    "dataset": "The images of the frames: recorded only with `record.frames=true`, and always from a camera.",
    "surface": "One message, after the last frame.",
    "building": "One message, after the last frame.",
}
IMAGE_FIELDS = """| channel | schema | |
|---|---|---|
| `/dataset/color` | `foxglove.CompressedImage` | PNG, 8 bits, RGB, (h, w, 3) |
| `/dataset/depth` | `foxglove.RawImage` | `32FC1`: float32 (h, w), metres, 0 = none |

`timestamp` and `log_time` are those of the message in [`/frames`](frames.md) that has the number and the camera."""
IMPORTS = """import numpy as np
import zstandard
from mcap.reader import make_reader
from mcap_protobuf.decoder import DecoderFactory
"""
ARRAY = """
def array(a):
    shape, data = tuple(a.shape), a.data
    if a.encoding in ("zstd", "rows"):
        data = zstandard.decompress(data)
    if a.encoding == "columns":  # the bytes of the rows, transposed
        data = np.frombuffer(data, np.uint8).reshape(-1, shape[0]).T.tobytes()
    values = np.frombuffer(data, a.dtype).reshape(shape)
    return np.cumsum(values, axis=0, dtype=np.uint8) if a.encoding == "rows" else values  # rows: steps from row to row
"""
TABLE = """
def table(t, before):  # before: the columns of this table in each earlier message
    layout, arrays = json.loads(t.layout), {a.name: array(a) for a in t.arrays}
    old, columns = before[-layout["back"]] if layout["back"] else {}, {}
    for name, (dtype, shape, _) in layout["schema"].items():
        columns[name] = np.zeros((layout["size"], *shape), dtype)
        columns[name][: len(old.get(name, ()))] = old.get(name, 0)
        if name in layout["rows"]:
            columns[name][arrays[f"rows{layout['rows'][name]}"]] = arrays[name]
        for chunk in arrays.get("emptied", ()):
            columns[name][CHUNK * chunk : CHUNK * (chunk + 1)] = 0
    before.append(columns)
    return columns
""".replace("CHUNK", str(CHUNK))
IMAGES = """from io import BytesIO

import numpy as np
from mcap.reader import make_reader
from mcap_protobuf.decoder import DecoderFactory
from PIL import Image

with open("run.mcap", "rb") as file:
    reader = make_reader(file, decoder_factories=[DecoderFactory()])
    for _, channel, _, message in reader.iter_decoded_messages(["/dataset/color", "/dataset/depth"]):
        if channel.topic == "/dataset/color":
            color = np.asarray(Image.open(BytesIO(message.data)))
        else:
            depth_m = np.frombuffer(message.data, "<f4").reshape(message.height, message.width)
"""
LOOP = """with open("run.mcap", "rb") as file:
    reader = make_reader(file, decoder_factories=[DecoderFactory()])
    for _, _, _, message in reader.iter_decoded_messages("{topic}"):
"""


def pages() -> dict[str, str]:
    """Text of each page by its place below docs/."""
    texts = {"README": overview(), **{topic: page(topic) for topic in topic_types()}}
    return {f"reference/topics/{name}.md": text for name, text in texts.items()}


def topic_types() -> dict[str, type[Any] | None]:
    """Return topic -> type of its values, in the order of the data; None for the times."""
    return {FRAMES_TOPIC: FrameReference, **{slot: _returned_type(kind) for slot, kind in SLOTS.items()}, TIMING_TOPIC.lstrip("/"): None}


def _returned_type(slot: type[Any]) -> type[Any]:
    """The type that a slot's stage returns; of a fold, what it ends with."""
    method: Any = slot.finish if hasattr(slot, "finish") else slot.__call__
    hint = get_type_hints(method)["return"]
    found: type[Any] = next((kind for kind in get_args(hint) if kind is not type(None)), hint)
    return found


def overview() -> str:
    """The list of the topics, and what their messages have in common."""
    rows = [f"| [`/{topic}`]({topic}.md) | {_schema(kind)} | {_first_line(topic, kind)} |" for topic, kind in topic_types().items()]
    return "\n\n".join([
        "# Topics of a recording",
        "`run.mcap` is an [MCAP](https://mcap.dev) file. Each topic is a channel of protobuf messages, whose schema, with these texts as comments, "
        "is in the file; `log_time` is the stamp of the frame. Nothing of Trihedron is needed to read it: each page has a decoder in plain `mcap`, "
        "`mcap-protobuf-support`, `zstandard` and NumPy.",
        "| topic | schema | |\n|---|---|---|\n" + "\n".join(rows),
        "Besides, `/tf` and `/view/…` are messages of [Foxglove's schemas](https://docs.foxglove.dev/docs/visualization/message-schemas), "
        "which Foxglove, rerun and the tools of ROS show; `/view/image` is a small `foxglove.CompressedImage`.",
        "## Arrays and tables",
        "The elements of a `trihedron.Array` have the NumPy type `dtype`, little endian; `encoding` is `raw` (row by row), `columns` (the bytes of "
        "the rows as a matrix (row, byte), transposed), `zstd` (raw under zstd) or `rows` (an image of three channels under zstd: the first row, "
        "then the difference of each row to the one above, modulo 256).",
        "A table `trihedron.Table` holds the rows that changed since an earlier message of the topic: `layout` is JSON with `size`, `back` (how many "
        "messages ago the table was that this changes; 0: this is all of it), `schema` {column: [dtype, shape, step]} and `rows` {column: k}; the "
        "arrays are a column's new rows, `rows<k>` their numbers, and `emptied` the numbers of chunks of "
        f"{CHUNK} rows that are zero again. "
        "[`map`](map.md) has the decoder. Rows that are not `alive` are no landmarks any more.",
    ]) + "\n"  # fmt: skip


def _schema(kind: type[Any] | None) -> str:
    """The schema of a topic's messages."""
    return "images of Foxglove's schemas" if kind is Frame else f"`trihedron.{kind.__name__ if kind else 'Timing'}`"


def _first_line(topic: str, kind: type[Any] | None) -> str:
    return first_sentence(inspect.cleandoc(kind.__doc__ or "")).replace("|", "\\|") + "." if kind else "Milliseconds of each stage."


def page(topic: str) -> str:
    """The page of one topic."""
    kind = topic_types()[topic]
    back = "[all topics](README.md)"
    if kind is Frame:
        return "\n\n".join([f"# `/{topic}/color`, `/{topic}/depth`: images", inspect.cleandoc(kind.__doc__ or ""), ABOUT[topic], back, "## Fields",
                            IMAGE_FIELDS, "## Decoder", _code_block(IMAGES)]) + "\n"  # fmt: skip
    if kind is None:
        text = "Times of a frame in milliseconds, of each stage that was called, and the resident memory of the process. `index` is the frame's."
        fields = (
            "| field | type |\n|---|---|\n| `index` | int64 |\n| `frame_ms` | double |\n| `stage_ms.<stage>` | double |\n| `memory_mb` | double |"
        )
        return "\n\n".join([f"# `/{topic}`: `trihedron.Timing`", text, back, "## Fields", fields, "## Decoder", _code_block(decoder(topic))]) + "\n"
    rows = [["`index`, `stamp_ns`", "int64", "number of the frame; its time, ns"], *_rows(kind, "")]
    fields = "| field | type | |\n|---|---|---|\n" + "\n".join(f"| {' | '.join(row)} |" for row in rows)
    dense = [DENSE.format(topic)] if getattr(kind, "dense", False) and topic not in ABOUT else []
    about = [ABOUT[topic]] if topic in ABOUT else dense
    about += ["Columns of the tables are explained in [landmarks.py](../../../plugins/mapping/landmarks.py)."] if topic == "map" else []
    heading = f"# `/{topic}`: `trihedron.{kind.__name__}`"
    return (
        "\n\n".join([heading, inspect.cleandoc(kind.__doc__ or ""), *about, back, "## Fields", fields, "## Decoder", _code_block(decoder(topic))])
        + "\n"
    )


def _rows(kind: Any, prefix: str) -> list[list[str]]:
    """Name, type and description of each field; those of nested values with dotted names."""
    rows = []
    for name in own_fields(kind):
        hint = hints_of(kind)[name]
        if is_nested(hint):
            rows += _rows(hint, f"{prefix}{name}.")
        else:
            text = (_columns(name) if kind is Map and hint is Table else field_text(kind, name)).replace("|", "\\|")
            rows.append([f"`{prefix}{name}`", NUMBERS.get(hint, "Table" if hint is Table else "Array"), text])
    return rows


def _columns(table: str) -> str:
    """The columns of a table of the map, with a binary descriptor of 32 bytes."""
    schema: dict[str, Column] = getattr(empty_map(0, 0, 32, 32, 48), table).schema
    return "; ".join(f"`{name}` {np.dtype(column.dtype).name} ({', '.join(map(str, ('n', *column.shape)))})" for name, column in schema.items())


def decoder(topic: str) -> str:
    """The program on a topic's page: reads every message of `run.mcap`."""
    kind: Any = topic_types()[topic]
    if kind is Frame:
        return IMAGES
    if kind is None:
        lines = ["times = {field.name: ms for field, ms in message.stage_ms.ListFields()}", "print(message.index, message.frame_ms, times)"]
        return _remove_imports(IMPORTS, ("numpy", "zstandard")) + "\n" + _loop(topic, lines)
    names = [name for name in own_fields(kind) if not is_nested(hints_of(kind)[name])]
    hints = hints_of(kind)
    tables = [name for name in names if hints[name] is Table]
    arrays = [name for name in names if name not in tables and hints[name] not in (*SCALARS.values(), str)]
    lines = [f"{name} = array(message.{name})" for name in arrays]
    lines += [f'{name} = table(message.{name}, known["{name}"])' for name in tables]
    lines += [f"{name} = message.{name}" for name in own_fields(kind) if name not in arrays and name not in tables]
    if not arrays and not tables:
        return _remove_imports(IMPORTS, ("numpy", "zstandard")) + "\n" + _loop(topic, lines)
    before = f"known = {{{', '.join(f'{chr(34)}{name}{chr(34)}: []' for name in tables)}}}\n" if tables else ""
    imports = ("import json\n\n" if tables else "") + IMPORTS
    return f"{imports}\n{ARRAY}\n{TABLE + chr(10) if tables else ''}\n{before}{_loop(topic, lines)}"


def _remove_imports(imports: str, unused: tuple[str, ...]) -> str:
    return "".join(line for line in imports.splitlines(keepends=True) if not any(name in line for name in unused))


def _loop(topic: str, lines: list[str]) -> str:
    return LOOP.format(topic=f"/{topic}") + "".join(f"        {line}\n" for line in lines)


def _code_block(program: str) -> str:
    return f"```python\n{program}```"
