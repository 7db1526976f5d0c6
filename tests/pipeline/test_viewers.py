"""Live views: a WebSocket client of Foxglove's protocol, rerun's viewer, previews of a fold, viewers that are slow or closed."""

from __future__ import annotations

import json
import os
import re
import signal
import socket
import struct
import subprocess
import sys
import threading
import time
import urllib.request
from collections.abc import Iterator
from contextlib import contextmanager, nullcontext, suppress
from pathlib import Path
from typing import Any

import pytest
from foxglove_schemas_protobuf.CompressedImage_pb2 import CompressedImage
from foxglove_schemas_protobuf.FrameTransform_pb2 import FrameTransform
from websockets.exceptions import InvalidStatus
from websockets.sync.client import connect

import trihedron as th
from trihedron.datasets.simulation.synthetic import Synthetic
from trihedron.pipeline.app.cli import main
from trihedron.pipeline.app.viewers import Viewer
from trihedron.pipeline.core.types import Map, Surface
from trihedron.pipeline.record import rerun_viewer
from trihedron.pipeline.record.foxglove_server import FoxgloveServer
from trihedron.pipeline.record.rerun_viewer import RerunViewer
from trihedron.pipeline.record.writer import RecordingWriter
from trihedron.pipeline.run.interrupts import ending_signals_interrupt, wait_for_the_end
from trihedron.pipeline.run.rerun_sink import WAITING, RerunSink
from trihedron.pipeline.run.runner import Runner
from trihedron.pipeline.run.sinks import MemorySink
from trihedron.tools import view

sys.path.insert(0, str(Path(__file__).parent))
from toys import ToySurface, toy_graph

ROOM = Synthetic(width=160, height=120)
LENGTH = 10


def free_port() -> int:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])


class Client:
    """Subscribes to channels of the server as they are advertised, and collects their messages. A channel that the server advertises before it
    knows it for this client, which happens on a busy machine, is asked for again."""

    def __init__(self, port: int, topics: set[str]) -> None:
        self.socket = connect(f"ws://localhost:{port}", subprotocols=["foxglove.sdk.v1"], max_size=None).__enter__()  # type: ignore[list-item]
        self.channels: dict[int, dict[str, Any]] = {}
        self.messages: list[tuple[str, int, bytes]] = []  # topic, log time, content
        self._topics = topics
        self._thread = threading.Thread(target=self._receive, daemon=True)
        self._thread.start()

    def _receive(self) -> None:
        for message in self.socket:
            if isinstance(message, bytes):
                opcode, subscription, stamp_ns = struct.unpack_from("<BIQ", message)
                assert opcode == 1
                self.messages.append((self.channels[subscription]["topic"], stamp_ns, message[13:]))
                continue
            content = json.loads(message)
            if content["op"] == "advertise":
                self.channels |= {channel["id"]: channel for channel in content["channels"]}
                self._subscribe([channel["id"] for channel in content["channels"] if channel["topic"] in self._topics])
            elif content["op"] == "status" and (unknown := re.match(r"Unknown channel ID: (\d+)", content["message"])):
                time.sleep(0.05)
                self._subscribe([int(unknown[1])])

    def _subscribe(self, ids: list[int]) -> None:
        self.socket.send(json.dumps({"op": "subscribe", "subscriptions": [{"id": id, "channelId": id} for id in ids]}))

    def closed(self) -> list[tuple[str, int, bytes]]:
        """Wait until the server closes the connection; return the messages."""
        self._thread.join(30)
        assert not self._thread.is_alive()
        return self.messages


def test_a_websocket_client_sees_the_run(tmp_path: Path) -> None:
    port = free_port()
    with th.Slam(ROOM(0).camera, "view=foxglove", f"view.port={port}", out=tmp_path / "run") as slam:
        client = Client(port, {"/tf", "/view/image", "/timing"})
        leaver = connect(f"ws://localhost:{port}", subprotocols=["foxglove.sdk.v1"]).__enter__()  # type: ignore[list-item]
        for i in range(LENGTH):
            frame = ROOM(i)
            pose = slam.track(frame.color, frame.depth_m, frame.stamp_ns / 1e9)
            if i == 3:
                leaver.close()
    messages = client.closed()
    transforms = [(stamp_ns, FrameTransform.FromString(content)) for topic, stamp_ns, content in messages if topic == "/tf"]
    assert transforms[-1][0] == ROOM(LENGTH - 1).stamp_ns
    place = transforms[-1][1].translation
    assert [place.x, place.y, place.z] == pose.T_world_camera[:3, 3].tolist()
    images = [CompressedImage.FromString(content) for topic, _, content in messages if topic == "/view/image"]
    assert images and images[0].format == "jpeg"
    names = {channel["topic"] for channel in client.channels.values()}
    assert {"/view/features", "/view/path", "/view/planes", "/view/axes", "/view/map_points", "/view/pose", "/timing"} <= names
    assert "/pose" not in names  # values are for the file
    assert len(th.Recording(tmp_path / "run").poses) == LENGTH


