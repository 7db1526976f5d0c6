"""`trihedron download`, against a server on the loopback interface with archives of the published layouts."""

from __future__ import annotations

import io
import json
import re
import tarfile
import threading
import zipfile
from collections.abc import Callable, Iterator
from contextlib import suppress
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path

import cv2
import numpy as np
import pytest

from trihedron.pipeline.core.errors import DataError, TrihedronError, UsageError
from trihedron.tools import download as command
from trihedron.tools.download_archive import Layout, unpack

TUM = "tum/fr3_structure_notexture_far"
POSE = "1 0 0 0\n0 1 0 0\n0 0 1 0\n0 0 0 1\n"


class Server:
    """Files by path; `cut` closes the connection after so many bytes of a body, `ranges` are the ranges asked for."""

    def __init__(self) -> None:
        self.files: dict[str, bytes] = {}
        self.cut: int | None = None
        self.ranges: list[str | None] = []
        self.length_stated = True
        parent = self

        class Handler(BaseHTTPRequestHandler):
            def do_GET(self) -> None:
                parent.answer(self)

            def log_message(self, *_: object) -> None:
                pass

        self.httpd = ThreadingHTTPServer(("127.0.0.1", 0), Handler)
        threading.Thread(target=self.httpd.serve_forever, daemon=True).start()

    def answer(self, handler: BaseHTTPRequestHandler) -> None:
        data = self.files.get(handler.path)
        if data is None:
            handler.send_error(404)
            return
        tag, asked = f'"{hash(data)}"', handler.headers.get("Range")
        self.ranges.append(asked)
        begin = int(re.findall(r"\d+", asked)[0]) if asked and handler.headers.get("If-Range") == tag else 0
        handler.send_response(206 if begin else 200)
        handler.send_header("ETag", tag)
        if begin:
            handler.send_header("Content-Range", f"bytes {begin}-{len(data) - 1}/{len(data)}")
        if self.length_stated:
            handler.send_header("Content-Length", str(len(data) - begin))
        handler.end_headers()
        with suppress(BrokenPipeError, ConnectionResetError):  # the client leaves what is too large
            handler.wfile.write(data[begin : len(data) if self.cut is None else begin + self.cut])

    def address(self, path: str, data: bytes) -> str:
        self.files[path] = data
        return f"http://127.0.0.1:{self.httpd.server_address[1]}{path}"


