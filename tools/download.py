"""Download public RGB-D sequences, unpacked into what the readers read.

Without a name it lists what there is, with the name of a collection its sequences. The addresses and, where known, the checksums are in the
program; none was verified against its publisher yet, which the list marks. The checksum of what was downloaded first is pinned in the user's cache:
an archive that changed since is refused (--repin accepts it). An interrupted download goes on where it stopped.

Example: trihedron download tum/fr3_structure_notexture_far
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cache
from importlib.resources import files
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import yaml

from trihedron.pipeline.core.errors import DataError, UsageError, did_you_mean
from trihedron.pipeline.core.text_table import table
from trihedron.tools.arguments import Parser

DEFAULT_FOLDER = Path("data")
GIGABYTE = 1e9
UNPACKED_FACTOR = 4  # of the archive's limit
CALIBRATION_FILE, CAMERA_FILE, SOURCE_FILE = "calibration.txt", "camera.yaml", "SOURCE.txt"


@dataclass(frozen=True)
class Sequence:
    """A public sequence: `collection/name`, the publisher's name and the entry of its collection in downloads.yaml."""

    collection: str
    name: str
    published: str
    entry: Mapping[str, Any]

    @property
    def full_name(self) -> str:
        """Return the name on the command line."""
        return f"{self.collection}/{self.name}"

    @property
    def archive(self) -> str:
        """Return the address of the archive; empty where only the collection's page is known."""
        return self._fill_template("archive")

    @property
    def nested(self) -> str:
        """Return the name of the archive inside the archive; empty where there is none."""
        return self._fill_template("nested")

    @property
    def folder(self) -> str:
        """Return the folder's name inside an archive that holds several sequences; empty where it holds one."""
        return self.published if self.entry.get("shared") else ""

    def _fill_template(self, key: str) -> str:
        return str(self.entry.get(key, "")).format(published=self.published, group=re.split("[_/]", self.published)[0])


def main(argv: list[str]) -> int:
    """Run the command; returns the exit code. Raises UsageError for an unknown name, DataError for what cannot be fetched or unpacked."""
    parser = Parser("download", __name__)
    parser.add_argument("names", nargs="*", metavar="NAME", help="COLLECTION/SEQUENCE; COLLECTION alone lists its sequences")
    parser.add_argument("--to", type=Path, default=DEFAULT_FOLDER, metavar="FOLDER", help=f"where to (default: {DEFAULT_FOLDER})")
    parser.add_argument("--from", dest="source", default="", metavar="FILE|ADDRESS", help="take the archive of one NAME from there")
    parser.add_argument("--max-gb", type=float, metavar="N", help="largest archive; unpacked at most four times as much (default: the collection's)")
    parser.add_argument("--repin", action="store_true", help="accept an archive whose checksum is not the pinned one, and pin it")
    parser.add_argument("--keep", action="store_true", help="keep the archive in the cache (those of several sequences are kept anyway)")
    options = parser.parse(argv)
    if not options.names or (len(options.names) == 1 and options.names[0] in catalog()):
        print(listing(options.names[0] if options.names else ""))
        return 0
    if options.source and len(options.names) > 1:
        raise UsageError("download", "--from takes one NAME", "download the others by commands of their own")
    if options.max_gb is not None and not 0.0 < options.max_gb < 10_000.0:
        raise UsageError("download", f"--max-gb {options.max_gb:g} is out of range", "give a number above 0 and below 10000")
    for sequence in [find(name) for name in options.names]:
        print(download(sequence, options.to, options.source, options.max_gb, options.repin, options.keep))
    return 0


@cache
def catalog() -> dict[str, Any]:
    """Return downloads.yaml: collection -> entry."""
    found: dict[str, Any] = yaml.safe_load(files(__package__).joinpath("downloads.yaml").read_text("utf-8"))
    return found


def sequences() -> dict[str, Sequence]:
    """Return every known sequence by its full name."""
    known = {}
    for collection, entry in catalog().items():
        listed = entry["sequences"]
        for name, published in (listed if isinstance(listed, dict) else dict(zip(listed, listed))).items():
            sequence = Sequence(collection, name, published, entry)
            known[sequence.full_name] = sequence
    return known


def find(name: str) -> Sequence:
    """Return the sequence of a full name. Raises UsageError with the closest one."""
    known = sequences()
    if name in known:
        return known[name]
    collection = name.partition("/")[0]
    candidates = [other for other in known if other.startswith(f"{collection}/")] or list(catalog())
    raise UsageError("download", f"there is no sequence '{name}'", did_you_mean(name if "/" in name else collection, candidates))