def test_viewers_change_no_byte(tmp_path: Path) -> None:
    words = ["dataset.width=160", "dataset.height=120", f"dataset.length={LENGTH}"]
    runs = [
        th.run(*words, out=tmp_path / "plain", quiet=True),
        th.run(*words, "view=foxglove", "view.port=0", out=tmp_path / "seen", quiet=True),
    ]
    plain, seen = (run.recording._file for run in runs)
    for topic in plain.topics:
        assert list(plain.messages(f"/{topic}")) == list(seen.messages(f"/{topic}")), topic


def test_a_viewer_that_cannot_be_opened_is_one_line_and_leaves_no_folder(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        port = taken.getsockname()[1]
        assert main(["run", "view=foxglove", f"view.port={port}", f"out={tmp_path / 'none'}"]) == 1
    printed = capsys.readouterr().err
    assert printed.startswith(f"trihedron: view.port: {port} cannot be opened: ") and printed.endswith(
        "; give another view.port, 0 for any that is free\n"
    )
    assert main(["run", "view.port=9", f"out={tmp_path / 'none'}"]) == 1
    assert capsys.readouterr().err == "trihedron: view.port: no viewer with this option is chosen; give view=foxglove or view=rerun too\n"
    for option, cure in (("prt", "did you mean 'port'?"), ("web", "it belongs to view=rerun")):
        assert main(["run", "view=foxglove", f"view.{option}=1", f"out={tmp_path / 'none'}"]) == 1
        assert capsys.readouterr().err == f"trihedron: view.{option}: view=foxglove has no option '{option}'; {cure}\n"
    assert main(["run", "view=foxgloves", f"out={tmp_path / 'none'}"]) == 1
    assert capsys.readouterr().err == "trihedron: view: there is no view 'foxgloves'; did you mean 'foxglove'?\n"
    assert not (tmp_path / "none").exists()


class Preview(ToySurface):
    """A fold that shows what it has so far: its stamps are those of the frames."""

    def preview(self, state: Any) -> Surface:
        return self.finish(state, None)


def test_folds_are_previewed_to_sinks() -> None:
    memory = MemorySink(3, {"pose"})
    previews: list[tuple[str, int]] = []
    memory.preview = lambda name, value: previews.append((name, len(value.vertices_m)))  # type: ignore[method-assign, assignment]
    runner = Runner(toy_graph(surface=Preview()), threads=2, preview_period=4)
    positions = [step.position for step in runner.steps(None, frozenset(), sinks=[memory])]
    taken = memory.folds["surface"].vertices_m[:, 0]  # numbers of the frames that had a pose
    assert previews == [("surface", sum(taken < count)) for count in range(4, len(positions) + 1, 4)]
    assert [index for index, _ in memory.frames] == positions[-3:]
    assert all(set(values) <= {"pose"} for _, values in memory.frames)
    assert memory.folds["surface"] is runner.result.folds["surface"]


class SlowStream:
    """A rerun stream that blocks until it is released."""

    def __init__(self) -> None:
        self.go, self.logged = threading.Event(), 0

    def log(self, *entity: Any, **options: Any) -> None:
        if self.logged:
            self.go.wait()
        self.logged += 1

    def set_time(self, *time: Any, **options: Any) -> None:
        self.go.wait()

    def flush(self, timeout_sec: float) -> None:
        """Nothing waits."""


def test_a_slow_viewer_does_not_slow_the_run() -> None:
    stream = SlowStream()
    sink = RerunSink(stream)
    count = len(list(Runner(toy_graph(), threads=2).steps(None, frozenset(), sinks=[sink])))  # ends although nothing is shown
    assert count > WAITING + 2
    stream.go.set()
    sink.close()
    assert stream.logged > 0


def test_show_opens_rerun_during_a_run(monkeypatch: pytest.MonkeyPatch) -> None:
    """It gets what there is so far, each further frame, and the surface at the end, when it is closed."""
    seen: list[str] = []

    class Sink:
        def frame(self, index: int, stamp_ns: int, values: Any, times: Any) -> None:
            seen.append(f"frame {index}")

        def preview(self, name: str, value: Any) -> None:
            seen.append(f"preview {name} {value.index}")

        def fold(self, name: str, value: Any) -> None:
            seen.append(f"fold {name}")

    @contextmanager
    def opened(config: Any) -> Iterator[Viewer]:
        if config.view is None:
            yield Viewer()
            return
        assert (config.view.viewer, config.view.web, config.view.port, config.view.web_port) == ("rerun", True, 1, 2)
        yield Viewer(sinks=(Sink(),))  # type: ignore[arg-type]
        seen.append("closed")

    monkeypatch.setattr("trihedron.slam.opened_viewer", opened)
    with th.Slam(ROOM(0).camera, threads=1, outputs=["trajectory", "surface"]) as slam:
        for k in range(3):
            slam.track(ROOM(k).color, ROOM(k).depth_m, ROOM(k).stamp_ns / 1e9)
            if k == 1:
                slam.show(port=1, web_port=2)
                so_far, seen = seen, []
    assert {"preview dataset 1", "preview pose 1", "preview planes 1", "preview surface 1"} <= set(so_far)
    assert any(line.startswith("preview map ") for line in so_far)
    assert seen == ["frame 2", "fold surface", "closed"]
    with pytest.raises(th.TrihedronError, match="Slam: is closed"):
        slam.show()


@pytest.mark.slow
def test_rerun_has_everything(tmp_path: Path) -> None:
    import rerun

    stream = rerun.RecordingStream("test")
    stream.save(tmp_path / "a.rrd")
    sink = RerunSink(stream)
    program = "run", "dataset.width=160", "dataset.height=120", "dataset.length=6", "outputs=[trajectory,surface]"
    import trihedron.pipeline.app.viewers as viewers

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(viewers, "opened_rerun", lambda host, port, web_port: nullcontext(RerunViewer(stream)))
        assert main([*program, "view=rerun", "view.keep=false", f"out={tmp_path / 'run'}"]) == 0
    sink.close()
    stream.disconnect()
    done = subprocess.run([sys.executable, "-m", "rerun", "rrd", "print", str(tmp_path / "a.rrd")], capture_output=True, text=True)
    printed = done.stdout + done.stderr
    for path in (
        "/world/camera/image",
        "/world/camera/keypoints",
        "/world/camera/axes",
        "/world/map/points",
        "/world/surface",
        "/status",
        "/times/pose",
    ):
        assert path in printed, path


def test_a_recording_without_a_file_writes_nowhere() -> None:
    server = FoxgloveServer(0)
    writer = RecordingWriter(None, {}, server)
    writer.write("map", Map.__new__(Map))  # is not encoded
    writer.close()
    server.close()


def test_a_client_that_says_nothing_does_not_hold_the_run() -> None:
    """A connection without a handshake: closing ends after two seconds, and so does the process."""
    program = (
        "import socket; from trihedron.pipeline.record.foxglove_server import FoxgloveServer; server = FoxgloveServer(0); "
        "silent = socket.create_connection(('127.0.0.1', int(server.url.rpartition(':')[2]))); server.close(); print('closed')"
    )
    assert subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, timeout=60).stdout == "closed\n"


