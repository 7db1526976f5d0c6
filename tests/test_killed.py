"""A plug that is pulled, a disk that is full: what was recorded until then is there, and one command gives it its index."""

import errno
import io
import json
import os
import resource
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
from mcap.reader import make_reader

from trihedron.pipeline.app.cli import main
from trihedron.pipeline.core.errors import RecordingError
from trihedron.pipeline.core.types import FrameReference
from trihedron.pipeline.record import mcap_writer
from trihedron.pipeline.record.reader import Recording
from trihedron.pipeline.record.writer import RecordingWriter

sys.path.insert(0, str(Path(__file__).parent / "pipeline"))
from toys import CAMERA, contents

PACED = """
import sys, time
from pathlib import Path
from trihedron.pipeline.core.types import Camera
from trihedron.pipeline.record.writer import RecordingWriter
from trihedron.pipeline.core.types import FrameReference, LineSegments
import numpy as np
writer, lines = RecordingWriter(Path(sys.argv[1]), {}), np.random.default_rng(0).random((2000, 2, 2), dtype=np.float32)
for i in range(3000):
    writer.write("frames", FrameReference(i, 33_000_000 * i, Camera(8, 6, 4.0, 4.0, 3.5, 2.5)))
    writer.write("lines", LineSegments(i, 33_000_000 * i, lines, np.empty((2000, 0), np.uint8)))
    print(i, time.monotonic(), flush=True)
    time.sleep(0.033)
"""
TRACKED = """
import sys, time
from trihedron.pipeline.app.cli import main
from trihedron.pipeline.run.recorder import Recorder
frame = Recorder.frame
def reported(self, index, *rest):
    frame(self, index, *rest)
    print("recorded", index, time.monotonic(), file=sys.stderr, flush=True)
Recorder.frame = reported
words = ["dataset=synthetic", "dataset.length=900", "dataset.width=320", "dataset.height=240", "record.frames=true"]
sys.exit(main(["run", *words, f"out={sys.argv[1]}"]))
"""


def killed(process, stream, after_s):
    """Kill it `after_s` after its first frame; the frames it had recorded, with the times."""
    recorded, end = [], None
    for line in stream:
        words = line.split()
        if len(words) >= 2 and words[-2].isdigit():
            recorded.append((int(words[-2]), float(words[-1])))
            end = end or recorded[0][1] + after_s
            if time.monotonic() > end:
                break
    process.send_signal(signal.SIGKILL)
    recorded += [(int(words[-2]), float(words[-1])) for words in map(str.split, stream) if len(words) >= 2 and words[-2].isdigit()]
    assert process.wait() == -signal.SIGKILL
    return recorded


def check(path, recorded, capsys):
    """The file refuses with the command that helps; after it, all is there that was recorded a second before the end."""
    with pytest.raises(RecordingError) as error:
        Recording(path)
    assert str(error.value).endswith(f"rescue what is whole with: trihedron recover {path}")
    assert main(["recover", str(path)]) == 0
    said = capsys.readouterr().out.splitlines()[-1]
    assert said.startswith(f"{path}: ") and "messages on" in said
    frames = [value.index for value in Recording(path).values("frames")]
    promised = [index for index, when in recorded if when < recorded[-1][1] - 1.0]
    assert frames == list(range(len(frames))) and len(frames) >= len(promised)
    return len(recorded) - len(frames)


def test_a_killed_writer_loses_less_than_a_second(tmp_path, capsys):
    rng, processes = np.random.default_rng(), []
    for i in range(3):
        command = [sys.executable, "-c", PACED, str(tmp_path / f"{i}.mcap")]
        processes.append(subprocess.Popen(command, stdout=subprocess.PIPE, text=True))
    for i, process in enumerate(processes):
        recorded = killed(process, process.stdout, rng.uniform(1.2, 1.8))
        assert recorded[-1][0] > 5
        check(tmp_path / f"{i}.mcap", recorded, capsys)


@pytest.mark.slow
def test_twenty_runs_killed_at_random_moments(tmp_path, capsys):
    rng, lines = np.random.default_rng(), []
    for i in range(20):
        out = tmp_path / str(i)
        process = subprocess.Popen([sys.executable, "-c", TRACKED, str(out)], stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True)
        recorded = killed(process, process.stderr, rng.uniform(0.1, 6.0))
        lost = check(out / "run.mcap", recorded, capsys)
        lines.append(f"killed after {len(recorded)} frames: {lost} lost")
        if i % 5 == 0 and len(recorded) > lost:
            again = tmp_path / f"again{i}"
            words = [f"replay={out}/run.mcap", "only=[rotation]", f"out={again}"]
            run = "import sys; from trihedron.pipeline.app.cli import main; sys.exit(main(['run', *sys.argv[1:]]))"
            done = subprocess.run([sys.executable, "-c", run, *words], capture_output=True, text=True)
            assert done.returncode == 0, done.stderr
            assert contents(again / "run.mcap").get("/rotation") == contents(out / "run.mcap").get("/rotation")
    print("\n".join(lines))


def recording(path, count, writer=None):
    writer = writer or RecordingWriter(path, {"overrides": "[]"})
    writer.attach("groundtruth.txt", "# none")
    for i in range(count):
        writer.write("frames", FrameReference(i, 1000 * i, CAMERA))
    return writer