def listing(collection: str = "") -> str:
    """Return the collections as a table, or the sequences of one."""
    if not collection:
        counts = {name: sum(1 for s in sequences().values() if s.collection == name) for name in catalog()}
        rows = [("collection", "sequences", "checksums", "licence", "what")]
        rows += [(name, str(counts[name]), _trust(entry), entry["licence"], entry["title"]) for name, entry in catalog().items()]
        return table(rows, "lr") + "\n\nThe sequences of one: trihedron download COLLECTION. Nobody verified those marked so; first use pins them."
    entry = catalog()[collection]
    names = [name for name, sequence in sequences().items() if sequence.collection == collection]
    where = "" if "archive" in entry else "; no address of archives is known: fetch them from the page and give --from FILE"
    return "\n".join([f"{entry['title']}; {entry['licence']}; {entry['page']}; {_trust(entry)}{where}", *(f"  {name}" for name in names)])


def _trust(entry: Mapping[str, Any]) -> str:
    return "verified" if entry["verified"] else "not verified"


def download(sequence: Sequence, to: Path, source: str = "", max_gb: float | None = None, repin: bool = False, keep: bool = False) -> str:
    """Fetch a sequence into TO/COLLECTION/NAME, unless it is there; returns a line for people. Raises DataError."""
    from trihedron.tools.download_archive import DamagedArchive, Layout, unpack
    from trihedron.tools.download_fetch import Cache

    target = to / sequence.collection / sequence.name
    entry = sequence.entry
    use = f"trihedron run dataset={entry['dataset']} dataset.path={target}"
    if target.exists():
        return f"{sequence.full_name}: is there; {use}"
    address = source or sequence.archive
    if not address:
        raise DataError(sequence.full_name, "no address of its archive is known", f"fetch it from {entry['page']} and give --from FILE")
    limit = round((max_gb or entry["max_gb"]) * GIGABYTE)
    store = Cache.of_user()
    archive = store.fetch(address, limit, entry["sha256"].get(address, ""), repin)
    target.parent.mkdir(parents=True, exist_ok=True)
    with TemporaryDirectory(dir=target.parent, prefix=".unpacking-") as temporary:
        folder = Path(temporary) / target.name  # readers look at the name
        try:
            layout = Layout(entry["marker"], sequence.folder, sequence.nested, tuple(entry.get("also", ())))
            unpack(archive.path, folder, layout, UNPACKED_FACTOR * limit)
        except DamagedArchive:
            store.discard(archive)
            raise
        _write_camera(folder, entry.get("camera"))
        _write_source(folder, sequence, address, archive.sha256)
        frames = _frames(sequence, folder)
        folder.rename(target)
    store.pin(archive)
    if not (keep or entry.get("shared")):
        store.discard(archive)
    return f"{sequence.full_name}: {frames} frames in {target}; SHA-256 {archive.sha256[:12]}… ({_trust(entry)}); {use}"


def _write_source(folder: Path, sequence: Sequence, address: str, sha256: str) -> None:
    entry = sequence.entry
    lines = [f"{entry['title']}: {sequence.published}", f"from {address}", f"SHA-256 of the archive {sha256} ({_trust(entry)})"]
    (folder / SOURCE_FILE).write_text("\n".join([*lines, f"licence: {entry['licence']}; {entry['page']}", ""]))


def _write_camera(target: Path, camera: Any) -> None:
    """Write the camera.yaml that the reader needs, from the catalog or from the publisher's calibration.txt (fx fy cx cy)."""
    if camera is None or (target / CAMERA_FILE).exists():
        return
    if camera == CALIBRATION_FILE:
        camera = _read_calibration(target)
    (target / CAMERA_FILE).write_text(yaml.safe_dump(dict(camera), sort_keys=False, default_flow_style=False))


def _read_calibration(target: Path) -> dict[str, Any]:
    from trihedron.datasets.readers.images import read_color
    from trihedron.pipeline.core.files import MAX_YAML_BYTES, one_line_errors, read_text

    path, cure = target / CALIBRATION_FILE, f"write a {CAMERA_FILE} there"
    with one_line_errors(str(path), cure):  # the archive is a stranger's
        words = read_text(path, MAX_YAML_BYTES).split()
        image = next((target / "rgb").glob("*.png"), None)
        if len(words) != 4 or image is None:
            raise DataError(str(path), "does not hold fx fy cx cy beside images in rgb/", cure)
        values = dict(zip(("fx", "fy", "cx", "cy"), map(float, words)))
        height, width = read_color(image).shape[:2]
    return {"width": width, "height": height, **values, "depth_scale": 5000.0}


def _frames(sequence: Sequence, folder: Path) -> int:
    """Open the folder with its reader, and return its number of frames. Raises DataError when the reader refuses it."""
    from trihedron.pipeline.core.registry import load_plugins, plugin_class

    load_plugins()
    try:
        return len(plugin_class("dataset", sequence.entry["dataset"])(path=str(folder)))
    except DataError as error:
        raise DataError(sequence.full_name, f"its archive is not as expected: {error.cause}", error.cure) from error