@pytest.mark.parametrize(
    "origin, allowed",
    [
        (None, True), ("http://localhost:8080", True), ("http://127.0.0.1:3000", True), ("https://app.foxglove.dev", True), ("file://", True),
        ("https://example.org", False), ("https://notfoxglove.dev", False), ("http://app.foxglove.dev", False), ("null", False),
        ("http://[", False), ("https://app.foxglove.dev.example.org", False),
    ],
)  # fmt: skip
def test_a_page_of_a_foreign_site_cannot_read_the_stream(origin: str | None, allowed: bool) -> None:
    server = FoxgloveServer(0)
    try:
        options: Any = {"origin": origin, "subprotocols": ["foxglove.sdk.v1"]}
        if allowed:
            with connect(server.url, **options) as client:
                assert json.loads(client.recv())["name"] == "trihedron"
        else:
            with pytest.raises(InvalidStatus) as error:
                connect(server.url, **options)
            assert error.value.response.status_code == 403
    finally:
        server.close()


TINY = ["dataset.width=160", "dataset.height=120", "dataset.length=6"]


class Kept:
    """A command that goes on serving. `line` is the one that says so; what it printed before is in `printed`."""

    def __init__(self, *words: str) -> None:
        listen = "import signal, sys; signal.signal(signal.SIGINT, signal.default_int_handler); "  # which a shell's background jobs ignore
        command = [sys.executable, "-c", listen + "from trihedron.pipeline.app.cli import main; sys.exit(main())", *words]
        self.process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
        self.printed: list[str] = []
        self.errors = ""
        assert self.process.stdout is not None
        while "is served until" not in (line := self.process.stdout.readline()):
            assert line, self.process.communicate()[1]
            self.printed.append(line)
        self.line = line

    def end(self, number: int) -> int:
        """Send the signal; return the exit code."""
        self.process.send_signal(number)
        self.errors = self.process.communicate(timeout=60)[1]
        return self.process.returncode


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_foxglove_server_stays_with_what_was_last_shown(number: int, tmp_path: Path) -> None:
    port = free_port()
    kept = Kept("run", *TINY, "view=foxglove", f"view.port={port}", f"out={tmp_path}")
    try:
        assert kept.line == f"view: ws://127.0.0.1:{port} is served until Ctrl-C or SIGTERM; view.keep=false ends it with the run\n"
        assert f"  {tmp_path / 'metrics.json'}\n" in kept.printed and len(th.Recording(tmp_path).poses) == 6
        shown = {"/tf", "/view/image", "/view/path", "/view/map_points"}
        late = Client(port, shown)
        for _ in range(300):
            if {topic for topic, _, _ in late.messages} == shown:
                break
            time.sleep(0.1)
        assert {topic for topic, _, _ in late.messages} == shown
        assert (kept.end(number), kept.errors) == (0, "")
        late.closed()
    finally:
        kept.process.kill()


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM, signal.SIGHUP])
def test_the_announced_end_is_no_interruption_however_often_it_is_asked_for(number: int) -> None:
    usual = signal.default_int_handler if number == signal.SIGINT else signal.SIG_DFL
    before = signal.signal(number, usual)
    try:
        with ending_signals_interrupt():
            threading.Timer(0.1, os.kill, (os.getpid(), number)).start()
            wait_for_the_end("served")
            for _ in range(3):
                os.kill(os.getpid(), number)
        assert signal.getsignal(number) == usual
    finally:
        signal.signal(number, before)