def test_a_file_cut_anywhere_gives_its_beginning(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(mcap_writer, "CHUNK_BYTES", 3_000)
    recording(tmp_path / "a.mcap", 60).close()
    whole, rng = (tmp_path / "a.mcap").read_bytes(), np.random.default_rng(0)
    counts = []
    for size in sorted(rng.integers(200, len(whole), 40)):
        (tmp_path / "cut.mcap").write_bytes(whole[:size])
        assert main(["recover", str(tmp_path / "cut.mcap"), "--out", str(tmp_path / "out.mcap")]) == 0
        assert (tmp_path / "cut.mcap").stat().st_size == size
        if "copied 0 messages" not in capsys.readouterr().out:
            rescued = Recording(tmp_path / "out.mcap")
            frames = [value.index for value in rescued.values("frames")]
            assert frames == list(range(len(frames))) and rescued.attachments == {"groundtruth.txt": "# none"}
            counts.append(len(frames))
    assert counts == sorted(counts) and counts[-1] == 60 and counts[0] < 15
    assert main(["recover", str(tmp_path / "a.mcap")]) == 0 and capsys.readouterr().out.endswith("s; the file has its end mark\n")
    assert main(["recover", str(tmp_path / "out.txt")]) == 1
    assert "cannot be read: No such file" in capsys.readouterr().err


def test_of_a_damaged_file_the_other_chunks_are_kept(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(mcap_writer, "CHUNK_BYTES", 3_000)
    recording(tmp_path / "a.mcap", 60).close()
    data = bytearray((tmp_path / "a.mcap").read_bytes())
    summary = make_reader(io.BytesIO(data)).get_summary()
    assert summary is not None
    chunk = summary.chunk_indexes[-1]
    data[chunk.chunk_start_offset + chunk.chunk_length // 2] ^= 0xFF
    (tmp_path / "a.mcap").write_bytes(data)
    with pytest.raises(RecordingError, match=r"channel /frames is damaged.*rescue what is whole with: trihedron recover"):
        list(Recording(tmp_path / "a.mcap").values("frames"))
    assert main(["recover", str(tmp_path / "a.mcap")]) == 0
    assert "; skipped 1 damaged chunks; " in capsys.readouterr().out
    assert 30 < len(list(Recording(tmp_path / "a.mcap").values("frames"))) < 60


def test_a_file_that_is_being_written(tmp_path, capsys):
    path = tmp_path / "a.mcap"
    writer = recording(path, 3)
    with pytest.raises(RecordingError) as error:
        RecordingWriter(path, {})
    assert str(error.value) == f"{path}: is being written by another process; wait until that has ended, or give another out=FOLDER"
    with pytest.raises(RecordingError, match="is still being written; wait until its run has ended"):
        Recording(path)
    assert main(["recover", str(path)]) == 1
    assert "is still being written" in capsys.readouterr().err
    writer.close()
    assert len(list(Recording(path).values("frames"))) == 3


def test_a_disk_that_fills_up_costs_the_last_chunk(tmp_path, monkeypatch):
    """The write fails in the middle of a chunk; so does the next one, which is tried in vain."""
    monkeypatch.setattr(mcap_writer, "CHUNK_BYTES", 3_000)
    real, path = os.write, tmp_path / "a.mcap"

    def limited(descriptor, data):
        room = 6_000 - os.fstat(descriptor).st_size
        if room <= 0:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        return real(descriptor, bytes(data)[:room])

    monkeypatch.setattr(mcap_writer.os, "write", limited)
    writer = RecordingWriter(path, {"overrides": "[]"})
    for i in range(200):
        writer.write("frames", FrameReference(i, 1000 * i, CAMERA))
    with pytest.raises(RecordingError) as error:
        writer.close()
    line = f"{path}: cannot be written: No space left on device; what was written before is kept; index it with: trihedron recover {path}"
    assert str(error.value) == line
    monkeypatch.setattr(mcap_writer.os, "write", real)
    assert path.stat().st_size <= 6_000 and main(["recover", str(path)]) == 0
    frames = [value.index for value in Recording(path).values("frames")]
    assert frames == list(range(len(frames))) and len(frames) > 10


@pytest.mark.slow
def test_a_run_without_room_for_its_recording_still_tracks(tmp_path):
    """The file may not grow beyond 5 MB, a few chunks; trajectory and metrics are smaller."""
    code = "import sys; from trihedron.pipeline.app.cli import main; sys.exit(main(['run', *sys.argv[1:]]))"
    words = ["dataset=synthetic", "dataset.length=90", "dataset.width=160", "dataset.height=120", "record.frames=true", f"out={tmp_path}/run"]
    limit = (5_000_000, resource.RLIM_INFINITY)
    done = subprocess.run(
        [sys.executable, "-c", code, *words], capture_output=True, text=True, preexec_fn=lambda: resource.setrlimit(resource.RLIMIT_FSIZE, limit)
    )
    path = tmp_path / "run" / "run.mcap"
    assert done.returncode == 1, done.stdout + done.stderr
    lines = done.stderr.strip().splitlines()
    assert f"trihedron: warning: {path}: cannot be written: File too large; the rest is done without it" in lines
    assert lines[-1] == (
        f"trihedron: {path}: cannot be written: File too large; what was written before is kept; index it with: trihedron recover {path}"
    )
    assert "Traceback" not in done.stderr
    assert json.loads((tmp_path / "run" / "metrics.json").read_text())["frames"] == 90
    assert main(["recover", str(path)]) == 0 and 0 < len(list(Recording(path).values("frames"))) < 90


def test_a_folder_that_cannot_be_made_is_one_line(tmp_path):
    code = "import sys; from trihedron.pipeline.app.cli import main; sys.exit(main(['run', *sys.argv[1:]]))"
    words = ["dataset=synthetic", "dataset.length=2", "outputs=[keypoints]", "out=/proc/nowhere"]
    done = subprocess.run([sys.executable, "-c", code, *words], capture_output=True, text=True, cwd=tmp_path)
    assert done.returncode == 1 and len(done.stderr.strip().splitlines()) == 1 and done.stderr.startswith("trihedron: "), done.stderr