@pytest.fixture
def server(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Iterator[Server]:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("TRIHEDRON_DOWNLOADS", str(tmp_path / "cache"))
    monkeypatch.setenv("NO_PROXY", "127.0.0.1")
    running = Server()
    yield running
    running.httpd.shutdown()
    running.httpd.server_close()


def png(dtype: type, size: tuple[int, int] = (480, 640)) -> bytes:
    shape = (*size, 3) if dtype is np.uint8 else size
    image = np.full(shape, 200, dtype)
    image[:80, :80] = np.random.default_rng(0).integers(0, 255, image[:80, :80].shape)
    return cv2.imencode(".png", image)[1].tobytes()


def tum_files(folder: str, size: tuple[int, int] = (480, 640)) -> dict[str, bytes]:
    stamps = [f"134169{k}.100000" for k in range(3)]
    files = {f"{folder}/{kind}/{s}.png": png(np.uint8 if kind == "rgb" else np.uint16, size) for kind in ("rgb", "depth") for s in stamps}
    lists = {kind: "# images\n" + "".join(f"{s} {kind}/{s}.png\n" for s in stamps) for kind in ("rgb", "depth")}
    files |= {f"{folder}/{kind}.txt": text.encode() for kind, text in lists.items()}
    return files | {f"{folder}/groundtruth.txt": "".join(f"{s} 0 0 0 0 0 0 1\n" for s in stamps).encode(), f"{folder}/accelerometer.txt": b"# none\n"}


def icl_files() -> dict[str, bytes]:
    files = {f"./{kind}/{k}.png": png(np.uint8 if kind == "rgb" else np.uint16) for kind in ("rgb", "depth") for k in range(3)}
    lines = "".join(f"{k} depth/{k}.png {k} rgb/{k}.png\n" for k in range(3))
    return files | {"./associations.txt": lines.encode(), "./livingRoom0n.gt.freiburg": b"1 0 0 -2.25 0 0 0 1\n2 0 0 -2.24 0 0 0 1\n"}


def seven_scenes_files(sequence: str) -> dict[str, bytes]:
    files = {}
    for k in range(2):
        files |= {f"{sequence}/frame-{k:06}.color.png": png(np.uint8), f"{sequence}/frame-{k:06}.depth.png": png(np.uint16)}
        files[f"{sequence}/frame-{k:06}.pose.txt"] = POSE.encode()
    return files


def replica_files() -> dict[str, bytes]:
    camera = {"camera": {"w": 640, "h": 480, "fx": 600.0, "fy": 600.0, "cx": 319.5, "cy": 239.5, "scale": 6553.5}}
    files = {"Replica/cam_params.json": json.dumps(camera).encode(), "Replica/room0_mesh.ply": b"ply\n"}
    color = cv2.imencode(".jpg", np.full((480, 640, 3), 90, np.uint8))[1].tobytes()
    for scene in ("office0", "room0"):
        files[f"Replica/{scene}/traj.txt"] = ("1 0 0 0 0 1 0 0 0 0 1 0 0 0 0 1\n" * 2).encode()
        for k in range(2):
            files |= {f"Replica/{scene}/results/frame{k:06}.jpg": color, f"Replica/{scene}/results/depth{k:06}.png": png(np.uint16)}
    return files


def tgz(files: dict[str, bytes]) -> bytes:
    out = io.BytesIO()
    with tarfile.open(fileobj=out, mode="w:gz") as archive:
        for name, data in files.items():
            member = tarfile.TarInfo(name)
            member.size = len(data)
            archive.addfile(member, io.BytesIO(data))
    return out.getvalue()


def zipped(files: dict[str, bytes]) -> bytes:
    out = io.BytesIO()
    with zipfile.ZipFile(out, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, data in files.items():
            archive.writestr(name, data)
    return out.getvalue()


LAYOUTS: dict[str, tuple[str, Callable[[], bytes], int]] = {
    TUM: ("/f3.tgz", lambda: tgz(tum_files("rgbd_dataset_freiburg3_structure_notexture_far")), 3),
    "icl_nuim/lr_kt0n": ("/living_room_traj0n_frei_png.tar.gz", lambda: tgz(icl_files()), 3),
    "seven_scenes/chess/seq-02": (
        "/chess.zip",
        lambda: zipped({f"chess/seq-0{k}.zip": zipped(seven_scenes_files(f"seq-0{k}")) for k in (1, 2)} | {"chess/TrainSplit.txt": b"sequence1\n"}),
        2,
    ),
    "replica/room0": ("/Replica.zip", lambda: zipped(replica_files()), 2),
    "bonn/balloon": ("/rgbd_bonn_balloon.zip", lambda: zipped(tum_files("rgbd_bonn_balloon")), 3),
    "eth3d/plant_1": (
        "/plant_1_rgbd.zip",
        lambda: zipped(tum_files("plant_1", (458, 739)) | {"plant_1/calibration.txt": b"726.2 726.2 354.6 186.4\n"}),
        3,
    ),
}


@pytest.mark.parametrize("name", LAYOUTS)
def test_every_published_layout_is_unpacked_into_what_its_reader_reads(name: str, server: Server, capsys: pytest.CaptureFixture[str]) -> None:
    path, data, frames = LAYOUTS[name]
    address = server.address(path, data())
    assert command.main([name, "--from", address]) == 0
    said = capsys.readouterr().out
    assert f"{name}: {frames} frames in data/{name}; SHA-256 " in said and "(not verified)" in said
    assert f"trihedron run dataset={command.find(name).entry['dataset']} dataset.path=data/{name}" in said
    assert not [path for path in Path("data").rglob(".*")] and address in Path(f"data/{name}/SOURCE.txt").read_text()
    assert command.main([name]) == 0
    assert capsys.readouterr().out.startswith(f"{name}: is there; ") and len(server.ranges) == 1


def test_a_camera_is_written_where_the_archive_has_none(server: Server) -> None:
    for name in ("bonn/balloon", "eth3d/plant_1"):
        path, data, _ = LAYOUTS[name]
        command.main([name, "--from", server.address(path, data())])
    assert "fx: 542.822841" in Path("data/bonn/balloon/camera.yaml").read_text()
    assert Path("data/eth3d/plant_1/camera.yaml").read_text().startswith("width: 739\nheight: 458\nfx: 726.2\n")


def test_only_its_own_sequence_comes_out_of_an_archive_of_several(server: Server, tmp_path: Path) -> None:
    path, data, _ = LAYOUTS["replica/room0"]
    address = server.address(path, data())
    command.main(["replica/room0", "--from", address])
    assert sorted(file.name for file in Path("data/replica/room0").iterdir()) == ["SOURCE.txt", "cam_params.json", "results", "traj.txt"]
    command.main(["replica/office0", "--from", address])
    assert len(server.ranges) == 1 and list((tmp_path / "cache").glob("*Replica.zip"))  # kept, for its other sequences


def failure(words: list[str]) -> str:
    with pytest.raises(TrihedronError) as caught:
        command.main(words)
    return str(caught.value)


def test_an_interrupted_download_goes_on_where_it_stopped(server: Server) -> None:
    data = LAYOUTS[TUM][1]()
    address = server.address("/f3.tgz", data)
    server.cut = 20_000
    cause = f"{address}: the download was interrupted after 0.0 of {len(data) / 1e6:.1f} MB; the same command again goes on from there"
    assert failure([TUM, "--from", address]) == cause and not Path("data").exists()
    server.cut = None
    assert command.main([TUM, "--from", address]) == 0
    assert server.ranges == [None, "bytes=16384-"]


def test_a_file_that_changed_during_an_interruption_is_fetched_anew(server: Server) -> None:
    address = server.address("/f3.tgz", b"another file" * 20_000)
    server.cut = 20_000
    failure([TUM, "--from", address])
    server.cut = None
    server.address("/f3.tgz", LAYOUTS[TUM][1]())
    assert command.main([TUM, "--from", address]) == 0


def test_an_archive_that_changed_since_its_first_use_is_refused(server: Server, tmp_path: Path) -> None:
    address = server.address("/f3.tgz", LAYOUTS[TUM][1]())
    command.main([TUM, "--from", address])
    pin = json.loads((tmp_path / "cache" / "pins.json").read_text())[address]
    server.address("/f3.tgz", tgz(tum_files("other")))
    words = [TUM, "--from", address, "--to", "again"]
    changed = f"the archive has changed since {pin['first']}: its SHA-256 is not the pinned {pin['sha256'][:12]}…"
    assert failure(words) == f"{address}: {changed}; give --repin if its publisher replaced it"
    assert not Path("again").exists() and not list((tmp_path / "cache").glob("*.tgz*"))
    assert command.main([*words, "--repin"]) == 0


@pytest.mark.parametrize("stated", [True, False])
def test_an_oversized_archive_is_refused(server: Server, stated: bool, tmp_path: Path) -> None:
    server.length_stated = stated
    address = server.address("/f3.tgz", bytes(3_000_000))
    message = failure([TUM, "--from", address, "--max-gb", "0.001"])
    assert re.fullmatch(re.escape(address) + r": has 0.00\d+ GB, more than the 0.001 GB allowed; give --max-gb N if that is right", message)
    assert not [file for file in (tmp_path / "cache").iterdir() if file.stat().st_size > 1000]


def test_an_archive_that_unpacks_to_too_much_is_refused(server: Server, tmp_path: Path) -> None:
    bomb = zipped(tum_files("plant_1") | {"plant_1/large.bin": bytes(30_000_000)})
    address = server.address("/plant_1_rgbd.zip", bomb)
    assert "unpacks to more than is allowed; give --max-gb N" in failure(["eth3d/plant_1", "--from", address, "--max-gb", "0.005"])
    assert not list((tmp_path / "data").rglob("*.bin"))


def test_a_damaged_archive_is_one_line_and_fetched_anew(server: Server, tmp_path: Path) -> None:
    good = LAYOUTS[TUM][1]()
    for bad in (good[: len(good) // 2], b"<html>moved</html>", good[:2000] + bytes(3000) + good[5000:]):
        address = server.address("/f3.tgz", bad)
        message = failure([TUM, "--from", address])
        assert "\n" not in message and ("is damaged" in message or "is neither a tar nor a zip archive" in message)
        assert not list((tmp_path / "cache").glob("*.tgz")) and not (tmp_path / "cache" / "pins.json").exists()
    address = server.address("/f3.tgz", good)
    assert command.main([TUM, "--from", address]) == 0


def test_what_cannot_be_reached_is_one_line(server: Server) -> None:
    address = server.address("/there", b"")
    assert failure([TUM, "--from", address + "/not"]) == (
        f"{address}/not: cannot be fetched (HTTP 404); check the network, or give --from with another address or file"
    )
    assert "ftp://host/file: is not an address of the web" in failure([TUM, "--from", "ftp://host/file"])
    assert "nothing.tgz: is not a file" in failure([TUM, "--from", "nothing.tgz"])
    server.httpd.shutdown()
    server.httpd.server_close()
    assert "cannot be fetched (no connection)" in failure([TUM, "--from", address])


def link(kind: bytes) -> bytes:
    out = io.BytesIO()
    with tarfile.open(fileobj=out, mode="w:gz") as archive:
        member = tarfile.TarInfo("sequence/rgb.txt")
        member.type, member.linkname = kind, "/etc/passwd"
        archive.addfile(member)
    return out.getvalue()


def zip_link() -> bytes:
    out = io.BytesIO()
    with zipfile.ZipFile(out, "w") as archive:
        member = zipfile.ZipInfo("sequence/rgb.txt")
        member.external_attr = 0o120777 << 16
        archive.writestr(member, "/etc/passwd")
    return out.getvalue()


@pytest.mark.parametrize(
    "data",
    [
        tgz({"../out.txt": b"x"}),
        tgz({"/tmp/out.txt": b"x"}),
        tgz({"sequence/rgb.txt": b"x", "sequence/../../out.txt": b"x"}),
        zipped({"../out.txt": b"x"}),
        zipped({"C:/out.txt": b"x"}),
        tgz({"sequence\\..\\..\\out.txt": b"x"}),
        link(tarfile.SYMTYPE),
        link(tarfile.LNKTYPE),
        link(tarfile.FIFOTYPE),
        zip_link(),
    ],
    ids=[f"archive {k}" for k in range(10)],
)
def test_no_member_leaves_the_folder(data: bytes, tmp_path: Path) -> None:
    archive = tmp_path / "archive"
    archive.write_bytes(data)
    (tmp_path / "inner").mkdir()
    with pytest.raises(DataError, match=r"would be written outside its folder; do not use|is a link or a device; do not use"):
        unpack(archive, tmp_path / "inner" / "target", Layout("rgb.txt"), 10**6)
    assert not list(tmp_path.rglob("out.txt")) and not (tmp_path / "inner" / "target" / "rgb.txt").exists()


def test_an_archive_of_something_else_is_named(tmp_path: Path) -> None:
    archive = tmp_path / "archive.zip"
    archive.write_bytes(zipped({"a/rgb.txt": b"", "b/rgb.txt": b""}))
    cases = [
        (Layout("traj.txt"), "holds no traj.txt"),
        (Layout("rgb.txt"), "holds several sequences: a, b"),
        (Layout("rgb.txt", "c"), "holds no folder c with rgb.txt"),
    ]
    for layout, cause in cases:
        with pytest.raises(DataError) as caught:
            unpack(archive, tmp_path / "target", layout, 10**6)
        assert caught.value.cause == cause


def test_names_and_lists(capsys: pytest.CaptureFixture[str]) -> None:
    assert command.main([]) == 0
    said = capsys.readouterr().out
    assert all(name in said for name in ("tum", "icl_nuim", "seven_scenes", "tamu", "replica", "bonn", "eth3d")) and said.count("not verified") == 7
    assert command.main(["tamu"]) == 0 and "no address of archives is known" in capsys.readouterr().out
    with pytest.raises(UsageError, match="there is no sequence 'tum/fr3_structure_notexture'; did you mean 'tum/fr3_structure_notexture_"):
        command.main(["tum/fr3_structure_notexture"])
    with pytest.raises(DataError, match="tamu/corridor_a: no address of its archive is known; fetch it from http"):
        command.main(["tamu/corridor_a"])
    known = command.sequences()
    assert known[TUM].archive == "https://cvg.cit.tum.de/rgbd/dataset/freiburg3/rgbd_dataset_freiburg3_structure_notexture_far.tgz"
    assert known["seven_scenes/chess/seq-02"].archive.endswith("/chess.zip") and known["seven_scenes/chess/seq-02"].nested == "chess/seq-02.zip"
    assert known["icl_nuim/of_kt3"].archive == "https://www.doc.ic.ac.uk/~ahanda/traj3_frei_png.tar.gz"
    assert all(s.archive.startswith("https://") for s in known.values() if s.collection != "tamu")