def test_the_announced_end_may_be_asked_for_at_once(monkeypatch: pytest.MonkeyPatch) -> None:
    """The signal comes while the line that announces it is printed."""
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    printed: list[str] = []

    def write(text: str, flush: bool) -> None:
        printed.append(text)
        signal.raise_signal(signal.SIGINT)

    monkeypatch.setattr("builtins.print", write)
    try:
        with ending_signals_interrupt():
            wait_for_the_end("served until Ctrl-C")
    finally:
        signal.signal(signal.SIGINT, before)
    assert printed == ["served until Ctrl-C"]


def test_a_server_that_is_not_kept_ends_with_the_run(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["run", *TINY, "view=foxglove", "view.port=0", "view.keep=false", "view.host=127.0.0.1", f"out={tmp_path}"]) == 0
    assert "is served until" not in capsys.readouterr().out


def test_no_window_without_a_display(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    monkeypatch.setattr(sys, "platform", "linux")
    for name in ("DISPLAY", "WAYLAND_DISPLAY"):
        monkeypatch.delenv(name, raising=False)
    assert main(["run", "view=rerun", f"out={tmp_path / 'none'}"]) == 1
    line = "trihedron: view: there is no display (DISPLAY and WAYLAND_DISPLAY are not set); give view.web=true for a browser\n"
    assert capsys.readouterr().err == line and not (tmp_path / "none").exists()


def page(url: str) -> bytes:
    with urllib.request.urlopen(url, timeout=10) as answer:
        content: bytes = answer.read()
    return content


def other_address() -> str:
    """An address of this machine that is not the loopback's, or nothing."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        try:
            probe.connect(("192.0.2.1", 9))  # sends nothing
        except OSError:
            return ""
        return str(probe.getsockname()[0])


@pytest.mark.slow
def test_rerun_is_served_to_this_machine_until_the_end(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    pytest.importorskip("rerun")
    port, web_port = free_port(), free_port()
    url = f"http://127.0.0.1:{web_port}?url=rerun%2Bhttp%3A%2F%2F127.0.0.1%3A{port}%2Fproxy"
    ports = f"view.port={port}", f"view.web_port={web_port}"
    kept = Kept("run", *TINY, "view=rerun", "view.web=true", *ports, f"out={tmp_path / 'run'}")
    try:
        assert kept.printed[0] == f"view: open {url} in a browser\n" and url in kept.line
        assert b"rerun" in page(url).lower()
        for number in (port, web_port) if other_address() else ():
            with pytest.raises(OSError):
                socket.create_connection((other_address(), number), timeout=5).close()
        assert main(["run", "view=rerun", "view.web=true", *ports, f"out={tmp_path / 'none'}"]) == 1
        assert capsys.readouterr().err == f"trihedron: view.port: {port} is in use; give another view.port\n"
        assert (kept.end(signal.SIGTERM), kept.errors) == (0, "")
    finally:
        kept.process.kill()
    with pytest.raises(OSError):
        page(url)
    kept = Kept("view", str(tmp_path / "run"), "--web", "--port", str(port), "--web-port", str(web_port))
    try:
        assert kept.printed == [f"6 frames of {tmp_path / 'run' / 'run.mcap'}\n"]
        assert kept.line == f"view: {url} is served until Ctrl-C or SIGTERM\n"
        assert b"rerun" in page(url).lower() and (kept.end(signal.SIGINT), kept.errors) == (0, "")
    finally:
        kept.process.kill()


class Shown:
    """A stream that only counts the frames at whose time something was logged."""

    def __init__(self) -> None:
        self.frames: list[int] = []

    def set_time(self, timeline: str, *, sequence: int | None = None, **_: object) -> None:
        self.frames += [] if sequence is None else [sequence]

    def __getattr__(self, name: str) -> Any:
        return lambda *_, **__: None


def test_a_recording_that_grows_is_shown_to_its_end(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    pytest.importorskip("rerun")
    shown, path = Shown(), tmp_path / "run" / "run.mcap"
    monkeypatch.setattr(rerun_viewer, "opened_rerun", lambda host, port, web_port: nullcontext(rerun_viewer.RerunViewer(shown, "http://page")))
    monkeypatch.setattr(view, "keep_serving", lambda url: print(f"kept {url}"))
    words = ["dataset.width=160", "dataset.height=120", "dataset.length=60", "real_time=true", "dataset.fps=10", f"out={path.parent}"]
    program = "import sys; from trihedron.pipeline.app.cli import main; sys.exit(main(['run', *sys.argv[1:]]))"
    writing = subprocess.Popen([sys.executable, "-c", program, *words], stdout=subprocess.DEVNULL)
    try:
        while not path.is_file() or path.stat().st_size < 30_000:
            assert writing.poll() is None
            time.sleep(0.05)
        assert main(["view", str(path.parent), "--web"]) == 0
        assert writing.wait(60) == 0
    finally:
        writing.kill()
    printed = capsys.readouterr()
    assert printed.err == ""
    lines = rf"view: (\d+) frames so far at http://page; new ones are shown until the run ends\n60 frames of {path}\nkept http://page\n"
    so_far = re.fullmatch(lines, printed.out)
    assert so_far is not None and int(so_far[1]) < 60 and set(shown.frames) == set(range(60))


@pytest.mark.slow
@pytest.mark.skipif(sys.platform != "linux", reason="children are read from /proc")
def test_a_frozen_rerun_does_not_hold_a_run_that_is_ended(tmp_path: Path) -> None:
    """The server of the page stands still (SIGSTOP) in the middle of the run, beside a client that connects and never reads."""
    pytest.importorskip("rerun")
    port, web_port = free_port(), free_port()
    words = ["view=rerun", "view.web=true", f"view.port={port}", f"view.web_port={web_port}", f"out={tmp_path}"]
    words += ["dataset.width=160", "dataset.height=120", "dataset.length=3000"]
    program = "import sys; from trihedron.pipeline.app.cli import main; sys.exit(main(['run', *sys.argv[1:]]))"
    run = subprocess.Popen([sys.executable, "-c", program, *words], stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True)
    path, frozen = tmp_path / "run.mcap", []
    try:
        while not path.is_file() or path.stat().st_size < 100_000:
            assert run.poll() is None
            time.sleep(0.05)
        with socket.create_connection(("127.0.0.1", port), timeout=5):
            frozen = descendants(run.pid)
            for process in frozen:
                os.kill(process, signal.SIGSTOP)
            time.sleep(2.0)
            run.send_signal(signal.SIGTERM)
            _, errors = run.communicate(timeout=30)
        for number in (port, web_port):  # the server has not outlived the run
            with pytest.raises(OSError):
                socket.create_connection(("127.0.0.1", number), timeout=5).close()
    finally:
        run.kill()
        for process in frozen:
            with suppress(ProcessLookupError):
                os.kill(process, signal.SIGKILL)
    assert frozen and "Traceback" not in errors
    recording = th.Recording(path)
    assert len(recording.poses) > 5 and (tmp_path / "trajectory.txt").is_file() and (tmp_path / "metrics.json").is_file()


def descendants(parent: int) -> list[int]:
    """The processes that were started by a process, and by those in turn."""
    children = [int(word) for file in Path(f"/proc/{parent}/task").glob("*/children") for word in file.read_text().split()]
    return children + [process for child in children for process in descendants(child)]
